"""The common task: the same values on every machine, and a take as its scene defines it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.lab import common_task, compared_solvers
from mocapfix.stats.sequences import find_runs

TASK = common_task.build_common_task()
LABELS, NAMES = TASK.subject.labels, TASK.subject.skeleton.names
HANDS = [
    [-0.2858662424, 0.7328595430, 0.1402946543],
    [0.0169141232, 0.9207433655, 1.4011055826],
    [-1.2932999804, 0.8864624952, -0.3435944043],
]  # the right index finger in the first, a middle and the last frame, metres
NOISY, START = [1.1325114353, 1.0739727444, 1.2239774103], [-0.0025025103, 0.9298809013, 0.0023594273]


def test_task_has_the_expected_values():
    assert (len(NAMES), len(LABELS), TASK.rate_hz) == (31, 53, 120.0)
    assert TASK.joint_positions.shape == (600, 31, 3)
    found = TASK.joint_positions[[0, 299, 599], NAMES.index("RightHandIndex1")]
    np.testing.assert_allclose(found, HANDS, atol=1e-9)
    np.testing.assert_allclose(TASK.takes["noisy"][137, LABELS.index("LFIN")], NOISY, atol=1e-9)
    np.testing.assert_allclose(TASK.root_starts["noisy"][0], START, atol=1e-9)


def test_a_tenth_of_the_noisy_take_is_missing_in_gaps_of_at_least_half_a_second():
    is_missing = np.isnan(TASK.takes["noisy"][..., 0])
    assert 0.1 <= is_missing.mean() < 0.1 + 60 / is_missing.size
    assert min(last - first + 1 for marker in is_missing.T for first, last in find_runs(marker)) == 60
    assert not np.isnan(TASK.takes["clean"]).any()


def test_noise_is_two_millimetres_per_axis():
    noise = (TASK.takes["noisy"] - TASK.takes["clean"]).reshape(-1, 3)
    np.testing.assert_allclose(np.nanstd(noise, axis=0), 0.002, rtol=0.02)
    np.testing.assert_allclose(np.nanmean(noise, axis=0), 0.0, atol=5e-5)


def test_bone_lengths_are_constant_and_speeds_are_human():
    parents, offsets = TASK.subject.skeleton.parents[1:], TASK.subject.skeleton.offsets[1:]
    lengths = np.linalg.norm(TASK.joint_positions[:, 1:] - TASK.joint_positions[:, parents], axis=-1)
    np.testing.assert_allclose(lengths, np.tile(np.linalg.norm(offsets, axis=1), (600, 1)), atol=1e-12)
    speed = np.linalg.norm(np.diff(TASK.takes["clean"], axis=0), axis=-1) * TASK.rate_hz
    assert 2.0 < speed.max() < 8.0


def test_joint_error_of_a_translated_body_is_the_distance():
    poses = compared_solvers.solve_with_mocapfix(TASK, "clean", use_all_cores=False)
    error = TASK.compute_joint_error(poses.root_position, poses.rotations)
    assert error < 0.67e-3
    assert TASK.compute_joint_error(poses.root_position + [0.3, 0.0, 0.4], poses.rotations) == pytest.approx(0.5, abs=error)


@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_zyx_rotations_agree_with_scipy(angles):
    expected = Rotation.from_euler("ZYX", angles).as_matrix()
    np.testing.assert_allclose(common_task.compute_zyx_rotations(np.array([[angles]]))[0, 0], expected, atol=1e-12)


def test_scipy_solver_jacobian_is_the_derivative_of_the_markers():
    x, moves_marker = np.random.default_rng(0).normal(0, 0.4, 96), compared_solvers.find_moving_joints(TASK)
    steps = 1e-6 * np.eye(96)
    numeric = (
        np.stack(
            [
                compared_solvers.place_markers(TASK, x + h).marker_positions
                - compared_solvers.place_markers(TASK, x - h).marker_positions
                for h in steps
            ],
            axis=-1,
        )
        / 2e-6
    )
    np.testing.assert_allclose(
        compared_solvers.compute_marker_jacobian(compared_solvers.place_markers(TASK, x), moves_marker), numeric, atol=1e-8
    )


def test_both_solvers_find_nearly_the_same_poses():
    scipy, own = (
        compared_solvers.solve_with_scipy(TASK, "noisy", 6),
        compared_solvers.solve_with_mocapfix(TASK, "noisy", use_all_cores=False),
    )
    assert scipy.rotations.shape == (6, 31, 3, 3)
    own_error, scipy_error = (
        TASK.compute_joint_error(own.root_position[:6], own.rotations[:6]),
        TASK.compute_joint_error(scipy.root_position, scipy.rotations),
    )
    assert own_error == pytest.approx(scipy_error, rel=0.05)


@pytest.mark.parametrize(("name", "least", "most"), [("clean", 0.60, 0.67), ("noisy", 2.15, 2.23)])
def test_sweep_gives_equal_results_on_one_thread_and_on_all(name, least, most):
    one, every = (
        compared_solvers.solve_with_mocapfix(TASK, name, use_all_cores=False),
        compared_solvers.solve_with_mocapfix(TASK, name, use_all_cores=True),
    )
    assert least < 1e3 * TASK.compute_joint_error(one.root_position, one.rotations) <= most
    np.testing.assert_array_equal(one.rotations, every.rotations)
    np.testing.assert_array_equal(one.root_position, every.root_position)
