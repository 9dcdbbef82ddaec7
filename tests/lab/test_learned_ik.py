"""The benchmark of learned inverse kinematics on synthetic motion: its results, and the SMPLify baseline."""

import json

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mocapfix.lab import learned_ik
from mocapfix.lab.learned_ik import follow_take, optimise_poses
from mocapfix.model.skeleton import load_cmu31_skeleton
from mocapfix.solve.learned_ik import PoseRegressor
from tests.lab.motion_files import draw_motion
from tests.solve.ik_cases import SKELETON, build_network, draw_poses, place


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Use one thread, which is faster than several for so little work."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a shard of two trials."""
    path = tmp_path_factory.mktemp("motion")
    motions = [draw_motion(seed, 70, spread=0.2) for seed in range(2)]
    rotations = np.concatenate(motions).reshape(-1, 3, 3)
    degrees = Rotation.from_matrix(rotations).as_euler("ZYX", degrees=True)
    euler = np.rint(degrees / 180 * 32767).astype(np.int16).reshape(-1, 31, 3)
    np.savez(
        path / "test.npz",
        euler=euler,
        trial=["02_01", "05_01"],
        start=[0, 70],
        length=[70, 70],
        root=np.zeros((140, 3), np.float32),
    )
    (path / "skeletons.json").write_text(json.dumps({"joints": load_cmu31_skeleton().names}), encoding="utf-8")
    return path


def test_results_are_complete(folder, monkeypatch):
    for name, value in (("MAX_SMPLIFY_PAIRS", 4), ("SINGLE_FRAMES", 4), ("SPEED_REPEATS", 1), ("PIECE_COUNT", 2)):
        monkeypatch.setattr(learned_ik, name, value)
    results = learned_ik.measure_learned_ik(folder, lambda text: None, build_network(scale=0.0))
    assert list(results["one_step_mm"]) == ["1", "3", "5", "7", "9"] == list(results["smplify_mm"])
    assert max(results["one_step_mm"].values()) < 1
    assert results["copied_mm"]["9"] > results["copied_mm"]["1"] > 1
    assert results["sequential_mm"] < 10  # hip stubs move here, which the closed form holds
    assert set(results["plug_in_mm"]) == {"noise", "arm_missing"}
    assert results["plug_in_mm"]["arm_missing"]["hybrik_x"] > results["plug_in_mm"]["noise"]["hybrik_x"]
    assert results["plug_in_mm"]["noise"]["window"] < results["plug_in_mm"]["noise"]["pass_1"]
    assert min(results[key] for key in ("fps_single", "fps_batch", "over_smplify")) > 0


def test_smplify_approaches_the_joints_from_the_start():
    start, (positions, _) = draw_poses(0, 4), place(draw_poses(1, 4))
    root = np.zeros((4, 3))
    solved = optimise_poses(SKELETON, (root, start), positions)
    before, after = (np.linalg.norm(place(each[1], each[0])[0] - positions, axis=-1).mean() for each in ((root, start), solved))
    assert after < 0.3 * before
    np.testing.assert_allclose(np.linalg.det(solved[1]), 1, atol=1e-4)


SD_M = np.full((12, 31), 1e-3)


def test_followed_take_reaches_given_joints():
    rotations = draw_poses(1)
    positions, _ = place(rotations)
    model = PoseRegressor(build_network(scale=0.0), SKELETON)
    root, local = follow_take(model, (np.zeros((1, 3)), rotations[:1]), positions)
    np.testing.assert_allclose(place(local, root)[0], positions, atol=1e-3)
