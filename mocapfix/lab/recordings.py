"""Recordings to train on: folders of BVH and AMC files, CMU shards, and AMASS.

A shard holds `euler` int16 (frames, 31, 3) of all its trials, in the order ZYX, where 32767 is 180 degrees; skeletons.json is in
the same folder. manifest.csv has one row per trial, whose columns `quality`, `source` and `licence` say where the motion comes
from, and whether it was transferred from another skeleton; without a licence it is CMU's. Shards whose name contains approx are
not read: their motion is 2 cm off.

AMASS: `poses` (T, 3 x joints) holds rotation vectors, Z up, and `mocap_framerate` the rate in Hz. In SMPL's rest pose all joints
have the axes of the world. Arms and legs point in slightly different directions than in the CMU skeleton, by which the rotations
are corrected. Hip stubs, upper neck, fingers, thumbs and toes have no counterpart and keep their rest rotation.

In CMU's skeleton the clavicles do not move. Where they do in another source, the arm is given their rotation as well, so that it
has the same direction in the world; the shoulder moves by about 2 cm.
"""

import csv
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.characters.alignment import align_skeleton
from mocapfix.characters.bone_mapping import map_joints
from mocapfix.errors import ReadError
from mocapfix.io.asf_amc import read_amc
from mocapfix.io.bvh import read_bvh
from mocapfix.model.animation import Animation
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.stats.rigid_alignment import compute_shortest_rotation

TRAINING_RATE_HZ = 30.0  # poses at a higher rate hold hardly more information
SHARD_LENGTH_UNIT_M = 0.056444  # the unit of root positions in CMU's BVH files and in shards: 1 / 0.45 inch


@dataclass(frozen=True)
class RecordingSource:
    """Where a recording comes from."""

    name: str = ""  # the database or repository; empty if it is unknown
    licence: str = ""  # as the source states it
    # whether the motion was transferred from another skeleton, so that its joints have other zero positions
    is_retargeted: bool = False


UNKNOWN_SOURCE = RecordingSource()
CMU_SOURCE = RecordingSource("CMU motion capture database", "free for research and commercial use")


@dataclass(frozen=True)
class Recording:
    """A trial of a subject."""

    name: str
    subject: str
    # (T, 31, 3, 3) local joint rotations, Y up; in the T-pose that faces +Z the axes of each joint are those of the world
    rotations: np.ndarray
    rate_hz: float
    root_position: np.ndarray  # (T, 3) of the root in metres, in the world
    source: RecordingSource = UNKNOWN_SOURCE  # where the recording comes from, as far as it is known
    bones: np.ndarray | None = None  # (31, 3) metres: the offsets of the subject's joints, where they are known


def compute_frame_step(rate_hz: float) -> int:
    """Return the number of frames per frame kept, for a rate close to TRAINING_RATE_HZ."""
    return max(1, round(rate_hz / TRAINING_RATE_HZ))


def infer_subject(path: Path) -> str:
    """Return the subject of a file by CMU's naming, 01 of 01_02.bvh; otherwise the name of its folder."""
    subject, underscore, _ = path.stem.partition("_")
    return subject if underscore else path.parent.name


def read_manifest_sources(folder: Path) -> dict[str, RecordingSource]:
    """Return the sources of a folder's trials by manifest.csv, none without one. Raises ReadError if its columns are missing."""
    path = folder / "manifest.csv"
    if not path.is_file():
        return {}
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return {row["trial"]: _build_source(row) for row in csv.DictReader(file)}
    except (OSError, ValueError, KeyError) as error:
        raise ReadError(f"{path}: is not a table of trials with the columns trial, quality and source ({error}).") from error


def _build_source(row: dict[str, str]) -> RecordingSource:
    licence, is_retargeted = row.get("licence", ""), row["quality"] != "exact"
    if not is_retargeted and (not licence or licence.startswith("CMU")):
        return CMU_SOURCE
    return RecordingSource(row["source"].partition("@")[0], licence, is_retargeted)


