"""Records of takes: written and read, and ignored where they cannot be read."""

from pathlib import Path

from mocapfix.batch.records import (
    SubjectFigures,
    TakeRecord,
    get_record_path,
    get_take_folder,
    read_record,
    read_records,
    write_record,
)


def build_record(take: str) -> TakeRecord:
    return TakeRecord(take=take, input=f"/in/{take}", status="done", subjects=(SubjectFigures(subject="Jim", filled=3),))


def test_record_is_read_as_it_was_written(tmp_path: Path) -> None:
    record = build_record("day 1/walk.c3d")
    path = write_record(tmp_path, record)
    assert path == tmp_path / "day 1" / "walk" / "walk.record.json"
    assert read_record(path) == record
    assert get_take_folder(tmp_path, record.take) == path.parent
    assert not list(tmp_path.rglob("*.part"))


def test_records_are_found_in_all_folders_by_id(tmp_path: Path) -> None:
    for take in ("b/walk.c3d", "a/walk.c3d", "walk.c3d"):
        write_record(tmp_path, build_record(take))
    assert [record.take for record in read_records(tmp_path)] == ["a/walk.c3d", "b/walk.c3d", "walk.c3d"]


def test_unreadable_record_is_none(tmp_path: Path) -> None:
    path = get_record_path(tmp_path, "walk.c3d")
    path.parent.mkdir()
    for text in ("", "{", '{"take": "walk.c3d"}', '{"another": 1}'):
        path.write_text(text, encoding="utf-8")
        assert read_record(path) is None
    assert read_records(tmp_path) == []
