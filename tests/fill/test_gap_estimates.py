import pickle
import textwrap
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from mocapfix.fill import gap_estimates
from mocapfix.fill.gap_estimates import (
    MAX_SPEED_RATIO,
    FillRequest,
    NeighbourActivity,
    build_expected_correlation,
    combine_gap_estimates,
    compare_with_spread,
    estimate_missing_samples,
    fill_short_gaps,
    measure_speed_limit,
    measure_velocity_variation,
)
from mocapfix.fill.gap_windows import FillMethod, Gap, GapEstimate, MarkersInTake, choose_hidden_stretches
from mocapfix.io import capture
from mocapfix.kernels.gap_estimates import find_weights, measure_error_covariances, shrink_covariance
from mocapfix.model.body_fit import BodyFit
from mocapfix.model.motion import PoseEvidence
from mocapfix.model.take import Take
from mocapfix.solve import kinematics
from mocapfix.solve.parallel import second_process
from mocapfix.synthetic import compose_take
from tests.captures import CAPTURES, needs_captures
from tests.fill.gap_examples import RATE

CAPTURE = CAPTURES / "cmu" / "06_01.c3d"


def prop(frames=400):
    t = np.arange(frames) / RATE
    turn = Rotation.from_rotvec(np.stack([np.sin(2 * t), np.cos(t), 0.8 * t], 1)).as_matrix()
    places = np.random.default_rng(0).normal(scale=0.2, size=(6, 3))
    markers = np.einsum("tab,mb->tma", turn, places) + np.stack([t, 1 + 0 * t, 0 * t], 1)[:, None]
    return Take(markers, tuple("ABCDEF"), RATE)


def estimate_take(take, is_inlier):
    return next(estimate_missing_samples(np.where(is_inlier[..., None], take.markers, np.nan), take.rate))


@given(first=st.integers(0, 300), length=st.integers(1, 99), bad=st.floats(-2, 2))
def test_only_outliers_are_estimated(first, length, bad):
    truth = prop()
    markers = truth.markers.copy()
    gap = slice(first, first + length)
    markers[gap, 3] += bad
    is_inlier = np.ones(markers.shape[:2], bool)
    is_inlier[gap, 3] = False
    filled, deviation, _ = estimate_take(truth.replace_markers(markers), is_inlier)
    assert np.abs(filled - truth.markers)[gap, 3].max() < 0.005
    assert np.isnan(filled[is_inlier]).all()
    assert (~np.isnan(deviation) == ~is_inlier).all()


def test_rarely_visible_marker_is_not_estimated():
    truth = prop()
    is_inlier = truth.visible.copy()
    is_inlier[15:, 0] = False
    filled, _, _ = estimate_take(truth, is_inlier)
    assert np.isnan(filled[~is_inlier]).all()


def test_rarely_visible_marker_is_estimated_between_its_samples():
    truth = prop()
    is_inlier = truth.visible.copy()
    is_inlier[:, 0] = False
    is_inlier[[10, 11, 12, 30, 31, 32], 0] = True
    filled, deviation, _ = estimate_take(truth, is_inlier)
    assert not np.isnan(filled[13:30, 0]).any()
    assert np.isnan(filled[:10, 0]).all()
    assert np.isnan(filled[33:, 0]).all()
    error = np.sqrt(((filled - truth.markers)[13:30, 0] ** 2).mean())
    assert error < 3 * np.sqrt((deviation[13:30, 0] ** 2).mean())


