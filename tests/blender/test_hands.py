"""Open hands in Blender: the bones of fingers point there where those of the solved hands do.

`make blender` installs Blender's Python module in .blender; without it these tests are skipped.
"""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from mocapfix.characters.character import build_cmu31_character, convert_motion
from mocapfix.characters.character_files import convert_hand_motion, write_character_bvh, write_character_glb
from mocapfix.characters.character_yaml import load_rig
from mocapfix.characters.fbx import BLENDER_VARIABLE, write_fbx
from mocapfix.characters.load_character import load_character
from mocapfix.characters.retarget_motion import retarget_motion
from mocapfix.hands.hand_model import RAYS
from mocapfix.hands.solve_hands import attach_hands
from mocapfix.io.bvh import write_bvh_tree
from mocapfix.io.gltf import write_gltf
from mocapfix.io.usd import write_usd
from mocapfix.output_formats import write_rig_bvh
from tests.hands.composed_hands import RATE_HZ
from tests.hands.test_attach_hands import compose_hands_on_body

PYTHON = Path(os.environ.get("BLENDER_PYTHON", Path(__file__).parents[2] / ".blender" / "bin" / "python"))
pytestmark = pytest.mark.skipif(not PYTHON.is_file(), reason="Blender's Python module is not installed (make blender)")
FRAMES = (0, 60, 130, 239)
MAX_ANGLE_DEG = 1.0
CHARACTERS = {  # the names of the bones from palm to tip, with {0} for the side, {1} for its letter and {2} for the finger
    "mixamo": [f"mixamorig:{{0}}Hand{{2}}{number}" for number in (1, 2, 3, 4)],
    "unreal": [f"{{2}}_0{number}_{{1}}" for number in (1, 2, 3)],
    "smplx": [f"{{0}}_{{2}}{number}" for number in (1, 2, 3)],
}
BODY_BONES = ["{0}{2}Proximal", "{0}{2}Intermediate", "{0}{2}Distal"]
NUMBERED_BONES = [f"{{0}}Hand{{2}}{number}" for number in (1, 2, 3)]
SUFFIXES = ("bvh", "glb", "fbx", "usdc")
FILES = {"blender.bvh": (BODY_BONES, 0), "motionbuilder.bvh": (NUMBERED_BONES, 1)} | {
    f"{name}.{suffix}": (bones, 0) for name, bones in {"body": BODY_BONES, **CHARACTERS}.items() for suffix in SUFFIXES
}
"""The bones of each file, and the frames before the motion."""


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    """The folder of the files, and the hands."""
    folder = tmp_path_factory.mktemp("hands")
    skeleton, motion, hands = compose_hands_on_body()
    tree = attach_hands(skeleton, motion, RATE_HZ, hands, RATE_HZ)
    write_bvh_tree(folder / "body.bvh", *tree, RATE_HZ)
    write_gltf(folder / "body.glb", *tree, RATE_HZ)
    for name in ("blender", "motionbuilder"):
        write_rig_bvh(folder / f"{name}.bvh", load_rig(name), skeleton, motion, RATE_HZ, hands, RATE_HZ)
    poses = {each.hand.model.side.lower(): convert_hand_motion(each, RATE_HZ, RATE_HZ) for each in hands}
    for name in CHARACTERS:
        character = load_character(name)
        moved = retarget_motion(build_cmu31_character(skeleton), convert_motion(motion, RATE_HZ), character, hands=poses)
        write_character_bvh(folder / f"{name}.bvh", character, moved)
        write_character_glb(folder / f"{name}.glb", character, moved, "take")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(BLENDER_VARIABLE, str(PYTHON))
        for name in ("body", *CHARACTERS):
            assert write_fbx(folder / f"{name}.fbx", folder / f"{name}.glb", RATE_HZ) is None
            assert write_usd(folder / f"{name}.usdc", folder / f"{name}.glb", RATE_HZ) is None
    return folder, hands


@pytest.fixture(scope="module")
def opened(solved):
    """Blender's heads and tails of the bones in every file."""
    folder, _ = solved
    jobs = [
        {"path": str(folder / file), "scale": 1.0, "rate": RATE_HZ, "frames": [lead + frame for frame in FRAMES]}
        for file, (_, lead) in FILES.items()
    ]
    (folder / "jobs.json").write_text(json.dumps(jobs), encoding="utf-8")
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    command = [PYTHON, Path(__file__).with_name("inside_characters.py"), folder / "jobs.json", folder / "answers.json"]
    process = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr[-3000:]
    return dict(zip(FILES, json.loads((folder / "answers.json").read_text(encoding="utf-8")), strict=True))


def name_bones(file, side, ray):
    """Return the names of the bones of a finger."""
    bones = FILES[file][0]
    if bones is BODY_BONES:
        ray = ray.replace("Pinky", "Little")
        bones = ["{0}ThumbMetacarpal", "{0}ThumbProximal", "{0}ThumbDistal"] if ray == "Thumb" else bones
    if file.endswith(".usdc"):  # names of USD have no colon
        bones = [each.replace(":", "_") for each in bones]
    is_lower = bones[0][0] == "{" and "_" in bones[0]
    return [each.format(side.lower() if is_lower else side, side[0].lower(), ray.lower() if is_lower else ray) for each in bones]


@pytest.mark.parametrize("file", FILES)
def test_bones_of_fingers_point_in_blender_as_the_solved_ones(solved, opened, file):
    for hand in solved[1]:
        for ray, name in enumerate(RAYS):
            bones = name_bones(file, hand.hand.model.side, name)
            joints, tip = hand.point_positions[:, 3 * ray : 3 * ray + 3], hand.tip_positions[:, [ray]]
            points = np.concatenate([joints, tip], axis=1)[list(FRAMES)]
            heads = np.array([[each[bone] for bone in bones] for each in opened[file]["heads"]])
            if file.endswith(".bvh") and len(bones) == 3:
                tails = [[each[bones[-1]]] for each in opened[file]["tails"]]  # in other formats Blender chooses the tails
                heads = np.concatenate([heads, tails], axis=1)
            found = np.diff(heads, axis=1)[..., [0, 2, 1]] * [1, 1, -1]  # Blender's Z is up
            wanted = np.diff(points[:, : heads.shape[1]], axis=1)
            cross, dot = np.linalg.norm(np.cross(found, wanted), axis=-1), (found * wanted).sum(-1)
            assert np.degrees(np.arctan2(cross, dot)).max() < MAX_ANGLE_DEG
