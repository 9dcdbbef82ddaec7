"""The edits of a changes file: what each does, how it is undone, and what others wrote meanwhile."""

import pickle
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mocapfix.errors import SceneError
from mocapfix.io.changes_file import read_changes_file, write_changes_file
from mocapfix.io.yaml_files import ChangesFileModel, read_yaml_model
from mocapfix.review.edits import AnyEdit, CarryEdit, DecisionStore, EditConflictError, EditedState, parse_edit
from tests.io.test_changes_file import build_change, build_take

SPIKE, GAP = "spike-C7-110", "gap-RBAC-120"
WRONG = {"kind": "wrong", "markers": ["C7"], "first": 110, "last": 119}


def write_file(folder: Path) -> Path:
    path = folder / "walk.changes.yaml"
    changes = [build_change(decision="accept"), build_change("gap", ("RBAC",), 120, 130, decision="accept")]
    write_changes_file(path, build_take(), changes)
    return path


def edit(store: DecisionStore, revision: str, **action: object) -> None:
    store.edit(revision, parse_edit(action))


def test_decisions_notes_and_corrections_are_in_the_file_at_once(tmp_path: Path) -> None:
    path = write_file(tmp_path)
    store = DecisionStore(path)
    edit(store, store.revision, type="decide", ids=[SPIKE], decision="reject", reviewer="Ann: <b>")
    edit(store, store.revision, type="note", id=GAP, text="looks <odd>: ask")
    edit(store, store.revision, type="add", corrections=[WRONG])
    review = read_changes_file(path, build_take())
    assert [(each.entry.id, each.entry.decision) for each in review.declined] == [(SPIKE, "reject")]
    assert (review.reviewers, review.notes) == ({SPIKE: "Ann: <b>"}, {GAP: "looks <odd>: ask"})
    assert [each.entry.kind for each in review.corrections] == ["wrong"]


def test_file_is_written_as_a_cleaning_writes_it(tmp_path: Path) -> None:
    path = write_file(tmp_path)
    before, store = path.read_bytes(), DecisionStore(path)
    edit(store, store.revision, type="decide", ids=[GAP], decision="keep")
    edit(store, store.revision, type="add", corrections=[WRONG])
    assert path.read_bytes() != before
    edit(store, store.revision, type="undo")
    edit(store, store.revision, type="undo")
    assert path.read_bytes() == before
    with pytest.raises(SceneError, match="nothing to undo"):
        edit(store, store.revision, type="undo")


@pytest.mark.parametrize("seed", range(3))
def test_after_a_thousand_edits_file_state_and_list_of_edits_are_equal(tmp_path: Path, seed: int) -> None:
    """Decisions, notes, corrections, undoing and redoing at random, beside a list of contents with a position in it."""
    rng, path = np.random.default_rng(seed), write_file(tmp_path)
    store = DecisionStore(path)
    start, edits, contents, position = store.state, list[AnyEdit](), [store.file], 0
    for n in range(1000):
        name, corrections = str(rng.choice([SPIKE, GAP])), store.file.corrections
        ids = [name] if rng.random() < 0.5 else [SPIKE, GAP]
        actions: list[dict[str, Any]] = [
            {"type": "decide", "ids": ids, "decision": str(rng.choice(["accept", "reject", "keep"]))},
            {"type": "note", "id": name, "text": "".join(map(chr, rng.integers(32, 0xD7FF, 8)))},
            *[{"type": "add", "corrections": [WRONG | {"note": str(n)}]}] * (len(corrections) < 20),
            *[{"type": "remove", "index": len(corrections) - 1}] * bool(corrections),
            *[{"type": "undo"}] * (2 * bool(position)),
            *[{"type": "redo"}] * (2 * (position < len(contents) - 1)),
        ]
        action = actions[rng.integers(len(actions))]
        edits.append(parse_edit(action))
        store.edit(store.revision, edits[-1])
        if action["type"] in ("undo", "redo"):
            position += 1 if action["type"] == "redo" else -1
        else:
            contents[position + 1 :] = [store.file]
            position += 1
        assert store.file == contents[position]
        assert (len(store.state.done), len(store.state.undone)) == (position, len(contents) - 1 - position)
        if n % 20 == 0:
            assert read_yaml_model(ChangesFileModel, path) == store.file
    state = reduce(lambda state, edit: edit.apply(state), edits, start)
    assert (state.file, len(state.done), len(state.undone)) == (store.file, len(store.state.done), len(store.state.undone))
    while store.state.done:
        edit(store, store.revision, type="undo")
    assert read_yaml_model(ChangesFileModel, path) == start.file


