"""Animations whose zero pose is no T-pose: the figure in them moves, and a character after it, as the known one does."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.alignment import align_skeleton, pose_skeleton
from mocapfix.characters.body_frames import SegmentMotion, build_body_frame, compute_segment_motion
from mocapfix.characters.bone_mapping import map_joints
from mocapfix.characters.character import LIMB_ENDS, SIDES, build_cmu31_character, convert_motion
from mocapfix.characters.load_character import load_character
from mocapfix.characters.retarget_motion import retarget_motion
from mocapfix.io.bvh import read_bvh, write_bvh_tree
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton, compute_local_rotations
from mocapfix.options import ReadOptions
from mocapfix.synthetic import compose_take

RATE = 60.0
ELBOW_TURN_DEG = 30.0
"""of the elbows' axis in CMU's skeleton, about the arm, from the vertical of a T-pose; in the figures here it is vertical"""
TRUNK = {"pelvis": "Hips", "spine.0": "LowerBack", "spine.1": "Spine", "spine.2": "Spine1", "neck": "Neck", "head": "Head"}
SIDE = {
    "clavicle": "Shoulder", "upper_arm": "Arm", "forearm": "ForeArm", "hand": "FingerBase", "thigh": "UpLeg", "shin": "Leg",
    "foot": "Foot", "toe": "ToeBase",
}  # fmt: skip
SEGMENTS = TRUNK | {f"{side}_{each}": side.capitalize() + joint for side in SIDES for each, joint in SIDE.items()}
"""where each segment begins: a joint of the composed body"""
SIDE_PARENTS = {"clavicle": "spine.2", "upper_arm": "clavicle", "forearm": "upper_arm", "hand": "forearm"}
SIDE_PARENTS |= {"thigh": "pelvis", "shin": "thigh", "foot": "shin", "toe": "foot"}
PARENTS = {"spine.0": "pelvis", "spine.1": "spine.0", "spine.2": "spine.1", "neck": "spine.2", "head": "neck"} | {
    f"{side}_{each}": parent if parent in TRUNK else f"{side}_{parent}" for side in SIDES for each, parent in SIDE_PARENTS.items()
}
BONES = {f"{side}_{start}": f"{side}_{end}" for side in SIDES for start, end in (LIMB_ENDS | {"foot": "toe"}).items()}


def name_segments(trunk: str, side: str, pattern: str) -> dict[str, str]:
    """Return names by segment from those of TRUNK and SIDE; "-" if a skeleton has no such joint."""
    names = dict(zip(TRUNK, trunk.split(), strict=True))
    for each, spelled in (("left", ("Left", "L")), ("right", ("Right", "R"))):
        for segment, name in zip(SIDE, side.split(), strict=True):
            names[f"{each}_{segment}"] = pattern.format(side=spelled[0], letter=spelled[1], name=name)
    return {segment: name for segment, name in names.items() if name != "-"}


LAFAN1 = name_segments(
    "Hips Spine Spine1 Spine2 Neck Head", "Shoulder Arm ForeArm Hand UpLeg Leg Foot Toe", "{side}{name}"
)  # fmt: skip
SOMA = name_segments(
    "Hips Spine1 Spine2 Chest Neck1 Head", "Shoulder Arm ForeArm Hand Leg Shin Foot ToeBase", "{side}{name}"
)  # fmt: skip
BANDAI = name_segments(
    "Hips Spine - Chest Neck Head", "Shoulder UpperArm LowerArm Hand UpperLeg LowerLeg Foot Toes", "{name}_{letter}"
)  # fmt: skip
PHC = name_segments("Pelvis Torso Spine Chest Neck Head", "Thorax Shoulder Elbow Wrist Hip Knee Ankle Toe", "{letter}_{name}")


@dataclass(frozen=True)
class Figure:
    """A figure in a T-pose, facing +Z, and its motion over T frames."""

    places: dict[str, np.ndarray]  # (3,) m: where each segment begins in the T-pose
    rotations: dict[str, np.ndarray]  # (T, 3, 3) from the T-pose, in the world
    pelvis: np.ndarray  # (T, 3) m


@cache
def compose_figure() -> Figure:
    take = compose_take(seed=2, seconds=4.0, rate=RATE)
    skeleton = take.subject.skeleton
    rest = pose_skeleton(skeleton, "t-pose").rest_positions
    places = {segment: rest[skeleton.find_joint(joint)] for segment, joint in SEGMENTS.items()}
    places["spine.0"] = places["spine.0"] + [0.0, 0.07, 0.0]  # the composed body's is at the hips
    moved = compute_segment_motion(build_body_frame(build_cmu31_character(skeleton)), convert_motion(take.motion, RATE))
    rotations = {segment: moved.rotation[segment] for segment in SEGMENTS if segment in moved.rotation}
    rotations |= {f"spine.{k}": moved.chains["spine"][:, k + 1] for k in range(3)} | {"neck": moved.chains["neck"][:, 1]}
    turn = Rotation.from_euler("x", -ELBOW_TURN_DEG, degrees=True).as_matrix()
    rotations |= {
        f"{side}_{each}": rotations[f"{side}_{each}"] @ turn for side in SIDES for each in ("upper_arm", "forearm", "hand")
    }
    return Figure(places, rotations, take.motion.root_position)


def turn_along_bones(names: dict[str, str], *, is_mirrored: bool = False) -> dict[str, np.ndarray]:
    """Return axes of joints in the T-pose whose x is along the bone, on the right against it if they are mirrored."""
    places, axes = compose_figure().places, {}
    for segment in names:
        ends = [each for each in names if find_parent(each, names) == segment]
        end = {"pelvis": "spine.0", "spine.2": "neck"}.get(segment, ends[0] if ends else "")
        along = places[end] - places[segment] if end else places[segment] - places[find_parent(segment, names)]
        x = along / np.linalg.norm(along) * (-1 if is_mirrored and segment.startswith("right") else 1)
        y = np.array([0.0, 1.0, 0.0] if segment.endswith(("foot", "toe")) else [0.0, 0.0, 1.0])
        y = y - x * (x @ y)
        y /= np.linalg.norm(y)
        axes[segment] = np.stack([x, y, np.cross(x, y)], axis=1)
    return axes


def find_parent(segment: str, names: dict[str, str]) -> str:
    parent = PARENTS.get(segment, "")
    return parent if not parent or parent in names else find_parent(parent, names)


def write_source(
    target: Path, names: dict[str, str], axes: dict[str, np.ndarray] | None, order: str = "ZYX", root: str = ""
) -> None:
    """Write the motion of the figure with the names of a program.

    Args:
        axes: Those of the joints in the T-pose by segment, which are parallel to each other where all angles are zero.
        order: Of the rotations.
        root: Name of a joint at the origin above the hips.
    """
    figure, segments = compose_figure(), list(names)
    axes = axes or dict.fromkeys(names, np.eye(3))
    above = [find_parent(segment, names) for segment in segments]
    parents = np.array([segments.index(each) if each else -1 for each in above])
    vectors = [figure.places[a] - figure.places[b] if b else np.zeros(3) for a, b in zip(segments, above, strict=True)]
    offsets = np.array([axes[b].T @ each if b else each for each, b in zip(vectors, above, strict=True)])
    ends = np.array([axes[a].T @ each / 2 for a, each in zip(segments, vectors, strict=True)])
    ends[np.isin(np.arange(len(segments)), parents)] = np.nan
    world, positions = np.stack([figure.rotations[segment] @ axes[segment] for segment in segments], axis=1), [figure.pelvis]
    if root:
        parents, positions = np.concatenate([[-1], parents + 1]), [np.zeros_like(figure.pelvis), figure.pelvis]
        offsets, ends = np.concatenate([np.zeros((1, 3)), offsets]), np.concatenate([np.full((1, 3), np.nan), ends])
        world = np.concatenate([np.tile(np.eye(3), (len(world), 1, 1, 1)), world], axis=1)
    tree = Skeleton(tuple([root] * bool(root) + [names[segment] for segment in segments]), parents, offsets, ends)
    local = np.ascontiguousarray(compute_local_rotations(world, parents))
    write_bvh_tree(target, tree, dict(enumerate(positions)), local, RATE, 0.01, order)


def measure_directions_deg(found: SegmentMotion) -> dict[str, float]:
    """Return by segment how far limbs and feet are at most from pointing where those of the figure do."""
    errors: dict[str, float] = {}
    for start, end in BONES.items():
        bone = compose_figure().places[end] - compose_figure().places[start]
        true, line = compose_figure().rotations[start] @ bone, found.position[end] - found.position[start]
        angles = np.arctan2(np.linalg.norm(np.cross(line, true), axis=1), (line * true).sum(1))
        errors[start] = float(np.degrees(angles.max()))
    return errors


def measure_rotations_deg(found: SegmentMotion) -> dict[str, float]:
    """Return by segment how far its rotation is at most from that of the figure."""
    pairs = {each: (found.rotation[each], true) for each, true in compose_figure().rotations.items() if each in found.rotation}
    turns = {each: Rotation.from_matrix(one) * Rotation.from_matrix(true).inv() for each, (one, true) in pairs.items()}
    return {segment: float(np.degrees(turn.magnitude().max())) for segment, turn in turns.items()}


def solve_source(path: Path) -> tuple[Skeleton, Motion, int]:
    """Return the motion of the 31-joint skeleton in a file, and the frame of which the alignment follows."""
    animation = read_bvh(path, options=ReadOptions(unit="cm", up_axis="Y"))
    mapping = map_joints(animation.names, animation.parents)
    assert mapping.file_joints is not None
    alignment = align_skeleton(animation, mapping.file_joints)
    assert alignment is not None
    root, local = alignment.convert_poses(*animation.compute_world_poses())
    none = np.zeros(len(root), int)
    motion = Motion(root, local, none, none, np.zeros((len(root), 0)), np.zeros((len(root), 0)))
    return alignment.body, motion, alignment.upright_frame


OWN_AXES = {segment: Rotation.random(rng=np.random.default_rng(k)).as_matrix() for k, segment in enumerate(SEGMENTS)}
SOURCES = {
    "lafan1": (LAFAN1, turn_along_bones, "ZYX", ""),
    "soma": (SOMA, lambda _: OWN_AXES, "ZYX", "Root"),
    "soma in a t-pose": (SOMA, lambda _: None, "ZYX", "Root"),
    "bandai": (BANDAI, lambda names: turn_along_bones(names, is_mirrored=True), "ZXY", "joint_Root"),
    "phc": (PHC, lambda _: None, "XYZ", ""),
}


@pytest.mark.parametrize("source", SOURCES)
def test_limbs_of_the_body_and_of_a_character_are_those_of_the_source(tmp_path, source):
    names, build_axes, order, root = SOURCES[source]
    write_source(tmp_path / "source.bvh", names, build_axes(names), order, root)
    write_source(tmp_path / "hero.bvh", LAFAN1, None)
    skeleton, motion, frame = solve_source(tmp_path / "source.bvh")
    character = build_cmu31_character(skeleton)
    found = compute_segment_motion(build_body_frame(character), convert_motion(motion, RATE))
    assert max(measure_directions_deg(found).values()) < 0.01
    errors = measure_rotations_deg(found)
    limbs = [segment for segment in errors if "_" in segment and "clavicle" not in segment]
    assert max(errors[segment] for segment in limbs) < 1.0
    assert (frame >= 0) == (build_axes(names) is not None)
    if frame < 0:  # the zero pose shows how the trunk is turned
        assert max(errors.values()) < 0.01
    hero = load_character(tmp_path / "hero.bvh")
    moved = retarget_motion(character, convert_motion(motion, RATE), hero)
    assert max(measure_directions_deg(compute_segment_motion(build_body_frame(hero), moved)).values()) < 1.0
