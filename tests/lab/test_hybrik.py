"""The benchmark of HybrIK by its command, on a few poses."""

import json

import pytest

from mocapfix.cli import app
from mocapfix.lab import hybrik_tables, initialisation, sound_takes

VARIANTS = ["naive", "adaptive", "x"]
PARTS = ["all_mm", "body_mm", "hands_mm"]


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """Use few poses, few timed frames, and one synthetic result of the starts."""
    poses = sound_takes.load_unseen_poses()[::50]
    monkeypatch.setattr(initialisation, "load_unseen_poses", lambda: poses)
    monkeypatch.setattr(initialisation, "SPEED_FRAME_COUNT", 30)
    row = {
        "frames": 7,
        "wrong": 1,
        "wrong_from_start": 1,
        "wrong_first_solve": 2,
        "unconverged": 3,
        "iterations": 4.0,
        "iterations_first_solve": 5.0,
    }
    row |= {"start_markers_mm": 6.0, "start_joints_mm": None, "start_seconds": 0.125, "seconds": 8.0, "wrong_in": {}}
    monkeypatch.setattr(initialisation, "measure_initialisation", lambda **_: {"composed": {"hybrik-x": row}})


def bench(*arguments):
    with pytest.raises(SystemExit) as exited:
        app.run_command_line(["bench", "hybrik", *map(str, arguments)])
    return exited.value.code


def test_json_has_its_keys(capsys):
    assert bench("--json") == 0
    results = json.loads(capsys.readouterr().out)
    assert results["poses"] == 20
    for key in ("jitter_mm", "from_given_mm", "wrong_bones_mm"):
        assert list(results[key]) == list(results["given_mm"]) == ["0", "10", "20", "30"]
        for variants in results[key].values():
            assert list(variants) == VARIANTS
            assert all(list(parts) == PARTS for parts in variants.values())
    assert results["ratios"]["jitter_mm"] == hybrik_tables.compute_noise_ratios(results["jitter_mm"])
    assert list(results["fingers_mm"]) == ["0", "5", "10"]
    assert {"random", "zero", "regressed", "markers"} < set(results["twist"])
    assert all({"joints_mm", "markers_mm"} < set(row) for row in results["twist"].values())
    assert list(results["fps_by_way"]) == VARIANTS
    assert min(results["fps"], results["from_markers_fps"], *results["fps_by_way"].values()) > 0
    assert results["starts"]["composed"]["hybrik-x"]["wrong"] == 1
