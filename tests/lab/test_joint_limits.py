"""Measuring joint limits of subjects whose range of motion is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.io.shipped import find_shipped_folder
from mocapfix.lab import body_statistics
from mocapfix.lab.body_statistics import FOREARM_TWIST_SD_RAD, LOCKED_JOINT_SD_RAD
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import mean_pose
from mocapfix.solve.mean_pose import MeanPosePrior, load_joint_limits

NAMES = ["Hips", "LeftArm", "RightArm", "LeftForeArm", "RightForeArm", "Head"]
IDENTITY = np.tile(np.eye(3), (len(NAMES), 1, 1))


def compute_euler(vectors):
    """Return ZYX Euler angles (T, 6, 3) in degrees of rotation vectors (T, 6, 3)."""
    flat = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_euler("ZYX", degrees=True)
    return flat.reshape(vectors.shape)


def swing_arm(low, high, frames=2001):
    """Return a trial in which only the left arm rotates about x, y and z in turn, to low (3,), to high (3,) and back."""
    vectors = np.zeros((3 * frames, len(NAMES), 3))
    for a in range(3):
        vectors[a * frames : (a + 1) * frames, 1, a] = np.interp(np.linspace(0, 3, frames), range(4), [0, low[a], high[a], 0])
    return compute_euler(vectors)


def measure(trials, subjects, locked=0.0):
    return body_statistics.measure_joint_limits(
        NAMES, trials, subjects, MeanPosePrior("", IDENTITY, IDENTITY, locked * IDENTITY, 0 * IDENTITY)
    )


def test_range_of_one_subject_is_measured_and_mirrored():
    limits = measure([swing_arm([-0.5, -0.2, -0.3], [1.2, 0.6, 0.4])], ["01"])
    np.testing.assert_allclose(limits["LeftArm"]["low"], [-0.5, -0.2, -0.3], atol=0.02)
    np.testing.assert_allclose(limits["LeftArm"]["high"], [1.2, 0.6, 0.4], atol=0.02)
    np.testing.assert_allclose(limits["RightArm"]["low"], [-0.5, -0.6, -0.4], atol=0.02)
    np.testing.assert_allclose(limits["RightArm"]["high"], [1.2, 0.2, 0.3], atol=0.02)
    assert list(limits) == NAMES[1:]


def test_locked_axes_have_limits_of_three_standard_deviations():
    limits = measure([np.zeros((100, len(NAMES), 3))], ["01"], locked=1 / LOCKED_JOINT_SD_RAD**2)
    np.testing.assert_allclose(limits["Head"]["high"], 3 * LOCKED_JOINT_SD_RAD, atol=1e-3)
    np.testing.assert_allclose(limits["Head"]["low"], -3 * LOCKED_JOINT_SD_RAD, atol=1e-3)
    np.testing.assert_allclose(
        limits["LeftForeArm"]["high"],
        3 * np.array([np.hypot(LOCKED_JOINT_SD_RAD, FOREARM_TWIST_SD_RAD), LOCKED_JOINT_SD_RAD, LOCKED_JOINT_SD_RAD]),
        atol=1e-3,
    )


def test_two_subjects_widen_the_range_for_the_one_with_the_margin_range():
    near, far = swing_arm([-0.3, 0, 0], [0.3, 0, 0]), swing_arm([-0.5, 0, 0], [0.9, 0, 0])
    alone = measure([far], ["02"])["LeftArm"]
    limits = measure([near, far], ["01", "02"])["LeftArm"]
    margin = np.array(limits["high"]) - alone["high"]
    assert 0.4 < margin[0] < 0.6
    np.testing.assert_allclose(np.array(alone["low"]) - limits["low"], margin, atol=0.02)


def test_a_jump_excludes_the_trial_for_that_joint_only():
    good = swing_arm([-0.5, 0, 0], [0.5, 0, 0])
    vectors = np.zeros((600, len(NAMES), 3))
    vectors[300:, 1, 2] = 2.5  # flipped to the end of the trial
    vectors[:, 5, 0] = np.linspace(0, 0.4, 600)
    limits = measure([good, compute_euler(vectors)], ["01", "01"])
    assert limits["LeftArm"]["high"][2] < 0.01
    assert limits["Head"]["high"][0] == pytest.approx(0.4, abs=0.02)


@pytest.mark.parametrize(("step", "expected"), [(0.9, True), (1.1, False)])
def test_a_jump_is_a_radian_in_a_thirtieth_of_a_second(step, expected):
    rotations = Rotation.from_rotvec(np.outer(np.repeat([0.0, step], 5), [0, 0.6, 0.8])).as_matrix()
    assert body_statistics.is_free_of_jumps(rotations) is expected
    assert body_statistics.is_free_of_jumps(rotations[:1])


def test_written_limits_load(tmp_path, monkeypatch):
    names = list(load_cmu31_body().skeleton.names)
    (tmp_path / "mean-pose.yaml").write_bytes((find_shipped_folder("priors") / "mean-pose.yaml").read_bytes())
    (tmp_path / "skeletons.json").write_text(f'{{"joints": {names}}}'.replace("'", '"'), encoding="utf-8")
    angles = np.random.default_rng(1).uniform(-20, 20, (40, len(names), 3))
    written = np.round(angles / 180 * 32767).astype(np.int16)
    np.savez(tmp_path / "train-0.npz", euler=written, trial=np.array(["01_01", "02_01"]), start=np.array([0, 25]))
    body_statistics.write_joint_limits(str(tmp_path), str(tmp_path / "joint-limits.yaml"))
    text = (tmp_path / "joint-limits.yaml").read_text(encoding="utf-8")
    assert "40 frames of 2 trials" in text
    assert "NSF" in text
    for module in (mean_pose, mean_pose):
        monkeypatch.setattr(module, "find_shipped_folder", lambda _: tmp_path)
    limits = load_joint_limits(load_cmu31_body().skeleton)
    assert (limits.lower_rad[1:] < limits.upper_rad[1:]).all()