def test_marker_seen_only_at_rest_follows_its_neighbours():
    """It shows nothing of its motion: that of its neighbours shows that it does not rest in the gap."""
    t = np.arange(600) / RATE
    angle = np.where((t > 1) & (t < 5), 1 - np.cos(2 * np.pi * (t - 1) / 4), 0.0)
    turn = Rotation.from_rotvec(angle[:, None] * [0.3, 1.0, 0.2]).as_matrix()
    places = np.random.default_rng(1).normal(scale=0.1, size=(8, 3))
    noise = np.random.default_rng(2).normal(scale=2e-4, size=(600, 8, 3))
    markers = np.einsum("tab,mb->tma", turn, places) + np.stack([angle, 0 * t, 0 * t], 1)[:, None] + noise
    damaged = markers.copy()
    damaged[20:-20, 0] = np.nan
    filled, deviation, _ = next(estimate_missing_samples(damaged, RATE))
    error = np.linalg.norm(filled - markers, axis=-1)[20:-20, 0]
    assert error.max() < 0.02
    assert deviation[20:-20, 0].max() < 0.25


@pytest.mark.parametrize("markers", [1, 2, 3])
def test_marker_without_neighbours_is_filled_from_its_trajectory(markers):
    """Uncertainly, and the more so the longer the gap is."""
    truth = prop()
    truth = Take(truth.markers[:, :markers], truth.labels[:markers], RATE)
    is_inlier = truth.visible.copy()
    is_inlier[100:130, 0] = is_inlier[200:300, 0] = False
    filled, deviation, _ = estimate_take(truth, is_inlier)
    error = np.abs(filled - truth.markers)[:, 0].max(1)
    assert error[100:130].max() < 0.05
    assert (error[200:300] < 4 * deviation[200:300, 0]).all()
    assert deviation[250, 0] > deviation[115, 0]


