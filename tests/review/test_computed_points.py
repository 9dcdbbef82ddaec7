from dataclasses import replace
from pathlib import Path

import numpy as np

from mocapfix.io import capture
from mocapfix.model.take import Take
from mocapfix.options import FillOptions
from mocapfix.output_formats import write_cleaned_copy
from mocapfix.report.notes import describe_computed_points
from mocapfix.review.apply_decisions import update_computed_points
from tests.c3d_files import c3d_bytes
from tests.stats.test_point_functions import build_segment

LABELS = ["LASI", "RASI", "MID", "LPSI", "RPSI", "SACR", "LHJC"]


def read_pelvis(folder: Path) -> tuple[Take, np.ndarray]:
    """Return a take with two computed midpoints, one of them recognised by its name, with gaps; and the true points."""
    markers = build_segment(3, 5)
    points = np.insert(markers, 2, markers[:, :2].mean(1), axis=1)
    points = np.concatenate([points, markers[:, [0, 2]].mean(1, keepdims=True)], axis=1)
    damaged = points.copy()
    damaged[50:60, [1, 2]] = 0  # a marker and its midpoint are missing
    damaged[100:110, 0] += 0.1  # a fault, which both midpoints share
    damaged[100:110, [2, 6]] += 0.05
    path = folder / "pelvis.c3d"
    path.write_bytes(c3d_bytes(damaged * 1000, LABELS, extra={"POINT:Y_SCREEN": "+Y"}))
    return capture.read_take(path), points


def count_updates(take: Take) -> list[int]:
    assert take.computed_points is not None
    return take.computed_points.updated_counts.tolist()


def clean(take: Take, points: np.ndarray) -> Take:
    """Return the take with its faults replaced by the truth."""
    truth = points[:, take.point_columns]
    is_wrong = ~(np.linalg.norm(take.markers - truth, axis=-1) < 1e-3)
    return take.replace_markers(np.where(is_wrong[..., None], truth, take.markers), np.where(is_wrong, 0.003, np.nan))


def test_gaps_of_points_that_are_functions_are_filled(tmp_path):
    take, points = read_pelvis(tmp_path)
    cleaned = update_computed_points(take, clean(take, points), FillOptions())
    assert cleaned.computed_points is not None
    after = cleaned.computed_points.take
    column = after.labels.index("MID")
    np.testing.assert_allclose(after.markers[50:60, column], points[50:60, 2], atol=1e-5)
    assert count_updates(cleaned) == [10 if label == "MID" else 0 for label in after.labels]
    assert "10 of their samples were computed" in describe_computed_points(cleaned)[0]
    assert "they are unchanged" in describe_computed_points(take)[0]


def test_points_are_computed_again_on_request(tmp_path):
    take, points = read_pelvis(tmp_path)
    cleaned = update_computed_points(take, clean(take, points), FillOptions(update_computed=True))
    assert cleaned.computed_points is not None
    after = cleaned.computed_points.take
    for label, column in (("MID", 2), ("LHJC", 6)):
        np.testing.assert_allclose(after.markers[:, after.labels.index(label)], points[:, column], atol=1e-5)
    assert sorted(count_updates(cleaned)) == [10, 20]


def test_kept_points_and_frames_are_not_updated(tmp_path):
    take, points = read_pelvis(tmp_path)
    for options in (FillOptions(update_computed=True, keep=("MID", "LHJC")), FillOptions(update_computed=True, frames=(1, 20))):
        cleaned = update_computed_points(take, clean(take, points), options)
        assert not any(count_updates(cleaned))


def test_updated_points_are_written_and_all_other_points_are_unchanged(tmp_path):
    take, points = read_pelvis(tmp_path)
    cleaned = update_computed_points(take, clean(take, points), FillOptions(update_computed=True))
    assert write_cleaned_copy(tmp_path / "cleaned.c3d", take, cleaned) == []
    again = capture.read_take(tmp_path / "cleaned.c3d")
    assert again.computed_points is not None
    assert again.labels == take.labels
    assert cleaned.computed_points is not None
    np.testing.assert_allclose(again.computed_points.take.markers, cleaned.computed_points.take.markers, atol=1e-6)
    unchanged = update_computed_points(take, take, FillOptions())
    untouched = replace(take, computed_points=None)
    write_cleaned_copy(tmp_path / "without.c3d", untouched, untouched)
    assert (tmp_path / "without.c3d").read_bytes() == (tmp_path / "pelvis.c3d").read_bytes()
    assert not any(count_updates(unchanged))
