"""Masks of the samples that are missing, faulty, inliers or used by the solver."""

import numpy as np
import pytest

from mocapfix.model.faults import MISSING_KINDS, Fault, Faults
from mocapfix.model.take import Take


@pytest.fixture
def take():
    markers = np.zeros((10, 3, 3))
    markers[4:6, 0] = markers[:3, 1] = np.nan
    return Take(markers, ("A", "B", "C"), 100.0)


@pytest.fixture
def faults():
    return Faults(
        (
            Fault("gap", 0, 4, 5, 0.01, "hidden"),
            Fault("spike", 0, 6, 6, 0.2, "too fast"),
            Fault("leading gap", 1, 0, 2, np.nan, "late"),
            Fault("jitter", 1, 2, 4, 0.003, "noisy"),  # its first sample is missing
            Fault("spike", 2, 9, 9, 0.2, "too fast"),
        )
    )


def test_faulty_mask_holds_visible_samples_only(take, faults):
    samples = {(int(t), int(m)) for t, m in np.argwhere(faults.compute_faulty_mask(take))}
    assert samples == {(6, 0), (3, 1), (4, 1), (9, 2)}


def test_samples_are_missing_faulty_or_inliers(take, faults):
    category_count = (~take.visible).astype(int) + faults.compute_faulty_mask(take) + faults.compute_inlier_mask(take)
    np.testing.assert_array_equal(category_count, 1)
    assert faults.compute_inlier_mask(take).sum() == 30 - 5 - 4


def test_solver_mask_includes_jitter_but_not_spikes(take, faults):
    assert faults.compute_solver_mask(take)[3:5, 1].all()
    samples = {(int(t), int(m)) for t, m in np.argwhere(faults.compute_solver_mask(take) & faults.compute_faulty_mask(take))}
    assert samples == {(3, 1), (4, 1)}
    assert not (faults.compute_inlier_mask(take) & ~faults.compute_solver_mask(take)).any()


@pytest.mark.parametrize("kind", MISSING_KINDS)
def test_gaps_make_no_sample_faulty(take, kind):
    assert not Faults((Fault(kind, 2, 0, 9, np.nan, ""),)).compute_faulty_mask(take).any()


def test_inliers_of_a_take_without_faults(take):
    np.testing.assert_array_equal(Faults().compute_inlier_mask(take), take.visible)
