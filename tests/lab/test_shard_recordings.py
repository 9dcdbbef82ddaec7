import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.lab import recordings
from mocapfix.model.skeleton import load_cmu31_body
from tests.lab.motion_files import draw_motion, write_bvh_motion

NAMES = load_cmu31_body().skeleton.names


def write_shard(folder, name="train-1.npz", joints=NAMES):
    """Write a shard of two trials, with a raised left shoulder, and return its path and the rotations."""
    rotations = draw_motion(0)
    rotations[:, NAMES.index("LeftShoulder")] = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
    degrees = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_euler("ZYX", degrees=True).reshape(-1, 31, 3)
    euler = np.round(degrees / 180 * 32767).astype(np.int16)
    trials = {"trial": np.array(["01_02", "14_01"]), "start": np.array([0, 10]), "length": np.array([10, 14])}
    trials["root"] = np.outer(np.arange(24), [1.0, 2.0, 0.0]).astype(np.float32)
    np.savez(folder / name, allow_pickle=False, euler=euler, **trials)
    (folder / "skeletons.json").write_text(json.dumps({"joints": joints}), encoding="utf-8")
    return folder / name, rotations


def test_shard_yields_its_trials(tmp_path):
    path, rotations = write_shard(tmp_path)
    first, second = recordings.read_shard_recordings(path)
    assert [(each.name, each.subject, each.rate_hz) for each in (first, second)] == [("01_02", "01", 30.0), ("14_01", "14", 30.0)]
    np.testing.assert_allclose(first.rotations, rotations[:10], atol=2e-4)
    np.testing.assert_allclose(second.rotations, rotations[10:], atol=2e-4)
    assert np.diff(second.root_position, axis=0) == pytest.approx(np.tile([0.056444, 0.112888, 0.0], (13, 1)))


def test_manifest_names_sources_and_retargeted_motion(tmp_path):
    path, _ = write_shard(tmp_path)
    assert [each.source for each in recordings.read_shard_recordings(path)] == [recordings.UNKNOWN_SOURCE] * 2
    manifest = tmp_path / "manifest.csv"
    manifest.write_text(
        "trial,quality,source,licence\n01_02,exact,a/b@1,CMU (free)\n14_01,retargeted,c/d@2,MIT\n", encoding="utf-8"
    )
    first, second = recordings.read_shard_recordings(path)
    assert first.source == recordings.CMU_SOURCE
    assert second.source == recordings.RecordingSource("c/d", "MIT", is_retargeted=True)
    manifest.write_text("trial,licence\n01_02,MIT\n", encoding="utf-8")
    with pytest.raises(ReadError, match=r"manifest\.csv.*columns"):
        list(recordings.read_shard_recordings(path))


def test_reconstructed_motion_is_skipped(tmp_path):
    path, _ = write_shard(tmp_path, "train-approx.npz")
    assert not list(recordings.read_shard_recordings(path))


def test_other_joints_or_missing_skeletons_raise(tmp_path):
    path, _ = write_shard(tmp_path, joints=NAMES[::-1])
    with pytest.raises(ReadError, match="not the 31"):
        list(recordings.read_shard_recordings(path))
    (tmp_path / "skeletons.json").unlink()
    with pytest.raises(ReadError, match=r"skeletons\.json"):
        list(recordings.read_shard_recordings(path))


def test_folder_yields_all_recordings_in_a_fixed_order(tmp_path):
    write_shard(tmp_path)
    (tmp_path / "more").mkdir()
    for name in ("09_02", "09_01"):
        write_bvh_motion(tmp_path / "more" / f"{name}.bvh", draw_motion(1))
    np.savez(tmp_path / "more" / "others_poses.npz", poses=np.zeros((4, 156)), trans=np.zeros((4, 3)), mocap_framerate=30.0)
    names = [each.name for each in recordings.read_recordings([tmp_path])]
    assert names == ["01_02", "14_01", "others_poses", "09_01", "09_02"]


def test_clavicles_do_not_move_and_arms_keep_their_direction(tmp_path):
    _, rotations = write_shard(tmp_path)
    clavicle, arm, other = (NAMES.index(name) for name in ("LeftShoulder", "LeftArm", "LeftForeArm"))
    first, _ = recordings.read_recordings([tmp_path])
    np.testing.assert_array_equal(first.rotations[:, clavicle], np.tile(np.eye(3), (10, 1, 1)))
    np.testing.assert_allclose(first.rotations[:, arm], (rotations[:, clavicle] @ rotations[:, arm])[:10], atol=4e-4)
    np.testing.assert_allclose(first.rotations[:, other], rotations[:10, other], atol=2e-4)


def test_folders_are_read_one_after_the_other(tmp_path):
    for name in ("b", "a"):
        (tmp_path / name).mkdir()
        write_bvh_motion(tmp_path / name / f"01_{name}.bvh", draw_motion(1))
    names = [each.name for each in recordings.read_recordings([tmp_path / "b", tmp_path / "a"])]
    assert names == ["01_b", "01_a"]


def test_folder_without_motion_raises(tmp_path):
    (tmp_path / "notes.txt").write_text("nothing", encoding="utf-8")
    with pytest.raises(ReadError, match="holds no motion"):
        list(recordings.read_recordings([tmp_path]))


def test_truncated_file_raises(tmp_path):
    path, _ = write_shard(tmp_path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ReadError, match=r"train-1\.npz"):
        list(recordings.read_recordings([tmp_path]))
