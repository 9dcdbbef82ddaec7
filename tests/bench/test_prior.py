"""The benchmark of priors by its command, on a few poses."""

import json
import shutil

import pytest
from tests.train.people import walked, write_bvh

from mocapfix.bench import compared_priors, pose_priors
from mocapfix.cli import app
from mocapfix.errors import SceneError
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.options import DEFAULT_PRIOR_NAME

ROW = {"position_mm", "rotation_deg", "position_sd", "rotation_sd"}


@pytest.fixture
def motion(tmp_path):
    (tmp_path / "motion").mkdir()
    for name in ("01_01", "02_01", "05_03"):
        write_bvh(tmp_path / "motion" / f"{name}.bvh", walked(int(name[:2])))
    return tmp_path / "motion"


@pytest.fixture
def linear_only(monkeypatch):
    """The shelf without networks, which would take long."""
    whole = compared_priors.load_compared_priors

    def shelf(where=None):
        return {name: model for name, model in whole(where).items() if name in ("none", "pca", "gaussian")}

    monkeypatch.setattr(compared_priors, "shelf", shelf)
    for module in (pose_priors, compared_priors):
        monkeypatch.setattr(module, "PRIOR", "gaussian")


def bench(*arguments):
    with pytest.raises(SystemExit) as left:
        app.run_command_line(["bench", "prior", *map(str, arguments)])
    return left.value.code


def test_the_json_has_the_keys_that_others_read(linear_only, capsys):
    assert bench("--frames", 4, "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["poses"], said["default"]) == (4, "gaussian")
    assert list(said["given_joints"]) == ["6", "8", "10", "15"]
    for rows in said["given_joints"].values():
        assert list(rows) == ["none", "pca", "gaussian"]
        assert all(set(row) == ROW for row in rows.values())
    assert set(said["better"]) == {"none", "pca"}
    assert said["bias_mm"] == said["all_joints"]["gaussian"]["bias_mm"]
    assert said["limb"] is None
    assert said["fps"] > 0
    assert said["fps_from_mean_pose"] > 0


def test_the_papers_split_is_measured_with_weights_of_its_own_and_the_table_is_told(linear_only, motion, tmp_path, capsys):
    weights = tmp_path / "weights"
    weights.mkdir()
    for name in ("pca", "gaussian"):
        shutil.copy(find_shipped_folder("priors") / f"{name}.safetensors", weights)
    figure = tmp_path / "pictures" / "curves.png"
    assert bench("--frames", 3, "--data", motion, "--paper-split", weights, "--figure", figure) == 0
    told = capsys.readouterr().out
    for part in ("3 poses of people that no prior has seen", "the paper's own split", "all joints given", "frames a second"):
        assert part in told
    assert figure.is_file()


def test_what_cannot_be_is_told(motion, tmp_path):
    with pytest.raises(SceneError, match="ask for one at least"):
        pose_priors.measure_pose_priors(None, 0, None, False, lambda what: None)
    with pytest.raises(SceneError, match="say with --data where it is"):
        pose_priors.measure_pose_priors(None, 3, tmp_path, False, lambda what: None)
    with pytest.raises(SceneError, match=f"holds no {DEFAULT_PRIOR_NAME}"):
        pose_priors.measure_pose_priors(motion, 3, tmp_path, False, lambda what: None)
