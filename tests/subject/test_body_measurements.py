"""The measurements by which takes of one person are recognised."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.model.take import Take
from mocapfix.subject.library import load_marker_set
from mocapfix.subject.people import compute_body_difference, measure_body
from mocapfix.synthetic import compose_take

MARKER_SET = load_marker_set("cmu41")
COMPOSED = compose_take(seed=3, seconds=4.0, rate=60.0)
TAKE = Take(COMPOSED.marker_positions, COMPOSED.labels, 60.0)


def test_difference_of_sizes_is_their_ratio() -> None:
    larger = replace(TAKE, markers=1.1 * TAKE.markers)
    difference = compute_body_difference(measure_body("a", TAKE, MARKER_SET), measure_body("b", larger, MARKER_SET))
    assert difference == pytest.approx(np.log(1.1), abs=1e-4)


def test_place_and_order_of_the_markers_do_not_matter() -> None:
    order = np.random.default_rng(0).permutation(len(TAKE.labels))
    turned = TAKE.markers[:, order] @ Rotation.from_euler("xyz", (0.3, 1.0, -0.5)).as_matrix().T + (3.0, 0.0, -2.0)
    other = Take(turned, tuple(TAKE.labels[m] for m in order), 60.0)
    assert compute_body_difference(measure_body("a", TAKE, MARKER_SET), measure_body("b", other, MARKER_SET)) == pytest.approx(
        0, abs=1e-4
    )


def test_gaps_spikes_and_swapped_labels_hardly_matter() -> None:
    markers, rng = TAKE.markers.copy(), np.random.default_rng(1)
    markers[rng.random(markers.shape[:2]) < 0.3] = np.nan
    spikes = rng.random(markers.shape[:2]) < 0.05
    markers[spikes] += rng.normal(0, 0.3, (spikes.sum(), 3))
    markers[:40, [0, 9]] = markers[:40, [9, 0]]
    difference = compute_body_difference(
        measure_body("a", TAKE, MARKER_SET), measure_body("b", replace(TAKE, markers=markers), MARKER_SET)
    )
    assert difference is not None
    assert difference < 0.01


def test_few_common_markers_compare_nothing() -> None:
    arm = [m for m, label in enumerate(TAKE.labels) if label in ("LSHO", "LELB", "LWRA")]
    few = Take(TAKE.markers[:, arm], tuple(TAKE.labels[m] for m in arm), 60.0)
    assert compute_body_difference(measure_body("a", TAKE, MARKER_SET), measure_body("b", few, MARKER_SET)) is None
    unseen = replace(TAKE, markers=np.full_like(TAKE.markers, np.nan))
    assert not measure_body("c", unseen, MARKER_SET).distances_m
