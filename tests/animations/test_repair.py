"""Repair of injected animation faults: faults are removed, and everything else stays bit-identical."""

from functools import cache

import numpy as np
import pytest

from mocapfix import synthetic as motions
from mocapfix.animations import repair
from mocapfix.lab.animation_repair import (
    ANIMATION_FAULT_INJECTORS,
    InjectedAnimationFault,
    build_expected_faults,
    inject_animation_faults,
    interpolate_faults,
)
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import kinematics
from mocapfix.solve.motion_prior import GapContext, GapPrediction
from mocapfix.solve.prior_conditioner import PriorConditioner
from mocapfix.synthetic import draw_subject

RATE = 30.0
SKELETON = load_cmu31_body().skeleton
MOST = {"flip": 0.3, "pop": 0.3, "jitter": 0.5, "limb gap": 0.8, "figure gap": 0.9, "root offset": 0.2}  # of linear's error


@cache
def composed() -> Motion:
    return motions.compose_motion(draw_subject(np.random.default_rng(5), asymmetric=True), 16.0, RATE)


def places(root: np.ndarray, local: np.ndarray) -> np.ndarray:
    return kinematics.compute_tree_poses(
        kinematics.build_kinematic_tree(SKELETON), np.ascontiguousarray(root), np.ascontiguousarray(local)
    )[0]


@pytest.mark.parametrize("kind", list(ANIMATION_FAULT_INJECTORS))
def test_injected_faults_are_repaired_and_the_rest_is_unchanged(kind):
    truth = composed()
    damaged, put = inject_animation_faults(truth, SKELETON, RATE, kind, "long", np.random.default_rng(1))
    faults = [fault for each in put for fault in build_expected_faults(each, len(SKELETON.names))]
    repaired = repair.repair_animation(
        SKELETON.parents, damaged.root_position, damaged.local_rotations, ["ZYX"] * 31, faults, RATE
    )
    about = repaired.method != repair.RepairMethod.UNCHANGED
    for fault in faults:
        assert about[fault.frame_slice, list(fault.markers)].all()
        about[fault.frame_slice, list(fault.markers)] = False
    assert not about.any()
    sound = repaired.method == repair.RepairMethod.UNCHANGED
    assert (repaired.local_rotations[sound[:, :-1]] == truth.local_rotations[sound[:, :-1]]).all()
    assert (repaired.root_position[sound[:, -1]] == truth.root_position[sound[:, -1]]).all()
    assert (repaired.variance > 0)[~sound].all()
    true = places(truth.root_position, truth.local_rotations)
    ours, linear = (
        np.linalg.norm(places(*each) - true, axis=-1).sum()
        for each in (
            (repaired.root_position, repaired.local_rotations),
            interpolate_faults(damaged.root_position, damaged.local_rotations, put),
        )
    )
    assert ours < MOST[kind] * linear


def test_no_faults_change_nothing():
    truth = composed()
    repaired = repair.repair_animation(SKELETON.parents, truth.root_position, truth.local_rotations, ["ZYX"] * 31, [], RATE)
    assert (repaired.local_rotations == truth.local_rotations).all()
    assert (repaired.root_position == truth.root_position).all()
    assert not repaired.method.any()


def test_joint_that_is_always_missing_stays_missing():
    truth = composed()
    local = truth.local_rotations.copy()
    local[:, 5] = np.nan
    gap = build_expected_faults(
        inject_animation_faults(truth, SKELETON, RATE, "limb gap", "long", np.random.default_rng(0))[1][0], 31
    )[0]
    whole = type(gap)("gap", 5, 0, truth.frame_count - 1, np.nan, "")
    repaired = repair.repair_animation(SKELETON.parents, truth.root_position, local, ["ZYX"] * 31, [whole], RATE)
    assert np.isfinite(repaired.local_rotations).all()
    assert not repaired.method[:, 5].any()


def test_certain_prediction_replaces_the_interpolation_of_a_lost_body():
    truth = composed()
    frames = slice(60, 80)

    def predict(context: GapContext, size_ratio: float) -> GapPrediction:
        count = context.last - context.first + 1
        certain = np.full((count, 31), 1e-12), np.full(count, 1e-12)
        return GapPrediction(truth.local_rotations[frames], certain[0], truth.root_position[frames], certain[1])

    injected = InjectedAnimationFault("figure gap", tuple(range(31)), frames.start, frames.stop - 1)
    root, rotations = truth.root_position.copy(), truth.local_rotations.copy()
    root[frames], rotations[frames] = np.nan, np.nan
    conditioner = PriorConditioner(lambda: pytest.fail("no pose is predicted"), 1.0, predict)
    faults = build_expected_faults(injected, 31)
    repaired = repair.repair_animation(SKELETON.parents, root, rotations, ["ZYX"] * 31, faults, RATE, conditioner)
    np.testing.assert_allclose(repaired.local_rotations, truth.local_rotations, atol=1e-4)
    np.testing.assert_allclose(repaired.root_position, truth.root_position, atol=1e-4)
    assert (repaired.variance[frames] < 1e-9).all()


def test_missing_values_that_no_fault_names_stay_missing_beside_a_repaired_gap():
    truth, kept, gap = composed(), slice(50, 55), slice(60, 80)
    injected = InjectedAnimationFault("figure gap", tuple(range(31)), gap.start, gap.stop - 1)
    root, rotations = truth.root_position.copy(), truth.local_rotations.copy()
    root[gap], rotations[gap], rotations[kept, 9] = np.nan, np.nan, np.nan
    repaired = repair.repair_animation(SKELETON.parents, root, rotations, ["ZYX"] * 31, build_expected_faults(injected, 31), RATE)
    is_missing = np.isnan(repaired.local_rotations[..., 0, 0])
    assert is_missing[kept, 9].all()
    assert is_missing.sum() == kept.stop - kept.start
    assert np.isfinite(repaired.root_position).all()
    assert (repaired.method[kept, 9] == repair.RepairMethod.UNCHANGED).all()