def test_decisions_are_carried_to_the_changes_that_a_cleaning_found(tmp_path: Path) -> None:
    before = DecisionStore(write_file(tmp_path)).file
    spike, gap = before.changes
    after = before.model_copy(
        update={
            "changes": [
                each.model_copy(update={"decision": "reject", "reviewed": True, "reviewer": "Ann"}) for each in (spike, gap)
            ]
        }
    )
    longer = spike.model_copy(update={"id": "spike-other", "first": spike.first - 2, "last": spike.first})
    apart = longer.model_copy(update={"id": "spike-apart", "first": spike.last + 1, "last": spike.last + 3})
    found = before.model_copy(update={"changes": [longer, apart]})
    carried = CarryEdit(before=before, after=after).change(found).changes
    assert [(each.id, each.decision) for each in carried] == [
        ("spike-other", "reject"),
        ("spike-apart", "accept"),
        (gap.id, "reject"),
    ]
    assert [each.reviewer for each in carried] == ["Ann", "", "Ann"]
    assert carried[2].samples == 0  # it is not found, and was not made
    assert CarryEdit(before=before, after=before).change(found) == found


def test_undoing_a_decision_on_all_of_many_changes_takes_little_memory(tmp_path: Path) -> None:
    path = write_file(tmp_path)
    file = read_yaml_model(ChangesFileModel, path)
    many = [file.changes[0].model_copy(update={"id": f"spike-{n}"}) for n in range(4000)]
    state = EditedState(file.model_copy(update={"changes": many}))
    for decision in ("reject", "keep"):
        action = {"type": "decide", "ids": [each.id for each in many], "decision": decision}
        state = parse_edit(action).apply(state)
    assert sum(len(pickle.dumps(step)) for step in state.done) < 200_000  # bytes; a content has some millions
    for decision in ("reject", "accept"):
        state = parse_edit({"type": "undo"}).apply(state)
        assert {each.decision for each in state.file.changes} == {decision}
    assert state.file.changes == many


def test_a_new_edit_ends_redoing(tmp_path: Path) -> None:
    store = DecisionStore(write_file(tmp_path))
    edit(store, store.revision, type="decide", ids=[SPIKE, GAP], decision="reject")
    edit(store, store.revision, type="undo")
    edit(store, store.revision, type="note", id=GAP, text="ask")
    with pytest.raises(SceneError, match="nothing to make again"):
        edit(store, store.revision, type="redo")


def test_edit_of_another_program_is_noticed_and_not_overwritten(tmp_path: Path) -> None:
    path = write_file(tmp_path)
    store = DecisionStore(path)
    old = store.revision
    edit(store, old, type="decide", ids=[SPIKE], decision="reject")
    path.write_text(path.read_text(encoding="utf-8").replace("decision: accept", "decision: keep"), encoding="utf-8")
    written = path.read_bytes()
    with pytest.raises(EditConflictError, match=r"walk\.changes\.yaml was changed by another page, program or person"):
        edit(store, store.revision, type="decide", ids=[GAP], decision="reject")
    assert path.read_bytes() == written
    assert [change.decision for change in store.file.changes] == ["reject", "keep"]  # the store has read it
    assert store.state.done == ()
    edit(store, store.revision, type="decide", ids=[GAP], decision="reject")
    with pytest.raises(EditConflictError):
        edit(store, old, type="decide", ids=[GAP], decision="accept")


def test_file_that_became_invalid_is_named_and_not_overwritten(tmp_path: Path) -> None:
    path = write_file(tmp_path)
    store = DecisionStore(path)
    path.write_text("take: [", encoding="utf-8")
    with pytest.raises(SceneError, match=r"walk\.changes\.yaml"):
        edit(store, store.revision, type="decide", ids=[GAP], decision="reject")
    assert path.read_text(encoding="utf-8") == "take: ["


@pytest.mark.parametrize(
    ("action", "sentence"),
    [
        ({"type": "decide", "ids": ["spike-NOSE-1"], "decision": "reject"}, "has no change spike-NOSE-1"),
        ({"type": "note", "id": "spike-NOSE-1", "text": ""}, "has no change spike-NOSE-1"),
        ({"type": "note", "id": GAP, "text": "x" * 3000}, "text String should have at most 2000 characters"),
        ({"type": "remove", "index": 0}, "has no correction 1"),
        ({"type": "add", "corrections": [WRONG | {"kind": "wrng"}]}, "The edit is not allowed: add.corrections.0.kind"),
        ({"type": "add", "corrections": [WRONG | {"markers": ["C7", "RBAC"]}]}, "wrong must name one marker"),
        ({"type": "add", "corrections": "wrong"}, "The edit is not allowed"),
        ({"type": "undo"}, "nothing to undo"),
        ({"type": "redo"}, "nothing to make again"),
        ({"type": "erase"}, "The edit is not allowed"),
    ],
)
def test_edit_that_is_not_allowed_changes_nothing(tmp_path: Path, action: dict[str, object], sentence: str) -> None:
    path = write_file(tmp_path)
    before, store = path.read_bytes(), DecisionStore(path)
    with pytest.raises(SceneError, match=sentence):
        store.edit(store.revision, parse_edit(action))
    assert (path.read_bytes(), store.state.done) == (before, ())
