from pathlib import Path

import numpy as np
import pytest

from mocapfix.errors import ReadError
from mocapfix.lab import recordings
from tests.lab.motion_files import draw_motion, write_bvh_motion

CMU = Path(__file__).resolve().parents[3].parent / "shared" / "data" / "captures" / "cmu"


def test_written_bvh_is_read_back(tmp_path):
    rotations = draw_motion(0)
    write_bvh_motion(tmp_path / "07_02.bvh", rotations)
    (recording,) = recordings.read_bvh_recording(tmp_path / "07_02.bvh")
    assert (recording.name, recording.subject) == ("07_02", "07")
    assert recording.rate_hz == pytest.approx(30.0)
    np.testing.assert_allclose(recording.rotations, rotations, atol=1e-7)


def test_high_rate_is_reduced_and_initial_t_pose_skipped(tmp_path):
    rotations = draw_motion(1)
    rotations[0] = np.eye(3)
    write_bvh_motion(tmp_path / "a.bvh", rotations, rate=120.0)
    (recording,) = recordings.read_bvh_recording(tmp_path / "a.bvh")
    assert recording.rate_hz == pytest.approx(30.0)
    assert recording.subject == tmp_path.name
    np.testing.assert_allclose(recording.rotations, rotations[1::4], atol=1e-7)


def test_incomplete_frames_are_skipped(tmp_path):
    rotations = draw_motion(2)
    write_bvh_motion(tmp_path / "a.bvh", rotations)
    lines = (tmp_path / "a.bvh").read_text(encoding="utf-8").splitlines()
    lines[-3] = " ".join(["nan", *lines[-3].split()[1:-1], "nan"])
    (tmp_path / "a.bvh").write_text("\n".join(lines), encoding="utf-8")
    (recording,) = recordings.read_bvh_recording(tmp_path / "a.bvh")
    np.testing.assert_allclose(recording.rotations, np.delete(rotations, -3, axis=0), atol=1e-7)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("JOINT LeftArm", "JOINT LeftWing", "lacks LeftArm"),
        ("MOTION", "NOTION", "has no line MOTION"),
        ("\n0.0", "\n0.0 1 ", "the file is damaged there"),
    ],
)
def test_unknown_skeleton_or_truncated_file_raises(tmp_path, old, new, message):
    write_bvh_motion(tmp_path / "a.bvh", draw_motion(3))
    text = (tmp_path / "a.bvh").read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "a.bvh").write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ReadError, match=rf"a\.bvh.*{message}"):
        list(recordings.read_bvh_recording(tmp_path / "a.bvh"))


@pytest.mark.skipif(not CMU.is_dir(), reason="needs the real captures")
def test_amc_and_bvh_of_a_cmu_trial_have_equal_poses():
    (motion,), (release,) = (
        recordings.read_amc_recording(CMU / "02_01.amc"),
        recordings.read_bvh_recording(CMU / "02_01.bvh"),
    )
    assert (
        (motion.name, motion.subject, motion.rate_hz) == (release.name, release.subject, release.rate_hz) == ("02_01", "02", 30.0)
    )
    np.testing.assert_allclose(motion.rotations, release.rotations, atol=1e-5)
