"""The marker set of points without labels: the right one is assumed, and none where none fits clearly."""

import numpy as np
import pytest

from mocapfix.lab.label_recovery import remove_labels
from mocapfix.labels.labeller import (
    SetComparison,
    assume_marker_set,
    compute_agreement,
    compute_place_agreement,
    describe_better_set,
    label_points,
)
from mocapfix.labels.tracklets import find_tracklets
from mocapfix.subject.library import load_marker_set
from mocapfix.synthetic import SyntheticTake, compose_take

MARKER_SETS = [load_marker_set(name) for name in ("optitrack-baseline41", "plug-in-gait39", "cmu41", "cast")]


@pytest.fixture(scope="module")
def take() -> SyntheticTake:
    return compose_take(8, 4.0, 60.0)


def find_points(markers, rate):
    return find_tracklets(remove_labels("ghosts", markers, rate, seed=1).points, rate)


def test_set_of_other_markers_is_not_assumed(take):
    """The markers of each section are elsewhere on it: no set has them."""
    markers = take.marker_positions + np.random.default_rng(0).normal(scale=0.12, size=(1, take.marker_positions.shape[1], 3))
    assert assume_marker_set(find_points(markers, take.rate), MARKER_SETS)[0] is None


def test_points_of_an_object_have_no_set():
    positions = np.random.default_rng(1).uniform(0, 1.5, (1, 40, 3)).repeat(60, 0)
    assumed = assume_marker_set(find_tracklets(positions, 100.0), MARKER_SETS)
    assert assumed[0] is None
    assert "fit" in assumed[1]


def test_agreement_compares_names_of_markers():
    """RBAK is another name of RBAC, LASI is not one of LFWT; points that one set leaves without a label do not count."""
    one, other = load_marker_set("plug-in-gait39"), load_marker_set("cmu41")
    pairs = [("RBAK", "RBAC"), ("LASI", "LFWT"), ("C7", "C7"), ("T10", None)]
    counts = np.array([10, 20, 30, 40])
    markers = [np.array([each.labels.index(pair[n]) if pair[n] else -1 for pair in pairs]) for n, each in enumerate((one, other))]
    agreement = compute_agreement(SetComparison(one, markers[0], counts, 0.0), SetComparison(other, markers[1], counts, 0.0))
    assert agreement == pytest.approx(40 / 60)
    places = compute_place_agreement(SetComparison(one, markers[0], counts, 0.0), SetComparison(other, markers[1], counts, 0.0))
    assert places == 1.0


def test_a_set_that_fits_clearly_better_than_the_named_one_is_stated(take):
    points, right = find_points(take.marker_positions, take.rate), load_marker_set("cmu41")
    wrong = load_marker_set("optitrack-baseline41")
    warning = describe_better_set(points, label_points(points, wrong), wrong, MARKER_SETS)
    assert warning.startswith("The points fit cmu41 clearly better than optitrack-baseline41")
    labels = label_points(points, right)
    assert labels.evidence_per_marker > 2.2
    assert not describe_better_set(points, labels, right, MARKER_SETS)
