"""Residuals of samples from the solved body, and the outliers that they show."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.detect import body_outliers
from mocapfix.detect.body_outliers import BodyOutlier
from mocapfix.solve import kinematics
from tests.detect.bodies import hidden
from tests.detect.on_body import FAR, RATE, displaced, solved


def detect_outliers(take, motion=None):
    subject = solved().subject
    return body_outliers.detect_body_outliers(
        body_outliers.compute_body_residuals(take, take.visible, subject, motion or solved().motion), RATE, 0.02
    )


def list_intervals(outliers):
    return [(outlier.marker, outlier.first, outlier.last) for outlier in outliers]


@given(
    marker=st.integers(0, 40),
    first=st.integers(1, 150),
    length=st.integers(1, 100),
    size=st.floats(0.04, 0.3),
    axis=st.integers(0, 2),
)
def test_excursion_is_found_to_the_frame(marker, first, length, size, axis):
    take = displaced(solved().take, marker, first, first + length - 1, size * np.eye(3)[axis])
    (outlier,) = detect_outliers(take)
    assert list_intervals([outlier]) == [(marker, first, first + length - 1)]
    assert outlier.distance_m == pytest.approx(size, abs=0.02)


def drop(take, marker, frame, returns=None):
    """Return the take with a marker that falls off in a frame and lies on the floor, to the end or until it returns."""
    markers, time_s = take.markers.copy(), np.arange(take.frame_count - frame) / take.rate
    path = np.tile(markers[frame, marker], (len(time_s), 1))
    path[:, 1] = np.maximum(path[:, 1] - 9.81 / 2 * time_s**2, 0.0)
    markers[frame:returns, marker] = (path + np.random.default_rng(0).normal(0, 0.0003, path.shape))[
        : returns and returns - frame
    ]
    return take.replace_markers(markers)


@pytest.mark.parametrize("label", ["LWRA", "C7", "RKNE"])
@pytest.mark.parametrize("frame", [130, 170])
def test_a_marker_that_falls_off_is_no_marker_from_there_on(label, frame):
    take, marker = solved().take, solved().take.labels.index(label)
    places = kinematics.predict_markers(solved().subject, (solved().motion.root_position, solved().motion.local_rotations))
    (fault,) = body_outliers.detect_fallen_markers(drop(take, marker, frame), places)
    assert (fault.kind, fault.marker, fault.last) == ("ghost", marker, take.frame_count - 1)
    assert frame <= fault.first <= frame + 8
    assert body_outliers.detect_fallen_markers(take, places) == []
    assert body_outliers.detect_fallen_markers(drop(take, marker, frame, take.frame_count - 10), places) == []
    assert body_outliers.detect_fallen_markers(drop(take, marker, take.frame_count - 100), places) == []  # too short
    assert body_outliers.detect_fallen_markers(take, places + 1.0) == []  # the body is wrong


def test_markers_of_a_limb_that_is_solved_wrongly_have_not_fallen_off():
    sound, places = (
        solved().take,
        kinematics.predict_markers(solved().subject, (solved().motion.root_position, solved().motion.local_rotations)),
    )
    arm = [sound.labels.index(f"L{name}") for name in ("ELB", "FRM", "WRA", "WRB", "FIN", "THM") if f"L{name}" in sound.labels]
    markers, places = sound.markers.copy(), places.copy()
    markers[150:] = markers[150] + np.random.default_rng(0).normal(0, 0.0003, markers[150:].shape)  # the person stands still
    places[150:] = places[150]
    assert body_outliers.detect_fallen_markers(sound.replace_markers(markers), places) == []
    places[150:, arm] += [0.0, 0.0, 0.4]
    assert body_outliers.detect_fallen_markers(sound.replace_markers(markers), places) == []
    markers[200:, [k for k in range(len(sound.labels)) if k not in arm]] = np.nan  # nothing else is seen
    assert body_outliers.detect_fallen_markers(sound.replace_markers(markers), places) == []


def test_sound_take_has_no_outliers():
    assert detect_outliers(solved().take) == []


def test_outlier_between_gaps_is_found_without_a_visible_leap():
    take = hidden(hidden(displaced(solved().take, 8, 100, 130, (0, 0.06, 0)), 8, 80, 99), 8, 131, 150)
    assert list_intervals(detect_outliers(take)) == [(8, 100, 130)]
    assert list_intervals(detect_outliers(hidden(take, 8, 101, 130))) == [(8, 100, 100)]


def test_slow_deviation_is_no_outlier():
    take = solved().take
    markers = take.markers.copy()
    markers[:, 8, 1] += 0.06 * np.exp(-(((np.arange(take.frame_count) - 180) / RATE / 0.3) ** 2))
    assert detect_outliers(take.replace_markers(markers)) == []


def test_leap_of_the_body_makes_no_outliers():
    motion = solved().motion
    root = motion.root_position.copy()
    root[150:] += [0.08, 0, 0]
    leaping = replace(motion, root_position=root)
    assert detect_outliers(solved().take, leaping) == []


def test_frames_in_which_most_markers_are_off_are_not_judged():
    take = solved().take
    markers = take.markers.copy()
    markers[100:110, :25] += [0, 0.3, 0]
    assert detect_outliers(take.replace_markers(markers)) == []


def test_marker_displaced_for_half_the_take_is_no_outlier():
    assert detect_outliers(displaced(solved().take, 8, 100, 300, (0, 0.06, 0))) == []


@pytest.mark.parametrize(("first", "last", "since"), [(230, 359, 230), (0, 129, 130)])
def test_marker_that_leaps_once_and_stays_has_moved(first, last, since):
    motion, subject, take = solved().motion, solved().subject, solved().take
    turn = kinematics.compute_world_poses(subject.skeleton, motion)[1][:, subject.joints[8]]
    markers = take.markers.copy()
    markers[first : last + 1, 8] += (turn @ [0.0, 0.05, 0.0])[first : last + 1]
    (outlier,) = detect_outliers(take.replace_markers(markers))
    moved = body_outliers.build_outlier_fault(outlier, take, 0.05)
    assert (moved.kind, moved.marker, moved.first, moved.last) == ("moved", 8, since, take.frame_count - 1)
    assert moved.severity == pytest.approx(0.05, abs=0.01)


def test_only_the_worst_simultaneous_outliers_are_selected():
    small, later = BodyOutlier(1, np.arange(10, 20), 0.03, 8.0), BodyOutlier(3, np.arange(40, 50), 0.03, 8.0)
    large, similar = BodyOutlier(2, np.arange(15, 25), 0.1, 30.0), BodyOutlier(4, np.arange(12, 30), 0.08, 20.0)
    assert body_outliers.select_dominant_outliers([small, later, large, similar]) == [large, similar, later]


def test_short_outlier_is_a_spike_and_the_reason_is_a_sentence():
    take = solved().take
    ghost, spike = (
        body_outliers.build_outlier_fault(BodyOutlier(5, np.arange(10, 10 + n), 0.0423, 14.0), take, 0.05) for n in (12, 1)
    )
    label = take.labels[5]
    assert (ghost.kind, spike.kind) == ("ghost", "spike")
    assert ghost.reason == f"{label} lies 42 mm off its position on the body, 14 standard deviations, for 0.10 s (12 frames)."
    assert spike.reason.endswith("for 0.01 s (1 frame).")
    assert ghost.confidence == pytest.approx(14 / 20)


def compute(take, motion=None, solver_mask=None):
    return body_outliers.compute_body_residuals(
        take, take.visible if solver_mask is None else solver_mask, solved().subject, motion or solved().motion
    )


def test_distance_is_the_displacement():
    take = solved().take
    shift = np.array([0.1, -0.2, 0.05])
    sound, moved = compute(take), compute(displaced(take, 7, 100, 120, shift))
    np.testing.assert_allclose(
        np.linalg.norm(moved.residual_segment[110, 7] - sound.residual_segment[110, 7]), np.linalg.norm(shift), atol=0.005
    )  # the usual position changes slightly
    assert moved.distance_m[110, 7] == pytest.approx(np.linalg.norm(shift), abs=0.02)


def test_calibration_bias_is_removed():
    take = solved().take
    away = take.replace_markers(
        take.markers + np.einsum("tab,b->ta", solved().motion.local_rotations[:, 0], [0.03, 0, 0])[:, None]
    )
    pelvis = [k for k, joint in enumerate(solved().subject.joints) if joint == 0]
    np.testing.assert_allclose(compute(away).residual_segment[:, pelvis], compute(take).residual_segment[:, pelvis], atol=1e-9)
    shift = away.markers - take.markers
    np.testing.assert_allclose(
        (compute(away).expected_world - compute(take).expected_world)[:, pelvis], shift[:, pelvis], atol=1e-9
    )


def test_samples_outside_the_solver_mask_do_not_affect_the_usual_position():
    take = displaced(solved().take, 7, 0, 299, (0.3, 0, 0))
    solver_mask = take.visible.copy()
    solver_mask[:300, 7] = False
    assert np.median(compute(take, solver_mask=solver_mask).distance_m[:300, 7]) == pytest.approx(0.3, abs=0.02)


def test_sd_grows_with_the_solver_uncertainty():
    motion = solved().motion
    marker_sd = motion.marker_sd.copy()
    marker_sd[50:60, 3] = 0.1
    sd, usual = compute(solved().take, replace(motion, marker_sd=marker_sd)).sd_m, compute(solved().take).sd_m
    np.testing.assert_allclose(sd[50:60, 3] ** 2, usual[50:60, 3] ** 2 + 0.1**2 - FAR**2)
    np.testing.assert_array_equal(sd[60:], usual[60:])


def test_missing_sample_is_nan_and_its_expected_position_is_known():
    there = compute(hidden(solved().take, 5, 10, 20))
    assert np.isnan(there.distance_m[10:21, 5]).all()
    assert not np.isnan(there.expected_world).any()
    assert not np.isnan(there.sd_m).any()
