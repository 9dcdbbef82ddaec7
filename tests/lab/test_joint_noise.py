"""HybrIK's variants with noisy joints: the findings of the papers, and known errors."""

import numpy as np
import pytest

from mocapfix.lab import hybrik_tables, sound_takes
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve.hybrik import DEFAULT_JOINT_SD_M

MEAN_CUBE_DISTANCE = 0.9606  # mean distance of a uniform point in a cube from its centre, in halves of its edge


@pytest.fixture(scope="module")
def results():
    return hybrik_tables.measure_joint_noise(sound_takes.load_unseen_poses()[::2], lambda text: None)


def test_exact_joints_are_met_by_every_variant(results):
    assert all(row["all_mm"] < 0.1 for row in results["jitter_mm"]["0"].values())
    assert results["given_mm"]["0"]["all_mm"] == 0


def test_adaptive_reduces_the_error_of_naive_and_x_that_of_the_hands(results):
    for ratios in hybrik_tables.compute_noise_ratios(results["jitter_mm"]).values():
        assert ratios["adaptive_over_naive_all"] < 0.6
        assert ratios["adaptive_over_naive_body"] < 0.66
        assert ratios["x_over_adaptive_hands"] < 0.9


def test_only_naive_increases_the_error_of_the_given_joints(results):
    for amount in ("10", "20", "30"):
        given = results["given_mm"][amount]
        assert given["all_mm"] == pytest.approx(MEAN_CUBE_DISTANCE * int(amount), rel=0.02)
        for way, worse in (("naive", True), ("adaptive", False), ("x", False)):
            assert all((results["jitter_mm"][amount][way][part] > given[part]) == worse for part in given)


def test_only_x_meets_the_hands_with_wrong_bones(results):
    exact = results["wrong_bones_mm"]["0"]
    assert exact["x"]["hands_mm"] < 0.4 * exact["adaptive"]["hands_mm"] < 0.4 * exact["naive"]["hands_mm"]


def test_hands_have_eight_joints():
    names = load_cmu31_body().skeleton.names
    true = np.zeros((2, len(names), 3))
    for name, part in (("LThumb", "hands_mm"), ("LeftForeArm", "body_mm")):
        found = true.copy()
        found[0, names.index(name)] = [0.03, 0, 0.04]
        expected = {"all_mm": 50 / 62, "body_mm": 0, "hands_mm": 0, part: 50 / (2 * (8 if part == "hands_mm" else 23))}
        assert hybrik_tables.summarise_body_parts(found, true) == pytest.approx(expected)


def test_noise_is_uniform_and_reproducible():
    true = np.random.default_rng(3).normal(size=(500, 31, 3))
    task = hybrik_tables.add_joint_noise(true, 20)
    off = task.given_positions - true
    assert 0.0199 < np.abs(off).max() <= 0.02
    assert task.sd_m == pytest.approx(off.std(), rel=0.01)
    np.testing.assert_array_equal(hybrik_tables.add_joint_noise(true, 20).given_positions, task.given_positions)
    assert hybrik_tables.add_joint_noise(true, 0).sd_m == DEFAULT_JOINT_SD_M


def test_ratios_omit_zero_noise():
    rows = {"naive": (4.0, 5.0, 8.0), "adaptive": (2.0, 3.0, 4.0), "x": (1.0, 3.0, 3.0)}
    ways = {
        way: {f"{part}_mm": far for part, far in zip(("all", "body", "hands"), row, strict=True)} for way, row in rows.items()
    }
    expected = {"adaptive_over_naive_all": 0.5, "adaptive_over_naive_body": 0.6, "x_over_adaptive_hands": 0.75}
    assert hybrik_tables.compute_noise_ratios({"0": ways, "10": ways}) == {"10": expected}
