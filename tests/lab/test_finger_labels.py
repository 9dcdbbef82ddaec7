"""The label errors of the benchmark of fingers."""

import numpy as np

from mocapfix.lab import hands
from mocapfix.model.take import Take

LABELS = tuple(f"{side}{ray}6" for side in "LR" for ray in hands.RAY_LABELS)


def test_exchanges_are_among_neighbours_or_both_hands_and_change_nothing_else():
    rng = np.random.default_rng(0)
    markers = np.cumsum(rng.normal(0, 0.001, (2000, 10, 3)), axis=0) + 0.05 * np.arange(10)[:, None]
    markers[500:530, 3] = markers[900:905, 7] = np.nan
    take = Take(markers, LABELS, 100.0)
    wrong, exchanges, is_ghost = hands.make_label_errors(rng, take, list(range(10)))
    assert len(exchanges) > 6
    restored = wrong.markers.copy()
    for kind, pair, part in exchanges:
        assert 3 <= part.stop - part.start <= 300
        sides, rays = zip(*((LABELS[m][0], hands.RAY_LABELS.index(LABELS[m][1:4])) for m in pair), strict=True)
        assert (sides[0] != sides[1]) == (kind == "hands")
        assert kind == "hands" or abs(rays[0] - rays[1]) == 1
        restored[part, pair] = restored[part, pair[::-1]]
    is_kept = ~np.isnan(restored[..., 0]) & ~is_ghost
    np.testing.assert_array_equal(restored[is_kept], markers[is_kept])
    assert np.isnan(markers[is_ghost]).all()
