"""Import the written files into Blender and compare bone positions, orientation and frame rate with the solve.

`make blender` installs Blender's Python module in .blender; without it these tests are skipped.
"""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from mocapfix.characters.alignment import place_hands_at_wrists
from mocapfix.characters.character_yaml import load_rig
from mocapfix.options import RIG_NAMES, OutputOptions
from mocapfix.solve.kinematics import compute_world_poses

ROOT = Path(__file__).parents[2]
PYTHON = Path(os.environ.get("BLENDER_PYTHON", ROOT / ".blender" / "bin" / "python"))
pytestmark = pytest.mark.skipif(not PYTHON.is_file(), reason="Blender's Python module is not installed (make blender)")
CLOSE = 1e-4  # metres
OUT, DOWN = (1, 0, 0), (0, 0, -1)  # directions of a left arm in Blender's axes
SCALES = {"bvh": 0.01, "blender.bvh": 1.0, "motionbuilder.bvh": 0.01, "3dsmax.bvh": 0.01, "cmu.bvh": 0.0564444444, "glb": 1.0}


@pytest.fixture(scope="module")
def moments(cleaned) -> np.ndarray:
    """The (10,) frames that are compared."""
    return np.linspace(0, cleaned.result.motion.frame_count - 1, 10).astype(int)


@pytest.fixture(scope="module")
def opened(cleaned, moments, tmp_path_factory) -> dict[str, dict]:
    """Blender's scene of every written file, by kind; "slow" is the BVH at 30 frames per second."""
    folder = tmp_path_factory.mktemp("blender")
    outputs = cleaned.result.write(folder / "all", options=OutputOptions(extra_formats=("gltf",), rigs=RIG_NAMES))
    slow = cleaned.result.write(folder / "slow", options=OutputOptions(output_rate_hz=30))
    paths = {kind: outputs[kind] for kind in SCALES} | {"slow": slow["bvh"]}
    jobs = [
        {"path": str(path), "scale": SCALES.get(kind, 0.01), "moments": [(lead(kind) + int(t)) / 120 for t in moments]}
        for kind, path in paths.items()
    ]
    jobs_path, answers = folder / "jobs.json", folder / "answers.json"
    jobs_path.write_text(json.dumps(jobs), encoding="utf-8")
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    process = subprocess.run(
        [PYTHON, Path(__file__).with_name("inside.py"), jobs_path, answers], env=environment, capture_output=True, text=True
    )
    assert process.returncode == 0, process.stderr
    return dict(zip(paths, json.loads(answers.read_text(encoding="utf-8")), strict=True))


def lead(kind: str) -> int:
    """Return the number of frames before the first frame of the motion."""
    name = kind.removesuffix(".bvh")
    return int(name in RIG_NAMES and load_rig(name).first_frame == "t-pose")


def joints_of(kind: str, names: tuple[str, ...]) -> dict[str, str]:
    """Return the joint of the skeleton at which each bone begins."""
    name = kind.removesuffix(".bvh")
    return {joint.name: joint.joint for joint in load_rig(name).joints} if name in RIG_NAMES else {each: each for each in names}


@pytest.mark.parametrize("kind", SCALES)
def test_bones_begin_at_the_solved_joints(opened, cleaned, moments, kind):
    skeleton, motion = cleaned.result.subject.skeleton, cleaned.result.motion
    if kind in ("blender.bvh", "motionbuilder.bvh", "3dsmax.bvh"):
        skeleton, motion = place_hands_at_wrists(skeleton, motion)
    places = compute_world_poses(skeleton, motion)[0][moments]
    bones = joints_of(kind, skeleton.names)
    for heads, frame in zip(opened[kind]["heads"], places, strict=True):
        assert set(heads) == set(bones)
        for bone, head in heads.items():
            x, y, z = frame[skeleton.find_joint(bones[bone])]
            np.testing.assert_allclose(head, [x, -z, y], atol=CLOSE, err_msg=bone)  # Blender's Z is up, its -Y forward


@pytest.mark.parametrize("kind", [kind for kind in SCALES if kind.endswith("bvh")])
def test_scene_has_the_rate_of_the_take(opened, cleaned, kind):
    assert opened[kind]["rate"] == pytest.approx(cleaned.result.input_take.rate, rel=1e-6)


@pytest.mark.parametrize("kind", SCALES)
def test_motion_has_the_duration_of_the_take(opened, cleaned, kind):
    frames = cleaned.result.motion.frame_count + lead(kind)
    assert opened[kind]["last"] == pytest.approx((frames - 1) / cleaned.result.input_take.rate, abs=1e-4)


def test_other_output_rate_keeps_the_timing_of_the_motion(opened, cleaned, moments):
    skeleton, slow = cleaned.result.subject.skeleton, opened["slow"]
    assert slow["rate"] == pytest.approx(30, rel=1e-6)
    for t, heads in zip(moments, slow["heads"], strict=True):
        if t % 4 == 0:
            x, y, z = cleaned.result.joint_position_world[t, skeleton.find_joint("LeftHand")]
            np.testing.assert_allclose(heads["LeftHand"], [x, -z, y], atol=CLOSE)


@pytest.mark.parametrize(("kind", "arm"), [("blender.bvh", OUT), ("motionbuilder.bvh", OUT), ("3dsmax.bvh", DOWN)])
def test_rest_pose_faces_forward_with_the_arms_of_the_rig(opened, kind, arm):
    rest = {joint: np.array(opened[kind]["rest"][bone]) for bone, joint in joints_of(kind, ()).items()}
    for side, mirror in (("Left", [1, 1, 1]), ("Right", [-1, 1, 1])):
        leg, reach = (rest[f"{side}{a}"] - rest[f"{side}{b}"] for a, b in (("Foot", "UpLeg"), ("Hand", "Arm")))
        toe = rest[f"{side}ToeBase"] - rest[f"{side}Foot"]
        np.testing.assert_allclose(leg / np.linalg.norm(leg), DOWN, atol=1e-4)
        np.testing.assert_allclose(reach / np.linalg.norm(reach), np.multiply(arm, mirror), atol=1e-4)
        assert toe[1] < -3 * abs(toe[0])  # forward, Blender's -Y


def test_gltf_has_an_armature_with_a_mesh(opened):
    assert opened["glb"]["meshes"] == 1