def read_shard_recordings(path: Path) -> Iterator[Recording]:
    """Yield the trials of a shard, and nothing if the file is not a shard. Raises ReadError if a shard is invalid."""
    try:
        with np.load(path) as shard:
            if "euler" not in shard or "approx" in path.name:
                return
            euler, root, trials, starts = shard["euler"], shard["root"], shard["trial"], shard["start"]
        skeletons = json.loads((path.parent / "skeletons.json").read_text(encoding="utf-8"))
        joints = tuple(skeletons["joints"])
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise ReadError(f"{path}: is not a shard of motion with its skeletons.json in the same folder ({error}).") from error
    if joints != load_cmu31_body().skeleton.names or euler.shape[1:] != (len(joints), 3) or root.shape != (len(euler), 3):
        raise ReadError(f"{path}: its joints are not the 31 of the CMU skeleton, in their order, with a root position a frame.")
    sources = read_manifest_sources(path.parent)
    for name, angles, position in zip(trials, np.split(euler, starts[1:]), np.split(root, starts[1:]), strict=True):
        rotations = Rotation.from_euler("ZYX", angles.reshape(-1, 3) / 32767 * 180, degrees=True).as_matrix()
        subject, root_position = str(name).split("_")[0], SHARD_LENGTH_UNIT_M * position.astype(float)
        local, source = rotations.reshape(*angles.shape, 3), sources.get(str(name), UNKNOWN_SOURCE)
        person = skeletons.get("skeletons", {}).get(subject, {})
        offsets = person.get("offsets_asf") or person.get("offsets")
        bones = SHARD_LENGTH_UNIT_M * np.array(offsets) if offsets else None
        yield Recording(str(name), subject, local, TRAINING_RATE_HZ, root_position, source, bones)


SMPL_SIDE_JOINTS = {
    "hip": "UpLeg",
    "knee": "Leg",
    "ankle": "Foot",
    "foot": "ToeBase",
    "collar": "Shoulder",
    "shoulder": "Arm",
    "elbow": "ForeArm",
    "wrist": "Hand",
}
SMPL_JOINT_NAMES = (
    *("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle", "spine3"),
    *("left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder", "right_shoulder"),
    *("left_elbow", "right_elbow", "left_wrist", "right_wrist"),
)
CMU31_NAME_OF_SMPL_JOINT = {
    "pelvis": "Hips",
    "spine1": "LowerBack",
    "spine2": "Spine",
    "spine3": "Spine1",
    "neck": "Neck",
    "head": "Head",
} | {f"{side.lower()}_{key}": side + name for side in ("Left", "Right") for key, name in SMPL_SIDE_JOINTS.items()}
# Direction of the bone beyond a joint in SMPL's rest pose, on the left side: measured on the mean body, to about a degree.
SMPL_REST_DIRECTIONS = {
    "UpLeg": (0.09, -0.99, -0.01),
    "Leg": (-0.03, -0.99, -0.11),
    "Foot": (0.19, -0.42, 0.89),
    "Arm": (0.99, -0.05, -0.10),
    "ForeArm": (1.0, 0.03, 0.0),
}


def read_amass_recordings(path: Path) -> Iterator[Recording]:
    """Yield the motion of an AMASS file, and nothing if the file has no poses (a shard, or the shape of a subject).

    Raises:
        ReadError: If the file is invalid.
    """
    try:
        with np.load(path) as file:
            if "poses" not in file:
                return
            poses = np.asarray(file["poses"], float)
            translation = np.asarray(file["trans"], float)
            rate_hz = float(file["mocap_framerate" if "mocap_framerate" in file else "mocap_frame_rate"])
        step = compute_frame_step(rate_hz)
        poses = poses[::step, : 3 * len(SMPL_JOINT_NAMES)].reshape(-1, len(SMPL_JOINT_NAMES), 3)
        root_position = translation[::step, [1, 2, 0]]  # from Z up to Y up: (x, y, z) -> (y, z, x)
        if root_position.shape != (len(poses), 3):
            raise ValueError("trans does not have one position a frame")
    except (OSError, ValueError, KeyError, IndexError, BadZipFile) as error:
        raise ReadError(f"{path}: is not an AMASS file with poses of 22 joints, trans and mocap_framerate ({error}).") from error
    local = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(*poses.shape, 3)
    local[:, 0] = local[:, 0][:, [1, 2, 0]]
    yield Recording(path.stem, path.parent.name, map_smpl_rotations(local), rate_hz / step, root_position)


