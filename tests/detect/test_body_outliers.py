from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.detect import body_outliers, body_residuals
from mocapfix.detect.body_outliers import BodyOutlier
from mocapfix.solve import kinematics
from tests.detect.bodies import hidden
from tests.detect.on_body import RATE, displaced, solved


def pieces(take, motion=None):
    subject = solved().subject
    return body_outliers.detect_body_outliers(
        body_residuals.compute_body_residuals(take, take.seen, subject, motion or solved().motion), RATE, 0.02
    )


def where(found):
    return [(piece.marker, piece.first, piece.last) for piece in found]


@given(
    marker=st.integers(0, 40),
    first=st.integers(1, 150),
    length=st.integers(1, 100),
    size=st.floats(0.04, 0.3),
    way=st.integers(0, 2),
)
def test_a_marker_that_leaps_and_comes_back_is_found_to_the_frame(marker, first, length, size, way):
    take = displaced(solved().take, marker, first, first + length - 1, size * np.eye(3)[way])
    (piece,) = pieces(take)
    assert where([piece]) == [(marker, first, first + length - 1)]
    assert piece.distance_m == pytest.approx(size, abs=0.02)


def test_a_sound_take_has_nothing_astray():
    assert pieces(solved().take) == []


def test_what_lies_between_gaps_is_found_without_a_leap_in_sight():
    take = hidden(hidden(displaced(solved().take, 8, 100, 130, (0, 0.06, 0)), 8, 80, 99), 8, 131, 150)
    assert where(pieces(take)) == [(8, 100, 130)]
    assert where(pieces(hidden(take, 8, 101, 130))) == [(8, 100, 100)]


def test_what_goes_astray_slowly_is_no_fault_of_the_samples():
    take = solved().take
    markers = take.markers.copy()
    markers[:, 8, 1] += 0.06 * np.exp(-(((np.arange(take.frame_count) - 180) / RATE / 0.3) ** 2))
    assert pieces(take.replace_markers(markers)) == []


def test_a_body_that_leaps_makes_no_sample_astray():
    motion = solved().motion
    root = motion.root_position.copy()
    root[150:] += [0.08, 0, 0]
    leaping = replace(motion, root_position=root)
    assert pieces(solved().take, leaping) == []


def test_where_nearly_all_is_off_the_body_is():
    take = solved().take
    markers = take.markers.copy()
    markers[100:110, :25] += [0, 0.3, 0]
    assert pieces(take.replace_markers(markers)) == []


def test_a_marker_that_is_elsewhere_for_half_the_take_sits_there():
    assert pieces(displaced(solved().take, 8, 100, 300, (0, 0.06, 0))) == []


@pytest.mark.parametrize(("first", "last", "since"), [(230, 359, 230), (0, 129, 130)])
def test_a_marker_that_leaps_once_and_keeps_its_new_place_was_moved(first, last, since):
    motion, subject, take = solved().motion, solved().subject, solved().take
    turn = kinematics.compute_world_poses(subject.skeleton, motion)[1][:, subject.joints[8]]
    markers = take.markers.copy()
    markers[first : last + 1, 8] += (turn @ [0.0, 0.05, 0.0])[first : last + 1]
    (piece,) = pieces(take.replace_markers(markers))
    moved = body_outliers.build_outlier_fault(piece, take, 0.05)
    assert (moved.kind, moved.marker, moved.first, moved.last) == ("moved", 8, since, take.frame_count - 1)
    assert moved.severity == pytest.approx(0.05, abs=0.01)


def test_only_the_worst_at_one_time_is_believed():
    small, later = BodyOutlier(1, np.arange(10, 20), 0.03, 8.0), BodyOutlier(3, np.arange(40, 50), 0.03, 8.0)
    large, alike = BodyOutlier(2, np.arange(15, 25), 0.1, 30.0), BodyOutlier(4, np.arange(12, 30), 0.08, 20.0)
    assert body_outliers.select_dominant_outliers([small, later, large, alike]) == [large, alike, later]


def test_a_short_one_is_a_spike_and_the_reason_is_a_sentence():
    take = solved().take
    ghost, spike = (
        body_outliers.build_outlier_fault(BodyOutlier(5, np.arange(10, 10 + n), 0.0423, 14.0), take, 0.05) for n in (12, 1)
    )
    label = take.labels[5]
    assert (ghost.kind, spike.kind) == ("ghost", "spike")
    assert ghost.reason == f"{label} lies 42 mm from where the body has it, 14 standard deviations, for 0.10 s (12 frames)."
    assert spike.reason.endswith("for 0.01 s (1 frame).")
    assert ghost.confidence == pytest.approx(14 / 20)
