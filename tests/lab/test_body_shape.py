"""Fitting shape components to bodies whose differences are known."""

from pathlib import Path

import numpy as np
import pytest

from mocapfix.io.shipped import find_shipped_folder
from mocapfix.lab import body_statistics
from mocapfix.model import skeleton
from mocapfix.model.skeleton import load_cmu31_skeleton

MEAN = np.array([[0, 0, 0], [0, 1.0, 0], [0.5, 0, 0], [-0.5, 0, 0]])  # a trunk with an arm on each side
MIRRORED = [0, 1, 3, 2]
MOTION = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "cmu-motion"


def draw_bodies(rng, count=400):
    """Return bodies of any size with both arms raised equally (SD 0.1) and arms of different length (SD 0.03)."""
    raised, uneven = np.zeros(MEAN.shape), np.zeros(MEAN.shape)
    raised[2:, 1], uneven[2:, 0] = 1.0, 1.0
    raised, uneven = (rng.normal(0, sd, (count, 1, 1)) * direction for sd, direction in ((0.1, raised), (0.03, uneven)))
    return rng.uniform(0.7, 1.3, (count, 1, 1)) * (MEAN + raised + uneven)


def test_components_are_fitted_at_equal_size():
    components, explained = body_statistics.fit_shape_components(draw_bodies(np.random.default_rng(0)), MEAN, MIRRORED, 10)
    assert len(components) == 2
    assert explained == pytest.approx(1.0)
    np.testing.assert_allclose(components[0], [[0, 0, 0], [0, 0, 0], [0, 0.1, 0], [0, 0.1, 0]], atol=0.01)
    np.testing.assert_allclose(np.abs(components[1]), [[0, 0, 0], [0, 0, 0], [0.03, 0, 0], [0.03, 0, 0]], atol=0.003)
    assert components[1, 2, 0] == pytest.approx(components[1, 3, 0])  # one arm longer, the other shorter


def test_largest_components_are_kept():
    components, explained = body_statistics.fit_shape_components(draw_bodies(np.random.default_rng(0)), MEAN, MIRRORED, 1)
    assert len(components) == 1
    assert explained == pytest.approx(0.1**2 / (0.1**2 + 0.03**2), abs=0.03)


def test_one_body_and_its_mirror_image_give_one_component():
    body = MEAN + [[0, 0, 0], [0, 0, 0], [0.1, 0, 0], [0.1, 0, 0]]
    components, _ = body_statistics.fit_shape_components(body[None], MEAN, MIRRORED, 10)
    np.testing.assert_allclose(np.abs(components), [[[0, 0, 0], [0, 0, 0], [0.1, 0, 0], [0.1, 0, 0]]], atol=1e-12)


def test_no_test_subject_is_fitted():
    assert not {"02", "05", "06", "16", "49"} & set(body_statistics.BODY_SUBJECTS)


@pytest.mark.skipif(not MOTION.is_dir(), reason=f"needs CMU's skeletons in {MOTION}")
def test_shipped_components_are_those_that_the_script_writes(tmp_path):
    body_statistics.write_shape_components(str(MOTION), str(tmp_path / "shape.yaml"))
    found, shipped = (
        skeleton.load_shape_components(folder / "shape.yaml", load_cmu31_skeleton().names)
        for folder in (tmp_path, find_shipped_folder("priors"))
    )
    np.testing.assert_allclose(found, shipped, atol=2e-5)
    assert "mocap.cs.cmu.edu" in (find_shipped_folder("priors") / "shape.yaml").read_text(encoding="utf-8")
