"""The effect of calibration parameters on a body, and their prior."""

from dataclasses import replace

import numpy as np

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.solve import mean_pose
from mocapfix.subject import refinement
from mocapfix.subject.library import load_marker_set

BODY, MARKER_SET = load_cmu31_body(), load_marker_set("cmu41")
START = Subject(
    BODY.skeleton, MARKER_SET.name, MARKER_SET.labels, MARKER_SET.joints, MARKER_SET.marker_offsets, MARKER_SET.marker_spread
)
MEAN = mean_pose.load_mean_pose_prior("mean-pose", BODY.skeleton)
FREE = refinement.build_calibration_parameters(START, BODY, MEAN)
TURNING = np.flatnonzero(BODY.free_joints)[1:]
SHIFTS = slice(-MARKER_SET.marker_offsets.size - 3 * len(TURNING), -3 * len(TURNING))
BONES = refinement.list_bones(BODY.skeleton)


def unknowns(**parts):
    """Return all zero but the size, the shape (P,), scales of groups by their names, bones' lengths by joints' names, the places'
    shifts (K, 3), turns (F, 3)
    """
    x, shapes, groups = np.zeros(len(FREE.information)), len(BODY.shape_components), list(BODY.bone_groups)
    for name, value in parts.items():
        if name == "places":
            x[SHIFTS] = np.ravel(value)
        elif name == "turns":
            x[SHIFTS.stop :] = np.ravel(value)
        elif name == "shape":
            x[1 : 1 + shapes] = value
        else:
            named = ["size", *[None] * shapes, *groups, *(BODY.skeleton.names[np.argmax(bone.any(1))] for bone in BONES)]
            x[named.index(name)] = value
    return x


def test_zero_parameters_give_the_start():
    offsets, places, _ = FREE.compute_body(unknowns())
    np.testing.assert_array_equal(offsets, BODY.skeleton.offsets)
    np.testing.assert_array_equal(places, MARKER_SET.marker_offsets)


def test_size_group_and_bone_parameters_scale_lengths():
    offsets, places, _ = FREE.compute_body(unknowns(size=0.1, shin=0.2, LeftLeg=-0.2))
    expected = 1.1 * BODY.skeleton.offsets
    shins = list(BODY.bone_groups["shin"])
    expected[shins] = 1.3 * BODY.skeleton.offsets[shins]
    thigh = BODY.skeleton.find_joint("LeftLeg")
    expected[thigh] = 0.9 * BODY.skeleton.offsets[thigh]
    np.testing.assert_allclose(offsets, expected)
    np.testing.assert_allclose(places, 1.1 * MARKER_SET.marker_offsets)


def test_marker_shifts_are_in_joint_axes():
    shifts = np.random.default_rng(0).normal(0, 0.02, MARKER_SET.marker_offsets.shape)
    offsets, places, _ = FREE.compute_body(unknowns(places=shifts))
    np.testing.assert_array_equal(offsets, BODY.skeleton.offsets)
    np.testing.assert_allclose(places, MARKER_SET.marker_offsets + shifts)


def test_bone_parameter_scales_with_the_starting_body():
    tall = replace(START, skeleton=replace(BODY.skeleton, offsets=1.2 * BODY.skeleton.offsets))
    offsets, *_ = refinement.build_calibration_parameters(tall, BODY, MEAN).compute_body(unknowns(RightFoot=0.05))
    shin = BODY.skeleton.find_joint("RightFoot")
    np.testing.assert_allclose(offsets[shin], 1.05 * 1.2 * BODY.skeleton.offsets[shin])


def test_every_bone_occurs_once_and_the_thorax_carries_three_joints():
    np.testing.assert_array_equal(
        (BONES != 0).any((0, 2)), np.linalg.norm(BODY.skeleton.offsets, axis=1) > refinement.MIN_SCALED_BONE_LENGTH_M
    )
    assert ((BONES != 0).any(2).sum(0) <= 1).all()
    thorax = BONES[BONES[:, BODY.skeleton.find_joint("Neck")].any(1)][0]
    carried = [BODY.skeleton.names[j] for j in np.flatnonzero(thorax.any(1))]
    assert carried == ["Neck", "LeftShoulder", "RightShoulder"]


