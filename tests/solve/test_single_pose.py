"""Single poses from joints, bones, distances and cameras, and the rejection of invalid constraints."""

import re
from typing import cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.errors import ConstraintError, SceneError
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import kinematics, single_pose, trained_priors
from mocapfix.solve.single_pose import (
    Camera,
    DirectionConstraint,
    DistanceConstraint,
    OrientationConstraint,
    PixelConstraint,
    PositionConstraint,
)

SKELETON = load_cmu31_body().skeleton
GAUSSIAN = trained_priors.load_pose_model("gaussian", SKELETON)
INDEX = SKELETON.find_joint


def draw_person(seed=0, heading=0.0):
    """Return joints (31, 3) and world rotations (31, 3, 3) of a pose that the Gaussian knows, facing anywhere"""
    code = np.random.default_rng(seed).normal(0, 0.7, (1, GAUSSIAN.code_size))
    local = Rotation.from_rotvec(GAUSSIAN.decode(code)[0]).as_matrix() @ GAUSSIAN.reference_rotations
    local[0] = Rotation.from_euler("y", heading).as_matrix() @ local[0]
    position, rotation = kinematics.compute_tree_poses(
        kinematics.build_kinematic_tree(SKELETON), np.array([[1.0, 0.9, -2.0]]), local[None]
    )
    return position[0], rotation[0]


def at(found, joint):
    return found.joint_positions[INDEX(joint)]


@pytest.mark.parametrize("heading", [0.0, 1.5, 3.1, -2.2])
def test_all_joints_determine_the_pose_in_any_heading(heading):
    joints, _ = draw_person(1, heading)
    found = single_pose.solve_pose(
        [PositionConstraint(name, p, 0.003) for name, p in zip(SKELETON.names, joints, strict=True)], "gaussian"
    )
    np.testing.assert_allclose(found.joint_positions, joints, atol=0.01)
    assert found.status.startswith("solved")
    assert found.iterations > 0
    assert found.joint_sd.max() < 0.005


def test_prior_predicts_unconstrained_joints_better_than_none():
    joints, _ = draw_person(2)
    given = [
        PositionConstraint(name, joints[INDEX(name)])
        for name in ("Head", "LeftHand", "RightHand", "LeftFoot", "RightFoot", "Hips")
    ]
    off = [
        np.linalg.norm(single_pose.solve_pose(given, prior).joint_positions - joints, axis=1).mean()
        for prior in ("gaussian", "none")
    ]
    assert off[0] < 0.6 * off[1]


def test_sd_is_small_at_constraints():
    joints, _ = draw_person(3)
    names = ("Head", "LeftHand", "LeftFoot", "RightFoot", "Hips")
    found = single_pose.solve_pose([PositionConstraint(name, joints[INDEX(name)], 0.004) for name in names], GAUSSIAN)
    assert all(found.joint_sd[INDEX(name)] < 0.0045 for name in names)
    assert found.joint_sd[INDEX("RightHand")] > 0.05


def test_point_direction_and_orientation_constraints_hold():
    joints, rotation = draw_person(4)
    thumb = np.array([0.02, -0.05, 0.01])
    tip, bone = (
        joints[INDEX("LeftHand")] + rotation[INDEX("LeftHand")] @ thumb,
        joints[INDEX("RightLeg")] - joints[INDEX("RightUpLeg")],
    )
    found = single_pose.solve_pose(
        [
            PositionConstraint("Hips", joints[0], 0.001),
            PositionConstraint("LeftHand", tip, 0.001, thumb),
            DirectionConstraint("RightUpLeg", "RightLeg", 3 * bone, 0.002),
            OrientationConstraint("Head", rotation[INDEX("Head")], 0.002),
        ],
        GAUSSIAN,
    )
    _, turned = kinematics.compute_tree_poses(
        kinematics.build_kinematic_tree(SKELETON), found.root_position[None], found.local_rotations[None]
    )
    np.testing.assert_allclose(at(found, "LeftHand") + turned[0, INDEX("LeftHand")] @ thumb, tip, atol=0.003)
    away = at(found, "RightLeg") - at(found, "RightUpLeg")
    assert np.dot(away, bone) / np.linalg.norm(away) / np.linalg.norm(bone) > np.cos(0.01)
    turn = Rotation.from_matrix(turned[0, INDEX("Head")] @ rotation[INDEX("Head")].T)
    assert turn.magnitude() < 0.01


def test_distance_constraint_holds():
    found = single_pose.solve_pose(
        [PositionConstraint("Hips", (0, 1, 0)), DistanceConstraint(("LeftHand", "RightHand"), 0.1, 0.001)], GAUSSIAN
    )
    assert np.linalg.norm(at(found, "LeftHand") - at(found, "RightHand")) == pytest.approx(0.1, abs=0.005)


@pytest.mark.parametrize("perspective", [True, False])
def test_two_cameras_determine_the_pose(perspective):
    joints, _ = draw_person(5)
    constraints, views = [], []
    for turn in (0.3, 1.7):
        rotation = Rotation.from_euler("xy", [np.pi, turn]).as_matrix()
        camera = Camera(rotation, np.array([0.1, 0.9, 4.0]) - rotation @ joints[0], 800.0, (640.0, 360.0), perspective)
        before = joints @ rotation.T + camera.translation
        pixels = 800.0 * before[:, :2] / (before[:, 2:] if perspective else 1.0) + [640.0, 360.0]
        views.append(pixels)
        constraints += [PixelConstraint(name, camera, pixel, 2.0) for name, pixel in zip(SKELETON.names, pixels, strict=True)]
    found = single_pose.solve_pose(constraints, GAUSSIAN)
    np.testing.assert_allclose(found.joint_positions, joints, atol=0.03)


