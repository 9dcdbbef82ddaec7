"""Imports on demand: the libraries take half a second to import, and --help does not need them."""

import subprocess
import sys
from pathlib import Path

import pytest

import mocapfix
from mocapfix.synthetic import compose_take, write_synthetic_take


def list_modules_after(code: str) -> set[str]:
    """Return the modules that a new interpreter has loaded after `code`."""
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\nimport sys; print(*sys.modules)"], capture_output=True, text=True, check=True
    )
    return set(done.stdout.split())


def test_command_line_imports_no_heavy_libraries():
    assert not {"numba", "scipy", "torch", "rerun", "pydantic"} & list_modules_after("import mocapfix.cli.app")


def test_modules_can_be_inspected_without_jaxtyping():
    code = "import mocapfix.__main__, importlib.util, inspect; inspect.stack(); importlib.util.find_spec('jaxtyping')"
    modules = list_modules_after(code)
    assert "jaxtyping" in modules
    assert "jaxtyping._array_types" not in modules


def test_clean_is_imported_without_torch_and_rerun():
    assert not {"torch", "rerun"} & list_modules_after("import mocapfix\nmocapfix.clean")


READ_CODE = """
import os, sys
from mocapfix.cli import app
from mocapfix.io import capture
read_capture = capture.read_capture

def read_and_end(path, options, **how):
    read_capture(path, options, **how)
    print(*sys.modules, flush=True)
    os._exit(0)

capture.read_capture = read_and_end
sys.argv = ["mocapfix", "clean", {path!r}]
app.run_command_line()
"""


def test_what_cleans_a_take_is_imported_after_it_is_read(tmp_path: Path):
    """A file that cannot be read is refused at once."""
    path = tmp_path / "walk.c3d"
    write_synthetic_take(path, compose_take(seconds=0.5))
    modules = list_modules_after(READ_CODE.format(path=str(path)))
    assert "mocapfix.io.c3d" in modules
    assert not modules & {"mocapfix.pipeline", "rerun", "torch", "sklearn", "matplotlib"}
    assert not modules & {f"scipy.{name}" for name in ("signal", "stats", "optimize", "spatial", "interpolate", "ndimage")}


def test_public_names():
    assert all(hasattr(mocapfix, name) for name in mocapfix.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'cleen'"):
        mocapfix.cleen  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]