def test_shape_is_a_sum_of_components_at_body_size():
    weights = np.random.default_rng(1).normal(size=len(BODY.shape_components))
    offsets, places, _ = FREE.compute_body(unknowns(shape=weights))
    np.testing.assert_allclose(offsets - BODY.skeleton.offsets, np.tensordot(weights, BODY.shape_components, 1), atol=1e-15)
    np.testing.assert_array_equal(places, MARKER_SET.marker_offsets)
    tall = refinement.build_calibration_parameters(
        replace(START, skeleton=replace(BODY.skeleton, offsets=1.2 * BODY.skeleton.offsets)), BODY, MEAN
    )
    np.testing.assert_allclose(tall.compute_body(unknowns(shape=weights))[0], 1.2 * offsets)


def test_size_is_practically_free_and_other_parameters_have_their_sd():
    information = np.diag(FREE.information)
    assert information[0] < 1e-5
    np.testing.assert_allclose(information[unknowns(thigh=1.0) > 0], refinement.BONE_GROUP_SD**-2.0)
    np.testing.assert_allclose(information[unknowns(LeftLeg=1.0) > 0], refinement.INDIVIDUAL_BONE_LENGTH_SD**-2.0)
    np.testing.assert_allclose(information[unknowns(shape=1.0) > 0], 1.0)  # in deviations already
    np.testing.assert_allclose(information[SHIFTS], np.repeat(MARKER_SET.marker_spread**-2.0, 3))


def test_mean_pose_has_information_for_free_joints_only():
    turns = np.random.default_rng(2).normal(0, 0.1, (len(TURNING), 3))
    *_, found = FREE.compute_body(unknowns(turns=turns))
    np.testing.assert_array_equal(found[TURNING], turns)
    assert not np.delete(found, TURNING, 0).any()
    covariance = np.linalg.inv(FREE.information[SHIFTS.stop :, SHIFTS.stop :])
    np.testing.assert_allclose(
        covariance[:3, :3], MEAN.between_take_covariance[TURNING[0]] + refinement.MEAN_POSE_SD_RAD**2 * np.eye(3), atol=1e-9
    )
    clavicle = 3 * list(TURNING).index(BODY.skeleton.find_joint("LeftShoulder"))
    its = slice(clavicle, clavicle + 3)
    np.testing.assert_allclose(covariance[its, its], refinement.MEAN_POSE_SD_RAD**2 * np.eye(3), atol=1e-9)


def test_a_leaning_bone_keeps_its_length_and_carries_what_it_carries():
    skeleton = BODY.skeleton
    leans = refinement.list_bone_leans(skeleton, ("Neck",))
    assert leans.shape == (2, len(skeleton.names), 3)
    moved = np.flatnonzero((leans != 0).any((0, 2)))
    assert [skeleton.names[j] for j in moved] == ["Neck", "LeftShoulder", "RightShoulder"]
    neck = skeleton.find_joint("Neck")
    np.testing.assert_allclose(leans[:, neck] @ skeleton.offsets[neck], 0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(leans[:, neck], axis=1), np.linalg.norm(skeleton.offsets[neck]))


def test_people_vary_more_in_what_the_fit_holds_firmly():
    held = FREE.variance_ratio > 1
    assert held.sum() == 2 * len(refinement.FIRM_BONES)
    assumed = 1 / np.diag(FREE.information)[held]
    actual = np.diag(FREE.gradient_covariance)[held] * assumed**2  # of an estimate that stays at 0
    np.testing.assert_allclose(assumed, refinement.FIRM_BONE_LEAN_SD_RAD**2)
    np.testing.assert_allclose(actual, refinement.PEOPLE_LEAN_SD_RAD**2)
    np.testing.assert_array_equal(FREE.gradient_covariance[~held][:, ~held], FREE.information[~held][:, ~held])


def test_basis_is_the_change_of_the_body_with_each_unknown():
    calibration = FREE
    step = np.random.default_rng(0).normal(size=len(calibration.information))
    first, second = calibration.compute_body(np.zeros(len(step))), calibration.compute_body(step)
    change = calibration.shape_basis @ step
    joints, markers = second.offsets - first.offsets, second.marker_offsets - first.marker_offsets
    np.testing.assert_allclose(change[: joints.size + markers.size], np.r_[joints.ravel(), markers.ravel()], atol=1e-12)
    vectors = second.mean_pose_vectors[np.flatnonzero(calibration.free_joints)[1:]]
    np.testing.assert_allclose(change[joints.size + markers.size :], vectors.ravel(), atol=1e-12)