def test_marker_at_rest_stays_where_it_is():
    """A foot that stands before and after a gap, of a person who moves."""
    t = np.arange(600) / RATE
    rng = np.random.default_rng(0)
    body = rng.normal(scale=0.3, size=(1, 8, 3)) + 0.3 * np.sin(2 * t + rng.normal(size=(8, 3, 1)) * 2).transpose(2, 0, 1)
    step = np.clip((t % 2 - 1.4) / 0.6, 0, 1)  # the foot stands for 1.4 s of every 2
    foot = np.stack([t // 2 + step**2 * (3 - 2 * step), 0.1 * np.sin(np.pi * step), 0 * t], 1)
    truth = Take(np.concatenate([body, foot[:, None]], 1), tuple("ABCDEFGHI"), RATE)
    is_inlier = truth.visible.copy()
    is_inlier[220:320, 8] = False
    filled, deviation, _ = estimate_take(truth, is_inlier)
    assert np.linalg.norm(filled - truth.markers, axis=-1)[220:320, 8].max() < 0.01
    assert deviation[220:320, 8].max() < 0.05


@pytest.mark.parametrize("seed", range(3))
def test_marker_alone_in_an_empty_volume_is_filled_as_well_as_by_a_line(seed):
    """It rests until the others enter with the person, and then moves with them."""
    rng, t = np.random.default_rng(seed), np.arange(1200) / 120
    moved = np.where(t < 1.5, 0.0, np.sin(3 * (t - 1.5)) + 0.2 * np.sin(9 * (t - 1.5)))[:, None, None] * np.array([0.5, 0.2, 0.3])
    truth = moved + rng.normal(0, 0.3, (8, 3)) + rng.normal(0, 0.0003, (1200, 8, 3))
    markers = truth.copy()
    markers[:180, 1:] = np.nan
    markers[70:95, 0] = np.nan
    estimate = next(estimate_missing_samples(markers, 120.0))
    line = truth[69, 0] + np.arange(1, 26)[:, None] / 26 * (truth[95, 0] - truth[69, 0])
    errors = [np.sqrt(((each - truth[70:95, 0]) ** 2).mean()) for each in (estimate.position[70:95, 0], line)]
    assert errors[0] < 1.1 * errors[1]


def test_a_gap_is_filled_by_a_spline_alone_throughout_or_not_at_all():
    """Near its ends a spline is precise in any gap, and what it fills there must not serve as its ends."""
    t = np.arange(600) / 120
    markers = np.stack([np.sin(5 * t), np.cos(4 * t), 0 * t], 1)[:, None] + np.random.default_rng(0).normal(
        0, 0.0002, (600, 1, 3)
    )
    gaps = {length: slice(first, first + length) for first, length in ((100, 3), (200, 12), (300, 20), (400, 40))}
    for gap in gaps.values():
        markers[gap] = np.nan
    filled = {length: np.isfinite(fill_short_gaps(markers, 120.0, []).sd[gap, 0]) for length, gap in gaps.items()}
    assert all(each.all() or not each.any() for each in filled.values())
    assert filled[3].all()
    assert not filled[40].any()


def test_no_inliers_give_no_estimate():
    truth = prop()
    filled, deviation, _ = estimate_take(truth, np.zeros_like(truth.visible))
    assert np.isnan(filled).all()
    assert np.isnan(deviation).all()


@needs_captures
def test_real_hand_gap_is_filled_better_than_linearly():
    truth = capture.read_take(CAPTURE)
    hand, gap = truth.bare_labels.index("RFIN"), slice(200, 320)
    is_inlier = truth.visible.copy()
    assert is_inlier[gap, hand].all()
    is_inlier[gap, hand] = False
    filled, deviation, _ = estimate_take(truth, is_inlier)
    step = np.linspace(0, 1, 122)[1:-1, None]
    line = (1 - step) * truth.markers[199, hand] + step * truth.markers[320, hand]
    error = np.linalg.norm(filled[gap, hand] - truth.markers[gap, hand], axis=1)
    assert error.mean() < 0.3 * np.linalg.norm(line - truth.markers[gap, hand], axis=1).mean()
    assert (error < 3 * np.sqrt(3) * deviation[gap, hand]).mean() > 0.9


class Oracle:
    """An estimator of a marker that moves on a known path; in gaps it is away by `offset_m`, and says that it is never."""

    def __init__(self, path: np.ndarray, offset_m: float) -> None:
        self.path, self.offset_m = path, offset_m

    def __call__(self, gap: Gap) -> list[GapEstimate]:
        w = gap.window
        error = np.full((*w.hidden_frames.shape, 3), self.offset_m)
        return [GapEstimate(FillMethod.BODY, self.path[w.gap_frames] + self.offset_m, error, np.full(len(w.points), 0.001))]


def register(monkeypatch, build: Callable[[MarkersInTake], Oracle]) -> None:
    monkeypatch.setattr(gap_estimates, "ESTIMATORS", (*gap_estimates.ESTIMATORS, build))


def wander(frames=600):
    """Return the path (T, 1, 3) of a single marker that nothing predicts."""
    return np.cumsum(np.random.default_rng(0).normal(scale=0.01, size=(frames, 1, 3)), axis=0)


@pytest.mark.parametrize(("offset_m", "is_used"), [(0.0, True), (1.0, False)])
def test_an_estimator_is_added_by_one_registration_and_weighted_by_its_errors(monkeypatch, offset_m, is_used):
    truth = wander()
    damaged = truth.copy()
    damaged[300:360] = np.nan
    register(monkeypatch, lambda take: Oracle(truth[:, 0], offset_m))
    filled = next(estimate_missing_samples(damaged, RATE))
    assert (np.linalg.norm(filled.position - truth, axis=-1)[300:360].max() < 0.005) == is_used
    assert (filled.method[330, 0] == FillMethod.BODY) == is_used


def test_the_estimator_of_the_guide_works_as_it_stands(monkeypatch):
    guide = Path(__file__).parents[2] / "docs" / "how-to" / "add-a-fill-estimator.md"
    code = guide.read_text(encoding="utf-8").split("```python")[1].split("```")[0]
    namespace: dict[str, object] = {}
    exec(textwrap.dedent(code), namespace)
    monkeypatch.setattr(gap_estimates, "ESTIMATORS", (namespace["MovesLikeNeighbour"],))
    monkeypatch.setattr(gap_estimates, "LATER_ESTIMATORS", ())
    truth = np.concatenate([wander(), wander() + [0.1, 0.0, 0.0]], axis=1)
    truth += np.random.default_rng(1).normal(scale=0.001, size=truth.shape)
    damaged = truth.copy()
    damaged[300:360, 0] = np.nan
    filled = next(estimate_missing_samples(damaged, RATE))
    error = np.sqrt(((filled.position - truth)[300:360, 0] ** 2).mean())
    assert 0.001 < error < 0.003
    assert 0.5 < error / np.sqrt((filled.sd[300:360, 0] ** 2).mean()) < 2


def test_requested_samples_have_the_estimate_of_one_method_or_none():
    """A spline through a gap of a parabola is exact, and a body that is not there gives nothing."""
    times = np.linspace(0, 1, 60)
    path = np.stack([times, times**2, 1 - times], axis=1)
    markers = np.stack([path, path + [0, 0, 1], path + [0, 1, 0]], axis=1)
    truth = markers.copy()
    markers[20:30] = np.nan
    usual = next(estimate_missing_samples(markers, 60.0))
    requests = [FillRequest(0, 22, 27, "spline"), FillRequest(2, 20, 29, "body")]
    changed = next(estimate_missing_samples(markers, 60.0, alternatives=[requests]))
    np.testing.assert_allclose(changed.position[22:28, 0], truth[22:28, 0], atol=1e-9)
    assert (changed.method[22:28, 0] == FillMethod.SPLINE).all()
    assert not np.isnan(changed.sd[20:30, 0]).any()
    assert np.isnan(changed.sd[20:30, 2]).all()
    np.testing.assert_allclose(changed.sd[20:30, 1], usual.sd[20:30, 1])


class Copies(Executor):
    """As a second process it computes with copies of what it is sent. One of its calls raises an error, with which it may end."""

    def __init__(self, failing: int, error: Exception) -> None:
        self.calls, self.failing, self.error = list[str](), failing, error

    def submit(self, fn: Any, call: bytes, /) -> Future[Any]:  # pyright: ignore[reportIncompatibleMethodOverride]
        future = Future[Any]()
        self.calls.append(pickle.loads(call).func.__name__)
        if len(self.calls) == self.failing or (len(self.calls) > self.failing and isinstance(self.error, BrokenExecutor)):
            future.set_exception(self.error)
            return future
        try:
            future.set_result(pickle.loads(pickle.dumps(fn(call))))
        except MemoryError as error:
            future.set_exception(error)
        return future


@pytest.fixture(scope="module")
def damaged_body():
    """Return markers with many gaps, and the body that carries them."""
    truth, rng = compose_take(seed=2, seconds=5.0, rate=60.0), np.random.default_rng(0)
    joints, on_body = kinematics.compute_joint_and_marker_positions(truth.subject, truth.motion)
    markers, (frames, count) = on_body + rng.normal(scale=0.001, size=on_body.shape), on_body.shape[:2]
    for length in (1, 1, 2, 4, 5, 8, 12, 20, 30, 31, 45, 60) * 2:
        first = int(rng.integers(5, frames - length - 5))
        markers[first : first + length, rng.integers(count)] = np.nan
    markers[100:160, 10:14] = markers[200:260, 20:24] = np.nan
    motion = replace(truth.motion, marker_sd=rng.uniform(0.002, 0.01, (frames, count)))
    nothing = np.zeros((frames, joints.shape[1]))
    evidence = PoseEvidence(motion.marker_sd, nothing, nothing, nothing[:, 0])
    take = Take(markers, truth.subject.labels, truth.rate)
    return markers, BodyFit(truth.subject, truth.subject, np.arange(count), take, motion, joints, on_body, evidence)


@pytest.mark.parametrize(
    ("failing", "error"), [(99, BrokenExecutor()), (6, BrokenExecutor()), (2, BrokenExecutor()), (2, MemoryError())]
)
@threadpool_limits.wrap(limits=1, user_api="blas")
def test_a_second_process_changes_no_estimate_whether_or_not_it_ends(damaged_body, failing, error):
    markers, body = damaged_body
    requests = [FillRequest(10, 110, 120, "body")]
    alone = next(estimate_missing_samples(markers, 60.0, body=body, alternatives=[requests]))
    token = second_process.set(process := Copies(failing, error))
    try:
        shared = next(estimate_missing_samples(markers, 60.0, body=body, alternatives=[requests]))
    finally:
        second_process.reset(token)
    for values, others in zip(alone, shared, strict=True):
        np.testing.assert_array_equal(values, others)
    assert process.calls[:2] == ["bool", "_begin_estimation"]
    assert process.calls.count("_compute_parts") > 5
    assert process.calls[-1] == "_end_estimation"
    used = set(alone.method[np.isnan(markers[..., 0])].tolist())
    assert {FillMethod.BODY, FillMethod.CLUSTER, FillMethod.GAUSSIAN_PROCESS} <= used


def test_speed_limit_follows_the_visible_motion():
    t = np.arange(200) / RATE
    path = np.stack([5 * t, 0 * t, 0 * t], 1)  # 5 metres a second
    np.testing.assert_allclose(measure_speed_limit(path[:, None], RATE), 5 * MAX_SPEED_RATIO)
    assert measure_speed_limit(np.full((5, 2, 3), np.nan), RATE) == np.inf
    assert measure_speed_limit(np.zeros((5, 0, 3)), RATE) == np.inf


def test_constant_velocity_does_not_vary_and_noise_counts_little():
    t = np.arange(400) / RATE
    rng = np.random.default_rng(0)
    noise = rng.normal(scale=0.0003, size=(400, 3))
    markers = np.stack([np.stack([t, 0 * t, 0 * t], 1) + noise, np.stack([np.sin(6 * t), 0 * t, 0 * t], 1)], 1)
    variation = measure_velocity_variation(np.concatenate([markers, np.full((400, 1, 3), np.nan)], 1), RATE)
    assert variation[0] < 0.01
    np.testing.assert_allclose(variation[1], 6 / np.sqrt(2), rtol=0.1)
    np.testing.assert_allclose(variation[2], np.sqrt((variation[:2] ** 2).mean()))


def test_neighbours_show_that_a_marker_is_visible_at_rest_only():
    t = np.arange(600) / RATE
    path = np.where((t > 2) & (t < 4), np.sin(6 * (t - 2)), 0.0)
    markers = np.stack([path, 0 * t, 0 * t], 1)[:, None] + np.arange(4)[:, None]
    markers[190:410, 0] = np.nan
    window = choose_hidden_stretches(~np.isnan(markers[:, 0, 0]), 190, 409, RATE)
    activity = NeighbourActivity(markers, RATE)
    assert activity.compare(0, window, np.array([1, 2, 3])) > 5
    resting = choose_hidden_stretches(np.ones(600, bool), 50, 99, RATE)
    assert activity.compare(1, resting, np.array([2, 3])) == 1
    assert activity.compare(0, window, np.array([], int)) == 1


def build_window(frames=2000):
    visible = np.ones(frames, bool)
    visible[500:520] = False
    return choose_hidden_stretches(visible, 500, 519, RATE)


def build_estimate(window, sd, *, expected_sd=0.01, method=FillMethod.SPLINE, seed=0, offset=0.0):
    error = np.random.default_rng(seed).normal(scale=sd, size=(*window.hidden_frames.shape, 3))
    return GapEstimate(method, np.full((window.length, 3), offset), error, np.full(len(window.points), expected_sd))


def test_estimate_with_small_hidden_errors_is_used():
    window = build_window()
    good = build_estimate(window, 0.001, method=FillMethod.CLUSTER)
    bad = build_estimate(window, 0.1, seed=1, offset=1.0)
    position, sd, method = combine_gap_estimates([bad, good], window, np.ones(len(window.starts)), 0.2)
    assert np.abs(position).max() < 0.02
    assert (method == FillMethod.CLUSTER).all()
    assert 0.0007 < sd.mean() < 0.003


@pytest.mark.parametrize("spread_m", [0.03, 0.06, 0.12])
def test_a_limb_is_as_uncertain_as_expected_and_as_its_estimates_disagree(spread_m):
    window = build_window()
    estimates = [build_estimate(window, 0.06, expected_sd=0.06, offset=offset) for offset in (spread_m, -spread_m)]
    fill = np.zeros((window.length, 3)), np.full(window.length, 0.06), np.zeros(window.length, np.int8)
    mean_m = np.sqrt(0.06 * spread_m)
    np.testing.assert_allclose(0.06 * compare_with_spread(estimates, fill), mean_m * (mean_m / 0.06) ** 0.3)


@pytest.mark.parametrize("other_sd", [np.nan, np.inf])
def test_one_estimate_of_a_limb_alone_does_not_make_it_certain(other_sd):
    window = build_window()
    one, other = build_estimate(window, 0.06, expected_sd=0.06), build_estimate(window, 0.06, expected_sd=other_sd, offset=0.1)
    fill = one.position, np.full(window.length, 0.06), np.zeros(window.length, np.int8)
    assert compare_with_spread([one], fill) == compare_with_spread([one, other], fill) == 1


def test_the_spread_of_a_limb_is_that_of_its_precise_estimates():
    window = build_window()
    precise = [build_estimate(window, 0.01, offset=offset) for offset in (0.01, -0.01)]
    vague = build_estimate(window, 1.0, expected_sd=1.0, offset=0.3)
    fill = np.zeros((window.length, 3)), np.full(window.length, 0.01), np.zeros(window.length, np.int8)
    assert compare_with_spread([*precise, vague], fill) < 1.6 * compare_with_spread(precise, fill)


def test_without_hidden_stretches_the_expected_error_counts():
    visible = np.ones(50, bool)
    visible[2:48] = False
    window = choose_hidden_stretches(visible, 2, 47, RATE)
    unknown = np.full((*window.hidden_frames.shape, 3), np.nan)
    near = GapEstimate(FillMethod.SPLINE, np.zeros((46, 3)), unknown, np.full(len(window.points), 0.01))
    far = GapEstimate(FillMethod.CLUSTER, np.ones((46, 3)), unknown, np.full(len(window.points), 0.1))
    position, sd, _ = combine_gap_estimates([near, far], window, np.ones(len(window.starts)), 0.2)
    assert np.abs(position).max() < 0.01
    np.testing.assert_allclose(sd, 0.01, rtol=0.01)


def test_dissimilar_stretches_do_not_count():
    window = build_window()
    count = len(window.starts)
    estimate = build_estimate(window, 0.001, expected_sd=0.05)
    similar, dissimilar = (combine_gap_estimates([estimate], window, np.full(count, each), 0.2)[1].mean() for each in (1.0, 1e-9))
    assert similar < 0.003
    np.testing.assert_allclose(dissimilar, 0.05, rtol=0.01)


def weight(covariance, active=None):
    """Return the weights of estimates and the variance of their combination."""
    weights = np.empty(len(covariance))
    is_active = np.isin(np.arange(len(covariance)), np.arange(len(covariance)) if active is None else active)
    variance = find_weights(covariance, is_active, np.empty(len(covariance), int), weights)
    return weights, variance


@given(size=st.integers(1, 6), seed=st.integers(0, 999))
def test_weights_are_positive_and_no_worse_than_any_single_estimate(size, seed):
    root = np.random.default_rng(seed).normal(size=(size, size + 2))
    covariance = root @ root.T + 1e-6 * np.eye(size)
    weights, variance = weight(covariance)
    assert (weights >= 0).all()
    np.testing.assert_allclose(weights.sum(), 1)
    assert variance <= np.diag(covariance).min() * (1 + 1e-9)


def test_best_estimate_is_kept_where_measured_correlations_contradict_each_other():
    sd = np.array([1.0, 2.0, 3.0])
    correlation = np.array([[1.0, 0.0, 0.8], [0.0, 1.0, 0.9], [0.8, 0.9, 1.0]])  # not positive definite
    weights, variance = weight(correlation * sd[:, None] * sd)
    np.testing.assert_array_equal(weights, [1, 0, 0])
    assert variance == 1.0


def test_independent_estimates_are_weighted_by_precision():
    weights, variance = weight(np.diag([1.0, 4.0, 9.0]))
    np.testing.assert_allclose(weights, [36 / 49, 9 / 49, 4 / 49])
    np.testing.assert_allclose(variance, 36 / 49)
    weights, variance = weight(np.diag([1.0, 4.0, 9.0]), active=[1, 2])
    np.testing.assert_allclose(weights, [0, 9 / 13, 4 / 13])
    np.testing.assert_allclose(variance, 36 / 13)


@pytest.mark.parametrize("trust", [0.0, 0.5, 1.0])
def test_variances_are_shrunk_by_their_logarithms(trust):
    covariance = np.array([[1e-4]])
    shrink_covariance(covariance, np.array([[0.1]]), 0, np.eye(1), np.array([trust]), 1e-4)
    np.testing.assert_allclose(np.sqrt(covariance[0, 0]), 0.01**trust * 0.1 ** (1 - trust), rtol=1e-3)


def measure_covariances(error):
    covariance = np.empty((error.shape[2], len(error), len(error)))
    measure_error_covariances(error, np.ones(error.shape[1]), covariance)
    return covariance


def test_covariances_are_those_of_the_errors():
    shared, own = np.random.default_rng(0).normal(size=(2, 4000, 3, 3))
    covariance = measure_covariances(np.stack([shared, shared + own]))
    np.testing.assert_allclose(covariance.mean(0), [[1, 1], [1, 2]], atol=0.05)
    assert np.isnan(measure_covariances(np.full((1, 4, 3, 3), np.nan))).all()


def test_covariances_are_averaged_over_points_of_which_one_mirrors_the_other():
    error = np.zeros((1, 2, 5, 3))
    error[0, 0, 0] = np.sqrt(8)  # of one of two stretches
    np.testing.assert_allclose(measure_covariances(error)[:, 0, 0], [2, 0.5, 0, 0.5, 2])


def test_estimates_in_the_same_axes_have_similar_errors():
    expected = build_expected_correlation(["a", "a", "b", None, None])
    assert expected[0, 1] == expected[1, 0] > expected[0, 2]
    assert expected[3, 4] == expected[0, 2]


def test_estimate_that_lacks_frames_counts_in_the_others():
    window = build_window()
    good, bad = build_estimate(window, 0.001, method=FillMethod.CLUSTER), build_estimate(window, 0.1, seed=1, offset=1.0)
    good.position[5:10] = np.nan
    position, sd, method = combine_gap_estimates([good, bad], window, np.ones(len(window.starts)), 0.2)
    is_lacking = np.isin(np.arange(window.length), np.arange(5, 10))
    assert (method == np.where(is_lacking, FillMethod.SPLINE, FillMethod.CLUSTER)).all()
    assert np.abs(position[~is_lacking]).max() < 0.02
    np.testing.assert_allclose(position[is_lacking], 1.0)
    assert sd[~is_lacking].max() < 0.01 < sd[is_lacking].min()
    alone = combine_gap_estimates([good], window, np.ones(len(window.starts)), 0.2)
    assert (np.isnan(alone[1]) == is_lacking).all()
