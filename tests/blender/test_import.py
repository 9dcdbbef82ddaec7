"""Blender itself opens what is written: bones where the solve has them, the right way up, at the right rate.

`make blender` puts Blender's Python module into .blender; where it is not there these tests are skipped.
"""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from mocapfix.options import RIG_NAMES, OutputOptions
from mocapfix.write import rig

ROOT = Path(__file__).parents[2]
PYTHON = Path(os.environ.get("BLENDER_PYTHON", ROOT / ".blender" / "bin" / "python"))
pytestmark = pytest.mark.skipif(not PYTHON.is_file(), reason="Blender's Python module is not installed (make blender)")
CLOSE = 1e-4  # metres
OUT, DOWN = (1, 0, 0), (0, 0, -1)  # a left arm's ways, as Blender has them
SCALES = {"bvh": 0.01, "blender.bvh": 1.0, "motionbuilder.bvh": 0.01, "3dsmax.bvh": 0.01, "cmu.bvh": 0.0564444444, "glb": 1.0}


@pytest.fixture(scope="module")
def moments(cleaned) -> np.ndarray:
    """-> (10,) the frames that are looked at"""
    return np.linspace(0, cleaned.result.motion.frame_count - 1, 10).astype(int)


@pytest.fixture(scope="module")
def opened(cleaned, moments, tmp_path_factory) -> dict[str, dict]:
    """-> by kind, what Blender makes of everything that is written; "slow" is the BVH at 30 frames a second."""
    folder = tmp_path_factory.mktemp("blender")
    outputs = cleaned.result.write(folder / "all", options=OutputOptions(extra_formats=("gltf",), rigs=RIG_NAMES))
    slow = cleaned.result.write(folder / "slow", options=OutputOptions(output_rate_hz=30))
    paths = {kind: outputs[kind] for kind in SCALES} | {"slow": slow["bvh"]}
    jobs = [
        {"path": str(path), "scale": SCALES.get(kind, 0.01), "moments": [(lead(kind) + int(t)) / 120 for t in moments]}
        for kind, path in paths.items()
    ]
    asked, answers = folder / "asked.json", folder / "answers.json"
    asked.write_text(json.dumps(jobs))
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    told = subprocess.run(
        [PYTHON, Path(__file__).with_name("inside.py"), asked, answers], env=environment, capture_output=True, text=True
    )
    assert told.returncode == 0, told.stderr
    return dict(zip(paths, json.loads(answers.read_text()), strict=True))


def lead(kind: str) -> int:
    """-> how many frames come before the motion's first"""
    name = kind.removesuffix(".bvh")
    return int(name in RIG_NAMES and rig.load_rig(name).starts_with_t_pose)


def joints_of(kind: str, names: tuple[str, ...]) -> dict[str, str]:
    """-> by bone, the skeleton's joint where it begins"""
    name = kind.removesuffix(".bvh")
    return (
        {joint.name: joint.joint for joint in rig.load_rig(name).joints} if name in RIG_NAMES else {each: each for each in names}
    )


@pytest.mark.parametrize("kind", SCALES)
def test_every_bone_begins_where_the_solve_has_its_joint(opened, cleaned, moments, kind):
    skeleton, places = cleaned.result.subject.skeleton, cleaned.result.joints[moments]
    bones = joints_of(kind, skeleton.names)
    for heads, frame in zip(opened[kind]["heads"], places, strict=True):
        assert set(heads) == set(bones)
        for bone, head in heads.items():
            x, y, z = frame[skeleton.index(bones[bone])]
            np.testing.assert_allclose(head, [x, -z, y], atol=CLOSE, err_msg=bone)  # Blender's Z is up, its -Y forward


@pytest.mark.parametrize("kind", [kind for kind in SCALES if kind.endswith("bvh")])
def test_the_scene_takes_the_take_s_rate(opened, cleaned, kind):
    assert opened[kind]["rate"] == pytest.approx(cleaned.result.before.rate, rel=1e-6)


@pytest.mark.parametrize("kind", SCALES)
def test_the_motion_lasts_as_long_as_the_take(opened, cleaned, kind):
    frames = cleaned.result.motion.frame_count + lead(kind)
    assert opened[kind]["last"] == pytest.approx((frames - 1) / cleaned.result.before.rate, abs=1e-4)


def test_another_rate_is_the_scene_s_and_the_motion_keeps_its_time(opened, cleaned, moments):
    skeleton, slow = cleaned.result.subject.skeleton, opened["slow"]
    assert slow["rate"] == pytest.approx(30, rel=1e-6)
    for t, heads in zip(moments, slow["heads"], strict=True):
        if t % 4 == 0:
            x, y, z = cleaned.result.joints[t, skeleton.index("LeftHand")]
            np.testing.assert_allclose(heads["LeftHand"], [x, -z, y], atol=CLOSE)


@pytest.mark.parametrize(("kind", "arm"), [("blender.bvh", OUT), ("motionbuilder.bvh", OUT), ("3dsmax.bvh", DOWN)])
def test_the_rest_pose_faces_forward_with_arms_as_the_program_wants_them(opened, kind, arm):
    rest = {joint: np.array(opened[kind]["rest"][bone]) for bone, joint in joints_of(kind, ()).items()}
    for side, mirror in (("Left", [1, 1, 1]), ("Right", [-1, 1, 1])):
        leg, reach = (rest[f"{side}{a}"] - rest[f"{side}{b}"] for a, b in (("Foot", "UpLeg"), ("Hand", "Arm")))
        toe = rest[f"{side}ToeBase"] - rest[f"{side}Foot"]
        np.testing.assert_allclose(leg / np.linalg.norm(leg), DOWN, atol=1e-4)
        np.testing.assert_allclose(reach / np.linalg.norm(reach), np.multiply(arm, mirror), atol=1e-4)
        assert toe[1] < -3 * abs(toe[0])  # forward, Blender's -Y


def test_of_gltf_blender_makes_an_armature_with_a_mesh_on_it(opened):
    assert opened["glb"]["meshes"] == 1
