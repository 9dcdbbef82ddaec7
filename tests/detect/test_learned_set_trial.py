"""The trial of a learned marker set on its own take."""

import numpy as np
import pytest

from mocapfix.detect.contradictions import SetTrial, compare_detections
from mocapfix.model.detected import Detected
from mocapfix.model.take import Take


@pytest.mark.parametrize(("counts", "is_passed"), [((0, 0, 0), True), ((2, 4, 0), True), ((0, 7, 0), False)])
def test_few_contradicted_samples_are_allowed(counts, is_passed):
    assert SetTrial(np.array(counts), 3000).is_passed == is_passed


def test_a_share_of_a_long_take_is_allowed():
    assert SetTrial(np.array([0, 15, 0]), 100_000).is_passed
    assert not SetTrial(np.array([0, 25, 0]), 100_000).is_passed


def test_the_markers_with_most_contradictions_are_left_out():
    counts = np.ones(20, int) * 0
    counts[[3, 7]] = 500, 2
    assert SetTrial(counts, 10_000).select_kept_markers().tolist() == [m for m in range(20) if m != 3]


def test_nothing_is_kept_where_many_markers_contradict():
    assert len(SetTrial(np.full(20, 50), 10_000).select_kept_markers()) == 0


def test_relabelled_samples_are_counted_for_the_markers_of_the_set():
    take = Take(np.random.default_rng(0).normal(size=(10, 4, 3)), ("A", "B", "C", "D"), 100.0)
    exchanged = Detected(take.exchange_labels((0, 3), 2, 4))
    trial = compare_detections(Detected(take), exchanged, np.array([3, 1, -1]))
    assert trial.contradicted_counts.tolist() == [3, 0, 0]
    assert trial.sample_count == 20
