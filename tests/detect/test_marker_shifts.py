from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.detect import body_outliers, marker_shifts
from mocapfix.detect.loop import detect_body_faults
from mocapfix.detect.marker_shifts import ShiftEstimate
from mocapfix.solve import kinematics
from tests.detect.on_body import RATE, solved

SECONDS = 12.0
FRAMES = round(SECONDS * RATE)
FOREARM = 12  # LFRM
ADJACENT_JOINTS = ("ForeArm", "Hand", "Foot")


@cache
def compute_rotations():
    """World rotations (T, J, 3, 3) of the segments."""
    sound = solved(seconds=SECONDS)
    return kinematics.compute_world_poses(sound.subject.skeleton, sound.motion)[1]


def shift_marker(take, marker, displacement, first, settled):
    """Move a marker by a displacement (3,) in metres on its segment, from frame `first` on, completely from `settled` on."""
    markers, subject = take.markers.copy(), solved(seconds=SECONDS).subject
    share = np.clip((np.arange(take.frame_count) - first + 1) / (settled - first + 1), 0, 1)
    markers[:, marker] += share[:, None] * (compute_rotations()[:, subject.joints[marker]] @ displacement)
    return take.replace_markers(markers)


def sound():
    return solved(seconds=SECONDS).take


def detect(take):
    subject, motion = solved(seconds=SECONDS).subject, solved(seconds=SECONDS).motion
    return marker_shifts.detect_marker_shifts(
        body_outliers.compute_body_residuals(take, take.visible, subject, motion), subject, motion, RATE
    )


def draw_displacements(smallest, largest):
    return st.tuples(st.floats(smallest, largest), st.integers(0, 99)).map(
        lambda drawn: drawn[0] * Rotation.random(rng=np.random.default_rng(drawn[1])).apply([0.0, 0.0, 1.0])
    )


@settings(max_examples=6)
@given(marker=st.integers(0, 40), first=st.integers(240, FRAMES - 240), displacement=draw_displacements(0.035, 0.07))
def test_knock_is_found_to_the_frame_and_its_size_to_a_centimetre(marker, first, displacement):
    (shift,) = detect(shift_marker(sound(), marker, displacement, first, first))
    assert shift.marker == marker
    assert abs(shift.first - first) <= 1
    assert shift.settled_frame == shift.first
    assert shift.size_m == pytest.approx(np.linalg.norm(displacement), abs=0.01)


@settings(max_examples=4)
@given(
    marker=st.integers(0, 40),
    first=st.integers(240, 480),
    seconds=st.floats(5.5, 6.5),
    displacement=draw_displacements(0.04, 0.06),
)
def test_slide_is_found_to_two_seconds(marker, first, seconds, displacement):
    (shift,) = detect(shift_marker(sound(), marker, displacement, first, first + round(seconds * RATE)))
    assert shift.marker == marker
    np.testing.assert_allclose([shift.first, shift.settled_frame], [first, first + seconds * RATE], rtol=0, atol=2 * RATE)
    assert shift.size_m == pytest.approx(np.linalg.norm(displacement), rel=0.2, abs=0.006)


def test_no_shift_in_a_sound_short_or_empty_take():
    assert detect(sound()) == []
    moved = shift_marker(sound(), 8, np.array([0.0, 0.04, 0.0]), 200, 200)
    few = np.zeros_like(moved.visible)
    few[:400] = True
    assert detect(moved.masked(few)) == []
    assert detect(moved.masked(np.zeros_like(few))) == []


def test_shift_within_a_gap():
    take = shift_marker(sound(), 8, np.array([0.0, 0.04, 0.0]), 700, 700)
    hidden = take.visible.copy()
    hidden[650:760, 8] = False
    (shift,) = detect(take.masked(hidden))
    assert (shift.marker, shift.first) == (8, 760)


