"""Gap borders, partly observed and unobserved joints: masks with known answers."""

import numpy as np
import pytest

from mocapfix import marker_sets
from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve import observability
from mocapfix.stats.sequences import find_runs
from mocapfix.subject import Subject

BODY, WORN = load_cmu31_body(), marker_sets.load_marker_set("cmu41")
NAMES = BODY.skeleton.names
SUBJECT = Subject(BODY.skeleton, WORN.name, WORN.labels, WORN.joints, WORN.marker_offsets, WORN.marker_spread)
ARM = ("LeftArm", "LeftForeArm", "LeftHand")
LEFT = [BODY.skeleton.find_joint(name) for name in ARM]


@pytest.mark.parametrize(
    ("rate", "gap", "silent"),
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
def test_samples_beside_gaps_are_not_used(rate, gap, silent):
    believed = np.ones((100, 2), bool)
    believed[gap[0] : gap[1] + 1, 0] = False
    mask = observability.find_gap_borders(believed, np.zeros((100, 2), bool), rate, 0.05)
    assert find_runs(mask[:, 0]) == ([] if silent is None else [silent])
    assert not mask[:, 1].any()


def test_gaps_of_an_unobserved_joint_have_no_borders():
    believed, gone = np.ones((100, 2), bool), np.zeros((100, 2), bool)
    believed[40:60] = False
    gone[40:60, 0], gone[45:60, 1] = True, True
    mask = observability.find_gap_borders(believed, gone, 100.0, 0.05)
    assert not mask[:, 0].any()
    assert find_runs(mask[:, 1]) == [(35, 64)]


def test_joint_lacks_own_and_child_markers():
    listened = np.ones((5, 41), bool)
    listened[3, WORN.labels.index("LFRM")] = False
    listened[4, WORN.labels.index("LFWT")] = False
    listened[:, WORN.labels.index("RFRM")] = False  # never there: nothing to miss
    joint = NAMES[WORN.joints[WORN.labels.index("LFRM")]]
    lacking = {
        (int(t), NAMES[j])
        for t, j in np.argwhere(observability.find_partly_observed_joints(listened, SUBJECT) & BODY.free_joints)
    }
    assert lacking == {(3, joint), (3, NAMES[BODY.skeleton.parents[NAMES.index(joint)]])}  # the root never


def heard(*labels, frames=(2,)):
    """Return (5, K) bool: all markers are listened to, but for these in these frames"""
    listened = np.ones((5, len(WORN.labels)), bool)
    for label in labels:
        listened[list(frames), WORN.labels.index(label)] = False
    return listened


def on(*names):
    return [label for label, joint in zip(WORN.labels, WORN.joints, strict=True) if BODY.skeleton.names[joint] in names]


def lost(listened):
    return {
        (int(t), BODY.skeleton.names[j])
        for t, j in np.argwhere(observability.find_unobserved_joints(listened, SUBJECT, BODY.free_joints))
    }


def test_nothing_is_unobserved_with_all_markers():
    assert lost(heard()) == set()


def test_arm_without_markers_is_unobserved():
    assert lost(heard(*on(*ARM))) == {(2, name) for name in ARM}
    assert lost(heard(*on(*ARM), frames=(0, 4))) == {(t, name) for t in (0, 4) for name in ARM}


def test_joint_with_a_distal_marker_is_observed():
    assert lost(heard(*on("LeftArm", "LeftForeArm"))) == set()
    assert lost(heard(*on("LeftForeArm", "LeftHand"))) == {(2, "LeftForeArm"), (2, "LeftHand")}
    assert lost(heard(*on("LeftHand")[1:])) == set()


def test_never_marked_limb_is_not_unobserved():
    assert lost(heard(*on(*ARM), frames=range(5))) == set()


def test_root_and_fixed_joints_are_never_unobserved():
    nothing = np.zeros((5, len(WORN.labels)), bool)
    nothing[0] = True
    gone = observability.find_unobserved_joints(nothing, SUBJECT, BODY.free_joints)
    assert not gone[:, 0].any()
    assert not gone[:, ~BODY.free_joints].any()
    assert gone[1:, LEFT].all()
    assert not gone[0].any()
