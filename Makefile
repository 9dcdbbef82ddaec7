# On a fresh machine with Python and pip: `make demo` shows what mocapfix does, `make test` proves it.

PYTHON ?= python3
VENV := .venv
PIP_INSTALL := $(VENV)/bin/python -m pip install --constraint constraints.txt

.PHONY: demo test blender lint clean

demo: $(VENV)/installed
	$(VENV)/bin/mocapfix demo

test: $(VENV)/installed-dev
	$(VENV)/bin/python -m pytest --numprocesses 2 # in two processes, for most of the time one of them compiles

# Blender as a Python module, for tests/blender; apart, for it wants a NumPy of its own. It needs the very Python 3.11.
blender: .blender/installed

lint: $(VENV)/installed-dev
	$(VENV)/bin/ruff check
	$(VENV)/bin/pyright

clean:
	rm -rf $(VENV) .blender dist .pytest_cache .ruff_cache .hypothesis
	find mocapfix tests -name __pycache__ -prune -exec rm -rf {} +

# Stamps: a second call installs nothing unless what is to be installed has changed.
$(VENV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP_INSTALL) --editable .
	touch $@

$(VENV)/installed-dev: $(VENV)/installed
	$(PIP_INSTALL) --editable ".[dev]"
	touch $@

.blender/installed: Makefile
	$(PYTHON) -m venv .blender
	.blender/bin/python -m pip install --no-compile bpy==5.0.1
	touch $@
