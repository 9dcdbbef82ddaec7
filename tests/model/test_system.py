"""What systems are, and names that files may have on all of them."""

import sys
from pathlib import Path

import pytest

from mocapfix.model.system import avoid_reserved_name, get_system, make_file_name


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("Jim", "Jim"),
        ("A:B", "A_B"),
        ("Jörg 2", "Jörg 2"),
        ("walk.", "walk_"),
        ("walk. .", "walk___"),
        ("con", "con_"),
        ("Aux.left", "Aux.left_"),
        ("COM1", "COM1_"),
        ("COM10", "COM10"),
        ("Conrad", "Conrad"),
        ("../a/b", ".._a_b"),
        ("", ""),
    ],
)
def test_names_are_allowed_on_every_system(text, name):
    assert make_file_name(text) == name


def test_other_characters_of_existing_names_are_kept():
    assert avoid_reserved_name("walk (2) +a&b") == "walk (2) +a&b"
    assert avoid_reserved_name("walk ") == "walk_"


@pytest.mark.parametrize(
    ("platform", "variables", "folder"),
    [
        ("win32", {"LOCALAPPDATA": "local"}, Path("local")),
        ("win32", {}, Path.home() / "AppData" / "Local"),
        ("darwin", {}, Path.home() / "Library" / "Caches"),
        ("linux", {"XDG_CACHE_HOME": "cache"}, Path("cache")),
        ("linux", {}, Path.home() / ".cache"),
    ],
)
def test_each_system_has_its_folder_for_caches(monkeypatch, platform, variables, folder):
    for name in ("LOCALAPPDATA", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr("signal.SIGBREAK", 21, raising=False)
    monkeypatch.setattr(sys, "platform", platform)
    assert get_system().cache_folder == folder
    assert get_system().keeps_open_files == (platform == "win32")
