"""The solver benchmark: the names and arithmetic of its results. No test depends on a speed."""

import json
import math
import os

import pytest

from mocapfix.cli.app import run_command_line
from mocapfix.lab import compared_solvers
from mocapfix.lab.compared_solvers import TimingEffort


@pytest.fixture(scope="module")
def results():
    """Return the output of `mocapfix bench solver --json --quick` with a single repetition."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MOCAPFIX_DEBUG", "")  # which the command line sets
        written, before = [], dict(os.environ)
        patch.setattr(
            compared_solvers,
            "QUICK_EFFORT",
            TimingEffort(rounds=1, samples_per_round=1, scipy_frame_count=2),
        )
        patch.setattr("mocapfix.cli.app.sys.stdout.write", written.append)
        with pytest.raises(SystemExit) as exited:
            run_command_line(["bench", "solver", "--json", "--quick"])
        assert exited.value.code == 0
        assert dict(os.environ) == before
        return json.loads("".join(written))


def test_common_task_has_results_for_both_takes(results):
    for key in ("fps_one_thread", "fps_all_threads", "joint_error_mm", "over_scipy", "scipy_fps", "scipy_joint_error_mm"):
        assert set(results[key]) == {"clean", "noisy"}
        assert all(math.isfinite(value) and value > 0 for value in results[key].values())
    assert results["scipy_frames"] == 2
    assert results["threads"] >= 1


def test_poses_are_converged(results):
    assert 0.60 < results["joint_error_mm"]["clean"] <= 0.67
    assert 2.15 < results["joint_error_mm"]["noisy"] <= 2.23


def test_tables_show_the_results(results, monkeypatch, capsys):
    monkeypatch.setattr(compared_solvers, "measure_in_fresh_process", lambda is_quick: results)
    with pytest.raises(SystemExit) as exited:
        run_command_line(["bench", "solver"])
    shown = capsys.readouterr().out
    assert exited.value.code == 0
    assert f"{results['joint_error_mm']['noisy']:.4g}" in shown
    assert "scipy, fps" in shown


def test_minimum_of_the_medians_counts():
    one, other = iter([5.0, 1.0, 4.0, 3.0, 9.0, 2.0]), iter([1.0, 1.0, 1.0, 0.5, 7.0, 7.0])
    samples = [lambda: next(one), lambda: next(other)]
    assert compared_solvers.time_samples(samples, TimingEffort(rounds=2, samples_per_round=3, scipy_frame_count=1)) == [3.0, 1.0]