@pytest.mark.parametrize("seconds", [0.1, 0.5, 2.0])
def test_temporary_displacement_is_no_shift(seconds):
    take, away = sound(), slice(500, 500 + round(seconds * RATE))
    markers = take.markers.copy()
    markers[away, 8] = shift_marker(take, 8, np.array([0.0, 0.04, 0.0]), 0, 0).markers[away, 8]
    assert detect(take.replace_markers(markers)) == []


@pytest.mark.parametrize(("follows", "found"), [(True, []), (False, [FOREARM])])
def test_displacement_that_follows_a_joint_is_no_shift(follows, found):
    """An elbow bends by half a radian in two seconds. A marker moves with it by 15 mm, or suddenly at another time."""
    subject, motion = solved(seconds=SECONDS).subject, solved(seconds=SECONDS).motion
    joint, time = int(subject.joints[FOREARM]), np.arange(FRAMES) / RATE
    bent = np.clip((time - 4) / 2, 0, 1)
    rotations = motion.local_rotations.copy()
    rotations[:, joint] @= Rotation.from_rotvec(0.5 * bent[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    bends = replace(motion, local_rotations=rotations)
    turn = kinematics.compute_world_poses(subject.skeleton, bends)[1][:, subject.joints]
    skin = np.einsum(
        "tkba,tkb->tka",
        compute_rotations()[:, subject.joints],
        sound().markers - kinematics.compute_joint_and_marker_positions(subject, motion)[1],
    )
    markers = kinematics.compute_joint_and_marker_positions(subject, bends)[1] + np.einsum("tkab,tkb->tka", turn, skin)
    share = bent if follows else (time >= 9).astype(float)
    markers[:, FOREARM] += share[:, None] * (turn[:, FOREARM] @ [0.0, 0.015, 0.0])
    take = sound().replace_markers(markers)
    residuals = body_outliers.compute_body_residuals(take, take.visible, subject, bends)
    assert [shift.marker for shift in marker_shifts.detect_marker_shifts(residuals, subject, bends, RATE)] == found


def test_smaller_shift_on_an_adjacent_joint_is_removed():
    subject = solved(seconds=SECONDS).subject
    forearm, hand, foot = (
        np.flatnonzero(subject.joints == subject.skeleton.names.index(f"Left{name}"))[0] for name in ADJACENT_JOINTS
    )
    greater, lesser, other = (
        ShiftEstimate(int(m), 300, 300, 0.02, gain, 2.0) for m, gain in ((forearm, 0.02), (hand, 0.01), (foot, 0.005))
    )
    assert marker_shifts.select_dominant_shifts([other, lesser, greater], subject) == [greater, other]


def test_body_faults_include_shifts_but_none_near_a_ghost():
    take, detect_faults = sound(), lambda take: detect_body_faults(take, take.visible, *solved(seconds=SECONDS)[1:])
    knocked = shift_marker(take, 8, np.array([0.0, 0.018, 0.0]), 700, 700)
    (moved,) = detect_faults(knocked)
    assert (moved.kind, moved.marker, moved.first, moved.last) == ("moved", 8, 700, take.frame_count - 1)
    markers = knocked.markers.copy()
    markers[200:260, 8] += [0.0, 0.2, 0.0]
    (ghost,) = detect_faults(take.replace_markers(markers))
    assert (ghost.kind, ghost.marker, ghost.first, ghost.last) == ("ghost", 8, 200, 259)


def test_reason_is_a_sentence():
    take = sound()
    label = take.labels[3]
    knock = marker_shifts.build_shift_fault(ShiftEstimate(3, 700, 700, 0.0123, 0.01, 2.0), take)
    slide = marker_shifts.build_shift_fault(ShiftEstimate(3, 240, 960, 0.0123, 0.01, 2.0), take)
    position = "keeps a new position on its segment: 12 mm not explained by the body."
    assert (knock.kind, knock.reason) == ("moved", f"{label} is knocked and {position}")
    assert (slide.kind, slide.reason) == ("drift", f"{label} slides for 6 s and {position}")
    assert (slide.first, slide.settled_frame, slide.last) == (240, 960, take.frame_count - 1)
    assert knock.confidence == pytest.approx(2 / 3)
