"""Session files: takes, people and options, and what is wrong with them."""

from pathlib import Path

import pytest

from mocapfix.batch.job_files import read_session_file
from mocapfix.errors import SceneError


def write_session(folder: Path, text: str) -> Path:
    for name in ("jim1.c3d", "jim2.c3d", "ann.c3d"):
        (folder / name).touch()
    path = folder / "session.yaml"
    path.write_text(f"kind: session\n{text}", encoding="utf-8")
    return path


def test_session_has_takes_people_and_options(tmp_path: Path) -> None:
    session = read_session_file(write_session(tmp_path, "takes: ['*.c3d']\npeople: {Jim: [jim*.c3d]}\nfill: {max_gap: 2}\n"))
    assert [take.id for take in session.takes] == ["ann.c3d", "jim1.c3d", "jim2.c3d"]
    assert session.people == {"Jim": ("jim1.c3d", "jim2.c3d")}
    assert session.options.fill.max_gap_s == 2.0


def test_patterns_match_neither_outputs_nor_other_files(tmp_path: Path) -> None:
    for name in ("walk/walk.c3d", "walk/walk.record.json", "video.mp4"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    session = read_session_file(write_session(tmp_path, "takes: ['**/*']\npeople: {Jim: ['**/jim*']}\n"))
    assert [take.id for take in session.takes] == ["ann.c3d", "jim1.c3d", "jim2.c3d"]
    assert session.people == {"Jim": ("jim1.c3d", "jim2.c3d")}
    with pytest.raises(SceneError, match="matches no take"):
        read_session_file(write_session(tmp_path, "takes: ['*.mp4']\n"))


def test_name_of_a_file_is_no_pattern(tmp_path: Path) -> None:
    for name in ("take[1].c3d", "take1.c3d"):
        (tmp_path / name).touch()
    session = read_session_file(write_session(tmp_path, "takes: ['take[1].c3d']\npeople: {Jim: ['take[1].c3d']}\n"))
    assert [take.id for take in session.takes] == ["take[1].c3d"]
    assert session.people == {"Jim": ("take[1].c3d",)}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("takes: []\n", "takes"),
        ("takes: [x*.c3d]\n", "takes: no file"),
        ("takes: [ann.c3d]\nkind: clean\n", "kind: must be 'session'"),
        ("takes: [ann.c3d]\nfill: {gap: 1}\n", "fill.gap"),
    ],
)
def test_wrong_session_files_are_refused(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(SceneError, match=words):
        read_session_file(write_session(tmp_path, text))
