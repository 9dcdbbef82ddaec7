"""What the page shows of a take: its samples, their states, the body, and what it does without the input."""

import json
import pickle
import shutil
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix import pipeline
from mocapfix.errors import ReadError, SceneError
from mocapfix.io.capture import read_capture
from mocapfix.io.changes_file import read_changes_file, write_changes_file
from mocapfix.io.yaml_files import ChangeModel, ChangesFileModel, read_yaml_model
from mocapfix.model.animation import Animation
from mocapfix.model.changes import serialize_changes
from mocapfix.report.sample_states import SampleOutcome
from mocapfix.review.edits import AnyEdit, CarryEdit, DecisionStore, EditConflictError, EditedState, parse_edit
from mocapfix.review.review_session import OpenTake
from mocapfix.review.take_files import (
    NO_INPUT_NOTE,
    classify_shown_samples,
    find_cleaned_takes,
    load_take_view,
    replace_unstored_sd,
)
from tests.io.test_changes_file import build_change, build_take


def test_states_are_those_of_the_cleaning(faulty, tmp_path: Path) -> None:
    result = faulty.result
    expected = result.comparison.sample_states
    arrays = (result.input_take.markers, result.take.markers, result.input_take.unlabelled.markers)
    states = classify_shown_samples(*(array.astype(np.float32) for array in arrays))
    # Only the faults that were left as measured cannot be seen from the positions.
    is_equal = (states == expected) | ((expected == SampleOutcome.SUSPECT) & (states == SampleOutcome.MEASURED))
    assert is_equal.all()
    assert {*np.unique(states)} >= {SampleOutcome.FILLED, SampleOutcome.REPLACED, SampleOutcome.RELABELLED}


@given(st.integers(0, 2**32 - 1))
def test_unchanged_samples_are_measured_and_new_ones_filled(seed: int) -> None:
    rng = np.random.default_rng(seed)
    before = rng.normal(size=(6, 4, 3)).astype(np.float32)
    before[rng.random((6, 4)) < 0.3] = np.nan
    after = before.copy()
    is_missing = np.isnan(before[..., 0])
    after[is_missing] = rng.normal(size=(int(is_missing.sum()), 3))
    states = classify_shown_samples(before, after, np.zeros((6, 0, 3), np.float32))
    np.testing.assert_array_equal(states, np.where(is_missing, SampleOutcome.FILLED, SampleOutcome.MEASURED))


def test_sticks_join_the_nearest_markers_of_one_segment(cleaned_take: Path) -> None:
    view = load_take_view(find_cleaned_takes(cleaned_take)[0])
    rng = np.random.default_rng(0)
    square = np.array([[0, 0, 0], [0.2, 0, 0], [0.2, 0.2, 0], [0, 0.2, 0]]) + rng.normal(size=(50, 1, 3))
    apart = np.full((50, 1, 3), 9.0)
    after = np.concatenate([square, square[:, 3:] + [0.0, 0.3, 0.0], apart], axis=1).astype(np.float32)
    after[10:20, 2] = np.nan
    sticks = replace(view, labels=tuple("abcdef"), after=after).sticks
    assert sticks == [(0, 1), (0, 3), (1, 2), (2, 3), (3, 4)]  # no diagonals, and none to a marker that is far away


def test_joints_are_those_of_the_solved_body(cleaned_take: Path) -> None:
    (take,) = find_cleaned_takes(cleaned_take / "walk.mocapfix")
    result = pipeline.clean(cleaned_take / "walk.c3d", prior="none")
    view = load_take_view(take, [ChangeModel.model_validate(each) for each in serialize_changes(result.changes)])
    assert result.subject
    assert result.joint_position_world is not None
    order = [view.joint_names.index(name) for name in result.subject.skeleton.names]
    expected = result.joint_position_world
    distance_m = np.linalg.norm(view.joints[:, order] - expected, axis=-1)
    assert np.nanmax(distance_m) < 1e-4
    sd = result.take.sample_sd
    assert sd is not None
    is_estimated = np.isfinite(sd)
    np.testing.assert_array_equal(np.isfinite(view.sd), is_estimated)
    assert np.abs(view.sd - sd)[is_estimated & (sd < 0.02)].max() < 1e-3  # residuals are stored in steps


def test_without_the_input_only_the_cleaned_markers_are_shown(folder: Path) -> None:
    (take,) = find_cleaned_takes(folder)
    complete = load_take_view(take)
    (folder.parent / "walk.c3d").unlink()
    (take,) = find_cleaned_takes(folder)
    view = load_take_view(take)
    assert view.notes == (NO_INPUT_NOTE.format(name="walk.c3d"),)
    np.testing.assert_array_equal(view.after, complete.after)
    is_filled = complete.states == SampleOutcome.FILLED
    assert np.isnan(view.before[is_filled]).all()
    described = OpenTake(take, [take]).describe()
    assert "walk.c3d" in described["cannot_clean_reason"]


def test_files_that_do_not_belong_together_are_named(folder: Path, cleaned_take: Path) -> None:
    path = folder / "walk.report.json"
    report = json.loads(path.read_text(encoding="utf-8"))
    report["take"]["labels"][0] = "NOSE"
    path.write_text(json.dumps(report), encoding="utf-8")
    (take,) = find_cleaned_takes(folder)
    with pytest.raises(ReadError, match=r"walk\.c3d: has no marker NOSE, which the report names"):
        load_take_view(take)
    shutil.copy(cleaned_take / "walk.mocapfix" / "walk.report.json", path)
    (folder / "walk.c3d").write_bytes(b"")
    with pytest.raises(ReadError, match=r"walk\.c3d"):
        load_take_view(take)


def test_uncertainty_that_the_file_cannot_store_is_that_of_its_change(cleaned_take: Path) -> None:
    (take,) = find_cleaned_takes(cleaned_take / "walk.mocapfix")
    view = load_take_view(take)
    estimated = np.argwhere(np.isfinite(view.sd))
    (frame, marker), (_, other) = estimated[0], estimated[-1]
    sd = np.full_like(view.sd, np.nan)
    sd[frame : frame + 2, marker] = [0.01, np.inf]
    sd[frame, other] = np.inf
    number = view.first_frame + int(frame)
    change = build_change("gap", (view.labels[marker],), number, number + 1, predicted_mm=173.2)
    model = ChangeModel.model_validate(serialize_changes([change])[0])
    replaced = replace_unstored_sd(replace(view, sd=sd), [model])
    np.testing.assert_allclose(replaced[frame : frame + 2, marker], [0.01, 0.1], rtol=1e-3)
    assert np.isnan(replaced[frame, other])


def test_animation_is_shown_by_its_joints(cleaned_take: Path, tmp_path: Path) -> None:
    path = tmp_path / "walk.bvh"
    shutil.copy(cleaned_take / "walk.mocapfix" / "walk.bvh", path)
    pipeline.clean(path, prior="none").write(tmp_path / "walk.mocapfix")
    (take,) = find_cleaned_takes(tmp_path / "walk.mocapfix")
    view = load_take_view(take)
    animation = read_capture(path)
    assert isinstance(animation, Animation)
    assert view.frame_count == animation.frame_count
    assert view.joint_names == animation.names
    assert len(view.labels) == len(view.joint_names) + 1


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
