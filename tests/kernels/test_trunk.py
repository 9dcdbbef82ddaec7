import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.kernels.rigid_registration import transform_to_body_axes
from mocapfix.stats.rigid_alignment import align_to_common_shape


def test_the_trunk_leads_where_limbs_swing():
    rng = np.random.default_rng(0)
    t = np.arange(200) / 50
    places = rng.normal(scale=0.3, size=(10, 3))
    own = np.tile(places, (200, 1, 1))
    own[:, 6:] += 0.3 * np.sin(4 * t[:, None, None] + rng.uniform(0, 6, (4, 3)))
    turn = Rotation.from_rotvec(np.stack([0.2 * np.sin(t), 0.9 * t, 0 * t], 1)).as_matrix()
    markers = np.einsum("tab,tmb->tma", turn, own) + np.stack([t, 1 + 0 * t, np.cos(t)], 1)[:, None]
    markers[50:90, 2] = markers[120:, 8] = np.nan
    axes, origin, placed = align_to_common_shape(markers)
    assert placed.all()
    trunk = transform_to_body_axes(markers, origin, axes)[:, :6]
    assert np.nanstd(trunk, axis=0).max() < 0.003


def test_fewer_than_three_markers_tell_no_axes():
    markers = np.random.default_rng(1).normal(size=(5, 6, 3))
    markers[3, 2:] = np.nan
    _, _, placed = align_to_common_shape(markers)
    np.testing.assert_array_equal(placed, [True, True, True, False, True])
