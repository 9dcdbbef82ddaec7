"""Long takes are divided into windows that overlap, and what was found in windows is joined."""

import gc
import pickle
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mocapfix.detect.gaps import detect_gaps
from mocapfix.model import windows
from mocapfix.model.changes import Change, SampleState
from mocapfix.model.faults import Fault, MarkerShift
from mocapfix.model.take import Take
from mocapfix.model.windows import (
    Window,
    build_survey,
    crop_intervals,
    extract_window,
    iterate_blocks,
    join_at_cuts,
    join_columns,
    open_array,
    plan_windows,
    store_take,
    write_rows,
)

RATE, FRAMES, MARKERS = 20.0, 6000, 5


def draw_visible(seed: int) -> np.ndarray:
    """Return which samples are visible: gaps of up to 15 s, and all markers lost for a while."""
    rng, visible = np.random.default_rng(seed), np.ones((FRAMES, MARKERS), bool)
    for _ in range(60):
        first = rng.integers(FRAMES)
        visible[first : first + rng.integers(1, 300), rng.integers(MARKERS)] = False
    visible[2000 : 2000 + 900 * (seed % 2)] = False
    return visible


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("length", [900, 1700, FRAMES])
def test_every_frame_is_in_the_middle_of_one_window(seed, length):
    visible = draw_visible(seed)
    plan = plan_windows(visible, RATE, length)
    assert np.array_equal(np.concatenate([np.arange(each.start, each.end) for each in plan]), np.arange(FRAMES))
    overlap = round(windows.OVERLAP_S * RATE)
    for window in plan:
        assert window.first <= max(0, window.start - overlap)
        assert window.stop >= min(FRAMES, window.end + overlap)
        assert (visible[window.start : window.end].sum(1) >= MARKERS / 2).sum() >= windows.MIN_SHOWN_S * RATE
    assert len(plan) == 1 or len(plan) >= FRAMES / length - 2


def test_windows_meet_where_markers_are_complete_or_overlap_until_gaps_end():
    visible = np.ones((FRAMES, MARKERS), bool)
    visible[2900:2990, 0] = visible[2995:3080, 1] = False
    first, second = plan_windows(visible, RATE, 3000)
    assert first.end == second.start
    assert visible[first.end - 15 : first.end + 15].all()
    visible[2700:3300, 2] = False  # 30 s, longer than the search
    first, second = plan_windows(visible, RATE, 3000)
    assert first.stop - first.end >= 3300 - first.end
    assert second.start - second.first >= second.start - 2700


def build_take(visible: np.ndarray) -> Take:
    markers = np.where(visible[..., None], np.random.default_rng(1).normal(size=(*visible.shape, 3)), np.nan)
    return Take(markers, tuple("ABCDE"), RATE, 11)


def test_a_window_knows_what_is_seen_around_it():
    visible = np.ones((FRAMES, MARKERS), bool)
    visible[950:1050, 0] = visible[:1200, 1] = visible[1900:, 2] = visible[:, 3] = False
    take = store_take(build_take(visible))
    part = extract_window(take, Window(1000, 2000, 1100, 1900))
    assert part.part is not None
    assert (part.frame_count, part.first_frame, part.markers.dtype) == (1000, 1011, float)
    assert part.part.is_seen.tolist() == [[True, False, True, False, True], [True, True, False, False, True]]
    assert part.part.missing.tolist() == [[50, 1000, 0, 1000, 0], [0, 0, 4000, 4000, 0]]
    assert part.is_ever_visible.tolist() == [True, True, True, False, True]
    found = {(fault.marker, fault.first): fault.kind for fault in detect_gaps(part)}
    assert found == {(0, 0): "gap", (1, 0): "leading gap", (2, 900): "trailing gap", (3, 0): "absent"}


def test_a_take_without_labelled_markers_is_stored():
    take = build_take(np.ones((FRAMES, MARKERS), bool))
    stored = store_take(replace(take, markers=take.markers[:, :0], labels=(), unlabelled=take))
    assert stored.markers.shape == (FRAMES, 0, 3)
    assert stored.unlabelled is not None
    assert np.allclose(stored.unlabelled.markers, take.markers, atol=1e-6)


def test_a_survey_shows_every_marker_in_pieces_with_breaks():
    visible = np.ones((FRAMES, MARKERS), bool)
    visible[:, 4] = False
    visible[4321:4340, 4] = True
    take = build_take(visible)
    survey, frames = build_survey(take)
    assert survey.frame_count < FRAMES / 2 + 2000
    assert np.array_equal(survey.markers[frames >= 0], take.markers[frames[frames >= 0]], equal_nan=True)
    assert not survey.visible[frames < 0].any()
    assert survey.visible[:, 4].sum() >= 10
    assert set(np.diff(frames[frames >= 0]).tolist()) > {1}


