"""Where compiled kernels are kept, and that what is out of date is neither used nor left behind."""

import inspect
import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from mocapfix.kernels import compilation_cache
from mocapfix.kernels.compilation_cache import PACKAGE_FOLDER, compile_inner_kernel, find_module_folder

KERNEL_SOURCES = {
    "kernels/inner.py": """
        from typing import NamedTuple
        from mocapfix.kernels.compilation_cache import compile_inner_kernel

        class Pair(NamedTuple):
            a: float
            b: float

        @compile_inner_kernel
        def add(pair):
            return pair.a + pair.b
        """,
    "kernels/outer.py": """
        from mocapfix.kernels.compilation_cache import compile_kernel
        from mocapfix.kernels.inner import Pair, add

        @compile_kernel
        def add_twice(pair):
            return add(pair) + add(pair)
        """,
    "kernels/__init__.py": "",
    "__init__.py": "",
}
RUN_CODE = """
from mocapfix.kernels.outer import Pair, add_twice
print(add_twice(Pair(1.0, 2.0)), sum(add_twice.stats.cache_hits.values()))
"""


@pytest.fixture
def package(tmp_path):
    """A package named mocapfix with two modules of kernels, one of which calls the other's, and the present cache."""
    folder = tmp_path / "mocapfix"
    for name, source in KERNEL_SOURCES.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(source))
    for module in (compilation_cache, compilation_cache):
        shutil.copy(inspect.getfile(module), folder / "kernels")
    return folder


def start_run(package, **environment):
    """Start a process that calls the outer kernel."""
    cleared = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    return subprocess.Popen(
        [sys.executable, "-c", RUN_CODE],
        env={**cleared, "PYTHONPATH": str(package.parent), **environment},
        cwd=package.parent,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run(package, **environment):
    """Call the outer kernel in a process of its own; return the result, and how often the cache had it."""
    process = start_run(package, **environment)
    output, errors = process.communicate()
    assert process.returncode == 0, errors
    result, hits = output.split()
    return float(result), int(hits)


def list_kernel_folders(package):
    return sorted(each.name.rpartition("-")[0] for each in (package / "kernels" / "__pycache__").glob("mocapfix.*"))


def test_kernels_are_cached_beside_the_package(package):
    assert run(package) == (6.0, 0)
    assert run(package) == (6.0, 1)
    assert list_kernel_folders(package) == ["mocapfix.kernels.inner", "mocapfix.kernels.outer"]


def test_a_changed_callee_is_compiled_again_with_its_callers_and_the_old_files_are_removed(package):
    run(package)
    inner = package / "kernels" / "inner.py"
    inner.write_text(inner.read_text().replace("pair.a + pair.b", "pair.a - pair.b"))
    legacy = package / "kernels" / "__pycache__" / "outer.add_twice-6.py311.nbi"
    legacy.write_bytes(b"")
    assert run(package) == (-2.0, 0)
    assert list_kernel_folders(package) == ["mocapfix.kernels.inner", "mocapfix.kernels.outer"]
    assert not legacy.exists()


def test_a_module_that_moved_leaves_no_files_behind(package):
    run(package)
    kernels = package / "kernels"
    (kernels / "inner.py").rename(kernels / "moved.py")
    (kernels / "outer.py").write_text((kernels / "outer.py").read_text().replace("kernels.inner", "kernels.moved"))
    assert run(package) == (6.0, 0)
    assert list_kernel_folders(package) == ["mocapfix.kernels.moved", "mocapfix.kernels.outer"]


def test_damaged_files_are_replaced(package):
    run(package)
    for file in (package / "kernels" / "__pycache__").glob("*/*.nb[ic]"):
        file.write_bytes(file.read_bytes()[:40])
    assert run(package)[0] == 6.0
    assert run(package) == (6.0, 1)


def test_a_read_only_package_uses_the_folder_of_the_user(package, tmp_path):
    (package / "kernels" / "__pycache__").write_bytes(b"")  # a file where the folder would be
    caches = {"XDG_CACHE_HOME": str(tmp_path / "user"), "LOCALAPPDATA": str(tmp_path / "user"), "HOME": str(tmp_path / "home")}
    assert run(package, **caches) == (6.0, 0)
    assert run(package, **caches) == (6.0, 1)


def test_kernels_work_where_nothing_can_be_written(package, tmp_path):
    (package / "kernels" / "__pycache__").write_bytes(b"")
    blocked = tmp_path / "blocked"
    blocked.write_bytes(b"")
    names = ("XDG_CACHE_HOME", "LOCALAPPDATA", "HOME", "NUMBA_CACHE_DIR")
    (package / "__init__.py").write_text(f"import tempfile; tempfile.gettempdir = lambda: {str(blocked)!r}\n")
    assert run(package, **dict.fromkeys(names, str(blocked))) == (6.0, 0)


def test_the_folder_of_numba_cache_dir_is_used(package, tmp_path):
    assert run(package, NUMBA_CACHE_DIR=str(tmp_path / "cache")) == (6.0, 0)
    assert run(package, NUMBA_CACHE_DIR=str(tmp_path / "cache")) == (6.0, 1)
    assert list_kernel_folders(package) == []


def test_processes_may_start_at_once(package):
    processes = [start_run(package) for _ in range(2)]
    assert [process.communicate()[0].split()[0] for process in processes] == ["6.0", "6.0"]
    assert run(package) == (6.0, 1)


def test_the_digest_covers_all_imported_kernels_and_the_registered_terms():
    imported = {"mocapfix.kernels.levenberg_marquardt"}
    for _ in range(12):
        sources = [compilation_cache._read_source(name) for name in imported]
        imported |= {name for source in sources if source for name in source[1]}
    assert {"mocapfix.kernels.sweep", "mocapfix.kernels.terms.points", "mocapfix.model.motion"} <= imported
    assert compilation_cache._read_source("mocapfix") is None


def test_inner_kernels_can_be_called_from_python():
    @compile_inner_kernel
    def double(x):
        return 2 * x

    assert [double(1), double(1), double(1.5)] == [2, 2, 3.0]


def test_the_folder_of_a_module_names_it():
    assert find_module_folder("mocapfix.kernels.lie").name.startswith("mocapfix.kernels.lie-")
    assert Path(compilation_cache.__file__).is_relative_to(PACKAGE_FOLDER)
