"""The benchmark of labelling: known answers of its scores, and the takes that it finds in a folder."""

from pathlib import Path

import numpy as np
import pytest

from mocapfix.errors import ReadError
from mocapfix.lab import label_recovery
from mocapfix.lab.label_recovery import LabelScore, compute_tracklet_purity, count_right_labels, summarise_label_scores
from mocapfix.labels.tracklets import PointLabels, UnlabelledPoints
from mocapfix.synthetic import compose_take, write_synthetic_take


def test_the_better_names_of_two_people_count() -> None:
    true = np.array([[0, 1, 2, 3, -1]])
    turned = PointLabels(np.array([[2, 3, 0, -1, 1]]), np.ones((1, 5)))
    assert count_right_labels(true, turned, 2) == 3
    assert count_right_labels(true, PointLabels(true, np.ones((1, 5))), 2) == 4


def test_purity_is_the_share_of_points_in_tracklets_of_their_marker() -> None:
    points = UnlabelledPoints(np.zeros((5, 2, 3)), np.array([[0, 1]] * 4 + [[0, -1]]), 100.0)
    assert compute_tracklet_purity(points, np.array([[0, 1]] * 4 + [[1, -1]])) == pytest.approx(8 / 9)


def test_a_composed_take_is_scored() -> None:
    take = next(iter(label_recovery.compose_takes()))
    score = label_recovery.score_labels("tracks", take._replace(markers=take.markers[:600]), seed=1)
    assert score.purity == 1
    assert score.f1 == pytest.approx(2 * score.recall * score.precision / (score.recall + score.precision))
    assert score.f1 > 0.9


def test_scores_are_summarised_by_kind() -> None:
    scores = [LabelScore("cloud", "a", 1.0, 40, 1.0, 1.0, 1.0, 0.1), LabelScore("cloud", "b", 0.5, 60, 0.8, 0.8, 0.8, 0.3)]
    row = summarise_label_scores(scores)["cloud"]
    assert (row["takes"], row["tracklets"], row["f1"], row["worst_f1"]) == (2, 50, 0.9, 0.8)


def test_captures_of_known_sets_are_found(tmp_path: Path) -> None:
    with pytest.raises(ReadError, match="holds no C3D file of a whole body"):
        label_recovery.measure_label_recovery(tmp_path)
    write_synthetic_take(tmp_path / "walk.c3d", compose_take(0, 2.0))
    (tmp_path / "broken.c3d").write_bytes(b"nothing")
    (take,) = label_recovery.iterate_captures(tmp_path)
    assert (take.name, take.marker_set.name, take.markers.shape[1]) == ("walk", "cmu41", 41)
