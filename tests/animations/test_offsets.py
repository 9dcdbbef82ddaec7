"""Known constant offsets are removed by each model."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.animations import offsets
from mocapfix.stats.rigid_alignment import multiply_quaternions

RATE = 30.0


def simulate_joint() -> Rotation:
    """Return the rotations of a joint about all axes over two seconds."""
    t = np.arange(60) / RATE
    return Rotation.from_euler("ZYX", np.stack([0.8 * np.sin(3 * t), 0.5 * np.cos(2 * t), 0.3 * t], axis=1))


def test_quaternion_product_equals_scipy():
    a, b = (Rotation.random(20, rng=np.random.default_rng(seed)) for seed in (1, 2))
    ours = Rotation.from_quat(multiply_quaternions(a.as_quat(), b.as_quat()))
    assert (ours * (a * b).inv()).magnitude().max() < 1e-12


@pytest.mark.parametrize("offset", ["parent", "joint", "first angle", "middle angle", "last angle"])
def test_rotation_offset_is_removed_in_every_model(offset):
    true, span, rotation_offset = simulate_joint(), slice(20, 40), Rotation.from_rotvec([0.5, -0.4, 0.3])
    shifted = true[span]
    if offset == "parent":
        shifted = rotation_offset * shifted
    elif offset == "joint":
        shifted = shifted * rotation_offset
    else:
        angles = shifted.as_euler("ZYX")
        angles[:, ["first", "middle", "last"].index(offset.split()[0])] += 0.6
        shifted = Rotation.from_euler("ZYX", angles)
    beside = np.r_[10:20, 40:50]
    models = offsets.build_rotation_offset_models(shifted.as_quat(), "ZYX")
    found, variance = offsets.fit_smoothest_offset(
        2 * true[beside].as_quat(), beside / RATE, models, np.arange(20, 40) / RATE, np.r_[:8, 12:20]
    )
    error = (Rotation.from_quat(found) * true[span].inv()).magnitude()
    assert error.max() < np.radians(0.5)
    assert 0 < variance < np.radians(2) ** 2


def test_position_offset_is_removed():
    t = np.arange(60) / RATE
    true = np.stack([t, 0.05 * np.sin(4 * t), 0.2 * t**2], axis=1)
    beside = np.r_[10:20, 40:50]
    models = offsets.build_position_offset_models(true[20:40] + [0.3, 0.1, -0.2])
    found, _ = offsets.fit_smoothest_offset(true[beside], beside / RATE, models, np.arange(20, 40) / RATE, np.arange(20))
    assert np.abs(found - true[20:40]).max() < 0.003
