from dataclasses import replace

import numpy as np
import pytest

from mocapfix.faults import Fault, MarkerShift
from mocapfix.report import change_curves


def fault_of(scene, kind, marker=None):
    return next(f for f in scene.comparison.faults.items if f.kind == kind and marker in (None, f.marker))


def path_of(shown, kind, rank=0):
    (found,) = (path for path in shown.curves if (path.kind, path.rank) == (kind, rank))
    return found.values


def test_a_gap_is_shown_with_half_a_second_beside_it(scene):
    shown = change_curves.build_change_curves(scene.comparison, fault_of(scene, "gap", 3))
    assert (shown.frames[0], shown.frames[-1]) == (0, 50 + 49 + 60)
    now, kept = path_of(shown, "now"), path_of(shown, "kept")
    inside = (shown.frames >= 50) & (shown.frames < 100)
    np.testing.assert_array_equal(np.isfinite(now).all(axis=1), np.isin(shown.frames, np.arange(49, 101)))  # to the next sample
    np.testing.assert_array_equal(np.isfinite(kept).all(axis=1), ~inside)


def test_paths_are_seen_from_the_nearest_markers_in_millimetres(scene):
    shown, after = change_curves.build_change_curves(scene.comparison, fault_of(scene, "gap", 3)), scene.comparison.after
    beside = [after.labels.index(label) for label in shown.reference_labels]
    assert len(beside) == 3
    expected = 1e3 * (after.markers[:, 3] - after.markers[:, beside].mean(axis=1))[shown.frames]
    now, kept = path_of(shown, "now"), path_of(shown, "kept")
    np.testing.assert_allclose(np.where(np.isfinite(now), now, kept), expected, atol=1e-9)
    assert np.ptp(expected, axis=0).max() < 1e-6  # though the body walks


def test_the_band_is_two_standard_deviations_to_either_side_of_what_was_estimated(scene):
    shown = change_curves.build_change_curves(scene.comparison, fault_of(scene, "gap", 3))
    inside = (shown.frames >= 50) & (shown.frames < 100)
    np.testing.assert_allclose(shown.band_mm[inside, :, 1] - shown.band_mm[inside, :, 0], 40.0)
    np.testing.assert_allclose(shown.band_mm[inside].mean(axis=-1), path_of(shown, "now")[inside], atol=1e-9)
    assert np.isnan(shown.band_mm[~inside]).all()


def test_both_markers_of_a_swap_are_shown_where_they_were_and_are(scene):
    shown = change_curves.build_change_curves(scene.comparison, fault_of(scene, "swap"))
    inside = (shown.frames >= 150) & (shown.frames < 170)
    for one, other in ((0, 1), (1, 0)):
        np.testing.assert_allclose(path_of(shown, "was", one)[inside], path_of(shown, "now", other)[inside])
    assert np.isnan(shown.band_mm).all()


def test_a_piece_is_shown_where_it_was_under_the_other_name(scene):
    shown = change_curves.build_change_curves(scene.comparison, fault_of(scene, "fragment"))
    inside = (shown.frames >= 20) & (shown.frames < 40)
    np.testing.assert_allclose(path_of(shown, "was", 1)[inside], path_of(shown, "now", 0)[inside])
    assert np.isnan(path_of(shown, "was", 0)[inside]).all()
    assert np.isnan(path_of(shown, "now", 1)[inside]).all()


def test_a_spike_of_one_sample_is_in_the_picture_of_a_fast_take(scene):
    frames = change_curves._select_frames(fault_of(scene, "spike"), scene.comparison.after)
    assert {69, 70, 71} <= set(frames)
    many = replace(scene.comparison.after.replace_markers(np.zeros((40_000, 31, 3))), rate=2000.0)
    assert {69, 70, 71} <= set(change_curves._select_frames(fault_of(scene, "spike"), many))
    assert len(change_curves._select_frames(fault_of(scene, "absent"), many)) <= 2 * change_curves.MAX_CURVE_POINTS


def test_a_marker_that_moved_is_shown_by_its_distances_before_and_after(scene):
    fault = fault_of(scene, "moved")
    shown, after = change_curves.build_change_curves(scene.comparison, fault), scene.comparison.after
    beside = [after.labels.index(label) for label in shown.axis_names]
    was, now = path_of(shown, "was"), path_of(shown, "now")
    assert (np.isfinite(was).all(axis=1) == ((shown.frames < fault.first) & (shown.frames != 200))).all()
    apart = 1e3 * np.linalg.norm(after.markers[:, beside] - after.markers[:, [20]], axis=-1)
    np.testing.assert_allclose(was[0], apart[0])
    np.testing.assert_allclose(now[-1], apart[-1])
    assert (abs(was[0] - now[-1]) > 3).all()  # they tell, though most markers are level with it


@pytest.mark.parametrize("settled", [210, 225])
def test_while_a_marker_slides_it_is_at_neither_place(scene, settled):
    shown = change_curves.build_change_curves(
        scene.comparison, MarkerShift("drift", 20, 210, 239, 0.03, "", settled_frame=settled)
    )
    between = (shown.frames >= 210) & (shown.frames < settled)
    assert (np.isfinite(path_of(shown, "kept")).all(axis=1) == between).all()
    assert (np.isfinite(path_of(shown, "now")).all(axis=1) == (shown.frames >= settled)).all()


def test_a_picture_is_not_seen_from_a_marker_that_is_lost_meanwhile(scene):
    nearest = scene.comparison.after.labels.index(
        change_curves.build_change_curves(scene.comparison, fault_of(scene, "gap", 3)).reference_labels[0]
    )
    markers = scene.comparison.after.markers.copy()
    markers[70, nearest] = np.nan
    scene = scene.with_(after=scene.comparison.after.replace_markers(markers, scene.comparison.after.deviation))
    assert (
        scene.comparison.after.labels[nearest]
        not in change_curves.build_change_curves(scene.comparison, fault_of(scene, "gap", 3)).reference_labels
    )


def test_of_a_long_exchange_the_beginning_is_shown_and_of_many_markers_three(scene):
    long = scene.comparison.after.replace_markers(np.zeros((40_000, 31, 3)))
    frames = change_curves._select_frames(Fault("mislabelled", 1, 0, 39_999, 0.1, "", other_markers=(2,)), long)
    assert frames[-1] / long.rate == change_curves.MAX_LABEL_CURVE_DURATION_S + change_curves.CURVE_MARGIN_S
    shown = change_curves.build_change_curves(
        scene.comparison, Fault("segment lost", 1, 60, 80, 0.1, "", other_markers=(2, 3, 4, 6))
    )
    assert {path.rank for path in shown.curves} == {0, 1, 2}


def test_without_markers_nearby_paths_are_those_in_the_room(scene):
    alone = scene.comparison.after.markers.copy()
    alone[:, [m for m in range(31) if m != 3]] += 10.0 * np.arange(1, 31)[:, None]
    scene = scene.with_(after=scene.comparison.after.replace_markers(alone, scene.comparison.after.deviation))
    shown = change_curves.build_change_curves(scene.comparison, fault_of(scene, "gap", 3))
    assert shown.reference_labels == ()
    inside = (shown.frames >= 50) & (shown.frames < 100)
    np.testing.assert_allclose(path_of(shown, "now")[inside], 1e3 * alone[shown.frames[inside], 3])
