"""The benchmark of whole cleans: its arithmetic, its files, and one measured clean of a short file."""

from pathlib import Path

import numpy as np
import pytest

from mocapfix.io.capture import read_capture
from mocapfix.lab import clean_speed
from mocapfix.lab.clean_speed import ProcessUsage
from mocapfix.model.animation import Animation
from mocapfix.model.take import Take

SHORT_S = 2.0


def test_costs_of_a_known_run():
    cost = clean_speed.summarise_run(ProcessUsage(duration_s=6.0, cpu_s=8.0, peak_mb=500.0), motion_s=20.0, solver_load=0.01)
    assert cost == {
        "seconds": 6.0,
        "seconds_per_second": pytest.approx(0.3),
        "over_solver": pytest.approx(40.0),
        "peak_mb": 500.0,
        "cpu_seconds": 8.0,
    }


@pytest.mark.parametrize("name", clean_speed.CLEAN_SCENES)
def test_scenes_are_files_of_the_stated_duration(name: str, tmp_path: Path):
    scene = clean_speed.CLEAN_SCENES[name](tmp_path, SHORT_S)
    capture = read_capture(scene.path)
    assert isinstance(capture, Animation if name == "animation" else Take)
    assert len(capture.values if isinstance(capture, Animation) else capture.markers) / capture.rate == pytest.approx(SHORT_S)
    assert scene.motion_s == pytest.approx(SHORT_S)


def test_scores_of_known_errors(tmp_path: Path):
    truth = clean_speed.write_heavily_damaged_take(tmp_path, SHORT_S).truth
    assert truth is not None
    moved = np.argwhere(truth.spike_mask)
    markers = truth.marker_positions + [0.0, 0.001, 0.0]
    unrepaired = moved[: len(moved) // 4]
    markers[tuple(unrepaired.T)] += [0.0, 0.0, 0.03]
    markers[tuple(moved[-1])] = np.nan
    scores = clean_speed.score_markers(truth, markers)
    assert scores["moved_mended"] == pytest.approx(1 - (len(unrepaired) + 1) / len(moved))
    assert scores["left_empty"] == pytest.approx(1 / truth.spike_mask.size)
    expected_mm = 1.0 + len(unrepaired) / (truth.spike_mask.size - 1) * (np.hypot(30, 1) - 1)
    assert scores["error_mm"] == pytest.approx(expected_mm)


def test_medians_of_the_runs_in_the_form_of_the_json(monkeypatch, tmp_path: Path):
    """Cleans and timings are replaced, so that the numbers are known: the better of 20,000 and 30,000 frames a second counts."""
    task_rate = clean_speed.build_common_task().rate_hz
    solver_fps = iter([1.0, *[20_000.0, 30_000.0, 20_000.0, 30_000.0]])
    usages = iter([ProcessUsage(3.0, 6.0, 400.0), ProcessUsage(5.0, 9.0, 500.0), ProcessUsage(4.0, 8.0, 300.0)])
    monkeypatch.setattr(clean_speed, "measure_solver_rate", lambda _: next(solver_fps))
    monkeypatch.setattr(clean_speed, "clean_scene", lambda _: (next(usages), {"fill": 2.0}, {}))
    monkeypatch.setattr(clean_speed, "CLEAN_SCENES", {"sound": lambda folder: clean_speed.write_sound_take(folder, SHORT_S)})
    costs = clean_speed.measure_clean_speed(3, names=("sound",), warm_up=False)
    assert list(costs) == ["sound"]
    assert costs["sound"]["seconds"] == 4.0
    assert costs["sound"]["seconds_per_second"] == 4.0 / SHORT_S
    assert costs["sound"]["peak_mb"] == 400.0
    assert costs["sound"]["over_solver"] == pytest.approx(8.0 / SHORT_S * 30_000.0 / task_rate)
    assert costs["sound"]["over_solver, fill"] == pytest.approx(2.0 / SHORT_S * 30_000.0 / task_rate)


def test_a_process_cleans_this_file_with_this_package(tmp_path: Path):
    scene = clean_speed.write_faulty_animation(tmp_path, SHORT_S)
    usage = clean_speed.run_clean_process(scene.path, tmp_path / "out")
    assert (tmp_path / "out" / "animation.bvh").exists()
    assert usage.cpu_s > 0
    assert usage.peak_mb > 50
