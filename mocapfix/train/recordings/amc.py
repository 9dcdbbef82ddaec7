"""ASF/AMC, the form in which CMU publishes its motion.

A bone of the ASF has axes of its own, turned by C from the world's in the rest pose; its turn M in the AMC is about those.
In the world's axes, which all the joints of the 31-joint skeleton have in the rest pose, that is C M C^-1. The rest pose is
the same: Hahne's release keeps each bone's direction.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.skeleton import cmu31
from mocapfix.train.recordings.recording import Recording, lines, step, subject

SIDE = {"hipjoint": "HipJoint", "femur": "UpLeg", "tibia": "Leg", "foot": "Foot", "toes": "ToeBase", "clavicle": "Shoulder"}
SIDE |= {"humerus": "Arm", "radius": "ForeArm", "wrist": "Hand", "hand": "FingerBase", "fingers": "HandIndex1", "thumb": "Thumb"}
BONES = {"root": "Hips", "lowerback": "LowerBack", "upperback": "Spine", "thorax": "Spine1"}
BONES |= {"lowerneck": "Neck", "upperneck": "Neck1", "head": "Head"}
for _letter, _side in (("l", "Left"), ("r", "Right")):
    for _bone, _joint in SIDE.items():  # the hips' stubs and the thumbs are LHipJoint and LThumb, the rest LeftArm
        BONES[_letter + _bone] = (_letter.upper() if _joint in ("HipJoint", "Thumb") else _side) + _joint
RATE = 120.0  # Hz: AMC does not say; CMU's are, but for some subjects at 60, of whom more poses are dropped than need be


def read(path: Path) -> Iterator[Recording]:
    """Yield the motion of an AMC. Raises ReadError where its subject's ASF is not beside it, or either is not as it should be."""
    try:
        skeleton = next(p for p in (path.parent / f"{subject(path)}.asf", *sorted(path.parent.glob("*.asf"))) if p.is_file())
        axes, freedoms = bones(lines(skeleton))
        frames = turns(lines(path))
        joints = cmu31().skeleton.names
        rotations = np.tile(np.eye(3), (len(frames), len(joints), 1, 1))[:: step(RATE)]
        for bone, name in BONES.items():
            if freedoms[bone]:
                kept = np.array([frame[bone] for frame in frames[:: step(RATE)]], float)
                rotations[:, joints.index(name)] = turned(axes[bone], freedoms[bone], kept)
    except StopIteration:
        raise ReadError(f"{path}: its skeleton, {subject(path)}.asf, is not beside it.") from None
    except (KeyError, ValueError, IndexError) as error:
        raise ReadError(f"{path}: it and {skeleton.name} do not describe the CMU skeleton ({error}).") from error
    yield Recording(path.stem, subject(path), rotations, RATE / step(RATE))


def turned(axis: list[float], freedoms: list[str], degrees: np.ndarray) -> np.ndarray:
    """-> (T, 3, 3) C M C^-1, of the numbers of a bone in every frame (T, D), M = Rz Ry Rx of those it is free in."""
    angles = np.zeros((len(degrees), 3))
    for column, freedom in enumerate(freedoms):
        if freedom[0] == "r":
            angles[:, "xyz".index(freedom[1])] = degrees[:, column]
    own = Rotation.from_euler("xyz", axis, degrees=True)
    return (own * Rotation.from_euler("xyz", angles, degrees=True) * own.inv()).as_matrix()


def bones(text: list[str]) -> tuple[dict[str, list[float]], dict[str, list[str]]]:
    """-> bone: its axes' turn from the world's, as angles about x, y, z; bone: what it is free in, as rx or tz."""
    axes, freedoms = {"root": [0.0, 0.0, 0.0]}, {bone: [] for bone in BONES}
    name = "root"
    for words in (line.lower().split() for line in text):
        match words:
            case ["name", bone]:
                name = bone
            case ["order", *order]:
                freedoms["root"] = order
            case ["axis", x, y, z, *_]:
                axes[name] = [float(x), float(y), float(z)]
            case ["dof", *free]:
                freedoms[name] = free
    return axes, freedoms


def turns(text: list[str]) -> list[dict[str, list[str]]]:
    """-> for every frame, bone: its numbers."""
    frames: list[dict[str, list[str]]] = []
    for line in text:
        words = line.split()
        if len(words) == 1 and words[0].isdigit():
            frames.append({})
        elif words and frames:
            frames[-1][words[0]] = words[1:]
    return frames
