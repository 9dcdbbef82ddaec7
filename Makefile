# On a fresh machine with Python and pip: `make demo` cleans a synthetic take, `make test` runs the tests, `make docs` builds the site.

PYTHON ?= python3
VENV := .venv
PIP_INSTALL := $(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

.PHONY: demo test test-package test-lab test-lab-slice bench docs dist install addon blender browser gltf-validator lint clean

demo: $(VENV)/installed
	@$(VENV)/bin/mocapfix demo

# The tests of the product, in two processes, each with one thread for linear algebra: with two each, threads wait for one another.
# The kernels are compiled before: each process of tests would compile most of them itself. A file is run by one process, which
# then composes and cleans its takes once.
PYTEST := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1 $(VENV)/bin/python -m pytest --numprocesses 2 --dist loadfile \
	--durations 20
test: $(VENV)/installed-dev
	$(VENV)/bin/python -m mocapfix.kernels.compilation
	$(PYTEST) --ignore tests/lab --ignore tests/test_packaging.py

# The sdist and the wheel, checked and installed into an empty environment, in which a take is cleaned.
test-package: $(VENV)/installed-dev
	$(VENV)/bin/python -m pytest tests/test_packaging.py

# The tests of benchmarks, training and fuzzing; test-lab-slice is the part of them that every change must pass.
LAB_SLICE := $(addprefix tests/lab/test_,baseline.py damaged_take.py fuzz.py settings.py stage_takes.py)
test-lab: $(VENV)/installed-dev
	$(PYTEST) tests/lab
test-lab-slice: $(VENV)/installed-dev
	$(PYTEST) $(LAB_SLICE)

# Accuracy, speed and memory against scenes/bench/baseline.json. Fails if anything became worse than its tolerance.
bench: $(VENV)/installed-dev
	$(VENV)/bin/mocapfix bench baseline

# The documentation as a site, in site/index.html. Any warning is an error.
docs: $(VENV)/installed-dev
	$(VENV)/bin/mkdocs build --strict --quiet

# The packages to publish, in dist/: the wheel is built from the sdist.
dist: $(VENV)/installed-dev
	rm -f dist/mocapfix-*
	$(VENV)/bin/python -m build --no-isolation
	$(VENV)/bin/python -m twine check --strict dist/mocapfix-*

install: $(VENV)/installed-dev

# The Blender add-on as an extension, dist/mocapfix_blender-VERSION.zip. It needs no packages.
addon:
	$(PYTHON) addon/build_addon.py dist

# Blender as a Python module, for tests/blender and tests/addon. It has its own environment, since it needs Python 3.11 and its own version of NumPy.
blender: .blender/installed

# Chromium for tests/review/test_page.py, from the system's packages; without it these tests are skipped.
browser:
	@command -v chromium >/dev/null || (apt-get update -q && apt-get install -qy --no-install-recommends chromium) >/dev/null \
		|| echo "Chromium could not be installed, so the tests of the review page are skipped; install it with the system's packages."

# Khronos' validator of glTF, for tests/characters/test_character_glb.py, from npm; without it this test is skipped.
gltf-validator: .gltf-validator/installed

lint: $(VENV)/installed-dev
	$(VENV)/bin/ruff check
	$(VENV)/bin/ruff format --check
	$(VENV)/bin/pyright

clean:
	rm -rf $(VENV) .blender .gltf-validator dist site .pytest_cache .ruff_cache .hypothesis
	find mocapfix tests -name __pycache__ -prune -exec rm -rf {} +

# These files are stamps: a second call installs nothing unless the requirements have changed. All tools for development are
# installed at once: another call of pip takes ten seconds to look at what is there.
$(VENV)/installed: pyproject.toml constraints.txt
	@echo "Installing mocapfix into $(VENV) (about a minute, once)"
	@$(PYTHON) -m venv $(VENV)
	@$(PIP_INSTALL) --editable ".[review]"
	@$(VENV)/bin/python -m compileall -q mocapfix
	@touch $@

$(VENV)/installed-dev: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP_INSTALL) --editable ".[dev,docs]"
	$(VENV)/bin/python -m compileall -q mocapfix
	touch $(VENV)/installed $@

.blender/installed: Makefile
	$(PYTHON) -m venv .blender
	.blender/bin/python -m pip install bpy==5.0.1
	touch $@

.gltf-validator/installed: Makefile
	@mkdir -p .gltf-validator
	@npm install --silent --no-fund --no-audit --prefix .gltf-validator gltf-validator@2.0.0-dev.3.10 && touch $@ \
		|| echo "Khronos' validator could not be installed, so its test of glTF files is skipped; install Node.js with npm."
