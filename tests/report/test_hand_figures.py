"""Hands in the report and the recording: their points beside the body's joints, and enlarged pictures with known bends."""

import numpy as np
import pytest

from mocapfix.hands.hand_model import RAYS
from mocapfix.model.faults import Faults
from mocapfix.model.take import Take
from mocapfix.report.sample_states import CleaningComparison
from mocapfix.report.stick_figures import HAND_POINTS, add_hand_points, build_hand_figures
from mocapfix.report.terms import get_point_terms
from mocapfix.solve.kinematics import compute_world_poses
from tests.hands.composed_hands import FRAMES, RATE_HZ
from tests.hands.test_attach_hands import compose_hands_on_body


def compare(skeleton, joints):
    take = Take(np.zeros((FRAMES, 1, 3)), ("LANK",), RATE_HZ)
    return CleaningComparison(take, take, take, Faults(()), (), skeleton, joints, None, get_point_terms(take), None)


def test_the_points_of_hands_follow_the_joints_of_the_body():
    skeleton, motion, hands = compose_hands_on_body()
    joints, _ = compute_world_poses(skeleton, motion)
    extended, positions = add_hand_points(skeleton, joints, hands)
    assert len(set(extended.names)) == len(extended.names) == positions.shape[1] == 31 + 2 * 21
    np.testing.assert_array_equal(positions[:, :31], joints)
    assert (extended.parents < np.arange(len(extended.names))).all()
    for hand in hands:
        side = hand.hand.model.side
        wrist = extended.find_joint(f"{side}{HAND_POINTS}")
        assert extended.names[extended.parents[wrist]] == f"{side}Hand"
        np.testing.assert_array_equal(positions[:, wrist], hand.palm_position)
        tip = extended.find_joint(f"{side}HandIndexTip of the hand")
        np.testing.assert_array_equal(positions[:, tip], hand.point_positions[:, 16])
        chain = [tip]
        while chain[-1] != wrist:
            chain.append(int(extended.parents[chain[-1]]))
        assert [extended.names[joint] for joint in chain[1:-1]] == [f"{side}HandIndex{k} of the hand" for k in (3, 2, 1)]
        lengths = np.linalg.norm(np.diff(positions[:, chain], axis=1), axis=2)
        np.testing.assert_allclose(lengths, np.tile(lengths[0], (len(lengths), 1)), atol=1e-9)


@pytest.mark.parametrize(("side", "thumb_is_right"), [("Left", True), ("Right", False)])
def test_pictures_show_the_back_of_the_hand_and_tell_the_bends(side, thumb_is_right):
    skeleton, motion, hands = compose_hands_on_body((side,))
    extended, positions = add_hand_points(skeleton, compute_world_poses(skeleton, motion)[0], hands)
    wrist, sign = extended.find_joint(f"{side}{HAND_POINTS}"), 1.0 if side == "Left" else -1.0
    points = np.zeros((21, 3))  # fingers along x, the thumb's side at +z; the index finger is bent by a right angle
    for ray in range(len(RAYS)):
        along = [0.03, 0.05, 0.07, 0.08] if ray == 0 else [0.09, 0.13, 0.15, 0.17]
        chain = np.array([[sign * x, 0.0, 0.02 * (2 - ray)] for x in along])
        if ray == 1:
            chain[2:] = chain[1] + [[0.0, -0.02, 0.0], [0.0, -0.04, 0.0]]
        points[1 + 3 * ray : 4 + 3 * ray], points[16 + ray] = chain[:3], chain[3]
    positions[3, wrist:] = points
    ((svg, name, text),) = build_hand_figures(compare(extended, positions), 3)
    assert name == f"{side} hand:"
    assert "Index 13, 90, 0" in text
    assert "Middle 0, 0, 0" in text
    left, _, width, _ = map(float, svg.split('viewBox="')[1].split('"')[0].split())
    first = svg.split('d="')[1].split("L")[1].split(" ")[0]  # from the wrist to the thumb's first joint
    assert (float(first) > 0) == thumb_is_right
    assert left < 0 < left + width


def test_a_body_without_hands_has_no_pictures():
    skeleton, motion, _ = compose_hands_on_body(())
    positions = compute_world_poses(skeleton, motion)[0]
    assert build_hand_figures(compare(skeleton, positions), 0) == []
    assert build_hand_figures(compare(None, None), 0) == []
