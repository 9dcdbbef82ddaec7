"""Imports on demand: the libraries take half a second to import, and --help does not need them."""

import subprocess
import sys

import pytest

import mocapfix


def list_modules_after(code: str) -> set[str]:
    """Return the modules that a new interpreter has loaded after `code`."""
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\nimport sys; print(*sys.modules)"], capture_output=True, text=True, check=True
    )
    return set(done.stdout.split())


def test_command_line_imports_no_heavy_libraries():
    assert not {"numba", "scipy", "torch", "rerun", "pydantic"} & list_modules_after("import mocapfix.cli.app")


def test_clean_is_imported_without_torch_and_rerun():
    assert not {"torch", "rerun"} & list_modules_after("import mocapfix\nmocapfix.clean")


def test_public_names():
    assert all(hasattr(mocapfix, name) for name in mocapfix.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'cleen'"):
        mocapfix.cleen  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]
