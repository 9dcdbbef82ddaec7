from pathlib import Path

import numpy as np
import pytest

from mocapfix.errors import ReadError
from mocapfix.train import recording_folders
from tests.train.people import walked, write_bvh

CMU = Path(__file__).resolve().parents[3].parent / "shared" / "data" / "captures" / "cmu"


def test_what_mocapfix_writes_it_reads(tmp_path):
    rotations = walked(0)
    write_bvh(tmp_path / "07_02.bvh", rotations)
    (found,) = recording_folders.read_bvh_recording(tmp_path / "07_02.bvh")
    assert (found.name, found.subject) == ("07_02", "07")
    assert found.rate_hz == pytest.approx(30.0)
    np.testing.assert_allclose(found.rotations, rotations, atol=1e-7)


def test_fast_motion_is_thinned_and_a_t_pose_at_its_start_left_out(tmp_path):
    rotations = walked(1)
    rotations[0] = np.eye(3)
    write_bvh(tmp_path / "a.bvh", rotations, rate=120.0)
    (found,) = recording_folders.read_bvh_recording(tmp_path / "a.bvh")
    assert found.rate_hz == pytest.approx(30.0)
    assert found.subject == tmp_path.name
    np.testing.assert_allclose(found.rotations, rotations[1::4], atol=1e-7)


def test_frames_that_are_not_all_there_are_left_out(tmp_path):
    rotations = walked(2)
    write_bvh(tmp_path / "a.bvh", rotations)
    lines = (tmp_path / "a.bvh").read_text().splitlines()
    lines[-3] = " ".join(["nan", *lines[-3].split()[1:-1], "nan"])
    (tmp_path / "a.bvh").write_text("\n".join(lines))
    (found,) = recording_folders.read_bvh_recording(tmp_path / "a.bvh")
    np.testing.assert_allclose(found.rotations, np.delete(rotations, -3, axis=0), atol=1e-7)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("JOINT LeftArm", "JOINT LeftWing", "which lacks LeftArm"),
        ("MOTION", "NOTION", "has no line MOTION"),
        ("\n0.0", "\n0.0 1 ", "is torn there"),
    ],
)
def test_another_skeleton_or_a_torn_file_is_refused(tmp_path, old, new, message):
    write_bvh(tmp_path / "a.bvh", walked(3))
    text = (tmp_path / "a.bvh").read_text()
    assert old in text
    (tmp_path / "a.bvh").write_text(text.replace(old, new, 1))
    with pytest.raises(ReadError, match=rf"a\.bvh.*{message}"):
        list(recording_folders.read_bvh_recording(tmp_path / "a.bvh"))


@pytest.mark.skipif(not CMU.is_dir(), reason="the real captures are not here")
def test_a_trial_of_cmu_is_the_same_poses_as_amc_and_as_bvh():
    (motion,), (release,) = (
        recording_folders.read_amc_recording(CMU / "02_01.amc"),
        recording_folders.read_bvh_recording(CMU / "02_01.bvh"),
    )
    assert (
        (motion.name, motion.subject, motion.rate_hz) == (release.name, release.subject, release.rate_hz) == ("02_01", "02", 30.0)
    )
    np.testing.assert_allclose(motion.rotations, release.rotations, atol=1e-5)
