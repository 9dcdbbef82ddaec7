"""Repair of injected animation faults: faults are removed, and everything else stays bit-identical."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix import synthetic as motions
from mocapfix.animations import repair
from mocapfix.animations.repair_methods import FrameSpan, RepairMethod, SpanEstimate
from mocapfix.lab.animation_repair import (
    ANIMATION_FAULT_INJECTORS,
    InjectedAnimationFault,
    build_expected_faults,
    inject_animation_faults,
    interpolate_faults,
)
from mocapfix.model.faults import Fault
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
    damaged, put = inject_animation_faults(truth, SKELETON, RATE, kind, "long", np.random.default_rng(2))
    faults = [fault for each in put for fault in build_expected_faults(each, len(SKELETON.names))]
    repaired = repair.repair_animation(
        SKELETON.parents, damaged.root_position, damaged.local_rotations, ["ZYX"] * 31, faults, RATE
    )
    about = repaired.method != RepairMethod.UNCHANGED
    for fault in faults:
        assert about[fault.frame_slice, list(fault.markers)].all()
        about[fault.frame_slice, list(fault.markers)] = False
    assert not about.any()
    sound = repaired.method == RepairMethod.UNCHANGED
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


def repair_lost_arm(frames: slice, predict=None) -> tuple[repair.AnimationRepair, float, float]:
    """Return the repair of an arm that is lost, its error, and that of interpolation, in metres."""
    truth, arm = composed(), tuple(map(SKELETON.names.index, ("LeftArm", "LeftForeArm", "LeftHand")))
    injected = InjectedAnimationFault("limb gap", arm, frames.start, frames.stop - 1)
    rotations = truth.local_rotations.copy()
    rotations[frames, arm] = np.nan
    poses = SKELETON.parents, truth.root_position, rotations, ["ZYX"] * 31, build_expected_faults(injected, 31), RATE
    conditioner = predict and NoPoses(lambda: pytest.fail("no pose is predicted"), 1.0, predict)
    repaired = repair.repair_animation(*poses, conditioner)
    true = places(truth.root_position, truth.local_rotations)
    linear = interpolate_faults(truth.root_position, rotations, [injected])
    own_error_m, linear_error_m = (
        np.linalg.norm(places(*each) - true, axis=-1)[frames].mean()
        for each in ((truth.root_position, repaired.local_rotations), linear)
    )
    return repaired, own_error_m, linear_error_m


class NoPoses(PriorConditioner):
    """A conditioner that predicts motion only."""

    def predict_rotations(self, local_rotations, observed_joints, occluded_joints, frames, reference):
        return reference


def predict_other_pose(context: GapContext, size_ratio: float) -> GapPrediction:
    """Predict with certainty a pose that nobody has, as a model does for a rig that is mapped wrongly."""
    count = context.last - context.first + 1
    turned = np.tile(np.diag([1.0, -1.0, -1.0]), (count, 31, 1, 1))
    return GapPrediction(turned, np.full((count, 31), 1e-12), np.zeros((count, 3)), np.full(count, 1e-12))


def test_prediction_that_fails_elsewhere_in_the_take_is_not_used():
    frames = slice(200, 222)
    plain, error_m, linear_error_m = repair_lost_arm(frames)
    misled = repair_lost_arm(frames, predict_other_pose)[0]
    assert error_m < 0.5 * linear_error_m
    np.testing.assert_array_equal(misled.local_rotations, plain.local_rotations)


def build_estimates(span: FrameSpan, offsets_m: tuple[float, ...], sd_m: float) -> list[SpanEstimate]:
    """Return an interpolation and another estimate of a position: these values, and their standard deviation per axis."""
    shape = len(span.frames), 1, 3
    variance = np.full(shape[:2], sd_m**2)
    methods = RepairMethod.GAP_INTERPOLATED, RepairMethod.OFFSET_REMOVED
    return [SpanEstimate(method, np.full(shape, each), variance) for method, each in zip(methods, offsets_m, strict=True)]


@pytest.mark.parametrize(("sd_m", "method"), [(0.01, RepairMethod.OFFSET_REMOVED), (0.03, RepairMethod.GAP_INTERPOLATED)])
def test_take_too_short_to_try_methods_is_repaired_by_a_method_that_differs_from_the_interpolation_by_its_error(sd_m, method):
    def estimate(span: FrameSpan) -> list[SpanEstimate]:
        return build_estimates(span, (0.0, 0.02), sd_m)

    chosen = repair.choose_estimate(estimate, np.zeros((5, 1, 3)), np.array([-1]), np.ones(5, bool), FrameSpan(2, 2, RATE))
    assert chosen is not None
    assert chosen.method == method


@pytest.mark.parametrize(("last", "trials", "sd_m"), [(40, 0, 0.5), (44, repair.MAX_TRIALS, 0.02)])
def test_long_interpolation_has_the_error_of_its_trials(last: int, trials: int, sd_m: float):
    tried = []

    def estimate(span: FrameSpan) -> list[SpanEstimate]:
        tried.append(span)
        return build_estimates(span, (0.02, 0.01), 0.5)

    chosen = repair.choose_estimate(estimate, np.zeros((99, 1, 3)), np.array([-1]), np.ones(99, bool), FrameSpan(40, last, RATE))
    assert chosen is not None
    assert chosen.method == RepairMethod.GAP_INTERPOLATED
    assert len(tried) == 1 + trials
    np.testing.assert_allclose(np.sqrt(chosen.variance), sd_m, rtol=0.02)


@pytest.mark.parametrize("span", [slice(100, 130), slice(0, 480)])
@pytest.mark.parametrize("is_position", [True, False])
def test_jitter_of_the_hips_is_smoothed_and_its_error_predicted(span: slice, is_position: bool):
    truth, rng = composed(), np.random.default_rng(4)
    true = truth.root_position[:, None] if is_position else truth.local_rotations[:, :1]
    track, sd = true.copy(), 0.01 if is_position else 0.06
    noise = rng.normal(0, sd, (len(track[span]), 3))
    track[span, 0] = track[span, 0] + noise if is_position else track[span, 0] @ Rotation.from_rotvec(noise).as_matrix()
    parts = (track[:, 0], truth.local_rotations) if is_position else (truth.root_position, truth.local_rotations.copy())
    parts[1][:, 0] = parts[1][:, 0] if is_position else track[:, 0]
    fault = Fault("jitter", 31 if is_position else 0, span.start, span.stop - 1, sd, "")
    repaired = repair.repair_animation(SKELETON.parents, *parts, ["ZYX"] * 31, [fault], RATE)
    smoothed = repaired.get_track(fault.marker)
    before, after = (np.sqrt(((each[span] - true[span]) ** 2).sum(axis=-1)).mean() for each in (track, smoothed))
    assert after < 0.5 * before
    error = (smoothed[span, 0] - true[span, 0]) if is_position else Rotation.from_matrix(
        true[span, 0].swapaxes(1, 2) @ smoothed[span, 0]
    ).as_rotvec()  # fmt: skip
    normalised = (error**2).mean() / repaired.variance[span, fault.marker].mean()
    assert 0.3 < normalised < 2.0


def test_repair_of_a_joint_at_rest_is_tried_where_the_joint_rests():
    t = np.arange(600) / RATE
    track = np.where((t % 10 < 5)[:, None, None], 0.3 * np.sin(9 * t)[:, None, None], 0.0) * np.ones(3)
    span = FrameSpan(225, 235, RATE)
    stretches = repair.find_similar_stretches(track, ~np.isin(np.arange(600), span.frames), span)
    assert len(stretches) == repair.MAX_TRIALS
    for stretch, weight in stretches:
        assert weight == 1.0
        assert (track[stretch.frames] == 0).all()
        assert not np.isin(stretch.frames, span.frames).any()
    assert len({frame for stretch, _ in stretches for frame in stretch.frames}) == repair.MAX_TRIALS * 11


@pytest.mark.parametrize(("error_m", "method"), [(0.01, 1), (0.05, 4)])
def test_method_with_the_smaller_error_in_sound_stretches_is_chosen(error_m: float, method: int):
    def estimate(span: FrameSpan) -> list[SpanEstimate]:
        return build_estimates(span, (0.02, -error_m), 0.0)

    track = np.zeros((100, 1, 3))
    chosen = repair.choose_estimate(estimate, track, np.array([-1]), np.ones(100, bool), FrameSpan(40, 44, RATE))
    assert chosen is not None
    assert chosen.method == method


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
    assert (repaired.method[kept, 9] == RepairMethod.UNCHANGED).all()
