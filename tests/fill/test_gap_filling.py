"""Which samples the fill changes, which stay empty and why: on rigid clusters and on a body."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.fill import gap_filling
from mocapfix.io.changes_file import locate_correction
from mocapfix.io.yaml_files import CorrectionModel
from mocapfix.model.body_fit import BodyFit
from mocapfix.model.changes import find_unfilled_runs
from mocapfix.model.detected import Detected
from mocapfix.model.faults import Faults, MarkerShift
from mocapfix.model.take import Take, TakePart
from mocapfix.options import FillOptions
from mocapfix.solve import kinematics
from mocapfix.stats.sequences import find_runs

FIRST, RATE, FRAMES = 501, 100.0, 400
LABELS = ("Jim:A", "Jim:B", "Jim:C", "Jim:D", "Jim:E", "lonely", "never")
ANYTHING = FillOptions()


@pytest.fixture
def rod():
    """Return five markers on a tumbling rigid body, one that moves independently, and one that is never visible."""
    t = np.arange(FRAMES) / RATE
    turn = np.stack([np.cos(t), 0 * t, np.sin(t), 0 * t, 1 + 0 * t, 0 * t, -np.sin(t), 0 * t, np.cos(t)], 1).reshape(-1, 3, 3)
    shape = np.random.default_rng(0).uniform(-0.15, 0.15, (5, 3))
    markers = np.full((FRAMES, 7, 3), np.nan)
    markers[:, :5] = np.einsum("tab,kb->tka", turn, shape) + np.stack([0.5 * t, 1 + 0 * t, np.sin(2 * t)], 1)[:, None]
    markers[:, 5] = np.cumsum(np.random.default_rng(1).normal(0, 0.05, (FRAMES, 3)), 0)
    return markers


def remove_samples(markers, *gaps):
    out = markers.copy()
    for marker, first, last in gaps:
        out[first : last + 1, marker] = np.nan
    return Take(out, LABELS, RATE, FIRST)


def fill(take, options=ANYTHING, is_inlier=None):
    kept = take.visible if is_inlier is None else is_inlier
    durations, ends = gap_filling.compute_gap_durations(kept, take.rate), gap_filling.find_ends(kept)
    filled, reasons, _ = next(gap_filling.fill_take(take, kept, durations, ends, None, options))
    return filled, find_unfilled_runs(filled, reasons)


def test_a_spline_by_hand_is_exact_where_the_path_is_a_line_and_goes_through_its_points():
    frames = np.arange(200.0)
    path = np.stack([0.002 * frames, np.full(200, 0.9), -0.001 * frames], 1)
    take = Take(path[:, None], ("LKNE",), 100.0, 1)
    points = [(frame, *np.round(path[frame - 1] * 1e3, 6)) for frame in (92, 97)]
    entry = CorrectionModel(kind="keys", markers=["LKNE"], first=90, last=99, points=points)
    positions = gap_filling.interpolate_keys(locate_correction(entry, take, "file"), path, 1)
    np.testing.assert_allclose(positions, path[89:99], atol=1e-9)
    empty = np.where((frames >= 85)[:, None] & (frames < 105)[:, None], np.nan, path)
    positions = gap_filling.interpolate_keys(locate_correction(entry, take, "file"), empty, 1)
    np.testing.assert_array_equal(np.isnan(positions[:, 0]), (frames[89:99] < 91) | (frames[89:99] > 96))  # between its points
    moved = entry.model_copy(update={"points": [(frame, x, y + 50.0, z) for frame, x, y, z in points]})
    positions = gap_filling.interpolate_keys(locate_correction(moved, take, "file"), path, 1)
    np.testing.assert_allclose(positions[[2, 7], 1], 0.95)
    assert np.abs(np.diff(positions[:, 1], 2)).max() < 0.02  # without a corner
    assert np.abs(positions[[0, -1], 1] - 0.9).max() < 0.02  # on to the samples beside it


def fill_with_body(take, body):
    durations = gap_filling.compute_gap_durations(take.visible, take.rate)
    ends = gap_filling.find_ends(take.visible)
    filled, reasons, _ = next(gap_filling.fill_take(take, take.visible, durations, ends, body, FillOptions()))
    return filled, find_unfilled_runs(filled, reasons)


def are_bits_equal(before, after, where):
    return before.markers[where].tobytes() == after.markers[where].tobytes()


def test_rigid_gap_is_filled_and_the_rest_is_bit_identical(rod):
    take = remove_samples(rod, (0, 100, 180))
    after, left = fill(take)
    np.testing.assert_allclose(after.markers[100:181, 0], rod[100:181, 0], atol=1e-4)
    assert are_bits_equal(take, after, take.visible)
    assert after.sample_sd is not None
    assert (after.sample_sd[100:181, 0] > 0).all()
    assert np.isnan(after.sample_sd[take.visible]).all()
    assert [(each.marker, each.first, each.last) for each in left] == [(6, 0, FRAMES - 1)]
    assert left[0].reason == "the marker is never visible in this take"


def test_gap_while_a_marker_slides_is_filled_from_its_own_samples(rod):
    rod[:, 0] += 0.03 * np.clip((np.arange(FRAMES) - 100) / 200, 0, 1)[:, None]
    take = remove_samples(rod, (0, 120, 150))
    slide = MarkerShift("drift", 0, 100, FRAMES - 1, 0.05, "", settled_frame=300)
    filled = next(gap_filling.fill_gaps(Detected(take, sample_faults=Faults((slide,))), None, {}, [()], ANYTHING))
    assert np.linalg.norm(filled.take.markers[120:151, 0] - rod[120:151, 0], axis=-1).max() < 0.003
    assert are_bits_equal(take, filled.take, take.visible)


def test_outlier_is_replaced_or_emptied(rod):
    take = remove_samples(rod)
    is_inlier = take.visible.copy()
    is_inlier[200, 0], is_inlier[200:300, 5] = False, False
    spiked = take.replace_markers(np.where(is_inlier[..., None] | ~take.visible[..., None], take.markers, take.markers + 0.3))
    after, left = fill(spiked, is_inlier=is_inlier)
    np.testing.assert_allclose(after.markers[200, 0], rod[200, 0], atol=1e-3)
    assert np.isnan(after.markers[250, 5]).all()  # not filled from outliers
    lonely = next(each for each in left if each.marker == 5)
    assert lonely.first >= 200
    assert lonely.last <= 299
    assert re.fullmatch(r"its predicted standard deviation exceeds \d+ mm|the markers that move with it .*", lonely.reason)


@pytest.mark.parametrize("label", ["Jim:A", "A"])
def test_kept_marker_is_unchanged(rod, label):
    take = remove_samples(rod, (0, 100, 120), (1, 300, 310))
    is_inlier = take.visible.copy()
    is_inlier[200, 0] = False
    after, left = fill(take, FillOptions(keep=(label,)), is_inlier)
    np.testing.assert_array_equal(after.markers[:, 0], take.markers[:, 0])
    assert not np.isnan(after.markers[300:311, 1]).any()
    reasons = {each.reason for each in left if each.marker == 0}
    assert reasons == {"excluded from editing by --keep or --frames"}


def test_only_selected_frames_are_changed(rod):
    take = remove_samples(rod, (0, 100, 120))
    after, left = fill(take, FillOptions(frames=(FIRST + 105, FIRST + 110)))
    filled = after.visible & ~take.visible
    assert find_runs(filled[:, 0]) == [(105, 110)]
    assert [(each.first, each.last) for each in left if each.marker == 0] == [(100, 104), (111, 120)]
    assert are_bits_equal(take, after, ~filled)


@pytest.mark.parametrize(("seconds", "filled"), [(0.2, False), (0.21, True), (5.0, True)])
def test_gap_duration_counts_its_samples_and_is_limited(rod, seconds, filled):
    take = remove_samples(rod, (0, 100, 120))  # 21 samples
    after, left = fill(take, FillOptions(max_gap_s=seconds))
    assert after.visible[100:121, 0].all() == filled
    assert [each.reason for each in left if each.marker == 0] == ([] if filled else [f"the gap is longer than {seconds:g} s"])


def test_uncertain_samples_stay_empty_with_a_reason(rod):
    take = remove_samples(rod, (0, 100, 180))
    after, left = fill(take, FillOptions(max_sd_m=1e-6))
    assert not after.visible[100:181, 0].any()
    assert next(each for each in left if each.marker == 0).reason == "its predicted standard deviation exceeds 0.001 mm"


def test_unfilled_runs_are_exactly_the_missing_samples(rod):
    take = remove_samples(rod, (0, 0, 50), (1, 40, 90), (2, 350, 399), (5, 100, 300))
    after, left = fill(take)
    is_unfilled = np.zeros(after.visible.shape, bool)
    for each in left:
        assert not is_unfilled[each.first : each.last + 1, each.marker].any()
        assert each.reason
        is_unfilled[each.first : each.last + 1, each.marker] = True
    np.testing.assert_array_equal(is_unfilled, ~after.visible)


def test_take_without_faults_is_unchanged(rod):
    take = Take(rod[:, :6], LABELS[:6], RATE, FIRST)
    after, left = fill(take)
    assert left == ()
    assert are_bits_equal(take, after, np.ones(take.visible.shape, bool))


def test_body_fills_a_lost_limb_and_clusters_fill_other_markers(cleaned):
    truth, subject = cleaned.truth, cleaned.truth.subject
    motion = replace(truth.motion, marker_sd=np.full(truth.missing_mask.shape, 0.005))
    on_body = kinematics.compute_joint_and_marker_positions(subject, motion)[1]
    prop = on_body[:, [subject.labels.index("LFHD")]] + [0.0, 0.2, 0.0]
    markers = np.concatenate([on_body, prop], 1)[:, ::-1].copy()
    labels = (*subject.labels, "prop")[::-1]
    columns = np.array([labels.index(label) for label in subject.labels])
    arm = [labels.index(label) for label in ("LUPA", "LELB", "LFRM", "LWRA", "LWRB", "LFIN")]
    true_markers = markers.copy()
    markers[300:420, arm] = np.nan
    markers[500:520, 0] = np.nan
    take = Take(markers, labels, truth.rate)
    joints, on_body = kinematics.compute_joint_and_marker_positions(subject, motion)
    after, left = fill_with_body(take, BodyFit(subject, subject, columns, take, motion, joints, on_body, None))
    assert left == ()
    assert np.linalg.norm(after.markers - true_markers, axis=-1)[300:420, arm].max() < 0.03
    assert np.linalg.norm(after.markers - true_markers, axis=-1)[500:520, 0].max() < 0.01
    assert are_bits_equal(take, after, take.visible)


def test_marker_set_may_have_markers_that_the_take_lacks(cleaned):
    truth, subject = cleaned.truth, cleaned.truth.subject
    markers, labels = truth.marker_positions[:100, 1:].copy(), truth.labels[1:]
    markers[40:50, 3] = np.nan
    motion = replace(truth.motion, **{name: getattr(truth.motion, name)[:100] for name in vars(truth.motion)})
    columns = np.r_[-1, np.arange(len(labels))]
    take = Take(markers, labels, truth.rate)
    joints, on_body = kinematics.compute_joint_and_marker_positions(subject, motion)
    after, left = fill_with_body(take, BodyFit(subject, subject, columns, take, motion, joints, on_body, None))
    assert left == ()
    assert after.markers.shape == markers.shape
    np.testing.assert_allclose(after.markers[40:50, 3], truth.marker_positions[40:50, 4], atol=0.01)


# before a marker is first measured and after it is last measured


@given(st.integers(1, 12).flatmap(lambda count: st.lists(st.booleans(), min_size=count, max_size=count)))
def test_ends_are_the_samples_outside_the_measured_ones(measured):
    ends = gap_filling.find_ends(np.array(measured)[:, None])[:, 0].tolist()
    if not any(measured):
        assert ends == [0] * len(measured)
        return
    first, last = measured.index(True), len(measured) - 1 - measured[::-1].index(True)
    assert ends == [-1 if t < first else int(t > last) for t in range(len(measured))]


def test_gaps_and_ends_of_a_part_are_those_of_the_longer_take():
    measured = np.ones((300, 3), bool)
    measured[80:130, 0] = measured[:150, 1] = measured[170:, 1] = measured[:120, 2] = False
    frames = slice(100, 200)
    visible = np.stack([measured[:100].any(0), measured[200:].any(0)])
    missing = np.array([[20, 100, 100], [0, 100, 0]])
    part, own = TakePart(100, missing, visible), measured[frames]
    assert np.array_equal(gap_filling.find_ends(own, part), gap_filling.find_ends(measured)[frames])
    durations = gap_filling.compute_gap_durations(measured, 100.0)[frames]
    assert np.array_equal(gap_filling.compute_gap_durations(own, 100.0, part), durations)


@pytest.mark.parametrize(("gap", "words"), [((0, 30), "before the marker is first"), ((370, 399), "after the marker is last")])
def test_uncertain_ends_stay_empty_and_say_by_which_rule(rod, gap, words):
    noise = np.random.default_rng(0).normal(0, 0.001, rod.shape)
    take = remove_samples(rod + noise, (0, *gap), (1, 100, 140))
    certain, _ = fill(take)
    assert certain.visible[:, :2].all()  # rigid: predicted well beyond its measurements too
    assert certain.sample_sd is not None
    sd = certain.sample_sd[slice(gap[0], gap[1] + 1), 0]
    after, left = fill(take, FillOptions(max_end_sd_m=float(np.median(sd))))
    assert (after.visible[gap[0] : gap[1] + 1, 0] == (sd <= np.median(sd))).all()
    reasons = [each.reason for each in left if each.marker == 0]
    assert reasons
    assert all(
        re.fullmatch(rf"{words} measured, where it is predicted worse than \S+ mm \(--max-end-sd\)", each) for each in reasons
    )
    after, left = fill(take, FillOptions(max_end_sd_m=0.0))
    assert [(each.first, each.last, each.reason) for each in left if each.marker == 0] == [
        (*gap, f"{words} measured (--max-end-sd 0)")
    ]
    assert after.visible[:, 1].all()  # a gap between measurements is no end
    assert are_bits_equal(take, after, take.visible)
