"""Motion and camera of an example film; every solve has the same terms, so that it compiles once."""

import json
from dataclasses import replace

import numpy as np
import pytest

from mocapfix.keypoints import film_solver
from mocapfix.keypoints.film_solver import ReprojectionProblem, build_camera_rotation
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import trained_priors
from tests.keypoints.example_film import compose_example_film

RATE = 10.0
SKELETON = load_cmu31_body().skeleton
MODEL = trained_priors.load_pose_model("pca", SKELETON)


def compute_error_m(found, truth):
    """Mean distances (T,) of joints (T, J, 3) relative to the root."""
    return np.linalg.norm((found - found[:, :1]) - (truth - truth[:, :1]), axis=-1).mean(axis=1)


@pytest.fixture(scope="module")
def composed(tmp_path_factory):
    """Keypoints, true joints and true camera."""
    film, joints, camera = compose_example_film("openpose", 1.0, RATE)
    path = tmp_path_factory.mktemp("film") / "film.json"
    path.write_text(json.dumps(film), encoding="utf-8")
    return film_solver.read_keypoints(path, SKELETON), joints, camera


def build_problem(keypoints):
    weight = np.where(keypoints.confidence > 0, keypoints.confidence / keypoints.detector.sd_m, 0.0) ** 2
    return ReprojectionProblem(
        SKELETON, keypoints.detector, MODEL, 1.0, build_camera_rotation(0.0), keypoints.position_px, weight
    )


@pytest.fixture(scope="module")
def solved(composed):
    return film_solver.solve_film(composed[0], RATE, SKELETON, MODEL, build_camera_rotation(0.0))


def compute_positions(keypoints, motion):
    return build_problem(keypoints).compute_positions(motion.root_position, motion.local_rotations)


def test_motion_and_camera_are_estimated_together(composed, solved):
    keypoints, joints, camera = composed
    motion, found = solved
    at, points = compute_positions(keypoints, motion)
    assert found.scale == pytest.approx(camera.scale, rel=0.03)
    assert compute_error_m(at, joints).mean() < 0.08
    distance = np.linalg.norm(found.project(points) - keypoints.position_px, axis=-1)[keypoints.confidence > 0]
    assert distance.mean() < 5.0


def test_body_stands_on_the_floor_above_the_origin(composed, solved):
    at, _ = compute_positions(composed[0], solved[0])
    assert at[..., 1].min() == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(solved[0].root_position[0, [0, 2]], 0, atol=1e-9)


def test_image_size_does_not_change_the_motion(composed, solved):
    keypoints = replace(composed[0], position_px=3 * composed[0].position_px + [50.0, -20.0])
    motion, camera = film_solver.solve_film(keypoints, RATE, SKELETON, MODEL, build_camera_rotation(0.0))
    assert camera.scale == pytest.approx(3 * solved[1].scale, rel=0.01)
    np.testing.assert_allclose(compute_positions(keypoints, motion)[0], compute_positions(keypoints, solved[0])[0], atol=0.02)


def test_frame_without_keypoints_is_interpolated(composed, solved):
    confidence = composed[0].confidence.copy()
    confidence[4:6] = 0.0
    keypoints = replace(composed[0], confidence=confidence)
    motion, _ = film_solver.solve_film(keypoints, RATE, SKELETON, MODEL, build_camera_rotation(0.0))
    found, expected = compute_positions(keypoints, motion)[0], compute_positions(keypoints, solved[0])[0]
    assert compute_error_m(found, expected)[4:6].max() < 0.12
    assert np.abs(motion.root_position - solved[0].root_position)[4:6].max() < 0.05


def test_single_image_is_solved(composed):
    one = replace(composed[0], position_px=composed[0].position_px[:1], confidence=composed[0].confidence[:1])
    motion, camera = film_solver.solve_film(one, RATE, SKELETON, MODEL, build_camera_rotation(0.0))
    assert motion.frame_count == 1
    assert camera.scale == pytest.approx(composed[2].scale, rel=0.15)
    assert compute_error_m(compute_positions(one, motion)[0], composed[1][:1])[0] < 0.15


def test_outlier_keypoints_hardly_change_the_motion(composed, solved):
    position_px = composed[0].position_px.copy()
    position_px[::4, 4] += [150.0, 60.0]  # right wrists
    keypoints = replace(composed[0], position_px=position_px)
    motion, camera = film_solver.solve_film(keypoints, RATE, SKELETON, MODEL, build_camera_rotation(0.0))
    assert camera.scale == pytest.approx(solved[1].scale, rel=0.03)
    assert compute_error_m(compute_positions(keypoints, motion)[0], composed[1]).mean() < 0.09


def test_robust_weight_decreases_with_distance(composed):
    problem, scale = build_problem(composed[0]), 180.0
    points = np.zeros((*problem.weight.shape, 3))
    points[..., :2] = problem.position_px / scale * [1, -1]
    np.testing.assert_allclose(problem.compute_robust_weights(scale, points), problem.weight)
    off = problem.robust_scales_sd[-1] / np.sqrt(
        np.maximum(problem.weight, 1e-9)
    )  # at the Geman-McClure scale the weight is a quarter
    points[..., 0] += off
    np.testing.assert_allclose(problem.compute_robust_weights(scale, points), problem.weight / 4)


def test_transition_cost_depends_on_joint_speed_relative_to_the_root():
    joints = np.zeros((2, 2, 4, 3))
    joints[1, :] += 5.0  # all joints alike: motion of the root has no cost
    joints[1, 1, 3, 0] += 0.2
    step = film_solver.compute_transition_costs(joints, 30.0)
    assert step.shape == (1, 2, 2)
    np.testing.assert_array_equal(step[0, :, 0], 0)
    assert step[0, 0, 1] == step[0, 1, 1] > 0
    np.testing.assert_allclose(film_solver.compute_transition_costs(joints, 60.0), 4 * step)


def test_headings_differ_in_the_root_only():
    pose = np.tile(np.eye(3), (31, 1, 1))
    poses = film_solver.rotate_to_headings(pose)
    np.testing.assert_array_equal(poses[:, 1:], np.tile(pose[1:], (film_solver.HEADING_COUNT, 1, 1, 1)))
    forward = poses[:, 0, :, 2]
    np.testing.assert_allclose(forward[:, 1], 0, atol=1e-12)
    np.testing.assert_allclose(forward.sum(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(forward[0], [0, 0, 1], atol=1e-12)
    assert len(poses[0]) == len(load_cmu31_body().skeleton.names)
