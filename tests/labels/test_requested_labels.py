"""Takes without labels: labelled by name, cleaned as labelled ones are, and refused where they cannot be."""

from typing import Any

import numpy as np
import pytest

from mocapfix import pipeline
from mocapfix.errors import TakeError
from mocapfix.io.c3d import write_c3d
from mocapfix.io.capture import read_take
from mocapfix.io.text_tables import write_csv, write_trc
from mocapfix.lab.label_recovery import remove_labels
from mocapfix.model.take import C3dLayout, Take
from mocapfix.options import OutputOptions, build_clean_options
from mocapfix.synthetic import SyntheticTake, compose_take


@pytest.fixture(scope="module")
def truth() -> SyntheticTake:
    return compose_take(6, 4.0, 60.0)


def write_unlabelled(folder, truth, kind, suffix="c3d"):
    unlabelled = remove_labels(kind, truth.marker_positions, truth.rate, seed=4)
    labels = tuple(f"*{c + 1}" for c in range(unlabelled.points.shape[1]))
    path = folder / f"{kind}.{suffix}"
    {"c3d": write_c3d, "trc": write_trc, "csv": write_csv}[suffix](path, Take(unlabelled.points, labels, truth.rate))
    return path


@pytest.mark.parametrize(("kind", "suffix"), [("tracks", "c3d"), ("cloud", "c3d"), ("ghosts", "trc"), ("tracks", "csv")])
def test_labelled_file_has_the_samples_under_their_labels(tmp_path, truth, kind, suffix):
    path = write_unlabelled(tmp_path, truth, kind, suffix)
    labelled = pipeline.label(path, build_clean_options(marker_set="cmu41"))
    assert labelled.labelled_file is not None
    target = tmp_path / f"labelled.{suffix}"
    target.write_bytes(labelled.labelled_file)
    take = read_take(target)
    assert set(take.labels) == set(truth.labels)
    columns = [take.labels.index(label) for label in truth.labels]
    distance = np.linalg.norm(take.markers[:, columns] - truth.marker_positions, axis=-1)
    assert np.nanmax(distance) < 1e-4
    assert np.isnan(distance).mean() < 0.01
    np.testing.assert_array_equal(labelled.markers, take.markers)


def test_only_names_change_where_each_trajectory_is_one_marker(tmp_path, truth):
    path = tmp_path / "whole.c3d"
    order = np.random.default_rng(0).permutation(len(truth.labels))
    write_c3d(path, Take(truth.marker_positions[:, order], tuple(f"*{c}" for c in order), truth.rate))
    labelled = pipeline.label(path, build_clean_options(marker_set="cmu41"))
    assert labelled.labels == tuple(truth.labels[m] for m in order)
    old, new = path.read_bytes(), labelled.labelled_file
    layout, old_layout = labelled.layout, read_take(path).layout
    assert isinstance(layout, C3dLayout)
    assert isinstance(old_layout, C3dLayout)
    assert new is not None
    stop = layout.frame_count * layout.frame_stride_bytes
    old_start = old_layout.data_start_byte
    assert new[layout.data_start_byte : layout.data_start_byte + stop] == old[old_start : old_start + stop]


def test_unlabelled_take_is_cleaned_as_the_labelled_one(tmp_path, truth):
    path = write_unlabelled(tmp_path, truth, "tracks")
    result = pipeline.clean(path, marker_set="cmu41")
    result.write(tmp_path / "out", options=OutputOptions(extra_formats=("npz",)))
    confidence = np.load(tmp_path / "out" / "tracks.npz")["label_confidence"]
    np.testing.assert_array_equal(np.isnan(confidence), ~result.input_take.visible)
    assert np.nanmin(confidence) > 0.95
    take = read_take(tmp_path / "out" / "tracks.c3d")
    columns = [take.labels.index(label) for label in truth.labels]
    assert np.nanmax(np.linalg.norm(take.markers[:, columns] - truth.marker_positions, axis=-1)) < 0.02
    report: Any = result.report
    section = report["take"]["labelling"]
    assert set(section["markers"]) == set(truth.labels)
    assert any("Labelled by mocapfix" in note for note in report["notes"])


def test_set_that_fits_clearly_is_assumed(tmp_path, truth):
    labelled = pipeline.label(write_unlabelled(tmp_path, truth, "tracks"))
    assert set(labelled.labels) == set(truth.labels)
    assert "The marker set cmu41 was assumed" in labelled.notes[0]


def test_take_without_labels_with_few_points_is_refused(tmp_path, truth):
    path = tmp_path / "head.c3d"
    write_c3d(path, Take(truth.marker_positions[:, :4], tuple(f"*{c}" for c in range(4)), truth.rate))
    with pytest.raises(TakeError, match=r"none of its 4 points has a label; name the markers with --marker-set"):
        pipeline.clean(path)


def test_take_with_labels_is_not_labelled_again(tmp_path, truth):
    path = tmp_path / "labelled.c3d"
    write_c3d(path, Take(truth.marker_positions, truth.labels, truth.rate))
    with pytest.raises(TakeError, match=r"has labels already \(.*\); `mocapfix clean` finds those that are wrong"):
        pipeline.label(path, build_clean_options(marker_set="cmu41"))


def test_labels_without_a_meaning_are_replaced_by_those_of_the_named_set(tmp_path, truth):
    path = tmp_path / "numbered.c3d"
    order = np.random.default_rng(1).permutation(len(truth.labels))
    labels = tuple(f"M{n:02d}" for n in range(len(order)))
    markers = truth.marker_positions[:, order].copy()
    markers[60:150, :5] = np.nan
    write_c3d(path, Take(markers, labels, truth.rate))
    labelled = pipeline.label(path, build_clean_options(marker_set="cmu41"))
    assert labelled.labels == tuple(truth.labels[m] for m in order)
    assert "mean nothing in cmu41" in labelled.notes[0]
    with pytest.raises(TakeError, match="has labels already"):
        pipeline.label(path)


def test_labels_with_a_meaning_are_kept_and_the_named_set_is_refused(tmp_path, truth):
    path = tmp_path / "other.c3d"
    labels = tuple(f"{side} {place} {n}" for n in range(7) for place in ("Knee", "Ankle", "Elbow") for side in ("Left", "Right"))
    write_c3d(path, Take(truth.marker_positions, labels[:41], truth.rate))
    with pytest.raises(TakeError, match="cmu41 does not fit"):
        pipeline.clean(path, marker_set="cmu41")


def test_numbered_points_without_a_set_state_the_cause(tmp_path, truth):
    path = tmp_path / "numbered.c3d"
    write_c3d(path, Take(truth.marker_positions[:, :22], tuple(str(c) for c in range(22)), truth.rate))
    with pytest.raises(TakeError, match=r"marker set .*fit.* Name the markers with --marker-set") as error:
        pipeline.label(path)
    assert "has labels" not in str(error.value)


def test_labelled_take_of_the_person_gives_the_labels(tmp_path, truth):
    labelled = tmp_path / "first.c3d"
    write_c3d(labelled, Take(truth.marker_positions, truth.labels, truth.rate))
    result = pipeline.label(write_unlabelled(tmp_path, truth, "tracks"), build_clean_options(like=labelled))
    assert set(result.labels) == set(truth.labels)
    with pytest.raises(TakeError, match="leave out --marker-set"):
        pipeline.label(labelled, build_clean_options(like=labelled, marker_set="cmu41"))
