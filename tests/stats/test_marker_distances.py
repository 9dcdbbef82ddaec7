"""Distances between markers and rigid signatures, learnt from a take."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.kernels.label_evidence import compute_contradiction, compute_own_contradictions
from mocapfix.labels.fragments import RigidSignatures, compute_plane_heights
from mocapfix.stats import marker_distances
from mocapfix.stats.marker_distances import MarkerDistances
from tests.detect.bodies import hidden, turning

NONE_EXCLUDED = np.zeros(3, bool)
TRIANGLE = np.array([[[0.0, 0, 0], [0.3, 0, 0], [0, 0.4, 0]]])  # sides of 3, 4 and 5 parts
KNOWN = MarkerDistances(
    partner=np.array([[1, 2], [0, 2], [0, -1]]),
    length_m=np.array([[0.3, 0.4], [0.3, 0.5], [0.4, 0.0]]),
    tolerance_m=np.array([[0.01, 0.01], [0.01, 0.02], [0.01, 0.0]]),
)


def moved(marker, by):
    markers = TRIANGLE.copy()
    markers[0, marker] += by
    return markers


def test_partners_are_markers_of_the_same_segment():
    take = turning(noise=0.0)
    known = marker_distances.estimate_distances(take.markers)
    for m in range(10):
        mates = known.partner[m, :4]
        assert sorted(mates) == [k for k in range(5 * (m // 5), 5 * (m // 5) + 5) if k != m]
        np.testing.assert_allclose(known.length_m[m, :4], np.linalg.norm(take.markers[0, mates] - take.markers[0, m], axis=-1))
        np.testing.assert_allclose(known.tolerance_m[m, :4], 0.009, rtol=1e-6)  # three times what even rigid things vary by


def test_partners_are_ordered_by_steadiness():
    take, rng = turning(), np.random.default_rng(0)
    markers = take.markers.copy()
    markers[:, 1] += rng.normal(0, 0.01, (480, 3))
    known = marker_distances.estimate_distances(markers)
    assert known.partner[0, 3] == 1
    assert (np.diff(known.tolerance_m[0, :4]) >= 0).all()
    markers[:, 1] += rng.normal(0, 0.2, (480, 3))
    known = marker_distances.estimate_distances(markers)
    assert 1 not in known.partner[0]
    assert (known.partner[1] == -1).all()


def test_distances_are_estimated_from_the_consistent_part_of_the_take():
    take = turning(noise=0.0)
    markers = take.markers.copy()
    markers[:200, 0] += np.random.default_rng(0).normal(0, 0.3, (200, 3))  # 280 of 480 frames are sound
    known, sound = marker_distances.estimate_distances(markers), marker_distances.estimate_distances(take.markers)
    mates = known.partner[0] >= 0
    assert mates.sum() == 4
    np.testing.assert_allclose(np.sort(known.length_m[0, mates]), np.sort(sound.length_m[0, :4]), atol=1e-3)
    assert not (marker_distances.estimate_distances(markers, 0.9).partner[0] >= 0).any()


def test_rarely_visible_marker_has_no_partners():
    assert (marker_distances.estimate_distances(hidden(turning(), 2, 5, 479).markers).partner[2] == -1).all()
    assert marker_distances.estimate_distances(np.zeros((0, 4, 3))).partner.shape == (4, 4)


@pytest.mark.parametrize("off", [0.0, 0.005, 0.02])
def test_contradiction_grows_with_the_distance_error(off):
    markers = moved(2, [0, off, 0])  # marker 2 has one partner only, 0
    assert compute_contradiction(markers, KNOWN, 0, 2, 2, NONE_EXCLUDED, 1.0) == pytest.approx(min(1.0, (off / 0.01) ** 2))


def test_votes_are_weighted_by_steadiness():
    markers = moved(1, [0.1, 0, 0])  # breaks both distances; marker 0 is excluded, so only marker 2 votes
    assert compute_contradiction(markers, KNOWN, 0, 1, 1, NONE_EXCLUDED, 1.0) == 1.0
    markers = TRIANGLE.copy()
    markers[0, 0] -= [0.1, 0, 0]  # marker 1's distance to 0 is broken, that to 2 is not
    assert compute_contradiction(markers, KNOWN, 0, 1, 1, NONE_EXCLUDED, 1.0) == pytest.approx(0.01**-2 / (0.01**-2 + 0.02**-2))
    assert compute_contradiction(markers, KNOWN, 0, 1, 1, np.array([True, False, False]), 1.0) == pytest.approx(0.0, abs=1e-12)


def test_missing_partners_have_the_unseen_vote():
    markers = TRIANGLE.copy()
    markers[0, 0] = np.nan
    assert compute_contradiction(markers, KNOWN, 0, 2, 2, NONE_EXCLUDED, 0.25) == 0.25
    assert compute_contradiction(TRIANGLE, KNOWN, 0, 2, 2, np.array([True, False, False]), 0.25) == 0.25  # nobody is left to vote


def test_contradiction_under_another_label():
    assert compute_contradiction(TRIANGLE, KNOWN, 0, 1, 2, NONE_EXCLUDED, 1.0) == 1.0  # 0.3 m from 0, where marker 2 keeps 0.4
    own = compute_own_contradictions(TRIANGLE, KNOWN, 1.0)
    assert own.shape == (1, 3)
    np.testing.assert_allclose(own, 0, atol=1e-12)


def test_distance_statistics_use_the_shortest_interval():
    apart = np.r_[np.linspace(0.2, 0.21, 60), np.linspace(0.5, 0.9, 40)]  # six tenths of the frames agree
    markers = np.zeros((100, 2, 3))
    markers[:, 1, 0] = apart
    centre, spread = marker_distances.estimate_distance_statistics(markers, 0.55)
    assert centre[0, 1] == centre[1, 0] == pytest.approx(0.205, abs=0.0006)
    assert spread[0, 1] == pytest.approx(0.0046 / 0.7554, rel=0.02)  # half of 55 of 60 steps; a normal distribution's quantile
    assert marker_distances.estimate_distance_statistics(markers, 0.9)[1][0, 1] > 0.1
    assert np.isinf(np.diag(centre)).all()
    markers[19:, 1] = np.nan
    assert np.isinf(marker_distances.estimate_distance_statistics(markers, 0.55)[0][0, 1])
    assert (
        marker_distances.estimate_distance_statistics(markers[:19], 0.55)[0][0, 1] < 0.21
    )  # of so short a take all frames must do


PLACES = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.0, 0.25, 0.0], [0.15, 0.1, 0.02], [0.05, 0.1, 0.12]])


def rigid(frames=300, noise=0.0005):
    """Return (T, 5, 3) a rigid segment that rotates and moves."""
    t = np.arange(frames) / 100
    turn = Rotation.from_rotvec(np.stack([np.sin(t), t, np.cos(2 * t)], -1)).as_matrix()
    path = np.einsum("tab,mb->tma", turn, PLACES) + np.stack([t, 0 * t, np.sin(t)], -1)[:, None]
    return path + np.random.default_rng(0).normal(0, noise, path.shape), turn


def test_marker_matches_its_own_signature_only():
    markers, _ = rigid()
    prints, frames = RigidSignatures(markers), np.arange(100, 150)
    for m in range(5):
        own = prints.match_samples(frames, markers[frames, m], m)
        assert own is not None
        assert own.distance_sd < 1
        assert own.side_sd < 1
        assert own.distance_error_m < 0.001
        for other in {0, 1, 2, 3, 4} - {m}:
            like = prints.match_samples(frames, markers[frames, other], m)
            assert like is not None
            assert like.distance_sd > 5


def test_mirror_image_matches_the_distances_but_not_the_side():
    markers, turn = rigid()
    image = markers[:, 4] - 2 * 0.12 * turn[:, :, 2]
    markers[:, 3] += 5 * np.random.default_rng(1).normal(size=(300, 3))  # not in the plane, so not compared
    like = RigidSignatures(markers).match_samples(np.arange(300), image, 4)
    assert like is None or like.side_sd > 20
    three = np.delete(markers, 3, axis=1)
    like = RigidSignatures(three).match_samples(np.arange(300), image, 3)
    assert like is not None
    assert like.distance_sd < 1
    assert like.side_sd > 20


def test_distance_error_is_in_metres():
    markers, turn = rigid(noise=0.0)
    away = markers[:, 0] - 0.03 * turn[:, :, 0]  # away from marker 1, along the line to it
    like = RigidSignatures(markers[:, :4]).match_samples(np.arange(300), away, 0)
    assert like is not None
    miss = [np.linalg.norm(PLACES[m] + [0.03, 0, 0]) - np.linalg.norm(PLACES[m]) for m in (1, 2, 3)]
    assert like.distance_error_m == pytest.approx(np.sqrt(np.mean(np.square(miss))), rel=1e-6)
    assert set(like.partners) == {1, 2, 3}


def test_missing_or_loose_partners_are_ignored():
    markers, _ = rigid()
    markers[:, 2] += 0.3 * np.sin(np.arange(300) / 20)[:, None]
    markers[100:150, 1] = np.nan
    prints = RigidSignatures(markers)
    assert prints.match_samples(np.arange(100, 150), markers[100:150, 0], 0) is None
    later = prints.match_samples(np.arange(200, 250), markers[200:250, 0], 0)
    assert later is not None
    assert set(later.partners) == {1, 3, 4}


def test_spike_of_a_partner_is_ignored():
    markers, _ = rigid()
    prints = RigidSignatures(markers)
    markers[110:113, 1] += 0.5
    like = prints.match_samples(np.arange(100, 120), markers[100:120, 0], 0)
    assert like is not None
    assert like.distance_sd < 1


def test_rarely_visible_marker_has_no_signature():
    markers, _ = rigid()
    markers[10:, 0] = np.nan
    assert RigidSignatures(markers).match_samples(np.arange(50, 60), markers[50:60, 1], 0) is None


def test_updated_signatures_are_those_of_the_changed_markers():
    markers, _ = rigid()
    markers = np.concatenate([markers, markers + [3.0, 0, 0] + np.random.default_rng(2).normal(0, 1, (300, 1, 3))], axis=1)
    whole = markers.copy()
    markers[40:, 1] = np.nan
    markers[:, 7] += np.sin(np.arange(300) / 20)[:, None]
    prints = RigidSignatures(markers)
    markers[:, [1, 7]] = whole[:, [1, 7]]
    is_affected, fresh = prints.update_markers([1, 7]), RigidSignatures(whole)
    np.testing.assert_array_equal(prints.distance_m, fresh.distance_m)
    np.testing.assert_array_equal(prints.distance_sd_m, fresh.distance_sd_m)
    np.testing.assert_array_equal(prints.sampled_markers, fresh.sampled_markers)
    assert is_affected.all()
    assert RigidSignatures(whole).update_markers([1]).tolist() == [True] * 5 + [False] * 5  # not the other body
    assert not fresh.update_markers([]).any()


def test_distances_of_hundreds_of_markers_are_those_of_each_body():
    markers, _ = rigid()
    bodies = np.concatenate([markers + [3.0 * k, 0, 0] for k in range(marker_distances.MAX_BODY_MARKERS // 5 + 1)], axis=1)
    centre_m, spread_m = marker_distances.estimate_distance_statistics(markers, 0.55)
    all_centres_m, all_spreads_m = marker_distances.estimate_distance_statistics(bodies, 0.55)
    for k in (0, 17, 50):
        body = slice(5 * k, 5 * k + 5)
        np.testing.assert_allclose(all_centres_m[body, body], centre_m, rtol=1e-9)
        np.testing.assert_allclose(all_spreads_m[body, body], spread_m, rtol=1e-6)
        assert np.isinf(all_spreads_m[body, 5 * k + 5 :]).all()
    partners = marker_distances.estimate_distances(bodies).partner
    assert ((partners == -1) | (partners // 5 == np.arange(len(partners))[:, None] // 5)).all()


def test_plane_heights_are_signed_and_in_metres():
    corners = np.array([[[0.0, 0, 0], [2, 0, 0], [0, 3, 0]]] * 2)
    np.testing.assert_allclose(compute_plane_heights(np.array([[5.0, 7, 0.4], [1, 1, -0.2]]), corners), [0.4, -0.2])
