"""The changes file under review: each edit is saved at once, undone in order, and never written over another's."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mocapfix.errors import MocapfixError, SceneError
from mocapfix.io.changes_file import ChangesFileModel, read_changes_file, write_changes_file
from mocapfix.io.yaml_files import read_yaml_model
from mocapfix.review.take_files import DecisionStore, EditConflictError
from tests.io.test_changes_file import build_change, build_take

SPIKE, GAP = "spike-C7-110", "gap-RBAC-120"
WRONG = {"kind": "wrong", "markers": ["C7"], "first": 110, "last": 119}


def write_file(folder: Path) -> Path:
    path = folder / "walk.changes.yaml"
    changes = [build_change(decision="accept"), build_change("gap", ("RBAC",), 120, 130, decision="accept")]
    write_changes_file(path, build_take(), changes)
    return path


def test_decisions_notes_and_corrections_are_in_the_file_at_once(tmp_path: Path) -> None:
    path = write_file(tmp_path)
    store = DecisionStore(path)
    store.decide(store.revision, [SPIKE], "reject")
    store.note(store.revision, GAP, "looks <odd>: ask")
    store.add_correction(store.revision, WRONG)
    review = read_changes_file(path, build_take())
    assert [(each.entry.id, each.decision) for each in review.declined] == [(SPIKE, "reject")]
    assert (review.reviewed_ids, review.notes) == ({SPIKE}, {GAP: "looks <odd>: ask"})
    assert [each.entry.kind for each in review.corrections] == ["wrong"]


def test_file_is_written_as_a_cleaning_writes_it(tmp_path: Path) -> None:
    path = write_file(tmp_path)
    before, store = path.read_bytes(), DecisionStore(path)
    store.decide(store.revision, [GAP], "keep")
    store.add_correction(store.revision, WRONG)
    assert path.read_bytes() != before
    store.undo(store.revision)
    store.undo(store.revision)
    assert path.read_bytes() == before
    with pytest.raises(SceneError, match="nothing to undo"):
        store.undo(store.revision)


EDITS = st.lists(
    st.sampled_from(["reject", "keep", "accept", "note", "add", "remove"]).flatmap(
        lambda kind: st.tuples(st.just(kind), st.sampled_from([SPIKE, GAP]), st.text(st.characters(codec="utf-8"), max_size=20))
    ),
    max_size=8,
)


@settings(deadline=None, max_examples=40)
@given(edits=EDITS)
def test_any_edits_can_be_undone_one_by_one(tmp_path_factory: pytest.TempPathFactory, edits: list[tuple[str, str, str]]) -> None:
    path = write_file(tmp_path_factory.mktemp("edits"))
    store = DecisionStore(path)
    contents = [store.file]
    for kind, name, text in edits:
        match kind:
            case "note":
                store.note(store.revision, name, text)
            case "add":
                store.add_correction(store.revision, WRONG | {"note": text})
            case "remove":
                if not store.file.corrections:
                    continue
                store.remove_correction(store.revision, 0)
            case _:
                store.decide(store.revision, [name], kind)  # pyright: ignore[reportArgumentType]
        contents.append(store.file)
        assert read_yaml_model(ChangesFileModel, path) == store.file
    for expected in reversed(contents[:-1]):
        store.undo(store.revision)
        assert read_yaml_model(ChangesFileModel, path) == expected


def test_edit_of_another_program_is_noticed_and_not_overwritten(tmp_path: Path) -> None:
    path = write_file(tmp_path)
    store = DecisionStore(path)
    old = store.revision
    store.decide(old, [SPIKE], "reject")
    path.write_text(path.read_text(encoding="utf-8").replace("decision: accept", "decision: keep"), encoding="utf-8")
    written = path.read_bytes()
    with pytest.raises(EditConflictError, match=r"walk\.changes\.yaml was changed by another page, program or person"):
        store.decide(store.revision, [GAP], "reject")
    assert path.read_bytes() == written
    assert [change.decision for change in store.file.changes] == ["reject", "keep"]  # the store has read it
    assert store.undo_count == 0
    store.decide(store.revision, [GAP], "reject")
    with pytest.raises(EditConflictError):
        store.decide(old, [GAP], "accept")


def test_file_that_became_invalid_is_named_and_not_overwritten(tmp_path: Path) -> None:
    path = write_file(tmp_path)
    store = DecisionStore(path)
    path.write_text("take: [", encoding="utf-8")
    with pytest.raises(SceneError, match=r"walk\.changes\.yaml"):
        store.decide(store.revision, [GAP], "reject")
    assert path.read_text(encoding="utf-8") == "take: ["


@pytest.mark.parametrize(
    ("edit", "sentence"),
    [
        (lambda store: store.decide(store.revision, ["spike-NOSE-1"], "reject"), "has no change spike-NOSE-1"),
        (lambda store: store.note(store.revision, "spike-NOSE-1", ""), "has no change spike-NOSE-1"),
        (lambda store: store.note(store.revision, GAP, "x" * 3000), "A note can have 2000 characters"),
        (lambda store: store.remove_correction(store.revision, 0), "has no correction 1"),
        (lambda store: store.add_correction(store.revision, WRONG | {"kind": "wrng"}), "The correction is not allowed: kind"),
        (lambda store: store.add_correction(store.revision, WRONG | {"markers": ["C7", "RBAC"]}), "wrong must name one marker"),
        (lambda store: store.add_correction(store.revision, "wrong"), "The correction is not allowed"),
    ],
)
def test_edit_that_is_not_allowed_changes_nothing(tmp_path: Path, edit, sentence: str) -> None:
    path = write_file(tmp_path)
    before, store = path.read_bytes(), DecisionStore(path)
    with pytest.raises(MocapfixError, match=sentence):
        edit(store)
    assert (path.read_bytes(), store.undo_count) == (before, 0)
