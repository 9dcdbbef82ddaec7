"""Filling from a body with known pose: the residual is interpolated from the edges of the gap."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from mocapfix.fill import gap_filling
from mocapfix.solve import kinematics
from mocapfix.synthetic import compose_take

RATE = 60.0


@pytest.fixture(scope="module")
def scene():
    """Return subject, motion, the markers (T, K, 3) on the body and world rotations; all markers have the same sd."""
    truth = compose_take(seed=2, seconds=6.0, rate=RATE)
    motion = replace(truth.motion, marker_sd=np.full(truth.missing_mask.shape, 0.004))
    _, rotation = kinematics.compute_world_poses(truth.subject.skeleton, motion)
    return truth.subject, motion, kinematics.compute_joint_and_marker_positions(truth.subject, motion)[1], rotation


def build_gap_mask(scene, marker, first, last):
    wanted = np.zeros(scene[2].shape[:2], bool)
    wanted[first : last + 1, marker] = True
    return wanted


def fill(scene, markers, wanted, motion=None):
    subject, known, _, _ = scene
    return gap_filling.fill_from_body(np.where(wanted[..., None], np.nan, markers), wanted, subject, motion or known, RATE)


def test_marker_at_its_offset_is_exact(scene):
    wanted = build_gap_mask(scene, 5, 100, 200) | build_gap_mask(scene, 30, 0, 20) | build_gap_mask(scene, 12, 350, 359)
    place, deviation = fill(scene, scene[2], wanted)
    np.testing.assert_allclose(place[wanted], scene[2][wanted], atol=1e-9)
    assert np.isnan(place[~wanted]).all()
    assert np.isnan(deviation[~wanted]).all()
    assert (deviation[wanted] > 0).all()


def test_residual_is_interpolated_in_segment_axes(scene):
    subject, _, on_body, rotation = scene
    k = subject.labels.index("LFRM")
    off = np.einsum("tab,b->ta", rotation[:, subject.joints[k]], [0.015, -0.01, 0.005])
    markers = on_body.copy()
    markers[:, k] += off
    wanted = build_gap_mask(scene, k, 150, 155)  # 0.1 s
    place, _ = fill(scene, markers, wanted)
    np.testing.assert_allclose(place[wanted], markers[wanted], atol=0.0015)  # the body alone is 19 mm off
    wanted = build_gap_mask(scene, k, 100, 300)
    place, _ = fill(scene, markers, wanted)
    beyond = np.linalg.norm(place[:, k] - on_body[:, k], axis=-1)
    assert beyond[100] > 0.015
    assert beyond[200] < 0.002  # far from measured samples, the fill is the marker on the body


def test_sd_grows_with_the_distance_from_the_edges(scene):
    on_body = scene[2]
    skin = gaussian_filter1d(np.random.default_rng(0).normal(0, 1, on_body.shape), 0.15 * RATE, axis=0)
    markers = on_body + 0.004 * skin / skin.std()
    wanted = build_gap_mask(scene, 7, 100, 250)
    deviation = fill(scene, markers, wanted)[1][:, 7]
    assert deviation[100] < deviation[110] < deviation[175]
    assert deviation[250] < deviation[240] < deviation[175]
    assert 0.002 < deviation[175] < 0.01  # of the size of the residual itself


def test_uncertain_pose_increases_the_sd(scene):
    _, motion, on_body, _ = scene
    wanted = build_gap_mask(scene, 7, 100, 250)
    sd_certain = fill(scene, on_body, wanted)[1][:, 7]
    marker_sd = motion.marker_sd.copy()
    marker_sd[100:251] = 0.05
    sd_uncertain = fill(scene, on_body, wanted, replace(motion, marker_sd=marker_sd))[1][:, 7]
    assert sd_certain[175] < 0.01
    assert sd_uncertain[175] == pytest.approx(0.05, rel=0.1)
    assert sd_uncertain[100] < 0.3 * sd_uncertain[175]  # at the gap's edge the residual holds the pose's error, too


def test_invisible_marker_is_placed_at_its_offset(scene):
    wanted = build_gap_mask(scene, 9, 0, len(scene[2]) - 1)
    place, deviation = fill(scene, scene[2], wanted)
    np.testing.assert_allclose(place[:, 9], scene[2][:, 9], atol=1e-9)
    assert (deviation[:, 9] >= 0.004).all()


def test_nothing_wanted_fills_nothing(scene):
    place, deviation = fill(scene, scene[2], build_gap_mask(scene, 0, 1, 0))
    assert np.isnan(place).all()
    assert np.isnan(deviation).all()
