"""The benchmark of animation repair: its injected faults, the interpolation it compares with, and its results."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix import synthetic as motions
from mocapfix.errors import SceneError
from mocapfix.lab import animation_repair
from mocapfix.lab.animation_repair import (
    ANIMATION_FAULT_INJECTORS,
    FAULT_DURATION_RANGES_S,
    InjectedAnimationFault,
    inject_animation_faults,
)
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.synthetic import draw_subject

SKELETON = load_cmu31_body().skeleton
RATE = 30.0


@pytest.fixture(scope="module")
def sound_motion():
    return motions.compose_motion(draw_subject(np.random.default_rng(0), asymmetric=True), 10.0, RATE)


@pytest.mark.parametrize("kind", list(ANIMATION_FAULT_INJECTORS))
def test_injected_faults_change_their_frames_only(sound_motion, kind: str):
    damaged, injected = inject_animation_faults(sound_motion, SKELETON, RATE, kind, "long", np.random.default_rng(0))
    assert injected
    is_sound = np.ones(damaged.frame_count, bool)
    min_duration_s, max_duration_s = FAULT_DURATION_RANGES_S["long"]
    for fault in injected:
        assert min_duration_s - 0.04 < (fault.last - fault.first + 1) / RATE < max_duration_s + 0.04
        is_sound[fault.first : fault.last + 1] = False
    same_rotations = (damaged.local_rotations == sound_motion.local_rotations).all((1, 2, 3))
    same_position = (damaged.root_position == sound_motion.root_position).all(1)
    np.testing.assert_array_equal(same_rotations & same_position, is_sound)


def test_fault_of_one_frame_changes_one_frame(sound_motion):
    _, injected = inject_animation_faults(sound_motion, SKELETON, RATE, "pop", "1 frame", np.random.default_rng(0))
    assert injected
    assert all(fault.first == fault.last for fault in injected)


def test_interpolation_is_exact_for_constant_velocity():
    time = np.arange(30)
    local_rotations = np.tile(np.eye(3), (30, 31, 1, 1))
    local_rotations[:, 3] = Rotation.from_euler("X", 0.02 * time[:, None]).as_matrix()
    root_position = np.outer(time, [0.01, 0.0, 0.02])
    injected = [InjectedAnimationFault("figure gap", tuple(range(31)), 10, 19)]
    damaged_position, damaged_rotations = root_position.copy(), local_rotations.copy()
    damaged_position[10:20], damaged_rotations[10:20] = np.nan, np.nan
    position, rotations = animation_repair.interpolate_faults(damaged_position, damaged_rotations, injected)
    assert np.abs(position - root_position).max() < 1e-12
    assert np.abs(rotations - local_rotations).max() < 1e-12


def test_removed_offsets_are_more_accurate_than_interpolation():
    report = animation_repair.measure_animation_repair(None, 1, kinds=("flip", "root offset"))
    for by_duration in report["rows"].values():
        assert by_duration["long"]["known_over_linear"] < 1 / 3
        assert by_duration["long"]["detected_share"] == by_duration["1 frame"]["detected_share"] == 1
    assert report["changed_share"] < 0.01


def test_zero_trials_are_refused():
    with pytest.raises(SceneError, match="At least one trial"):
        animation_repair.measure_animation_repair(None, 0)
