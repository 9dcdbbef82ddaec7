from dataclasses import replace

import numpy as np
import pytest

from mocapfix.detect import body_residuals
from tests.detect.bodies import hidden
from tests.detect.on_body import FAR, displaced, solved


def compute(take, motion=None, solver_mask=None):
    return body_residuals.compute_body_residuals(
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
