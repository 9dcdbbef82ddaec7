"""Detection of faults in joint rotations and the root's position: of each kind where it was injected, and of none elsewhere."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix import synthetic as motions
from mocapfix.animations import detect
from mocapfix.animations.detect import TrackMotion
from mocapfix.model.faults import Fault
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.synthetic import draw_subject

RATE = 60.0
SPAN = slice(200, 230)
NAMES = load_cmu31_body().skeleton.names
ARM = NAMES.index("LeftForeArm")


@cache
def compose_sound_motion() -> Motion:
    return motions.compose_motion(draw_subject(np.random.default_rng(3), asymmetric=True), 8.0, RATE)


def detect_faults(root_position: np.ndarray | None = None, local_rotations: np.ndarray | None = None) -> list[Fault]:
    """Detect the faults of the composed motion with another root position or other rotations."""
    motion = compose_sound_motion()
    root_position = motion.root_position if root_position is None else root_position
    local_rotations = motion.local_rotations if local_rotations is None else local_rotations
    return detect.detect_pose_faults(NAMES, root_position, local_rotations, ["ZYX"] * len(NAMES), RATE)


def get_only(faults: list[Fault]) -> tuple[str, int, int, int]:
    """Return kind, track, first and last frame of the only fault."""
    assert len(faults) == 1, faults
    return faults[0].kind, faults[0].marker, faults[0].first, faults[0].last


def test_sound_motion_has_no_faults():
    assert detect_faults() == []


@pytest.mark.parametrize(("degrees", "kind"), [(25.0, "pop"), (-40.0, "pop"), (180.0, "flip")])
@pytest.mark.parametrize("in_joint_axes", [True, False])
def test_rotation_offset_is_detected_to_the_frame(degrees: float, kind: str, in_joint_axes: bool):
    rotations = compose_sound_motion().local_rotations.copy()
    offset = Rotation.from_euler("X", degrees, degrees=True).as_matrix()
    rotations[SPAN, ARM] = rotations[SPAN, ARM] @ offset if in_joint_axes else offset @ rotations[SPAN, ARM]
    faults = detect_faults(local_rotations=rotations)
    assert get_only(faults) == (kind, ARM, 200, 229)
    assert faults[0].severity == pytest.approx(np.radians(abs(degrees)), abs=np.radians(2))
    assert faults[0].severity_unit == "rad"
    assert "LeftForeArm" in faults[0].reason


def test_equivalent_euler_angles_are_no_fault():
    rotations = compose_sound_motion().local_rotations.copy()
    angles = Rotation.from_matrix(rotations[:, ARM]).as_euler("ZYX", degrees=True)
    angles[SPAN] = np.stack([angles[SPAN, 0] + 180, 180 - angles[SPAN, 1], angles[SPAN, 2] - 180], axis=1)
    rotations[:, ARM] = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
    assert detect_faults(local_rotations=rotations) == []


def test_jitter_is_detected_with_its_amplitude():
    rotations, rng = compose_sound_motion().local_rotations.copy(), np.random.default_rng(0)
    rotations[SPAN, ARM] = rotations[SPAN, ARM] @ Rotation.from_rotvec(rng.normal(0, np.radians(3), (30, 3))).as_matrix()
    faults = detect_faults(local_rotations=rotations)
    kind, joint, first, last = get_only(faults)
    assert (kind, joint) == ("jitter", ARM)
    assert abs(first - 200) <= 3
    assert abs(last - 229) <= 3
    assert np.radians(2) < faults[0].severity < np.radians(4)


@pytest.mark.parametrize("span", [SPAN, slice(0, 480)])
def test_jitter_of_the_position_is_detected_also_throughout(span: slice):
    root, rng = compose_sound_motion().root_position.copy(), np.random.default_rng(0)
    root[span] += rng.normal(0, 0.005, root[span].shape)
    faults = detect_faults(root)
    kind, track, first, last = get_only(faults)
    assert (kind, track) == ("jitter", len(NAMES))
    assert abs(first - span.start) <= 3
    assert abs(last - span.stop + 1) <= 3
    assert 0.004 < faults[0].severity < 0.006
    assert faults[0].severity_unit == "m"


def test_repeated_frames_of_a_raised_rate_are_no_jitter_of_the_position():
    time_s = np.arange(480) / 120
    path = np.stack([0.5 * np.sin(3 * time_s), 0.3 * np.sin(5 * time_s), 0.5 * np.cos(2 * time_s)], axis=1)  # up to 2 m/s
    noisy = path + np.random.default_rng(0).normal(0, 0.005, path.shape)
    found = [
        detect.detect_jitter(each, np.ones(len(each), bool), 120, detect.POSITION_JITTER)
        for each in (path, path.repeat(2, 0), noisy)
    ]
    assert [len(each) for each in found] == [0, 0, 1]


@pytest.mark.parametrize("axes", [(1, 0, 0), (1, 0.6, 0)])
def test_frequent_jerks_about_one_or_two_axes_are_no_jitter(axes: tuple[float, float, float]):
    rotations, rng = compose_sound_motion().local_rotations.copy(), np.random.default_rng(2)
    for first in range(40, 440, 60):
        jerk = Rotation.from_rotvec(rng.normal(0, np.radians(3), (12, 1)) * axes).as_matrix()
        rotations[first : first + 12, ARM] = rotations[first : first + 12, ARM] @ jerk
    assert not [fault for fault in detect_faults(local_rotations=rotations) if fault.kind == "jitter"]


def test_single_jitter_burst_about_one_axis_is_detected():
    rotations, rng = compose_sound_motion().local_rotations.copy(), np.random.default_rng(0)
    noise = Rotation.from_rotvec(rng.normal(0, np.radians(6), (30, 1)) * [1, 0, 0]).as_matrix()
    rotations[SPAN, ARM] = rotations[SPAN, ARM] @ noise
    bursts = [fault for fault in detect_faults(local_rotations=rotations) if fault.kind == "jitter"]
    assert get_only(bursts)[:2] == ("jitter", ARM)


@pytest.mark.parametrize("tracks", [[0], [0, 1]])
def test_value_repeated_in_one_frame_is_a_gap_if_several_tracks_share_it(tracks: list[int]):
    steps, rest_distances = np.full((60, 8), 0.01), np.ones((61, 8))
    steps[30, tracks], steps[31, tracks] = 0.0, 0.05
    found = detect.detect_animation_gaps(TrackMotion(steps, rest_distances), np.zeros(rest_distances.shape, bool), RATE)
    assert [each[:3] for each in found] == ([((0, 1), 31, 31)] if len(tracks) > 1 else [])


@pytest.mark.parametrize("value", [np.nan, 0.0, "held"])
def test_lost_limb_is_one_fault(value: float | str):
    rotations, joints = compose_sound_motion().local_rotations.copy(), [ARM, ARM + 1]
    rotations[SPAN, joints] = rotations[199, joints] if value == "held" else np.eye(3) if value == 0.0 else np.nan
    faults = detect_faults(local_rotations=rotations)
    assert {fault.kind for fault in faults} == {"stuck" if value == "held" else "gap"}
    assert ARM in faults[0].markers
    assert (faults[0].first, faults[0].last) == (200, 229)


def test_joint_that_rests_at_another_angle_is_lost_from_the_first_frame_of_it():
    steps, rest_distances = np.full((60, 8), 0.01), np.ones((61, 8))
    steps[20:40, 3] = 0.0
    steps[[29, 36], 3] = 0.5  # a joint at rest jumps to another angle in frame 30, and back in frame 37
    found = detect.detect_animation_gaps(TrackMotion(steps, rest_distances), np.zeros(rest_distances.shape, bool), RATE)
    assert [each[:3] for each in found] == [((3,), 30, 36)]


def test_frozen_joint_of_a_resting_figure_is_a_gap():
    steps, rest_distances = np.full((60, 8), 0.01), np.ones((61, 8))
    steps[20:45] = 0.0
    steps[34, 3] = 0.5
    steps[35:, 3] = 0.01
    found = detect.detect_animation_gaps(TrackMotion(steps, rest_distances), np.zeros(rest_distances.shape, bool), RATE)
    assert [each[:3] for each in found] == [((3,), 21, 34)]


def test_short_hold_of_one_joint_is_a_gap_after_a_clear_jump():
    steps, rest_distances = np.full((60, 8), 0.05), np.ones((61, 8))
    steps[30:32, 3] = 0.0
    for jump_rad, found in ((0.12, []), (0.18, [((3,), 31, 32)])):
        steps[32, 3] = jump_rad
        gaps = detect.detect_animation_gaps(TrackMotion(steps, rest_distances), np.zeros(rest_distances.shape, bool), RATE)
        assert [each[:3] for each in gaps] == found


def test_frozen_figure_is_one_fault_of_all_tracks():
    root_position, rotations = compose_sound_motion().root_position.copy(), compose_sound_motion().local_rotations.copy()
    root_position[SPAN], rotations[SPAN] = root_position[199], rotations[199]
    faults = detect_faults(root_position, rotations)
    assert get_only(faults) == ("stuck", 0, 200, 229)
    assert len(faults[0].markers) == len(NAMES) + 1
    assert faults[0].reason.startswith("The whole figure: held at one value for 0.50 s")


def test_rest_pose_before_motion_and_hold_after_it_are_no_faults():
    root_position, rotations = compose_sound_motion().root_position.copy(), compose_sound_motion().local_rotations.copy()
    root_position[0], rotations[0] = 0, np.eye(3)
    root_position[-40:], rotations[-40:] = root_position[-40], rotations[-40]
    assert detect_faults(root_position, rotations) == []


def test_intended_standstill_is_no_gap():
    progress = 0.5 - 0.5 * np.cos(np.pi * np.r_[np.linspace(0, 1, 150), np.ones(60), np.linspace(1, 0, 150)])
    frames = np.round(300 * progress).astype(int)
    motion = compose_sound_motion()
    tracks = detect.compute_track_motion(motion.root_position[frames], motion.local_rotations[frames])
    found = detect.detect_animation_gaps(tracks, np.zeros(tracks.rest_distances.shape, bool), RATE)
    assert not [gap for gap in found if gap.last - gap.first > 30]


def test_root_offset_is_a_fault_of_the_position_track():
    root_position = compose_sound_motion().root_position.copy()
    root_position[SPAN] += [0.2, 0.0, 0.1]
    faults = detect_faults(root_position)
    assert get_only(faults) == ("spike", len(NAMES), 200, 229)
    assert faults[0].severity_unit == "m"
