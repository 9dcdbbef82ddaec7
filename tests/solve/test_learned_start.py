"""Initial poses by learned inverse kinematics, and previews that are made of them."""

import numpy as np
import pytest

from mocapfix import pipeline
from mocapfix.contacts.contacts import GaitEvent
from mocapfix.io.c3d_events import add_c3d_events
from mocapfix.io.capture import read_take
from mocapfix.model.body_fit import SubjectInTake
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.solve import initial_motion
from mocapfix.solve.kinematics import compute_world_poses
from mocapfix.solve.mean_pose import load_mean_pose_prior
from mocapfix.synthetic import compose_take, write_synthetic_take
from tests.c3d_files import get_layout


@pytest.fixture(scope="module")
def performance():
    return compose_take(seed=4, seconds=2.0, rate=60.0)


def initialise(performance, markers, method):
    body = load_cmu31_body()
    prior = load_mean_pose_prior("mean-pose", body.skeleton)
    take = Take(markers, performance.subject.labels, 60.0)
    return initial_motion.initialise_motion(take, performance.subject, body, prior, method)


def measure_error(performance, motion):
    positions, _ = compute_world_poses(performance.subject.skeleton, motion)
    return np.linalg.norm(positions - performance.joint_positions, axis=-1)


def test_poses_of_a_whole_set_of_markers_hardly_change(performance):
    errors = [
        measure_error(performance, initialise(performance, performance.marker_positions, m)) for m in ("hybrik-x", "learned")
    ]
    assert errors[1].mean() < errors[0].mean() + 5e-3


def test_lost_arm_is_inferred_better_than_by_the_mean_pose(performance):
    skeleton = performance.subject.skeleton
    arm = [skeleton.find_joint(f"Left{name}") for name in ("Arm", "ForeArm", "Hand", "FingerBase", "HandIndex1")]
    markers = performance.marker_positions.copy()
    markers[:, np.isin(performance.subject.joints, arm)] = np.nan
    before, after = (measure_error(performance, initialise(performance, markers, m))[:, arm] for m in ("hybrik-x", "learned"))
    assert after.mean() < before.mean()
    assert np.isfinite(after).all()


def test_preview_has_a_pose_in_every_frame_and_states_its_error(performance, tmp_path):
    path = tmp_path / "take.c3d"
    write_synthetic_take(path, performance)
    result = pipeline.clean(path, is_fast=True)
    assert result.motion is not None
    assert result.contacts is not None
    assert result.contacts.is_known[:, :4].all()  # also of toes without a marker of their own
    assert (result.motion.iterations == 0).all()
    assert any(note.startswith("Preview: ") and "10 mm" in note for note in result.subject_report["notes"])
    error = np.linalg.norm(result.joint_position_world - performance.joint_positions, axis=-1)
    assert np.nanmean(error) < 0.04
    solve = result.subject_report["solve"]
    assert solve is not None
    assert solve["start"] == "learned"
    assert solve["prior"] is None
    preview = set(result.write(tmp_path / "out"))
    assert {"rrd", "report.html"} == set(pipeline.clean(path).write(tmp_path / "out", overwrite=True)) - preview
    result.write(tmp_path / "out", overwrite=True)
    assert not (tmp_path / "out" / "take.rrd").exists()


def test_preview_has_events_of_gait_only_if_they_are_written(performance, tmp_path):
    path, events = tmp_path / "take.c3d", [GaitEvent("left", "foot strike", 0.5, "file")]
    write_synthetic_take(path, performance)
    add_c3d_events(path, get_layout(read_take(path)).data_start_byte, {"": events}, 1, performance.rate)
    without, written = (pipeline.clean(path, is_fast=True, write_events=each).contacts for each in (False, True))
    assert without is not None
    assert written is not None
    assert not without.events
    assert any(each.source == "file" for each in written.events)
    np.testing.assert_array_equal(without.is_contact, written.is_contact)


def test_some_frames_have_the_poses_that_they_have_in_the_whole_take(performance):
    """The frames are not consecutive, so their positions must not be smoothed as if they were."""
    skeleton, subject, body = performance.subject.skeleton, performance.subject, load_cmu31_body()
    markers = performance.marker_positions.copy()
    markers[:, np.isin(subject.joints, [skeleton.find_joint("LeftHand"), skeleton.find_joint("LeftFingerBase")])] = np.nan
    take, prior = Take(markers, subject.labels, 60.0), load_mean_pose_prior("mean-pose", body.skeleton)
    frames = np.array([3, 4, 50, 110])
    found = initial_motion.initialise_frames(take, frames, subject, body, prior, method="learned")
    expected = initial_motion.initialise_motion(take, subject, body, prior, "learned")
    np.testing.assert_allclose(found.local_rotations, expected.local_rotations[frames])
    np.testing.assert_allclose(found.root_position, expected.root_position[frames])


def test_first_poses_between_those_of_their_own_rate_are_near_those_of_all_frames(performance):
    columns = np.arange(len(performance.subject.labels))
    take = Take(performance.marker_positions, performance.subject.labels, 60.0)
    subject = SubjectInTake(performance.subject, performance.subject, columns, take)
    found = initial_motion.initialise_between(subject, "hybrik-x")
    body, prior = load_cmu31_body(), load_mean_pose_prior("mean-pose", load_cmu31_body().skeleton)
    every = initial_motion.initialise_motion(take, performance.subject, body, prior, "hybrik-x")
    frames = [0, 2, 116, len(take.markers) - 1]  # the last is no multiple of the step
    np.testing.assert_allclose(found.local_rotations[frames], every.local_rotations[frames], atol=1e-9)
    rotation = found.local_rotations
    np.testing.assert_allclose(np.einsum("tjab,tjcb->tjac", rotation, rotation) - np.eye(3), 0.0, atol=1e-9)
    first, second = (compute_world_poses(performance.subject.skeleton, each)[0] for each in (found, every))
    assert np.linalg.norm(first - second, axis=-1).mean() < 0.004