def test_intervals_are_cropped_moved_and_joined_at_cuts():
    plan = (Window(0, 60, 0, 50), Window(40, 100, 50, 100))
    faults = [Fault("spike", 1, 45, 55, 0.1, "in both"), Fault("ghost", 2, 50, 52, 0.1, "in the second")]
    shift = MarkerShift("moved", 0, 45, 99, 0.02, "moved", settled_frame=47)
    found = []
    for window in plan:
        own = crop_intervals([*faults, shift], slice(window.first, window.stop))
        own = crop_intervals(own, slice(window.start - window.first, window.end - window.first))
        found += crop_intervals(own, slice(-window.start, 100 - window.start))
    assert len(found) == 4  # the spike twice, and the shift only where it begins
    joined = join_at_cuts(found, {50}, lambda each: (each.kind, each.markers))
    assert sorted(joined, key=lambda each: each.marker) == [shift, *faults]
    apart = [replace(faults[1], first=50, last=52), replace(faults[1], first=45, last=48)]
    assert join_at_cuts(apart, {50}, lambda each: each.kind) == apart[::-1]


def test_parts_of_a_change_become_one_with_the_error_of_both():
    def build_change(first: int, last: int, missing: int, off_body_mm: float, predicted_mm: float) -> Change:
        before, after = SampleState(missing, off_body_mm), SampleState(0, off_body_mm)
        return Change(f"gap-A-{first}", "gap", ("A",), first, last, last - first + 1, "", "spline", before, after, predicted_mm)

    (joined,) = join_at_cuts(
        [build_change(10, 13, 3, 1.0, 3.0), build_change(14, 25, 12, 5.0, 1.0)], {14}, lambda each: each.kind
    )
    assert (joined.id, joined.first, joined.last, joined.samples) == ("gap-A-10", 10, 25, 16)
    assert (joined.before, joined.after, joined.predicted_mm) == (SampleState(15, 5.0), SampleState(0, 5.0), 1.7)


def test_arrays_in_files_are_written_in_any_order_and_read_by_another_process():
    folder, values = tempfile.TemporaryDirectory(**windows.ARRAY_FOLDER), np.arange(12.0).reshape(6, 2)
    empty = write_rows(Path(folder.name) / "x", 4, values[4:])
    assert write_rows(Path(folder.name) / "x", 0, values[:4]).shape == empty.shape == (0, 2)
    assert open_array(folder, "y", values, 6) is values
    array = open_array(folder, "x", empty, 6)
    assert array.dtype == np.float32
    assert np.array_equal(array, values)
    assert all(np.array_equal(pickle.loads(pickle.dumps(part)), part) for part in (array[2:5], array[:, 1], array[:0]))
    text = pickle.dumps(array)
    assert b"mocapfix-" in text
    assert np.array_equal(pickle.loads(text), values)
    name, part = Path(folder.name), array[2:4]
    del array, folder
    gc.collect()
    assert np.array_equal(part, values[2:4])
    assert name.exists()
    del part
    assert not name.exists()


def test_columns_are_joined_in_a_file_if_the_first_of_them_are_in_one(monkeypatch):
    monkeypatch.setattr(windows, "MAX_BLOCK_FRAMES", 4)  # three blocks, the last of two frames
    folder, values = tempfile.TemporaryDirectory(**windows.ARRAY_FOLDER), np.arange(90.0).reshape(10, 3, 3)
    stored = open_array(folder, "x", write_rows(Path(folder.name) / "x", 0, values), 10)
    assert join_columns([stored]) is stored
    for first in (stored, values):
        joined = join_columns([first, values[:, :1], values[:, 1:]])
        assert np.array_equal(joined, np.concatenate([values, values], axis=1))
        assert (b"mocapfix-" in pickle.dumps(joined)) == (first is stored)


def test_blocks_have_each_frame_once_and_leave_what_has_none():
    take = windows.store_take(build_take(draw_visible(3)))
    count, markers = take.frame_count, np.array(take.markers)
    blocks = list(iterate_blocks(take, count, count // 3 + 1))
    assert [frames.start for frames, _ in blocks] == [0, count // 3 + 1, 2 * (count // 3 + 1)]
    np.testing.assert_array_equal(np.concatenate([block.markers for _, block in blocks]), markers)
    as_many = replace(take, point_columns=np.arange(count))  # points as frames
    assert all(len(block.point_columns) == count for _, block in iterate_blocks(as_many, count, 7))
