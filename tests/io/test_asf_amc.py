from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.errors import WriteError
from mocapfix.io.asf_amc import get_bone_axes_deg, get_cmu_bone_names, read_amc, write_asf_amc
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import kinematics
from tests.captures import CAPTURES

SKELETON = load_cmu31_body().skeleton
CMU = CAPTURES / "cmu"


def random_motion(seed: int, frames: int = 20, fixed: tuple[str, ...] = ("LHipJoint", "RHipJoint")) -> Motion:
    """Return a motion of all joints except the fixed ones, with rotations beyond full turns."""
    rng = np.random.default_rng(seed)
    vectors = np.cumsum(rng.normal(0, 0.4, (frames, 31, 3)), axis=0)
    vectors[:, [SKELETON.find_joint(name) for name in fixed]] = 0.0
    rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, 31, 3, 3)
    none = np.zeros((frames, 0))
    return Motion(rng.normal(0, 2, (frames, 3)), rotations, np.zeros(frames, int), np.zeros(frames, int), none, none)


def write_and_read(folder: Path, motion: Motion, first_frame: int = 1):
    write_asf_amc(folder / "w.asf", folder / "w_1.amc", SKELETON, motion, 100.0, first_frame)
    return read_amc(folder / "w_1.amc")


@pytest.mark.parametrize("fixed", [("LHipJoint", "RHipJoint"), ()])
def test_joints_read_back_at_their_positions(tmp_path, fixed):
    motion = random_motion(0, fixed=fixed)
    found = write_and_read(tmp_path, motion, first_frame=301)
    assert (found.frame_count, found.first_frame, found.rate) == (motion.frame_count, 301, 100.0)
    order = [found.names.index(name) for name in get_cmu_bone_names(SKELETON)]
    error_deg = np.degrees(
        np.linalg.norm(found.compute_local_rotations()[:, order] - motion.local_rotations, axis=(2, 3)) / np.sqrt(2)
    )
    assert error_deg.max() < 1e-4
    position, _ = kinematics.compute_world_poses(SKELETON, motion)
    assert np.linalg.norm(found.compute_world_poses()[0][:, order] - position, axis=-1).max() < 1e-6
    for joint, name in enumerate(SKELETON.names):
        if not np.isnan(SKELETON.ends[joint]).any():
            np.testing.assert_allclose(
                found.end_sites[order[joint]][0] * found.unit_m, SKELETON.ends[joint], atol=1e-9, err_msg=name
            )


def test_angles_are_continuous(tmp_path):
    motion = random_motion(1, frames=200, fixed=SKELETON.names)
    motion.local_rotations[:, 0] = Rotation.from_rotvec(np.radians(np.arange(200) * 10.0)[:, None] * [1, 0, 0]).as_matrix()
    found = write_and_read(tmp_path, motion)
    np.testing.assert_allclose(found.values[:, found.get_rotation_channels(0)[0][-1]], np.arange(200) * 10.0, atol=1e-6)


def test_the_layout_is_that_of_cmus_files(tmp_path):
    write_and_read(tmp_path, random_motion(2))
    lines = (tmp_path / "w_1.amc").read_text().splitlines()
    assert [line.split()[0] for line in lines[1:6]] == [":FULLY-SPECIFIED", ":DEGREES", "1", "root", "lfemur"]
    assert len(lines) == 3 + 20 * (1 + 29)  # the frame number, the root and 28 bones: all except the hip joints
    assert all(len(line.split()) in (1, 4, 7) for line in lines[3:])


@pytest.mark.skipif(not CMU.is_dir(), reason="no captures beside the repository")
def test_names_tree_and_axes_are_those_of_cmus_skeleton(tmp_path):
    write_and_read(tmp_path, random_motion(3))
    own, cmu = read_amc(tmp_path / "w.asf"), read_amc(CMU / "02.asf")
    assert sorted(own.names) == sorted(cmu.names)
    for joint, name in enumerate(own.names):
        other = cmu.names.index(name)
        np.testing.assert_allclose(own.rest_rotations[joint], cmu.rest_rotations[other], atol=1e-4, err_msg=name)
        above = own.names[own.parents[joint]] if joint else ""
        assert above == (cmu.names[cmu.parents[other]] if joint else "")
    assert own.unit_m == cmu.unit_m
    assert get_bone_axes_deg("rhumerus") == (180, 30, 90)


def test_refused_motions_leave_no_files(tmp_path):
    motion, offsets = random_motion(4), SKELETON.offsets.copy()
    offsets[SKELETON.find_joint("LeftShoulder"), 0] += 0.01
    with pytest.raises(WriteError, match=r"w\.asf: LeftShoulder and Neck do not begin at the same position"):
        write_asf_amc(tmp_path / "w.asf", tmp_path / "w.amc", replace(SKELETON, offsets=offsets), motion, 100.0)
    motion.root_position[3, 1] = np.nan
    with pytest.raises(WriteError, match=r"w\.amc: the motion has missing frames"):
        write_asf_amc(tmp_path / "w.asf", tmp_path / "w.amc", SKELETON, motion, 100.0)
    assert not list(tmp_path.iterdir())
