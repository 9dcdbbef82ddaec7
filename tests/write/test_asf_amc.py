from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.errors import WriteError
from mocapfix.motion import Motion
from mocapfix.read import amc as reading
from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve import kinematics
from mocapfix.write.asf_amc import get_bone_axes_deg, get_cmu_bone_names, write_asf_amc

SKELETON = load_cmu31_body().skeleton
CMU = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "captures" / "cmu"


def moved(seed: int, frames: int = 20, still: tuple[str, ...] = ("LHipJoint", "RHipJoint")) -> Motion:
    """-> a motion of all joints but the still ones, through whole turns."""
    rng = np.random.default_rng(seed)
    vectors = np.cumsum(rng.normal(0, 0.4, (frames, 31, 3)), axis=0)
    vectors[:, [SKELETON.index(name) for name in still]] = 0.0
    rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, 31, 3, 3)
    none = np.zeros((frames, 0))
    return Motion(rng.normal(0, 2, (frames, 3)), rotations, np.zeros(frames, int), np.zeros(frames, int), none, none)


def written(folder: Path, motion: Motion, **kinds):
    write_asf_amc(folder / "w.asf", folder / "w_1.amc", SKELETON, motion, 100.0, **kinds)
    return reading.read_amc(folder / "w_1.amc")


@pytest.mark.parametrize("still", [("LHipJoint", "RHipJoint"), ()])
def test_what_is_written_is_read_back_where_it_was(tmp_path, still):
    motion = moved(0, still=still)
    found = written(tmp_path, motion, first_frame=301)
    assert (found.frame_count, found.first_frame, found.rate) == (motion.frame_count, 301, 100.0)
    order = [found.index(name) for name in get_cmu_bone_names(SKELETON)]
    apart = np.degrees(np.linalg.norm(found.local_rotations()[:, order] - motion.local_rotations, axis=(2, 3)) / np.sqrt(2))
    assert apart.max() < 1e-4
    position, _ = kinematics.compute_world_poses(SKELETON, motion)
    assert np.linalg.norm(found.world()[0][:, order] - position, axis=-1).max() < 1e-6
    for joint, name in enumerate(SKELETON.names):
        if not np.isnan(SKELETON.ends[joint]).any():
            np.testing.assert_allclose(found.ends[order[joint]][0] * found.unit, SKELETON.ends[joint], atol=1e-9, err_msg=name)


def test_angles_run_on_from_frame_to_frame(tmp_path):
    motion = moved(1, frames=200, still=SKELETON.names)
    motion.local_rotations[:, 0] = Rotation.from_rotvec(np.radians(np.arange(200) * 10.0)[:, None] * [1, 0, 0]).as_matrix()
    found = written(tmp_path, motion)
    np.testing.assert_allclose(found.values[:, found.turning(0)[0][-1]], np.arange(200) * 10.0, atol=1e-6)


def test_the_form_is_cmus(tmp_path):
    written(tmp_path, moved(2))
    lines = (tmp_path / "w_1.amc").read_text().splitlines()
    assert [line.split()[0] for line in lines[1:6]] == [":FULLY-SPECIFIED", ":DEGREES", "1", "root", "lfemur"]
    assert len(lines) == 3 + 20 * (1 + 29)  # a frame's number, the root and 28 bones: all but the hips' stubs
    assert all(len(line.split()) in (1, 4, 7) for line in lines[3:])


@pytest.mark.skipif(not CMU.is_dir(), reason="the real captures are not here")
def test_names_order_and_axes_are_those_of_cmus_own_skeleton(tmp_path):
    written(tmp_path, moved(3))
    own, cmus = reading.read_amc(tmp_path / "w.asf"), reading.read_amc(CMU / "02.asf")
    assert sorted(own.names) == sorted(cmus.names)
    for joint, name in enumerate(own.names):
        there = cmus.index(name)
        np.testing.assert_allclose(own.rest[joint], cmus.rest[there], atol=1e-4, err_msg=name)
        above = own.names[own.parents[joint]] if joint else ""
        assert above == (cmus.names[cmus.parents[there]] if joint else "")
    assert own.unit == cmus.unit
    assert get_bone_axes_deg("rhumerus") == (180, 30, 90)


def test_what_an_asf_cannot_hold_is_refused_and_nothing_is_left(tmp_path):
    motion, offsets = moved(4), SKELETON.offsets.copy()
    offsets[SKELETON.index("LeftShoulder"), 0] += 0.01
    with pytest.raises(WriteError, match=r"w\.asf: LeftShoulder and Neck do not begin at the same place"):
        write_asf_amc(tmp_path / "w.asf", tmp_path / "w.amc", replace(SKELETON, offsets=offsets), motion, 100.0)
    motion.root[3, 1] = np.nan
    with pytest.raises(WriteError, match=r"w\.amc: the motion is not known in every frame"):
        write_asf_amc(tmp_path / "w.asf", tmp_path / "w.amc", SKELETON, motion, 100.0)
    assert not list(tmp_path.iterdir())
