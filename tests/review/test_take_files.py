"""What the page shows of a take: its samples, their states, the body, and what it does without the input."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix import pipeline
from mocapfix.errors import ReadError
from mocapfix.io.bvh import read_bvh
from mocapfix.io.capture import read_capture
from mocapfix.io.yaml_files import ChangeModel
from mocapfix.model.animation import Animation
from mocapfix.model.changes import serialize_changes
from mocapfix.report.sample_states import SampleOutcome
from mocapfix.review.review_session import OpenTake
from mocapfix.review.take_files import (
    NO_INPUT_NOTE,
    classify_shown_samples,
    find_cleaned_takes,
    load_take_view,
    replace_unstored_sd,
    trace_marker,
)
from tests.io.test_changes_file import build_change


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
    assert view.body
    order = [view.body.names.index(name) for name in result.subject.skeleton.names]
    expected = result.joint_position_world
    distance_m = np.linalg.norm(view.compute_poses(slice(None))[0][:, order] - expected, axis=-1)
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
    assert view.body
    assert view.body.names == animation.names
    assert len(view.labels) == len(animation.names) + 1


def test_a_marker_is_traced_where_the_solved_body_has_it(cleaned_take: Path) -> None:
    (take,) = find_cleaned_takes(cleaned_take / "walk.mocapfix")
    result, view = pipeline.clean(cleaned_take / "walk.c3d", prior="none"), load_take_view(take)
    assert result.residual_m is not None
    for m, label in enumerate(view.labels):
        distance_m = np.linalg.norm(view.after[:, m] - trace_marker(take, view, label), axis=1)
        known = np.isfinite(result.residual_m[:, m])
        assert known.mean() > 0.5
        np.testing.assert_allclose(distance_m[known], result.residual_m[known, m], atol=1e-4)
    assert trace_marker(take, replace(view, labels=("Box:1",)), "Box:1").shape == (view.frame_count, 0)


def test_a_joint_of_an_animation_is_traced_by_its_angles(cleaned_take: Path, tmp_path: Path) -> None:
    path = tmp_path / "walk.bvh"
    animation = read_bvh(cleaned_take / "walk.mocapfix" / "walk.bvh")
    joint, values = animation.names.index("LeftForeArm"), animation.values.copy()
    columns, axes = animation.get_rotation_channels(joint)
    values[100:104, columns[0]] += 60.0  # a pop, which is repaired
    rows = "\n".join(" ".join(f"{value:.6f}" for value in row) for row in values)
    text = (cleaned_take / "walk.mocapfix" / "walk.bvh").read_text(encoding="utf-8")
    head = text[: text.index("Frame Time:")]
    path.write_text(f"{head}{text[len(head) :].splitlines()[0]}\n{rows}\n", encoding="utf-8")
    pipeline.clean(path, prior="none").write(tmp_path / "walk.mocapfix")
    (take,) = find_cleaned_takes(tmp_path / "walk.mocapfix")
    trace = trace_marker(take, load_take_view(take), "LeftForeArm")
    np.testing.assert_allclose(trace[:, axes], values[:, columns], atol=1e-5)
    assert np.abs(trace[100:104, 3 + axes[0]] - animation.values[100:104, columns[0]]).max() < 30.0
    np.testing.assert_array_equal(trace[:90, 3:], trace[:90, :3])
