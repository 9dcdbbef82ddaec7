"""The solver's benchmark: its figures' names and their arithmetic. How fast anything is, no test says."""

import json
import math
import os
import re

import pytest

from mocapfix.bench import solver_speed
from mocapfix.bench.solver_speed import TimingEffort
from mocapfix.cli.app import run_command_line


@pytest.fixture(scope="module")
def said():
    """-> what `mocapfix bench solver --json --quick` prints, every time taken once."""
    with pytest.MonkeyPatch.context() as patch:
        written, before = [], dict(os.environ)
        patch.setattr(
            solver_speed, "QUICK", TimingEffort(rounds=1, samples_per_round=1, directions_per_sample=1, scipy_frame_count=2)
        )
        patch.setattr("mocapfix.cli.app.sys.stdout.write", written.append)
        with pytest.raises(SystemExit) as left:
            run_command_line(["bench", "solver", "--json", "--quick"])
        assert left.value.code == 0
        assert dict(os.environ) == before
        return json.loads("".join(written))


def test_every_figure_of_the_common_task_is_there_for_both_takes(said):
    for key in ("fps_one_thread", "fps_all_threads", "joint_error_mm", "over_scipy", "scipy_fps", "scipy_joint_error_mm"):
        assert set(said[key]) == {"clean", "noisy"}
        assert all(math.isfinite(value) and value > 0 for value in said[key].values())
    assert said["scipy_frames"] == 2
    assert said["threads"] >= 1


def test_the_poses_are_converged(said):
    assert 0.60 < said["joint_error_mm"]["clean"] <= 0.67
    assert 2.15 < said["joint_error_mm"]["noisy"] <= 2.23


def test_the_directions_are_told_by_joints_and_their_ratios_are_ratios(said):
    for key in ("direction_us", "dense_direction_us"):
        assert set(said[key]) == {"23", "31", "51"}
        assert all(math.isfinite(value) and value > 0 for value in said[key].values())
    assert said["k51_over_k23"] == said["direction_us"]["51"] / said["direction_us"]["23"]
    for joints in (23, 51):
        rows = [row["speedup"] for row in said["experiments"] if (row["experiment"], row["joints"]) == (1, joints)]
        assert said[f"sparse_speedup_k{joints}"] == pytest.approx(math.prod(rows) ** (1 / 5))
    assert all(row["speedup"] == row["dense_us"] / row["sparse_us"] for row in said["experiments"])


def test_the_tables_show_what_was_measured(said, monkeypatch, capsys):
    monkeypatch.setattr(solver_speed, "alone", lambda quick: said)
    with pytest.raises(SystemExit) as left:
        run_command_line(["bench", "solver"])
    shown = capsys.readouterr().out
    assert left.value.code == 0
    assert f"{said['joint_error_mm']['noisy']:.2f}" in shown
    assert f"51 joints cost {said['k51_over_k23']:.2f} times 23" in shown
    assert len(re.findall(r"│ 3 +│ 51 +│ 416 ", shown)) == 11


def test_the_least_of_the_medians_counts():
    one, other = iter([5.0, 1.0, 4.0, 3.0, 9.0, 2.0]), iter([1.0, 1.0, 1.0, 0.5, 7.0, 7.0])
    samples = [lambda: next(one), lambda: next(other)]
    assert solver_speed.time_samples(
        samples, TimingEffort(rounds=2, samples_per_round=3, directions_per_sample=1, scipy_frame_count=1)
    ) == [3.0, 1.0]


def test_a_speedup_is_the_geometric_mean_of_one_experiment_on_one_tree():
    rows = [
        {"experiment": experiment, "joints": joints, "speedup": ratio}
        for experiment, joints, ratio in ((1, 23, 2.0), (1, 23, 8.0), (1, 51, 100.0), (2, 23, 100.0))
    ]
    assert solver_speed.compute_speedup(rows, 1, 23) == pytest.approx(4.0)
