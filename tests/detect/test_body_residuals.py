from dataclasses import replace

import numpy as np
import pytest

from mocapfix.detect import body_residuals
from tests.detect.bodies import hidden
from tests.detect.on_body import FAR, displaced, solved


def off(take, motion=None, heard=None):
    return body_residuals.compute_body_residuals(
        take, take.seen if heard is None else heard, solved().subject, motion or solved().motion
    )


def test_a_sample_is_as_far_off_as_it_was_displaced():
    take = solved().take
    shift = np.array([0.1, -0.2, 0.05])
    sound, moved = off(take), off(displaced(take, 7, 100, 120, shift))
    np.testing.assert_allclose(
        np.linalg.norm(moved.residual_segment[110, 7] - sound.residual_segment[110, 7]), np.linalg.norm(shift), atol=0.005
    )  # the usual place may give way a little
    assert moved.distance_m[110, 7] == pytest.approx(np.linalg.norm(shift), abs=0.02)


def test_a_bias_of_the_calibration_does_not_count():
    take = solved().take
    away = take.replace_markers(
        take.markers + np.einsum("tab,b->ta", solved().motion.local_rotations[:, 0], [0.03, 0, 0])[:, None]
    )
    pelvis = [k for k, joint in enumerate(solved().subject.joints) if joint == 0]
    np.testing.assert_allclose(off(away).residual_segment[:, pelvis], off(take).residual_segment[:, pelvis], atol=1e-9)
    shift = away.markers - take.markers
    np.testing.assert_allclose((off(away).expected_world - off(take).expected_world)[:, pelvis], shift[:, pelvis], atol=1e-9)


def test_what_is_not_heard_tells_nothing_of_the_usual():
    take = displaced(solved().take, 7, 0, 299, (0.3, 0, 0))
    heard = take.visible.copy()
    heard[:300, 7] = False
    assert np.median(off(take, heard=heard).distance_m[:300, 7]) == pytest.approx(0.3, abs=0.02)


def test_a_marker_may_be_farther_off_where_the_solver_is_less_sure_than_usual():
    motion = solved().motion
    unsure = motion.marker_sd.copy()
    unsure[50:60, 3] = 0.1
    sd, usual = off(solved().take, replace(motion, marker_sd=unsure)).sd_m, off(solved().take).sd_m
    np.testing.assert_allclose(sd[50:60, 3] ** 2, usual[50:60, 3] ** 2 + 0.1**2 - FAR**2)
    np.testing.assert_array_equal(sd[60:], usual[60:])


def test_what_is_not_seen_is_nan_and_its_place_is_known():
    there = off(hidden(solved().take, 5, 10, 20))
    assert np.isnan(there.distance_m[10:21, 5]).all()
    assert not np.isnan(there.expected_world).any()
    assert not np.isnan(there.sd_m).any()
