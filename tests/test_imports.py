"""What is imported when: the libraries cost half a second, and --help must not wait for them."""

import subprocess
import sys

import pytest

import mocapfix


def loaded_after(code: str) -> set[str]:
    """-> the modules that a fresh interpreter holds after `code`"""
    told = subprocess.run(
        [sys.executable, "-c", f"{code}\nimport sys; print(*sys.modules)"], capture_output=True, text=True, check=True
    )
    return set(told.stdout.split())


def test_the_command_line_alone_needs_none_of_the_heavy_libraries():
    assert not {"numba", "scipy", "torch", "rerun", "pydantic"} & loaded_after("import mocapfix.cli.app")


def test_cleaning_needs_neither_torch_nor_rerun_before_something_is_shown():
    assert not {"torch", "rerun"} & loaded_after("import mocapfix\nmocapfix.clean")


def test_every_public_name_is_there_and_no_other():
    assert all(hasattr(mocapfix, name) for name in mocapfix.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'cleen'"):
        mocapfix.cleen  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]
