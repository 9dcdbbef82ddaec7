"""The segments of markers on bodies with known poses."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import kinematics
from mocapfix.subject.library import load_marker_set, load_shipped_marker_sets
from mocapfix.subject.marker_set_fit import MarkerAtlas, attach_markers, build_marker_atlas, measure_marker_offsets

SKELETON = load_cmu31_body().skeleton
NAMES, ATLAS = SKELETON.names, build_marker_atlas(load_shipped_marker_sets())
NOTHING = np.zeros((1, len(NAMES)))


def posed(frames: int = 60, seed: int = 0, turn: float = 0.4) -> tuple[np.ndarray, np.ndarray]:
    """Return joints (N, J, 3) and rotations (N, J, 3, 3) in the world of a body whose joints all turn by about `turn` radians"""
    rng, joints = np.random.default_rng(seed), len(NAMES)
    local = Rotation.from_rotvec(rng.normal(0, turn, (frames * joints, 3))).as_matrix().reshape(frames, joints, 3, 3)
    return kinematics.compute_tree_poses(
        kinematics.build_kinematic_tree(SKELETON), rng.normal(0, 1, (frames, 3)), np.ascontiguousarray(local)
    )


POSITION, ROTATION = posed()


def riding(joint: str, place) -> np.ndarray:
    """Return (N, 3) metres: a marker at a place on a joint"""
    j = NAMES.index(joint)
    return POSITION[:, j] + ROTATION[:, j] @ np.asarray(place, float)


def one(marker: np.ndarray, log_odds: np.ndarray = NOTHING):
    return attach_markers(marker[:, None], POSITION, ROTATION, ATLAS, NAMES, log_odds)


@given(st.integers(0, len(ATLAS.joints) - 1), st.integers(0, 2**31))
def test_marker_near_a_known_position_is_attached_there(which, seed):
    rng = np.random.default_rng(seed)
    place = ATLAS.offsets[which] + rng.normal(0, 0.02, 3)
    found = one(riding(NAMES[ATLAS.joints[which]], place) + rng.normal(0, 0.003, (len(POSITION), 3)))
    assert found.joints[0] == ATLAS.joints[which]
    assert found.probability[0] > 0.9
    assert found.residual_sd[0] < 0.006
    np.testing.assert_allclose(found.offsets[0], place, atol=0.003)
    assert found.rejection_reasons == ("",)


def test_independently_moving_marker_is_rejected():
    found = one(np.random.default_rng(1).normal(0, 1, (len(POSITION), 3)))
    assert found.joints[0] == -1
    assert "and by more against every other segment" in found.rejection_reasons[0]


def test_held_marker_is_rejected_unless_its_label_names_the_segment():
    stick = riding("LeftHand", [0.1, 0.0, 0.5])
    found = one(stick)
    assert found.joints[0] == -1
    assert "on a prop or another segment" in found.rejection_reasons[0]
    log_odds = NOTHING.copy()
    log_odds[0, NAMES.index("LeftHand")] = 4.0
    assert NAMES[one(stick, log_odds).joints[0]] == "LeftHand"


def test_rarely_visible_marker_is_rejected():
    marker = riding("Head", [0, 0.2, 0])
    marker[5:] = np.nan
    assert "visible in 5 of the frames" in one(marker).rejection_reasons[0]
    found = one(np.full_like(marker, np.nan))
    assert (found.rejection_reasons, found.joints[0]) == (("is never visible",), -1)


def test_short_takes_need_fewer_frames():
    marker, few = riding("Head", [0, 0.2, 0])[:, None], slice(0, 6)
    found = attach_markers(marker[few], POSITION[few], ROTATION[few], ATLAS, NAMES, NOTHING)
    assert (NAMES[found.joints[0]], found.rejection_reasons) == ("Head", ("",))


def test_a_tenth_of_the_frames_may_be_outliers():
    marker = riding("RightLeg", [-0.135, -0.133, -0.011])
    marker[:5] += 0.5
    found = one(marker)
    assert (NAMES[found.joints[0]], found.residual_sd[0] < 0.001) == ("RightLeg", True)


def test_position_decides_without_motion():
    position, rotation = np.repeat(POSITION[:1], 60, axis=0), np.repeat(ROTATION[:1], 60, axis=0)
    marker_set = load_marker_set("cmu41")
    markers = position[:, marker_set.joints] + np.einsum(
        "nkab,kb->nka", rotation[:, marker_set.joints], marker_set.marker_offsets
    )
    found = attach_markers(markers, position, rotation, ATLAS, NAMES, np.zeros((len(marker_set.labels), len(NAMES))))
    assert (found.joints == marker_set.joints).mean() > 0.9


def test_residual_is_per_axis_in_metres():
    noise = np.random.default_rng(2).normal(0, 0.004, (len(POSITION), 3))
    places, strays = measure_marker_offsets((riding("Hips", [0.1, 0, 0]) + noise)[:, None], POSITION[:, :1], ROTATION[:, :1])
    assert strays[0, 0] == pytest.approx(0.0035, rel=0.2)  # the stillest nine tenths of normal noise
    np.testing.assert_allclose(places[0, 0], [0.1, 0, 0], atol=0.002)


def test_atlas_scales_with_the_body():
    small = MarkerAtlas(np.array([0, 0]), np.array([[0.1, 0, 0], [0.0, 0.1, 0]])).scale(2.0)
    np.testing.assert_allclose(small.compute_distances(0, np.array([[0.2, 0, 0], [0.2, 0.1, 0]])), [0.0, 0.1])
