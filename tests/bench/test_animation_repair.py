"""The bench of animations: the baseline is what it says, and mending is better where nothing is hidden."""

import numpy as np
import pytest

from mocapfix.bench import animation_repair
from mocapfix.bench.injected_animation_faults import (
    ANIMATION_FAULT_INJECTORS,
    FAULT_DURATION_RANGES_S,
    InjectedAnimationFault,
    inject_animation_faults,
)
from mocapfix.errors import SceneError
from mocapfix.skeleton import load_cmu31_body

SKELETON = load_cmu31_body().skeleton


@pytest.mark.parametrize("kind", list(ANIMATION_FAULT_INJECTORS))
def test_a_fault_is_where_it_says_and_nowhere_else(kind):
    (trial,) = animation_repair._iterate_performances(None, 1)
    struck, put = inject_animation_faults(trial.motion, SKELETON, trial.rate_hz, kind, "long", np.random.default_rng(0))
    assert put
    sound = np.ones(len(struck.root_position), bool)
    for each in put:
        seconds = (each.last - each.first + 1) / trial.rate_hz
        assert FAULT_DURATION_RANGES_S["long"][0] - 0.04 < seconds < FAULT_DURATION_RANGES_S["long"][1] + 0.04
        sound[each.first : each.last + 1] = False
    assert (struck.root_position[sound] == trial.motion.root_position[sound]).all()
    assert (struck.local_rotations[sound] == trial.motion.local_rotations[sound]).all()
    same = (struck.local_rotations[~sound] == trial.motion.local_rotations[~sound]).all((1, 2, 3))
    assert not (same & (struck.root_position[~sound] == trial.motion.root_position[~sound]).all(1)).all()


def test_a_fault_of_one_frame_is_in_one_frame():
    (trial,) = animation_repair._iterate_performances(None, 1)
    put = inject_animation_faults(trial.motion, SKELETON, trial.rate_hz, "pop", "1 frame", np.random.default_rng(0))[1]
    assert put
    assert all(each.first == each.last for each in put)


def test_linear_interpolation_is_exact_on_steady_turns():
    from scipy.spatial.transform import Rotation

    t = np.arange(30)
    local = np.tile(np.eye(3), (30, 31, 1, 1))
    local[:, 3] = Rotation.from_euler("X", 0.02 * t[:, None]).as_matrix()
    root = np.outer(t, [0.01, 0.0, 0.02])
    put = [InjectedAnimationFault("figure lost", tuple(range(31)), 10, 19)]
    struck_root, struck = root.copy(), local.copy()
    struck_root[10:20], struck[10:20] = np.nan, np.nan
    found = animation_repair.interpolate_faults(struck_root, struck, put)
    assert np.abs(found[0] - root).max() < 1e-12
    assert np.abs(found[1] - local).max() < 1e-12


def test_what_is_turned_back_is_far_better_than_interpolated():
    said = animation_repair.measure_animation_repair(None, 1, kinds=("flip", "root off"))
    for lengths in said["rows"].values():
        assert lengths["long"]["told_over_linear"] < 1 / 3
        assert lengths["long"]["found"] == lengths["1 frame"]["found"] == 1
    assert said["touched"] < 0.01


def test_no_trial_is_refused():
    with pytest.raises(SceneError, match="At least one trial"):
        animation_repair.measure_animation_repair(None, 0)
