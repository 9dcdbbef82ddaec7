"""The figures of cleaned takes: counts as in the report, the worst predicted error, and the picture of its frame."""

import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from mocapfix import pipeline
from mocapfix.batch.jobs import describe_moment, draw_worst_moment, measure_result
from mocapfix.batch.records import SubjectFigures
from mocapfix.cli.clean import print_summary
from mocapfix.io.changes_file import NO_REVIEW
from mocapfix.io.yaml_files import ChangesFileModel, read_yaml_model
from mocapfix.model.stage_timer import StageTimer
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions
from mocapfix.result import CleaningResult
from mocapfix.review.review_session import describe_take
from mocapfix.review.take_files import read_cleaned_take
from mocapfix.synthetic import compose_take, write_synthetic_take
from tests.text_files import trc

MAX_PICTURE_BYTES = 6000
FRAMES, RATE = 60, 60.0


def clean_moving_points(labels: tuple[str, ...] = ("A<b>", "B&", 'C"', "D"), gap_frames: int = 9) -> CleaningResult:
    """Return four points that move alike, of which one has a gap and one is missing in the last ten frames."""
    time_s = np.arange(FRAMES) / RATE
    place = np.array([[0.0, 1.0, 0.0], [0.2, 1.1, 0.0], [0.1, 1.3, 0.1], [0.0, 1.2, 0.3]])
    path = np.stack([np.sin(3 * time_s), 0.1 * np.cos(5 * time_s), 0.5 * time_s], axis=1)
    markers = path[:, None] + place
    markers[20 : 20 + gap_frames, 0] = np.nan
    markers[50:, 1] = np.nan
    take, options = Take(markers, labels, RATE, 101, Path("points.c3d")), CleanOptions()
    return pipeline.clean_subject(take, NO_REVIEW, options, StageTimer())


@pytest.fixture(scope="module")
def result() -> CleaningResult:
    return clean_moving_points()


def test_figures_are_those_of_the_report(result: CleaningResult) -> None:
    (figures,) = measure_result(result)
    fill = result.subject_report["fill"]
    assert (figures.frame_count, figures.rate_hz, figures.duration_s, figures.sample_count) == (60, 60.0, 1.0, 240)
    assert figures.missing_before == fill["missing_before"] == 19
    assert figures.filled + figures.left_empty == 19
    assert (figures.marker_set, figures.residual_mm, figures.subject) == (None, None, "")
    assert sum(figures.fault_counts.values()) == len(result.subject_report["faults"])
    assert SubjectFigures.model_validate_json(figures.model_dump_json()) == figures


def test_worst_error_is_that_of_the_worst_change_of_the_report(result: CleaningResult) -> None:
    assert result.take.sample_sd is not None
    sample_sd = result.take.sample_sd.copy()
    sample_sd[25, 0] = 0.030  # one sample of the gap of the first marker
    changed = replace(result, take=result.take.replace_markers(result.take.markers, sample_sd))
    (figures,) = measure_result(changed)
    predicted = {tuple(each["markers"]): each["predicted_mm"] for each in result.subject_report["changes"]}
    frame, worst = changed.comparison.worst_moment
    assert worst is not None
    assert figures.worst_predicted_error_mm == worst.predicted_mm == max(filter(None, predicted.values()))
    assert figures.worst_frame == 101 + frame


