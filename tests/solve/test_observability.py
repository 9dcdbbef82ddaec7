"""Gap borders, partly observed and unobserved joints: masks with known answers."""

import numpy as np
import pytest

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.solve import pose_problem
from mocapfix.stats.sequences import find_runs
from mocapfix.subject.library import load_marker_set

BODY, MARKER_SET = load_cmu31_body(), load_marker_set("cmu41")
NAMES = BODY.skeleton.names
SUBJECT = Subject(
    BODY.skeleton, MARKER_SET.name, MARKER_SET.labels, MARKER_SET.joints, MARKER_SET.marker_offsets, MARKER_SET.marker_spread
)
ARM = ("LeftArm", "LeftForeArm", "LeftHand")
LEFT = [BODY.skeleton.find_joint(name) for name in ARM]


@pytest.mark.parametrize(
    ("rate", "gap", "border"),
    [
        (100.0, (40, 59), (35, 64)),  # 0.2 s: 0.05 s on either side
        (100.0, (40, 44), (38, 46)),  # 0.05 s: half of that, rounded
        (100.0, (40, 41), None),  # flicker
        (240.0, (40, 87), (28, 99)),
        (100.0, (0, 19), (0, 24)),
        (100.0, (90, 99), (85, 99)),
        (100.0, (0, 99), (0, 99)),
    ],
)
def test_samples_beside_gaps_are_not_used(rate, gap, border):
    is_inlier = np.ones((100, 2), bool)
    is_inlier[gap[0] : gap[1] + 1, 0] = False
    mask = pose_problem.find_gap_borders(is_inlier, np.zeros((100, 2), bool), rate, 0.05)
    assert find_runs(mask[:, 0]) == ([] if border is None else [border])
    assert not mask[:, 1].any()


def test_gaps_of_an_unobserved_joint_have_no_borders():
    is_inlier, is_unobserved = np.ones((100, 2), bool), np.zeros((100, 2), bool)
    is_inlier[40:60] = False
    is_unobserved[40:60, 0], is_unobserved[45:60, 1] = True, True
    mask = pose_problem.find_gap_borders(is_inlier, is_unobserved, 100.0, 0.05)
    assert not mask[:, 0].any()
    assert find_runs(mask[:, 1]) == [(35, 64)]


def test_joint_lacks_own_and_child_markers():
    is_used = np.ones((5, 41), bool)
    is_used[3, MARKER_SET.labels.index("LFRM")] = False
    is_used[4, MARKER_SET.labels.index("LFWT")] = False
    is_used[:, MARKER_SET.labels.index("RFRM")] = False  # never visible, so its absence is normal
    joint = NAMES[MARKER_SET.joints[MARKER_SET.labels.index("LFRM")]]
    lacking = {
        (int(t), NAMES[j]) for t, j in np.argwhere(pose_problem.find_partly_observed_joints(is_used, SUBJECT) & BODY.free_joints)
    }
    assert lacking == {(3, joint), (3, NAMES[BODY.skeleton.parents[NAMES.index(joint)]])}  # the root never


def build_used_mask(*labels, frames=(2,)):
    """Return (5, K) bool: True for all markers except the labels in the frames."""
    is_used = np.ones((5, len(MARKER_SET.labels)), bool)
    for label in labels:
        is_used[list(frames), MARKER_SET.labels.index(label)] = False
    return is_used


def list_labels_on(*names):
    return [
        label for label, joint in zip(MARKER_SET.labels, MARKER_SET.joints, strict=True) if BODY.skeleton.names[joint] in names
    ]


def find_unobserved(is_used):
    return {
        (int(t), BODY.skeleton.names[j])
        for t, j in np.argwhere(pose_problem.find_unobserved_joints(is_used, SUBJECT, BODY.free_joints))
    }


def test_nothing_is_unobserved_with_all_markers():
    assert find_unobserved(build_used_mask()) == set()


def test_arm_without_markers_is_unobserved():
    assert find_unobserved(build_used_mask(*list_labels_on(*ARM))) == {(2, name) for name in ARM}
    assert find_unobserved(build_used_mask(*list_labels_on(*ARM), frames=(0, 4))) == {(t, name) for t in (0, 4) for name in ARM}


def test_joint_with_a_distal_marker_is_observed():
    assert find_unobserved(build_used_mask(*list_labels_on("LeftArm", "LeftForeArm"))) == set()
    assert find_unobserved(build_used_mask(*list_labels_on("LeftForeArm", "LeftHand"))) == {(2, "LeftForeArm"), (2, "LeftHand")}
    assert find_unobserved(build_used_mask(*list_labels_on("LeftHand")[1:])) == set()


def test_never_marked_limb_is_not_unobserved():
    assert find_unobserved(build_used_mask(*list_labels_on(*ARM), frames=range(5))) == set()


def test_root_and_fixed_joints_are_never_unobserved():
    is_used = np.zeros((5, len(MARKER_SET.labels)), bool)
    is_used[0] = True
    is_unobserved = pose_problem.find_unobserved_joints(is_used, SUBJECT, BODY.free_joints)
    assert not is_unobserved[:, 0].any()
    assert not is_unobserved[:, ~BODY.free_joints].any()
    assert is_unobserved[1:, LEFT].all()
    assert not is_unobserved[0].any()
