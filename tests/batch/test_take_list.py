"""The takes of folders, patterns and files, and their ids."""

import os
from pathlib import Path

import pytest

from mocapfix.batch.job_files import build_take_list, find_takes
from mocapfix.errors import ReadError


def make_files(folder: Path, *names: str) -> None:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def test_folder_stands_for_its_captures_but_not_for_outputs(tmp_path: Path) -> None:
    make_files(
        tmp_path,
        "a/walk.c3d",
        "a/walk.trc",
        "b/run.C3D",
        "run.mocapfix/run.c3d",
        "out/a/walk/walk.c3d",
        "notes.txt",
    )
    found = find_takes([str(tmp_path)], tmp_path / "out")
    assert [take.id for take in found.takes] == ["a/walk.c3d", "b/run.C3D"]
    assert [path.name for path in found.skipped] == ["walk.trc"]


def test_outputs_of_clean_are_no_takes_wherever_they_are(tmp_path: Path) -> None:
    make_files(
        tmp_path,
        "walk.c3d",
        "jump.c3d",
        "walk.mocapfix/walk.c3d",
        "cleaned/walk.c3d",
        "cleaned/walk.bvh",
        "cleaned/walk.report.json",
        "cleaned/pair.c3d",
        "cleaned/pair.Jim.report.json",
        "cleaned/run.c3d",
        "cleaned/run.1.c3d",
        "cleaned/run.1.report.json",
    )
    ids = ["cleaned/run.c3d", "jump.c3d", "walk.c3d"]
    assert [take.id for take in find_takes([str(tmp_path)], tmp_path / "out").takes] == ids
    assert [take.id for take in find_takes([str(tmp_path / "**" / "*.c3d")], tmp_path / "out").takes] == ids
    named = find_takes([str(tmp_path / "walk.mocapfix" / "walk.c3d")], tmp_path / "out")
    assert [take.id for take in named.takes] == ["walk.c3d"]


def test_pattern_gives_ids_below_the_common_folder(tmp_path: Path) -> None:
    make_files(tmp_path, "day1/walk.c3d", "day2/walk.c3d", "day2/rest.csv")
    found = find_takes([str(tmp_path / "**" / "*.c3d"), str(tmp_path / "day1" / "walk.c3d")], tmp_path / "out")
    assert [take.id for take in found.takes] == ["day1/walk.c3d", "day2/walk.c3d"]


def test_takes_with_one_output_folder_are_refused(tmp_path: Path) -> None:
    make_files(tmp_path, "walk.c3d", "walk.trc")
    with pytest.raises(ReadError, match="same folder"):
        find_takes([str(tmp_path / "walk.*")], tmp_path / "out")


@pytest.mark.parametrize("source", ["none.c3d", "*.c3d", "."])
def test_sources_without_takes_are_refused(tmp_path: Path, source: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ReadError, match="take"):
        find_takes([source], tmp_path / "out")


def test_name_that_is_not_utf8_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(ReadError, match=r"caf\\udce9\.c3d: its name or folder is not valid UTF-8; rename it\."):
        build_take_list([tmp_path / "walk.c3d", tmp_path / os.fsdecode(b"caf\xe9.c3d")])


def test_outputs_of_batches_are_no_takes(tmp_path: Path) -> None:
    make_files(tmp_path, "day1/walk.c3d", "old/walk/walk.c3d", "old/walk/walk.Jim.bvh", "old/walk/walk.record.json")
    make_files(tmp_path, "out/day1/walk/walk.c3d", "out/day1/walk/.walk.attempts", "out/day1/walk/.walk.x1/walk.c3d")
    for sources in ([str(tmp_path / "**" / "*.c3d")], [str(tmp_path)]):
        assert [take.path for take in find_takes(sources, tmp_path / "other").takes] == [tmp_path / "day1" / "walk.c3d"]


def test_hidden_folder_that_a_pattern_names_is_searched(tmp_path: Path) -> None:
    make_files(tmp_path, ".lab/walk.c3d")
    assert find_takes([str(tmp_path / ".lab" / "*.c3d")], tmp_path / "out").takes


def test_linked_take_keeps_the_name_and_folder_of_its_link(tmp_path: Path) -> None:
    make_files(tmp_path, "store/4f2a.c3d", "session/run.c3d")
    (tmp_path / "session" / "walk.c3d").symlink_to(tmp_path / "store" / "4f2a.c3d")
    assert [take.id for take in find_takes([str(tmp_path / "session")], tmp_path / "out").takes] == ["run.c3d", "walk.c3d"]


def test_links_to_folders_are_followed_once(tmp_path: Path) -> None:
    session, store = tmp_path / "session", tmp_path / "store"
    for folder in (session, store):
        folder.mkdir()
    (store / "walk.c3d").touch()
    (session / "day2").symlink_to(store)
    (session / "day3").symlink_to(store)
    (store / "back").symlink_to(session)
    assert [take.id for take in find_takes([str(session)], tmp_path / "out").takes] == ["day2/walk.c3d"]


def test_folder_that_fails_to_open_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "walk.c3d").touch()
    (tmp_path / "closed").mkdir()
    scan = os.scandir

    def refuse(path: str) -> object:
        if Path(path).name == "closed":
            raise PermissionError(13, "Permission denied", path)
        return scan(path)

    monkeypatch.setattr(os, "scandir", refuse)
    found = find_takes([str(tmp_path)], tmp_path / "out")
    assert found.unreadable == (tmp_path / "closed",)
    assert [take.id for take in found.takes] == ["walk.c3d"]
