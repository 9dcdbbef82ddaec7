import numpy as np
import pytest

from mocapfix.detect import gaps
from tests.detect.people import CMU41, columns, compose_person, without

ARM = ("LUPA", "LELB", "LFRM", "LWRA", "LWRB", "LFIN")
FOOT = ("RHEE", "RTOE", "RMT5")


def where(take, found):
    return [([take.labels[m] for m in fault.markers], fault.first, fault.last) for fault in found]


def test_complete_take_has_no_lost_segments():
    assert gaps.detect_lost_segments(compose_person(), CMU41) == []


def test_segment_is_lost_if_all_its_markers_are_missing():
    take = without(
        without(without(compose_person(), "RHEE", first=10, last=40), "RTOE", first=20, last=45), "RMT5", first=15, last=50
    )
    (fault,) = gaps.detect_lost_segments(take, CMU41)
    assert fault.kind == "segment lost"
    assert where(take, [fault]) == [(list(FOOT), 20, 40)]
    labels = "RHEE, RTOE, RMT5"
    rest = "its pose is estimated from its neighbours and the pose prior."
    assert fault.reason == f"All markers of RightFoot are missing for 0.70 s ({labels}): {rest}"


def test_lost_limb_is_reported_once_and_longer_losses_separately():
    take = without(compose_person(), *ARM, first=20, last=50)
    (arm,) = gaps.detect_lost_segments(take, CMU41)
    assert set(arm.markers) == set(columns(take, *ARM))
    assert "the left arm" in arm.reason
    take = without(take, "LFRM", "LWRA", "LWRB", first=51, last=70)
    assert where(take, gaps.detect_lost_segments(take, CMU41)) == [(list(ARM), 20, 50), (["LFRM", "LWRA", "LWRB"], 20, 70)]


def test_lost_body_is_reported_alone():
    take = without(compose_person(), *CMU41.labels, first=30, last=40)
    (body,) = gaps.detect_lost_segments(take, CMU41)
    assert (len(body.markers), body.first, body.last) == (41, 30, 40)
    assert body.reason.startswith("All markers of the body are missing for 0.37 s: ")


@pytest.mark.parametrize(("last", "count"), [(21, 0), (22, 1)])
def test_short_losses_are_not_reported(last, count):
    assert len(gaps.detect_lost_segments(without(compose_person(), *FOOT, first=20, last=last), CMU41)) == count


def test_single_marker_is_no_lost_segment():
    assert gaps.detect_lost_segments(without(compose_person(), "LFIN", "LSHO", first=20, last=60), CMU41) == []


def test_severity_is_the_travel_of_the_segment():
    sound = compose_person()
    (fault,) = gaps.detect_lost_segments(without(sound, *FOOT, first=20, last=40), CMU41)
    travel_m = np.linalg.norm(sound.markers[41] - sound.markers[19], axis=-1)[list(columns(sound, *FOOT))]
    assert fault.severity == pytest.approx(np.median(travel_m))
    (late,) = gaps.detect_lost_segments(without(sound, *FOOT, first=40), CMU41)
    assert np.isnan(late.severity)
    assert "for 1.67 s" in late.reason


def test_segment_missing_in_the_whole_take():
    (fault,) = gaps.detect_lost_segments(without(compose_person(), *FOOT), CMU41)
    assert "All markers of RightFoot are missing in the whole take" in fault.reason
