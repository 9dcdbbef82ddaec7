"""The benchmark of priors by its command, on a few poses."""

import json

import pytest

from mocapfix.cli import app
from mocapfix.errors import SceneError
from mocapfix.lab import compared_priors, pose_priors
from mocapfix.options import DEFAULT_PRIOR_NAME
from tests.lab.motion_files import draw_motion, write_bvh_motion

ROW = {"position_mm", "rotation_deg", "position_sd", "rotation_sd"}


@pytest.fixture
def motion(tmp_path):
    (tmp_path / "motion").mkdir()
    for name in ("01_01", "02_01", "05_03"):
        write_bvh_motion(tmp_path / "motion" / f"{name}.bvh", draw_motion(int(name[:2])))
    return tmp_path / "motion"


@pytest.fixture
def linear_only(monkeypatch):
    """Compare priors without networks, which take long."""
    load_all = compared_priors.load_compared_priors

    def load_linear(weights_folder=None):
        return {name: model for name, model in load_all(weights_folder).items() if name in ("none", "pca", "gaussian")}

    monkeypatch.setattr(pose_priors, "load_compared_priors", load_linear)
    for module in (pose_priors, compared_priors):
        monkeypatch.setattr(module, "DEFAULT_PRIOR_NAME", "gaussian")


def bench(*arguments):
    with pytest.raises(SystemExit) as exited:
        app.run_command_line(["bench", "prior", *map(str, arguments)])
    return exited.value.code


def test_json_has_its_keys(linear_only, capsys):
    assert bench("--frames", 4, "--json") == 0
    results = json.loads(capsys.readouterr().out)
    assert (results["poses"], results["default"]) == (4, "gaussian")
    assert list(results["given_joints"]) == ["6", "8", "10", "15"]
    for rows in results["given_joints"].values():
        assert list(rows) == ["none", "pca", "gaussian"]
        assert all(set(row) == ROW for row in rows.values())
    assert set(results["better"]) == {"none", "pca"}
    assert results["bias_mm"] == results["all_joints"]["gaussian"]["bias_mm"]
    assert results["limb"] is None
    assert results["fps"] > 0
    assert results["fps_from_mean_pose"] > 0


def test_tables_are_printed(linear_only, motion, capsys):
    assert bench("--frames", 3, "--data", motion) == 0
    output = capsys.readouterr().out
    for part in ("given joints: 6", "given joints: 15", "all joints", "position, mm"):
        assert part in output


def test_invalid_requests_raise(tmp_path):
    with pytest.raises(SceneError, match="must be at least 1, not 0"):
        pose_priors.measure_pose_priors(None, 0, lambda text: None)
    with pytest.raises(SceneError, match=f"holds no {DEFAULT_PRIOR_NAME}"):
        compared_priors.load_compared_priors(tmp_path)
