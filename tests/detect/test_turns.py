"""What is wrong with turns: all kinds are found where they were put, and nothing else."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.animations import detect, gaps
from mocapfix.faults import Fault
from mocapfix.motion import Motion
from mocapfix.skeleton import load_cmu31_body
from mocapfix.synthetic import motions
from mocapfix.synthetic.synthetic_takes import draw_subject

RATE = 60.0
SPAN = slice(200, 230)
NAMES = load_cmu31_body().skeleton.names
ARM = NAMES.index("LeftForeArm")


@cache
def composed() -> Motion:
    return motions.compose_motion(draw_subject(np.random.default_rng(3), asymmetric=True), 8.0, RATE)


def found(root: np.ndarray, local: np.ndarray) -> list[Fault]:
    return detect.detect_pose_faults(NAMES, root, local, ["ZYX"] * len(NAMES), RATE)


def only(faults: list[Fault]) -> tuple[str, int, int, int]:
    assert len(faults) == 1, faults
    return faults[0].kind, faults[0].marker, faults[0].first, faults[0].last


def test_sound_motion_has_no_faults():
    assert found(composed().root_position, composed().local_rotations) == []


@pytest.mark.parametrize(("degrees", "kind"), [(25.0, "pop"), (-40.0, "pop"), (180.0, "flip")])
@pytest.mark.parametrize("own", [True, False])
def test_a_joint_that_is_off_for_a_while_is_told_to_the_frame(degrees, kind, own):
    local, turn = composed().local_rotations.copy(), Rotation.from_euler("X", degrees, degrees=True).as_matrix()
    local[SPAN, ARM] = local[SPAN, ARM] @ turn if own else turn @ local[SPAN, ARM]
    faults = found(composed().root_position, local)
    assert only(faults) == (kind, ARM, 200, 229)
    assert faults[0].severity == pytest.approx(np.radians(abs(degrees)), abs=np.radians(2))
    assert "LeftForeArm" in faults[0].reason


def test_whole_turns_of_the_angles_turn_nothing_and_are_no_fault():
    angles = Rotation.from_matrix(composed().local_rotations[:, ARM]).as_euler("ZYX", degrees=True)
    angles[SPAN] = np.stack([angles[SPAN, 0] + 180, 180 - angles[SPAN, 1], angles[SPAN, 2] - 180], axis=1)
    local = composed().local_rotations.copy()
    local[:, ARM] = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
    assert found(composed().root_position, local) == []


def test_a_joint_that_trembles_is_told_with_its_size():
    local, rng = composed().local_rotations.copy(), np.random.default_rng(0)
    local[SPAN, ARM] = local[SPAN, ARM] @ Rotation.from_rotvec(rng.normal(0, np.radians(3), (30, 3))).as_matrix()
    faults = found(composed().root_position, local)
    kind, joint, first, last = only(faults)
    assert (kind, joint) == ("jitter", ARM)
    assert abs(first - 200) <= 3
    assert abs(last - 229) <= 3
    assert np.radians(2) < faults[0].severity < np.radians(4)


@pytest.mark.parametrize("axes", [(1, 0, 0), (1, 0.6, 0)])
def test_a_joint_that_is_often_jerked_about_an_axis_or_two_does_not_tremble(axes):
    local, rng = composed().local_rotations.copy(), np.random.default_rng(2)
    for first in range(40, 440, 60):
        by = rng.normal(0, np.radians(3), (12, 1)) * axes
        local[first : first + 12, ARM] = local[first : first + 12, ARM] @ Rotation.from_rotvec(by).as_matrix()
    assert [fault for fault in found(composed().root_position, local) if fault.kind == "jitter"] == []


def test_a_tremble_about_one_axis_is_told_where_nothing_else_is_like_it():
    local, rng = composed().local_rotations.copy(), np.random.default_rng(0)
    local[SPAN, ARM] = local[SPAN, ARM] @ Rotation.from_rotvec(rng.normal(0, np.radians(6), (30, 1)) * [1, 0, 0]).as_matrix()
    assert only([fault for fault in found(composed().root_position, local) if fault.kind == "jitter"])[:2] == ("jitter", ARM)


@pytest.mark.parametrize("limb", [[0], [0, 1]])
def test_several_joints_that_are_held_in_one_frame_are_lost_there(limb):
    steps, rest = np.full((60, 8), 0.01), np.ones((61, 8))
    steps[30, limb], steps[31, limb] = 0.0, 0.05
    faults = gaps.detect_animation_gaps(steps, rest, np.zeros(rest.shape, bool), RATE)
    assert [each[:3] for each in faults] == ([((0, 1), 31, 31)] if len(limb) > 1 else [])


@pytest.mark.parametrize("how", [np.nan, 0.0, "held"])
def test_a_lost_limb_is_one_fault(how):
    local, joints = composed().local_rotations.copy(), [ARM, ARM + 1]
    local[SPAN, joints] = local[199, joints] if how == "held" else np.eye(3) if how == 0.0 else np.nan
    faults = found(composed().root_position, local)
    assert {fault.kind for fault in faults} == {"stuck" if how == "held" else "gap"}
    assert ARM in faults[0].markers
    assert (faults[0].first, faults[0].last) == (200, 229)


def test_a_frozen_figure_is_one_fault_of_everything():
    root, local = composed().root_position.copy(), composed().local_rotations.copy()
    root[SPAN], local[SPAN] = root[199], local[199]
    faults = found(root, local)
    assert only(faults) == ("stuck", 0, 200, 229)
    assert len(faults[0].markers) == len(NAMES) + 1


def test_a_rest_pose_before_the_motion_and_a_hold_after_it_are_no_faults():
    root, local = composed().root_position.copy(), composed().local_rotations.copy()
    root[0], local[0] = 0, np.eye(3)
    root[-40:], local[-40:] = root[-40], local[-40]
    assert found(root, local) == []


def test_a_figure_that_stands_still_on_purpose_is_not_frozen():
    ease = 0.5 - 0.5 * np.cos(np.pi * np.r_[np.linspace(0, 1, 150), np.ones(60), np.linspace(1, 0, 150)])
    at = np.round(300 * ease).astype(int)
    steps = detect.compute_steps(composed().root_position[at], composed().local_rotations[at])
    assert not [
        each for each in gaps.detect_animation_gaps(*steps, np.zeros(steps[1].shape, bool), RATE) if each.last - each.first > 30
    ]


def test_a_root_that_is_off_is_a_fault_of_its_place():
    root = composed().root_position.copy()
    root[SPAN] += [0.2, 0.0, 0.1]
    kind, course, first, last = only(found(root, composed().local_rotations))
    assert (kind, course, first, last) == ("spike", len(NAMES), 200, 229)
