from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.detect import body_residuals, loop, marker_shifts
from mocapfix.detect.marker_shifts import ShiftEstimate
from mocapfix.solve import kinematics
from tests.detect.on_body import RATE, solved

SECONDS = 12.0
FRAMES = round(SECONDS * RATE)
FOREARM = 12  # LFRM
BESIDE = ("ForeArm", "Hand", "Foot")


@cache
def turned():
    """-> (T, J, 3, 3): how the segments lie in the world."""
    sound = solved(seconds=SECONDS)
    return kinematics.compute_world_poses(sound.subject.skeleton, sound.motion)[1]


def elsewhere(take, marker, way, first, settled):
    """-> the take with a marker moved by `way` (3,) metres on its segment, from frame `first` on, wholly from `settled` on."""
    markers, subject = take.markers.copy(), solved(seconds=SECONDS).subject
    share = np.clip((np.arange(take.frame_count) - first + 1) / (settled - first + 1), 0, 1)
    markers[:, marker] += share[:, None] * (turned()[:, subject.joints[marker]] @ way)
    return take.replace_markers(markers)


def sound():
    return solved(seconds=SECONDS).take


def seen(take):
    subject, motion = solved(seconds=SECONDS).subject, solved(seconds=SECONDS).motion
    return marker_shifts.detect_marker_shifts(
        body_residuals.compute_body_residuals(take, take.seen, subject, motion), subject, motion, RATE
    )


def ways(smallest, largest):
    return st.tuples(st.floats(smallest, largest), st.integers(0, 99)).map(
        lambda drawn: drawn[0] * Rotation.random(rng=np.random.default_rng(drawn[1])).apply([0.0, 0.0, 1.0])
    )


@settings(max_examples=6)
@given(marker=st.integers(0, 40), first=st.integers(240, FRAMES - 240), way=ways(0.035, 0.07))
def test_a_knock_is_found_to_the_frame_and_its_size_to_a_centimetre(marker, first, way):
    (shift,) = seen(elsewhere(sound(), marker, way, first, first))
    assert shift.marker == marker
    assert abs(shift.first - first) <= 1
    assert shift.settled_frame == shift.first
    assert shift.size_m == pytest.approx(np.linalg.norm(way), abs=0.01)


@settings(max_examples=4)
@given(marker=st.integers(0, 40), first=st.integers(240, 480), seconds=st.floats(5.5, 6.5), way=ways(0.04, 0.06))
def test_a_slide_is_found_to_a_second_or_two(marker, first, seconds, way):
    (shift,) = seen(elsewhere(sound(), marker, way, first, first + round(seconds * RATE)))
    assert shift.marker == marker
    np.testing.assert_allclose([shift.first, shift.settled_frame], [first, first + seconds * RATE], rtol=0, atol=2 * RATE)
    assert shift.size_m == pytest.approx(np.linalg.norm(way), rel=0.2, abs=0.006)


def test_nothing_is_shifted_on_a_sound_take_nor_on_a_short_or_empty_one():
    assert seen(sound()) == []
    moved = elsewhere(sound(), 8, np.array([0.0, 0.04, 0.0]), 200, 200)
    few = np.zeros_like(moved.visible)
    few[:400] = True
    assert seen(moved.masked(few)) == []
    assert seen(moved.masked(np.zeros_like(few))) == []


def test_a_marker_that_comes_back_elsewhere_from_a_gap():
    take = elsewhere(sound(), 8, np.array([0.0, 0.04, 0.0]), 700, 700)
    hidden = take.visible.copy()
    hidden[650:760, 8] = False
    (shift,) = seen(take.masked(hidden))
    assert (shift.marker, shift.first) == (8, 760)


@pytest.mark.parametrize("seconds", [0.1, 0.5, 2.0])
def test_a_marker_that_comes_back_is_not_shifted(seconds):
    take, away = sound(), slice(500, 500 + round(seconds * RATE))
    markers = take.markers.copy()
    markers[away, 8] = elsewhere(take, 8, np.array([0.0, 0.04, 0.0]), 0, 0).markers[away, 8]
    assert seen(take.replace_markers(markers)) == []