def test_solve_starts_at_the_given_pose():
    joints, _ = draw_person(6)
    given = [PositionConstraint(name, p, 0.003) for name, p in zip(SKELETON.names, joints, strict=True)]
    first = single_pose.solve_pose(given, GAUSSIAN)
    again = single_pose.solve_pose(given, GAUSSIAN, start=(first.root_position, first.local_rotations))
    assert again.iterations <= first.iterations
    np.testing.assert_allclose(again.joint_positions, first.joint_positions, atol=1e-3)


def test_larger_prior_scale_favours_constraints():
    given, span = (
        [PositionConstraint("LeftHand", (3.0, 1.0, 0.0), 1.0), PositionConstraint("RightHand", (-3.0, 1.0, 0.0), 1.0)],
        [],
    )
    for scale in (0.2, 5.0):
        found = single_pose.solve_pose(given, GAUSSIAN, prior_scale=scale)
        span.append(np.linalg.norm(at(found, "LeftHand") - at(found, "RightHand")))
    assert span[1] > 1.5 * span[0]


HAND = PositionConstraint("LeftHand", (0.5, 1.4, 0.3))


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ([], "There is no constraint"),
        (
            [HAND, "head"],
            "'head' is not a constraint; choose from: PositionConstraint, DirectionConstraint, OrientationConstraint",
        ),
        (
            [PositionConstraint("LeftHnd", (0, 0, 0))],
            "PositionConstraint of LeftHnd: there is no joint 'LeftHnd'; the skeleton has: Hips, LHipJoint",
        ),
        (
            [PositionConstraint("Head", (0, np.nan, 0))],
            r"PositionConstraint of Head: position must be 3 finite numbers, not \(0, nan, 0\).",
        ),
        ([PositionConstraint("Head", (0, 0))], r"PositionConstraint of Head: position must be 3 finite numbers, not \(0, 0\)."),
        ([PositionConstraint("Head", (0, 0, 0), 0.0)], "PositionConstraint of Head: sd must be greater than 0, not 0.0."),
        (
            [PositionConstraint("Head", (0, 0, 0), cast("float", "x"))],
            "PositionConstraint of Head: sd must be one finite number, not 'x'.",
        ),
        (
            [DirectionConstraint("LeftArm", "Head", (0, 1, 0))],
            "DirectionConstraint of LeftArm: Head is no child of LeftArm; its parent is Neck1.",
        ),
        ([DirectionConstraint("Hips", "Hips", (0, 1, 0))], "its parent is none."),
        (
            [DirectionConstraint("LeftArm", "LeftForeArm", (0, 0, 0))],
            "DirectionConstraint of LeftArm: direction has length zero and therefore no direction.",
        ),
        ([OrientationConstraint("Head", -np.eye(3))], "OrientationConstraint of Head: rotation must be a right-handed matrix"),
        ([DistanceConstraint(("Head", "Foot"), 1.0)], "DistanceConstraint of Head and Foot: there is no joint 'Foot'"),
        ([DistanceConstraint(("Head", "Neck"), np.inf)], "distance must be one finite number, not inf."),
        ([DistanceConstraint(("Head",), 1.0)], "DistanceConstraint of Head: joints must be the names of two joints."),  # type: ignore[arg-type]
        ([DistanceConstraint("Head", 1.0)], "DistanceConstraint of Head: joints must be the names of two joints."),  # type: ignore[arg-type]
        ([PixelConstraint("Head", None, (1, 2))], "PixelConstraint of Head: camera must be a Camera, not None."),  # type: ignore[arg-type]
        (
            [PixelConstraint("Head", Camera(np.eye(3), (0, 0, 4), 0.0), (1, 2))],
            "PixelConstraint of Head: camera.scale must be greater than 0",
        ),
    ],
)
def test_invalid_constraints_are_rejected(wrong, why):
    with pytest.raises(ConstraintError, match=why):
        single_pose.solve_pose(wrong, GAUSSIAN)


def test_unknown_prior_and_invalid_start_are_rejected():
    with pytest.raises(SceneError, match="There is no trained prior 'gauss'"):
        single_pose.solve_pose([HAND], "gauss")
    with pytest.raises(ConstraintError, match=re.escape("start must be a root (3,) and rotations (31, 3, 3)")):
        single_pose.solve_pose([HAND], GAUSSIAN, start=(np.zeros(3), np.zeros((31, 3))))
    with pytest.raises(ConstraintError, match="The rotations of start must be right-handed matrices"):
        single_pose.solve_pose([HAND], GAUSSIAN, start=(np.zeros(3), np.ones((31, 3, 3))))


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf])
def test_invalid_prior_scale_is_rejected(scale):
    with pytest.raises(ConstraintError, match=f"prior_scale must be greater than 0 and finite, not {scale!r}"):
        single_pose.solve_pose([HAND], GAUSSIAN, prior_scale=scale)


def test_mnn_ik_network_is_rejected_by_name():
    with pytest.raises(
        SceneError,
        match=r"'mnn-ik' is available in mocapfix bench prior only; choose one of: autoencoder, gaussian, mixture, pca\.",
    ):
        single_pose.solve_pose([HAND], "mnn-ik")
