import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from mocapfix.fill.gap_windows import MarkerEstimate, MarkersInTake, choose_hidden_stretches
from mocapfix.fill.marker_processes import MAX_SETTLED_SD_M, MarkerProcesses, select_input_markers
from mocapfix.stats.sequences import group_gaps

RATE = 100.0


def walking(frames=800, seed=0, size=14):
    """Return (T, M, 3): a trunk of six markers that travels and turns, the others swinging on it, all by two hidden numbers."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames) / RATE
    phase = np.stack([np.sin(5 * t), np.sin(3.1 * t + 1)], 1)
    swing = rng.normal(scale=0.1, size=(2, size, 3))
    swing[:, :6] = 0
    inside = rng.normal(scale=0.3, size=(size, 3)) + np.einsum("tk,kma->tma", phase, swing)
    turn = Rotation.from_rotvec(np.stack([0 * t, 0.7 * t, 0.1 * np.sin(5 * t)], 1)).as_matrix()
    return np.einsum("tab,tmb->tma", turn, inside) + np.stack([t, 1 + 0 * t, np.sin(t)], 1)[:, None]


def fill(markers, other_positions, other_sd):
    """Return positions (T, M, 3) and standard deviations (T, M) of all gaps, NaN where there is no estimate."""
    processes = build_processes(markers, other_positions, other_sd)
    visible = ~np.isnan(markers[..., 0])
    filled, sd = np.full(markers.shape, np.nan), np.full(markers.shape[:2], np.nan)
    for (first, last), lost in group_gaps(~visible).items():
        window = choose_hidden_stretches(visible[:, lost].all(1), first, last, RATE)
        lost = lost[~(other_sd[first : last + 1, lost] < MAX_SETTLED_SD_M).all(0)]
        for m, estimate in zip(lost, processes.estimate_gap(window, lost) if len(lost) else [], strict=False):
            gap, frames = window.gap_frames, np.arange(window.length)
            filled[gap, m], sd[gap, m] = estimate.position, np.interp(frames, window.points, estimate.expected_sd)
    return filled, sd


def build_processes(markers, other_positions, other_sd):
    others = MarkerEstimate(other_positions, other_sd, np.zeros(other_sd.shape, np.int8))
    return MarkerProcesses(MarkersInTake(markers, markers, others, np.zeros((markers.shape[1],) * 2), RATE))


def given_nothing_else(markers):
    """Return what it makes of a take where no other way says anything"""
    return fill(markers, np.full(markers.shape, np.nan), np.full(markers.shape[:2], np.nan))


def error(filled, truth, gap, m):
    return np.sqrt(((filled - truth)[gap][:, m] ** 2).mean())


def lost(truth, gap, m):
    """Return what it makes of a take that lost one marker in a gap: positions (T, M, 3), deviation (T, M)"""
    damaged = truth.copy()
    damaged[gap, m] = np.nan
    return given_nothing_else(damaged)


@given(first=st.integers(0, 600), seconds=st.floats(0.05, 1.0), m=st.integers(0, 13), seed=st.integers(0, 9))
def test_correlated_marker_is_predicted(first, seconds, m, seed):
    truth, gap = walking(seed=seed), slice(first, first + round(seconds * RATE))
    filled, _ = lost(truth, gap, m)
    assert error(filled, truth, gap, [m]) < 0.035  # the swing has a standard deviation of 0.1 m
    filled[gap, m] = np.nan
    assert np.isnan(filled).all()


def test_errors_are_within_two_sd():
    rng, within = np.random.default_rng(0), []
    for seed in range(50):
        truth, first, m = walking(seed=seed % 10), rng.integers(600), rng.integers(14)
        gap = slice(first, first + round(rng.uniform(0.05, 2.0) * RATE))
        filled, deviation = lost(truth, gap, m)
        within.append(error(filled, truth, gap, [m]) < 2 * np.sqrt((deviation[gap, m] ** 2).mean()))
    assert np.mean(within) > 0.95


def test_lost_limb_is_filled_and_continuous_at_the_edges():
    truth = walking()
    limb, gap = [10, 11, 12, 13], slice(300, 400)
    damaged = truth.copy()
    damaged[gap, limb] = np.nan
    filled, deviation = given_nothing_else(damaged)
    assert error(filled, truth, gap, limb) < 0.03
    for m in limb:
        for edge in (300, 399):
            assert np.linalg.norm(filled[edge, m] - truth[edge, m]) < 0.005
        assert deviation[300, m] < 0.5 * deviation[350, m]


def test_a_limb_at_rest_in_a_short_take_may_move_while_it_is_lost():
    sd = {}
    for frames in (300, 3000):
        truth = np.tile(walking(1), (frames, 1, 1)) + np.random.default_rng(0).normal(scale=0.001, size=(frames, 14, 3))
        truth[100:250] = walking(150)
        damaged = truth.copy()
        damaged[100:250, 9:13] = np.nan
        sd[frames] = given_nothing_else(damaged)[1][100:250, 9:13].mean()
    assert sd[300] > 3 * sd[3000]


def test_rarely_visible_marker_is_not_filled_and_harmless():
    truth = walking()
    damaged = truth.copy()
    damaged[300:350, 8] = np.nan
    alone, _ = given_nothing_else(damaged)
    ghost = np.full((800, 1, 3), np.nan)
    ghost[100:120] = 50.0
    filled, deviation = given_nothing_else(np.concatenate([damaged, ghost], 1))
    np.testing.assert_allclose(filled[300:350, 8], alone[300:350, 8], atol=1e-3)
    assert np.isnan(filled[:, 14]).all()
    assert np.isnan(deviation[:, 14]).all()


@given(
    shape=st.sampled_from([(0, 5), (1, 5), (2, 4), (50, 0), (50, 1), (50, 3), (50, 6), (7, 12)]),
    lost=st.floats(0, 1),
    seed=st.integers(0, 99),
    still=st.booleans(),
)
def test_degenerate_takes_give_finite_values_or_nan(shape, lost, seed, still):
    rng = np.random.default_rng(seed)
    markers = np.zeros((*shape, 3)) if still else rng.normal(size=(*shape, 3))
    missing = rng.random(shape) < lost
    markers[missing] = np.nan
    filled, deviation = given_nothing_else(markers)
    assert (np.isnan(filled[..., 0]) == np.isnan(deviation)).all()
    assert np.isnan(deviation[~missing]).all()
    assert np.isfinite(filled[~np.isnan(filled)]).all()


def test_frames_with_fewer_than_three_markers_stay_empty():
    damaged = walking()
    damaged[400, 2:] = np.nan
    filled, _ = given_nothing_else(damaged)
    assert np.isnan(filled).all()


def test_errors_of_hidden_stretches_are_like_those_of_the_gap():
    truth = walking()
    damaged = truth.copy()
    damaged[300:360, 10:] = np.nan
    window = choose_hidden_stretches(~np.isnan(damaged[:, 10, 0]), 300, 359, RATE)
    others = np.full(truth.shape, np.nan)
    estimates = build_processes(damaged, others, others[..., 0]).estimate_gap(window, np.arange(10, 14))
    assert len(estimates) == 4
    actual = np.sqrt(np.mean([(e.position - truth[300:360, m]) ** 2 for m, e in enumerate(estimates, start=10)]))
    hidden = np.sqrt(np.nanmean([e.error**2 for e in estimates]))
    assert 0.2 < actual / hidden < 2


def test_hard_motion_elsewhere_does_not_count_as_the_error_in_an_easy_gap():
    """Limbs swing at random in the second half of the take; the gap is in the first."""
    truth, rng = walking(), np.random.default_rng(3)
    swing = gaussian_filter1d(rng.normal(size=(400, 8, 3)), 20, axis=0)
    truth[400:, 6:] += 0.2 * swing / swing.std()
    damaged = truth.copy()
    damaged[200:240, 10:] = np.nan
    window = choose_hidden_stretches(~np.isnan(damaged[:, 10, 0]), 200, 239, RATE)
    others = np.full(truth.shape, np.nan)
    estimates = build_processes(damaged, others, others[..., 0]).estimate_gap(window, np.arange(10, 14))
    actual = np.sqrt(np.mean([(e.position - truth[200:240, m]) ** 2 for m, e in enumerate(estimates, start=10)]))
    assert np.sqrt(np.nanmean([e.error**2 for e in estimates])) < 1.2 * actual


def test_precise_estimates_are_used_as_inputs():
    """Only three markers are visible throughout the gap, but the others are filled with a small sd and serve as inputs."""
    truth = walking()
    damaged, others, sd = truth.copy(), truth.copy(), np.full(truth.shape[:2], 0.005)
    damaged[300:400, 3:] = np.nan
    sd[300:400, 13] = 0.2
    alone, _ = given_nothing_else(damaged)
    filled, _ = fill(damaged, others, sd)
    assert np.isnan(alone[350, 13]).all()
    assert error(filled, truth, slice(300, 400), [13]) < 0.02


@pytest.mark.parametrize("turned", [0.0, 1.0, 3.0])
def test_rotating_the_world_rotates_the_fill(turned):
    truth = walking()
    truth[200:260, 9] = np.nan
    about = Rotation.from_rotvec([0, turned, 0]).as_matrix()
    one, one_deviation = given_nothing_else(truth)
    other, other_deviation = given_nothing_else(truth @ about.T + [3.0, 0.0, -2.0])
    np.testing.assert_allclose(other, one @ about.T + [3.0, 0.0, -2.0], atol=1e-6)
    np.testing.assert_allclose(other_deviation, one_deviation, rtol=1e-6)


def test_long_gap_without_three_other_markers_is_divided():
    truth = walking()
    damaged = truth.copy()
    damaged[300:400, 13] = damaged[290:348, :6] = damaged[352:410, 6:12] = np.nan
    filled, _ = given_nothing_else(damaged)
    assert error(filled, truth, slice(300, 345), [13]) < 0.06
    assert error(filled, truth, slice(355, 400), [13]) < 0.06


def test_hundreds_of_gap_patterns_are_fast_enough():
    markers = walking(frames=100, size=41)
    markers[np.random.default_rng(0).random((100, 41)) < 0.1] = np.nan
    filled, _ = given_nothing_else(markers)
    missing = np.isnan(markers[..., 0])
    assert np.isnan(filled[~missing]).all()
    assert (~np.isnan(filled[missing])).mean() > 0.95


def test_gaps_with_precise_estimates_are_skipped():
    damaged = walking()
    damaged[300:350, 8] = damaged[600:640, 9] = np.nan
    others, sd = np.zeros(damaged.shape), np.full(damaged.shape[:2], np.nan)
    sd[300:350, 8], sd[600:640, 9] = 0.9 * MAX_SETTLED_SD_M, 1.1 * MAX_SETTLED_SD_M
    filled, _ = fill(damaged, others, sd)
    assert np.isnan(filled[:, 8]).all()
    assert not np.isnan(filled[600:640, 9]).any()


def test_inputs_share_half_of_the_frames():
    known = np.ones((100, 5), bool)
    known[:30, 1] = known[60:, 3] = known[20:25, 4] = False
    np.testing.assert_array_equal(select_input_markers(known, np.array([0, 1, 3, 4])), [0, 1, 4])
    np.testing.assert_array_equal(select_input_markers(known, np.array([0, 2, 3])), [0, 2, 3])
