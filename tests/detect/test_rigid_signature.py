import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.detect.rigid_signature import RigidSignatures, compute_plane_heights

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


def test_plane_heights_are_signed_and_in_metres():
    corners = np.array([[[0.0, 0, 0], [2, 0, 0], [0, 3, 0]]] * 2)
    np.testing.assert_allclose(compute_plane_heights(np.array([[5.0, 7, 0.4], [1, 1, -0.2]]), corners), [0.4, -0.2])