def map_smpl_rotations(local: Float[np.ndarray, "T 22 3 3"]) -> Float[np.ndarray, "T 31 3 3"]:
    """Return the local rotations of the CMU joints, given those of the SMPL joints.

    Let A be the rotation of a CMU joint that points its bone in SMPL's rest direction. In the world, the CMU joint has SMPL's
    rotation times A; its local rotation is therefore A_parent^-1 R A.
    """
    skeleton = load_cmu31_body().skeleton
    rotations, rest = np.tile(np.eye(3), (len(local), len(skeleton.names), 1, 1)), compute_smpl_rest_rotations(skeleton)
    for i, name in enumerate(SMPL_JOINT_NAMES):
        rotations[:, skeleton.find_joint(CMU31_NAME_OF_SMPL_JOINT[name])] = local[:, i]
    parents = np.maximum(skeleton.parents, 0)
    return np.swapaxes(rest[parents], 1, 2) @ rotations @ rest


def compute_smpl_rest_rotations(skeleton: Skeleton) -> Float[np.ndarray, "J 3 3"]:
    """Return the world rotation of each joint in SMPL's rest pose; joints without a bone of their own rotate with their
    parent.
    """
    rotations = np.tile(np.eye(3), (len(skeleton.names), 1, 1))
    for j, name in enumerate(skeleton.names):
        side = next((side for side in ("Left", "Right") if name.startswith(side)), "")
        if (bone := name.removeprefix(side)) in SMPL_REST_DIRECTIONS:
            child = int(np.flatnonzero(skeleton.parents == j)[0])
            direction = np.array(SMPL_REST_DIRECTIONS[bone]) * [1.0 if side == "Left" else -1.0, 1.0, 1.0]
            rotations[j] = compute_shortest_rotation(skeleton.offsets[child], direction)
        elif name.endswith(("Hand", "FingerBase", "HandIndex1", "Thumb", "ToeBase")):
            rotations[j] = rotations[skeleton.parents[j]]
    return rotations


def read_recordings(folders: Sequence[Path]) -> Iterator[Recording]:
    """Yield all motion in folders and their subfolders, always in the same order, with clavicles that do not move.

    Raises:
        ReadError: If a folder holds no motion, or if a file is invalid.
    """
    for folder in folders:
        is_empty = True
        for pattern, read in RECORDING_READERS:
            for path in sorted(Path(folder).rglob(pattern)):
                for recording in read(path):
                    is_empty = False
                    yield replace(recording, rotations=fold_clavicles(recording.rotations))
        if is_empty:
            raise ReadError(f"{folder}: holds no motion; give a folder of BVH, ASF/AMC, AMASS npz, or shards of CMU motion.")


def fold_clavicles(rotations: Float[np.ndarray, "T 31 3 3"]) -> Float[np.ndarray, "T 31 3 3"]:
    """Return local rotations whose clavicles do not move, the arms having the same rotation in the world as before."""
    skeleton, folded = load_cmu31_body().skeleton, rotations.copy()
    for side in ("Left", "Right"):
        clavicle, arm = skeleton.find_joint(f"{side}Shoulder"), skeleton.find_joint(f"{side}Arm")
        folded[:, arm] = rotations[:, clavicle] @ rotations[:, arm]
        folded[:, clavicle] = np.eye(3)
    return folded


def read_bvh_recording(path: Path) -> Iterator[Recording]:
    """Yield the motion of a BVH. Raises ReadError if it is invalid or does not animate a whole body."""
    yield _read_recording(path, read_bvh)


def read_amc_recording(path: Path) -> Iterator[Recording]:
    """Yield the motion of an AMC. Raises ReadError if it is invalid, has no ASF, or does not animate a whole body."""
    yield _read_recording(path, read_amc)


def _read_recording(path: Path, read: Callable[[Path], Animation]) -> Recording:
    animation = read(path)
    result = map_joints(animation.names, animation.parents)
    if result.file_joints is None:
        raise ReadError(f"{path}: {result.reason}")
    alignment = align_skeleton(animation, result.file_joints)
    if alignment is None:
        raise ReadError(f"{path}: the figure never stands upright, so the axes of its joints cannot be determined.")
    step = compute_frame_step(animation.rate)
    kept = animation.replace_values(animation.values[int(animation.has_reference_pose) :: step])
    root, rotations = alignment.convert_poses(*kept.compute_world_poses())
    is_complete = ~np.isnan(rotations).any((1, 2, 3)) & ~np.isnan(root).any(1)
    return Recording(path.stem, infer_subject(path), rotations[is_complete], animation.rate / step, root[is_complete])


RECORDING_READERS: tuple[tuple[str, Callable[[Path], Iterator[Recording]]], ...] = (
    ("*.npz", read_shard_recordings),
    ("*.npz", read_amass_recordings),
    ("*.bvh", read_bvh_recording),
    ("*.amc", read_amc_recording),
)
