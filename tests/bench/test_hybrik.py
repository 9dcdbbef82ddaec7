"""The benchmark of HybrIK by its command, on a few poses."""

import json

import pytest

from mocapfix.bench import hybrik, initialisation, joint_noise, unseen_poses
from mocapfix.cli import app

WAYS = ["naive", "adaptive", "x"]
PARTS = ["all_mm", "body_mm", "hands_mm"]


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """Few poses, hardly any frames to time, and one short take for the starts."""
    poses = unseen_poses.load_unseen_poses()[::50]
    monkeypatch.setattr(unseen_poses, "shipped", lambda: poses)
    monkeypatch.setattr(hybrik, "FRAMES", 30)
    row = {"frames": 7, "wrong": 1, "astray": 1, "wrong_alone": 2, "unconverged": 3, "iterations": 4.0, "iterations_alone": 5.0}
    row |= {"start_markers_mm": 6.0, "start_joints_mm": None, "start_seconds": 0.125, "seconds": 8.0, "wrong_in": {}}
    monkeypatch.setattr(initialisation, "run", lambda **asked: {"composed": {"hybrik-x": row}})


def bench(*arguments):
    with pytest.raises(SystemExit) as left:
        app.run_command_line(["bench", "hybrik", *map(str, arguments)])
    return left.value.code


def test_the_json_has_the_keys_that_others_read(capsys):
    assert bench("--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["poses"] == 20
    for key in ("jitter_mm", "from_given_mm", "wrong_bones_mm"):
        assert list(said[key]) == list(said["given_mm"]) == ["0", "10", "20", "30"]
        for ways in said[key].values():
            assert list(ways) == WAYS
            assert all(list(parts) == PARTS for parts in ways.values())
    assert said["ratios"]["jitter_mm"] == joint_noise.compute_noise_ratios(said["jitter_mm"])
    assert {"random", "zero", "regressed", "markers"} < set(said["twist"])
    assert all({"joints_mm", "markers_mm"} < set(row) for row in said["twist"].values())
    assert list(said["fps_by_way"]) == WAYS
    assert min(said["fps"], said["from_markers_fps"], *said["fps_by_way"].values()) > 0
    assert said["starts"]["composed"]["hybrik-x"]["wrong"] == 1


def test_the_tables_are_told_and_the_errors_drawn(tmp_path, capsys):
    assert bench("--figures", tmp_path / "pictures") == 0
    told = capsys.readouterr().out
    for part in ("20 poses of people that no model has seen", "as given", "LeftForeArm, degrees", "composed: 7 frames"):
        assert part in told
    assert [path.name for path in (tmp_path / "pictures").iterdir()] == ["hybrik-jitter.png"]
    assert (tmp_path / "pictures" / "hybrik-jitter.png").read_bytes().startswith(b"\x89PNG\r\n")