def test_the_worst_predicted_error_is_the_same_in_all_outputs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    markers = 1000 * clean_moving_points().input_take.markers
    (tmp_path / "points.trc").write_text(trc(markers, ("A", "B", "C", "D")))
    result = pipeline.clean(tmp_path / "points.trc")
    outputs = result.write(tmp_path / "out")
    (figures,), report = measure_result(result), json.loads(outputs["report.json"].read_text())
    worst = max(each["predicted_mm"] or 0.0 for each in report["changes"])
    assert worst == figures.worst_predicted_error_mm
    assert describe_take(read_cleaned_take(tmp_path, tmp_path / "out", "points"))["worst_mm"] == worst
    assert max(each.predicted_mm or 0.0 for each in read_yaml_model(ChangesFileModel, outputs["changes.yaml"]).changes) == worst
    page = outputs["report.html"].read_text(encoding="utf-8")
    assert f"<b>{worst:.1f} mm</b><small>predicted error of the worst change</small>" in page
    assert f"event 1, predicted error {worst:.1f} mm" in page
    print_summary(report, outputs)
    (line,) = (line for line in capsys.readouterr().out.splitlines() if "predicted error" in line)
    assert line.startswith(f"  worst predicted error: {worst:.1f} mm, gap of ")


def test_without_fills_the_frame_with_the_most_empty_samples_is_shown(result: CleaningResult) -> None:
    empty = replace(result, take=result.input_take, relabelled_take=result.input_take)
    (figures,) = measure_result(empty)
    assert figures.worst_predicted_error_mm is None
    assert figures.worst_frame is not None
    assert 121 <= figures.worst_frame <= 129 or 151 <= figures.worst_frame <= 160


def test_picture_is_small_and_well_formed_whatever_the_labels(result: CleaningResult) -> None:
    svg = draw_worst_moment(result, 25)
    assert len(svg.encode()) < MAX_PICTURE_BYTES
    root = ElementTree.fromstring(svg)
    assert root.attrib["role"] == "img"
    assert (root.findtext("title") or "").startswith("Frame 126:")
    dots = [path.attrib["d"].count("h0") for path in root.iter("path") if "dot" in path.attrib["class"]]
    assert sum(dots) == int(np.isfinite(result.take.markers[25]).all(axis=1).sum())


def test_picture_of_many_markers_stays_small() -> None:
    rng = np.random.default_rng(1)
    take = Take(rng.normal(size=(3, 900, 3)), tuple(f"marker {n}" for n in range(900)), 100.0, 1, Path("many.c3d"))
    part = clean_moving_points()
    many = replace(part, input_take=take, relabelled_take=take, take=take, faults=type(part.faults)(), changes=())
    assert 0 < len(draw_worst_moment(many, 1).encode()) < MAX_PICTURE_BYTES


def test_frame_without_markers_has_no_picture(result: CleaningResult) -> None:
    nothing = result.take.masked(np.zeros(result.take.visible.shape, bool))
    assert draw_worst_moment(replace(result, take=nothing, input_take=nothing, relabelled_take=nothing), 3) == ""


def test_title_names_few_markers(result: CleaningResult) -> None:
    everything = np.ones(4, bool)
    text = describe_moment(result.take, 0, (("estimated", everything), ("empty", ~everything)))
    assert text == 'Frame 101: 4 estimated (A<b>, B&, C", D).'
    assert describe_moment(result.take, 0, ()) == "Frame 101: nothing was corrected."


def test_empty_marker_is_crossed_where_the_body_carries_it(tmp_path: Path) -> None:
    truth = compose_take(seed=3, seconds=2.0, rate=60.0)
    write_synthetic_take(tmp_path / "take.c3d", truth)
    result = pipeline.clean(tmp_path / "take.c3d", CleanOptions(), subject=truth.subject)
    (figures,) = measure_result(result)
    assert (figures.marker_set, figures.left_empty) == ("cmu41", 0)
    assert figures.residual_mm is not None
    assert 'class="bones"' in figures.picture_svg
    assert 'class="lost"' not in figures.picture_svg
    visible = result.take.visible.copy()
    visible[40, [3, 8]] = False
    svg = draw_worst_moment(replace(result, take=result.take.masked(visible)), 40)
    (crosses,) = (path.attrib["d"] for path in ElementTree.fromstring(svg).iter("path") if path.attrib["class"] == "lost")
    assert crosses.count("M") == 2
    assert len(svg.encode()) < MAX_PICTURE_BYTES
