"""The benchmark of the scopes of the trained prior."""

import numpy as np
import pytest

from mocapfix import synthetic
from mocapfix.lab import prior_scope
from mocapfix.lab.prior_scope import PRIOR_CASES, clean_case, write_thinned_marker_set
from mocapfix.lab.sound_takes import remove_damage
from mocapfix.subject.library import load_marker_set


@pytest.fixture(scope="module")
def take():
    return remove_damage(synthetic.compose_take(seed=3, seconds=3.0, rate=60.0))


@pytest.mark.parametrize("case", PRIOR_CASES)
def test_cases_hide_samples_and_keep_the_truth(take, case):
    damaged = PRIOR_CASES[case].damage(take)
    np.testing.assert_array_equal(damaged.marker_positions, take.marker_positions)
    assert np.isnan(damaged.damaged_positions[damaged.missing_mask]).all()
    assert damaged.missing_mask.mean() < 0.5
    assert not take.missing_mask.any()
    assert set(PRIOR_CASES[case].kept_labels) <= set(take.labels)


def test_thinned_marker_set_can_be_read(tmp_path):
    write_thinned_marker_set(tmp_path / "few.yaml", prior_scope.TWELVE_MARKERS)
    assert set(load_marker_set(tmp_path / "few.yaml").labels) == set(prior_scope.TWELVE_MARKERS)


def test_every_scope_cleans_a_thinned_take(take):
    errors = {scope: clean_case(take, PRIOR_CASES["20 markers"], scope)["joint_mm"] for scope in prior_scope.PRIOR_SCOPES}
    assert errors["lost-limbs"] == errors["none"]
    assert 0 < errors["every-frame"] < 40
    assert errors["every-frame"] != errors["none"]