@pytest.mark.parametrize(("follows", "found"), [(True, []), (False, [FOREARM])])
def test_what_goes_with_a_joint_that_bends_for_good_is_not_shifted(follows, found):
    """An elbow bends by half a radian in two seconds; a marker goes with it by 15 mm, or at once and at another time."""
    subject, motion = solved(seconds=SECONDS).subject, solved(seconds=SECONDS).motion
    joint, time = int(subject.joints[FOREARM]), np.arange(FRAMES) / RATE
    bent = np.clip((time - 4) / 2, 0, 1)
    rotations = motion.local_rotations.copy()
    rotations[:, joint] @= Rotation.from_rotvec(0.5 * bent[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    bends = replace(motion, local_rotations=rotations)
    turn = kinematics.compute_world_poses(subject.skeleton, bends)[1][:, subject.joints]
    skin = np.einsum(
        "tkba,tkb->tka",
        turned()[:, subject.joints],
        sound().markers - kinematics.compute_joint_and_marker_positions(subject, motion)[1],
    )
    markers = kinematics.compute_joint_and_marker_positions(subject, bends)[1] + np.einsum("tkab,tkb->tka", turn, skin)
    share = bent if follows else (time >= 9).astype(float)
    markers[:, FOREARM] += share[:, None] * (turn[:, FOREARM] @ [0.0, 0.015, 0.0])
    take = sound().replace_markers(markers)
    off = body_residuals.compute_body_residuals(take, take.visible, subject, bends)
    assert [shift.marker for shift in marker_shifts.detect_marker_shifts(off, subject, bends, RATE)] == found


def test_beside_a_greater_change_a_lesser_one_waits():
    subject = solved(seconds=SECONDS).subject
    forearm, hand, foot = (np.flatnonzero(subject.joints == subject.skeleton.names.index(f"Left{name}"))[0] for name in BESIDE)
    greater, lesser, other = (
        ShiftEstimate(int(m), 300, 300, 0.02, gain, 2.0) for m, gain in ((forearm, 0.02), (hand, 0.01), (foot, 0.005))
    )
    assert marker_shifts.select_dominant_shifts([other, lesser, greater], subject) == [greater, other]


def test_the_second_look_tells_of_shifts_and_of_none_beside_a_stray():
    take, look = sound(), lambda take: loop.detect_body_faults(take, take.seen, *solved(seconds=SECONDS)[1:])
    knocked = elsewhere(take, 8, np.array([0.0, 0.018, 0.0]), 700, 700)
    (moved,) = look(knocked)
    assert (moved.kind, moved.marker, moved.first, moved.last) == ("moved", 8, 700, take.frame_count - 1)
    markers = knocked.markers.copy()
    markers[200:260, 8] += [0.0, 0.2, 0.0]
    (ghost,) = look(take.replace_markers(markers))
    assert (ghost.kind, ghost.marker, ghost.first, ghost.last) == ("ghost", 8, 200, 259)


def test_the_reason_is_a_sentence():
    take = sound()
    label = take.labels[3]
    knock = marker_shifts.build_shift_fault(ShiftEstimate(3, 700, 700, 0.0123, 0.01, 2.0), take)
    slide = marker_shifts.build_shift_fault(ShiftEstimate(3, 240, 960, 0.0123, 0.01, 2.0), take)
    where = "stays elsewhere on its segment: 12 mm of that the body cannot follow."
    assert (knock.kind, knock.reason) == ("moved", f"{label} is knocked and {where}")
    assert (slide.kind, slide.reason) == ("drift", f"{label} slides in 6 s and {where}")
    assert (slide.first, slide.settled_frame, slide.last) == (240, 960, take.frame_count - 1)
    assert knock.confidence == pytest.approx(2 / 3)
