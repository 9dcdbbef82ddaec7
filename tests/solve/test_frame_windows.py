"""The frames that are solved again after a change, and the windows that they are solved in."""

import numpy as np
import pytest

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.options import SolveOptions
from mocapfix.solve import initial_motion, kinematics, mean_pose, motion_solver, pose_problem
from mocapfix.solve.pose_problem import FrameWindow, change_all_frames, find_changed_frames, select_windows
from mocapfix.synthetic import compose_take

BODY = load_cmu31_body()
PRIOR, LIMITS = mean_pose.load_mean_pose_prior("mean-pose", BODY.skeleton), mean_pose.load_joint_limits(BODY.skeleton)
RATE = 60.0


def mark(frame_count: int, *frames: int) -> np.ndarray:
    mask = np.zeros(frame_count, bool)
    mask[list(frames)] = True
    return mask


def test_changed_frames_are_those_with_other_samples():
    old = np.random.default_rng(0).normal(size=(6, 2, 3))
    old[3, 1] = np.nan
    new = old.copy()
    new[1, 0] = np.nan  # rejected
    new[4, 1] += 0.01  # another label
    changes = find_changed_frames(old, new, is_same_subject=True)
    np.testing.assert_array_equal(changes.is_restarted, mark(6, 1, 4))
    np.testing.assert_array_equal(changes.is_affected, mark(6, 1, 4))
    changes = find_changed_frames(old, new, is_same_subject=False)
    np.testing.assert_array_equal(changes.is_restarted, mark(6, 1, 4))
    assert changes.is_affected.all()


def test_frames_with_an_added_marker_start_from_their_solution():
    old = np.zeros((4, 2, 3))
    new = np.full((4, 3, 3), np.nan)
    new[:, :2] = 0.0
    new[2:, 2] = 1.0
    changes = find_changed_frames(old, new, is_same_subject=True)
    assert not changes.is_restarted.any()
    np.testing.assert_array_equal(changes.is_affected, mark(4, 2, 3))


def test_windows_reach_beyond_the_changes():
    windows = select_windows(mark(2000, 300, 310, 1999), RATE)
    assert windows == [FrameWindow(270, 341, 240, 371), FrameWindow(1969, 2000, 1939, 2000)]
    np.testing.assert_array_equal(pose_problem.list_window_frames(windows), np.r_[270:341, 1969:2000])
    assert select_windows(np.zeros(50, bool), RATE) == []


def test_many_changes_make_one_window_and_long_takes_several(monkeypatch):
    assert select_windows(mark(300, 100, 200), RATE) == [FrameWindow(0, 300, 0, 300)]
    monkeypatch.setattr(pose_problem, "MAX_WINDOW_FRAMES", 100)
    windows = select_windows(np.ones(300, bool), RATE)
    assert windows == [FrameWindow(0, 100, 0, 130), FrameWindow(100, 200, 70, 230), FrameWindow(200, 300, 170, 300)]
    np.testing.assert_array_equal(pose_problem.list_window_frames(windows), np.arange(300))


@pytest.fixture(scope="module")
def scene():
    """Return a subject, a take of six seconds, and the same with a spike in frame 180."""
    truth = compose_take(seed=4, seconds=6.0, rate=RATE)
    take = Take(truth.marker_positions, truth.labels, RATE)
    markers = take.markers.copy()
    markers[180, truth.labels.index("LWRA")] += 0.04
    return truth.subject, take, Take(markers, truth.labels, RATE)


def build_problem(subject, take):
    return pose_problem.build_motion_problem(take, subject, BODY, PRIOR, LIMITS, SolveOptions())


def solve(subject, take):
    start = initial_motion.initialise_motion(take, subject, BODY, PRIOR)
    return motion_solver.solve_changed_frames(build_problem(subject, take), start, change_all_frames(take.frame_count))


def compute_joints(subject, motion):
    return kinematics.compute_joint_and_marker_positions(subject, motion)[0]


def test_solving_the_changes_equals_solving_all(scene):
    subject, _, spiked = scene
    markers = spiked.markers.copy()
    markers[180, spiked.labels.index("LWRA")] = np.nan
    repaired = Take(markers, spiked.labels, RATE)
    motion, evidence = solve(subject, spiked)
    before = compute_joints(subject, motion)
    changes = find_changed_frames(spiked.markers, repaired.markers, is_same_subject=True)
    updated, _ = motion_solver.solve_changed_frames(build_problem(subject, repaired), motion, changes, evidence)
    after, whole = (compute_joints(subject, each) for each in (updated, solve(subject, repaired)[0]))
    assert np.linalg.norm(whole[180] - before[180], axis=-1).max() > 1e-3  # the spike moved the hand
    assert np.linalg.norm(whole - after, axis=-1).max() < 1e-3
    kept = np.r_[0:149, 212:360]
    np.testing.assert_array_equal(after[kept], before[kept])


def test_several_windows_give_nearly_the_same_solution_as_one(scene, monkeypatch):
    subject, take, _ = scene
    whole = compute_joints(subject, solve(subject, take)[0])
    monkeypatch.setattr(pose_problem, "MAX_WINDOW_FRAMES", 120)
    parts = compute_joints(subject, solve(subject, take)[0])
    distance = np.linalg.norm(whole - parts, axis=-1)
    assert distance.max() < 5e-3
    assert distance.mean() < 1e-4
