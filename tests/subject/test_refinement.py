"""Bones and marker offsets refined from frames with exact markers."""

from dataclasses import replace

import numpy as np

from mocapfix import synthetic as motions
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.solve import kinematics, mean_pose
from mocapfix.subject import refinement
from mocapfix.subject.library import load_marker_set

BODY, MARKER_SET = load_cmu31_body(), load_marker_set("cmu41")
MEAN = mean_pose.load_mean_pose_prior("mean-pose", BODY.skeleton)
NOMINAL = Subject(
    BODY.skeleton, MARKER_SET.name, MARKER_SET.labels, MARKER_SET.joints, MARKER_SET.marker_offsets, MARKER_SET.marker_spread
)
INDEX = {joint: g for g, joints in enumerate(BODY.bone_groups.values()) for joint in joints}
GROUPS = np.array([INDEX.get(joint, -1) for joint in range(len(BODY.skeleton.names))])


def lengths(skeleton):
    return np.linalg.norm(skeleton.offsets, axis=1)


def scale_bones(scales):
    """Return the average body with its bone groups scaled by `scales` (G,), markers at their nominal offsets."""
    factor = np.where(GROUPS >= 0, scales[GROUPS], 1.0)
    return replace(NOMINAL, skeleton=replace(BODY.skeleton, offsets=BODY.skeleton.offsets * factor[:, None]))


def perform(subject, frames=90):
    """Return the markers (N, K, 3) of a person who walks, reaches and crouches, and the motion."""
    motion = motions.compose_motion(subject, 9.0, frames / 9.0)
    return kinematics.compute_joint_and_marker_positions(subject, motion)[1], motion


def refine(markers, start=NOMINAL, interval_s=0.1):
    posed = refinement.pose_frames(start, BODY, MEAN, markers)
    times_s = interval_s * np.arange(len(markers))
    found = refinement.refine_body(start, BODY, MEAN, markers, posed)
    return refinement.build_refined_subject(start, found.state, found.curvature, times_s)


def test_average_body_is_a_fixed_point():
    found = refine(perform(NOMINAL)[0])
    np.testing.assert_allclose(lengths(found.skeleton), lengths(BODY.skeleton), atol=0.013)  # the prior bends the wrists
    assert np.linalg.norm(found.marker_offsets - MARKER_SET.marker_offsets, axis=1).mean() < 0.006


def test_longer_legs_are_recovered_symmetrically():
    scales = np.ones(len(BODY.bone_groups))
    thigh, shin = (GROUPS[BODY.skeleton.find_joint(name)] for name in ("LeftLeg", "LeftFoot"))
    scales[thigh], scales[shin] = 1.08, 0.93
    subject = scale_bones(scales)
    found = refine(perform(subject)[0])
    for name in ("LeftLeg", "LeftFoot"):
        j = BODY.skeleton.find_joint(name)
        true, guess = lengths(subject.skeleton)[j], lengths(BODY.skeleton)[j]
        assert abs(lengths(found.skeleton)[j] - true) < 0.4 * abs(guess - true)
    left = [j for j, name in enumerate(BODY.skeleton.names) if name.startswith("Left")]
    right = [BODY.skeleton.find_joint(BODY.skeleton.names[j].replace("Left", "Right")) for j in left]
    np.testing.assert_allclose(lengths(found.skeleton)[left], lengths(found.skeleton)[right], atol=0.005)


def test_shape_component_is_recovered():
    offsets = BODY.skeleton.offsets + np.tensordot([1.5, -1.0, 0.0, 1.5], BODY.shape_components[:4], 1)
    subject = replace(NOMINAL, skeleton=replace(BODY.skeleton, offsets=offsets))
    found = refine(perform(subject)[0])
    # bones with markers at one end or both
    carried = np.unique([*MARKER_SET.joints, *BODY.skeleton.parents[MARKER_SET.joints]])[1:]
    off, was = (np.linalg.norm(each.offsets - offsets, axis=1)[carried].mean() for each in (found.skeleton, BODY.skeleton))
    assert off < 0.5 * was


def test_displaced_marker_is_recovered():
    k = MARKER_SET.labels.index("LTHI")
    places = MARKER_SET.marker_offsets.copy()
    places[k] += [0.02, 0.03, -0.02]
    subject = replace(NOMINAL, marker_offsets=places)
    found = refine(perform(subject)[0])
    assert np.linalg.norm(found.marker_offsets[k] - places[k]) < 0.4 * np.linalg.norm(MARKER_SET.marker_offsets[k] - places[k])


def test_sd_of_an_invisible_marker_is_its_prior():
    markers, _ = perform(NOMINAL, frames=30)
    k = MARKER_SET.labels.index("RWRA")
    markers[:, k] = np.nan
    found = refine(markers)
    assert MARKER_SET.marker_spread[k] < found.marker_sd[k] < 1.5 * MARKER_SET.marker_spread[k]  # and a little of the forearm's
    assert (np.delete(found.marker_sd, k) < 0.2 * MARKER_SET.marker_spread[k]).all()
    assert (found.joint_sd > 0).all()


def test_errors_of_markers_are_not_taken_for_motion():
    still = np.repeat(perform(NOMINAL, frames=30)[0][:1], 60, axis=0)
    noise = np.random.default_rng(0).normal(0, 0.012, still.shape)
    joints = [BODY.skeleton.find_joint(name) for name in ("LeftFoot", "RightFoot", "LeftHand", "RightHand")]
    exact, noisy = (refine(markers, interval_s=0.5).joint_sd[joints] for markers in (still, still + noise))
    assert (noisy > 0.95 * exact).all()  # nobody moved: more error makes no joint certain


def test_invisible_parts_stay_nominal_at_the_body_size():
    markers, _ = perform(NOMINAL)
    k = MARKER_SET.labels.index("RWRA")
    markers[:, k] = np.nan
    found = refine(markers)
    size = (found.marker_offsets[k] @ MARKER_SET.marker_offsets[k]) / (
        MARKER_SET.marker_offsets[k] @ MARKER_SET.marker_offsets[k]
    )
    assert 0.98 < size < 1.02
    np.testing.assert_allclose(found.marker_offsets[k], size * MARKER_SET.marker_offsets[k], atol=1e-6)
    assert found.marker_spread[k] == MARKER_SET.marker_spread[k]
    assert (np.delete(found.marker_spread, k) < 0.003).all()  # markers without noise


def test_spread_is_the_marker_motion():
    rng = np.random.default_rng(0)
    markers, _ = perform(NOMINAL, frames=120)
    k = MARKER_SET.labels.index("LTHI")
    markers[:, k] += rng.normal(0, 0.02, (120, 3))
    found = refine(markers)
    assert 0.01 < found.marker_spread[k] < 0.03
    assert np.median(found.marker_spread) < 0.004


def test_input_poses_are_not_modified():
    markers, _ = perform(NOMINAL, frames=30)
    posed = refinement.pose_frames(NOMINAL, BODY, MEAN, markers)
    was = [field.copy() for field in posed]
    assert len(refinement.refine_body(NOMINAL, BODY, MEAN, markers, posed).state.poses[0]) == 30
    for before, after in zip(was, posed, strict=True):
        np.testing.assert_array_equal(before, after)
