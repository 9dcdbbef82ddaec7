"""The rest pose of a character: the one of the poses in its file that is a T- or A-pose.

Retargeting keeps rotations relative to the rest pose, so in it the figure stands upright. A glTF has a bind pose, the transforms
of its nodes, which may be those of any frame of an animation, and the frames of its animations. A BVH has the pose with all
angles zero, which is no figure where the offsets lie along the bones, and its frames; often the first is a T-pose.

They are tried in this order. Where none is a T- or A-pose, the frame in which the figure stands best is taken: trunk and head are
turned as in the mean of all frames in which it stands, and the feet as where they are lowest, so that their soles lie flat.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import compute_facings
from mocapfix.characters.character import LIMB_ENDS, SIDES, Character, reparent_bones
from mocapfix.characters.kept_positions import MAX_SLOPE_DIFFERENCE_RAD, measure_slope
from mocapfix.characters.read_gltf import BonePoses, iterate_animations, read_bind_pose
from mocapfix.errors import SceneError
from mocapfix.io.bvh import read_bvh
from mocapfix.model.skeleton import compose_transforms, compute_local_rotations
from mocapfix.stats.rigid_alignment import compute_shortest_rotation

MAX_TILT_DEG = 40.0  # angle of the trunk, the thighs and the shins from the vertical of a figure that stands
MAX_ASYMMETRY_DEG = 25.0  # angle between a limb and the mirrored one of the other side in T- and A-poses
MAX_FRAME_TILT_DEG, MAX_FRAME_ASYMMETRY_DEG, MAX_FRAME_ARM_DEG = 25.0, 15.0, 30.0
"""the same in a frame of a file, where other poses are likely, and the bend of an elbow"""
MAX_ARM_SLOPE_DEG = 60.0  # angle between an upper arm and the horizontal in A-poses; a larger one counts as a bend
ARM_COST, STANDING_COST = 0.5, 1000.0
"""costs of a degree of an arm, over that of a leg, and of a frame in which the figure stands, but not in a T- or A-pose"""
LOWEST_FOOT_PERCENTILE, FLAT_FOOT_RANGE_M = 2.0, 0.01  # of the heights of a foot; so far above that it lies flat
SAME_OFFSET_M, SAME_ROTATION = 1e-3, 2e-3  # differences of two poses that count as the same: 1 mm and 0.1 degrees
UP = np.array([0.0, 1.0, 0.0])
TRUNK_SEGMENTS = ("pelvis", "spine", "neck", "head", *(f"{side}_clavicle" for side in SIDES))


class PoseAngles(NamedTuple):
    """How far T poses are from a T- or A-pose, in degrees."""

    tilt: Float[np.ndarray, " T"]  # the largest of trunk, thighs and shins from the vertical
    asymmetry: Float[np.ndarray, " T"]  # the largest of a limb from the mirrored one of the other side
    arm: Float[np.ndarray, " T"]  # the largest bend of an elbow
    cost: Float[np.ndarray, " T"]  # the sum of all


def measure_poses(positions: Float[np.ndarray, "T J 3"], bones: Mapping[str, tuple[int, ...]]) -> PoseAngles:
    """Measure how far poses are from a T- or A-pose, from the positions of the bones in the world, Y up."""
    heads = {segment: positions[:, chain[0]] for segment, chain in bones.items() if chain}
    facing, thighs, arms = compute_facings(positions, bones), heads["left_thigh"], heads["left_upper_arm"]
    trunk = arms + heads["right_upper_arm"] - thighs - heads["right_thigh"]
    vectors = {
        (side, segment): np.einsum("tba,tb->ta", facing, heads[f"{side}_{end}"] - heads[f"{side}_{segment}"])
        for side in SIDES
        for segment, end in LIMB_ENDS.items()
        if f"{side}_{end}" in heads
    }
    tilts = [_measure_angles_deg(trunk, UP)]
    tilts += [_measure_angles_deg(vectors[side, segment], -UP) for side in SIDES for segment in ("thigh", "shin")]
    asymmetries = [
        _measure_angles_deg(vector, vectors["right", segment] * [-1, 1, 1])
        for (side, segment), vector in vectors.items()
        if side == "left" and ("right", segment) in vectors
    ]
    slopes = [np.abs(90.0 - _measure_angles_deg(vectors[side, "upper_arm"], UP)) for side in SIDES]
    bends = [np.maximum(slope - MAX_ARM_SLOPE_DEG, 0.0) for slope in slopes]
    bends += [
        _measure_angles_deg(vectors[s, "upper_arm"], each) for (s, segment), each in vectors.items() if segment == "forearm"
    ]
    cost = np.sum(tilts + asymmetries, axis=0) + ARM_COST * np.sum(bends, axis=0)
    return PoseAngles(np.max(tilts, axis=0), np.max(asymmetries, axis=0), np.max(bends, axis=0), cost)


def _measure_angles_deg(one: Float[np.ndarray, "T 3"], other: Float[np.ndarray, "*T 3"]) -> Float[np.ndarray, " T"]:
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(one, other), axis=1), (one * other).sum(1)))


def choose_rest_pose(character: Character, assign: Callable[[Character], Character], rest_frame: int | None) -> Character:
    """Return a character in its rest pose, with the bones of the segments of its body.

    Args:
        character: As its file was read.
        assign: Gives a posed character its mapping; raises SceneError if the bones do not form a body in that pose.
        rest_frame: The frame of its file that is the rest pose, counted from 1; None to look for one.

    Raises:
        SceneError: If the bones do not form a body, or it stands in no pose of the file. The message names the file.
    """
    if rest_frame is not None:
        return _note_pose(assign(_take_frame(character, rest_frame)), f"frame {rest_frame} of its file")
    errors: list[SceneError] = []
    found: list[tuple[float, Character]] = []  # with their tilts
    bind = read_bind_pose(character)
    is_same = bind is None or (
        np.allclose(bind.offsets[0], character.skeleton.offsets, atol=SAME_OFFSET_M)
        and np.allclose(bind.rotations[0], character.skeleton.rest_rotations, atol=SAME_ROTATION)
    )
    poses = [] if bind is None or is_same else [(_pose(character, bind, 0), "the bind pose of its mesh")]
    for posed, name in (*poses, (character, "")):
        try:
            mapped = _note_pose(assign(posed), name)
        except SceneError as error:
            errors.append(error)
            continue
        angles = measure_poses(mapped.skeleton.rest_positions[None], mapped.mapping.bones)
        if angles.tilt[0] <= MAX_TILT_DEG and angles.asymmetry[0] <= MAX_ASYMMETRY_DEG:
            return mapped
        found.append((float(angles.tilt[0]), mapped))
    if not found:
        raise errors[0]
    framed = _find_standing_frame(character, found[0][1])
    standing = [each for tilt, each in [(0.0, framed), *found] if each is not None and tilt <= MAX_TILT_DEG]
    if standing:
        return standing[0]
    raise SceneError(
        f"{character.origin}: its trunk or a leg is {found[0][0]:.0f} degrees from the vertical in its rest pose, and it stands "
        "in no frame of its file; export it in a T- or A-pose."
    )


def _pose(character: Character, poses: BonePoses, frame: int) -> Character:
    skeleton = replace(character.skeleton, offsets=poses.offsets[frame], rest_rotations=poses.rotations[frame])
    return replace(character, skeleton=skeleton)


def _note_pose(character: Character, pose: str) -> Character:
    return replace(character, mapping=character.mapping.add_sentence(f"Its rest pose is {pose}.")) if pose else character


def _iterate_frames(character: Character) -> Iterator[BonePoses]:
    """Yield the frames of a character's file: of a BVH together, of a glTF those of one animation after the other."""
    source = character.source
    if source is not None and source.kind == "bvh":
        animation = read_bvh(Path(source.path), source.data)
        rotations, offsets = animation.compute_local_rotations(), animation.compute_local_positions()
        offsets[:, 0] -= animation.compute_world_poses()[0][:, animation.moving_joint] * [1, 0, 1]  # stands over the origin
        axes = animation.rotation_y_up_file
        rotations[:, 1:] = axes.T @ rotations[:, 1:] @ axes
        rotations[:, 0] = rotations[:, 0] @ axes
        offsets[:, 1:] = offsets[:, 1:] @ axes
        offsets[~np.isfinite(rotations).all((1, 2, 3))] = np.nan
        yield BonePoses(offsets, rotations)
    else:
        yield from iterate_animations(character)


def _take_frame(character: Character, rest_frame: int) -> Character:
    count, has = 0, ""
    for poses in _iterate_frames(character):
        if 1 <= rest_frame - count <= len(poses.offsets):
            posed = _pose(character, poses, rest_frame - count - 1)
            if np.isfinite(posed.skeleton.offsets).all():
                return posed
            has = "an incomplete frame there"
        count += len(poses.offsets)
    has = has or (f"frames 1 to {count}" if count else "no frames")
    problem = f"has {has}, so frame {rest_frame} cannot be its rest pose (--rest-frame); name another or none"
    raise SceneError(f"{character.origin}: {problem}.")


def _find_standing_frame(character: Character, mapped: Character) -> Character | None:
    """Return a character in the frame of its file that is the most like a T- or A-pose; None if it stands in no frame.

    Args:
        character: As its file was read.
        mapped: The same with the mapping in some pose, in which bones may have other parents.
    """
    place = [character.skeleton.names.index(name) for name in mapped.skeleton.names]
    mapping = mapped.mapping.renumber(place)
    character, bones = replace(character, mapping=mapping, has_feet_flat=mapped.has_feet_flat), mapping.bones
    carriers = {place[bone]: place[parent] for bone, parent in enumerate(mapped.skeleton.parents.tolist()) if parent >= 0}
    moved = {bone: carrier for bone, carrier in carriers.items() if character.skeleton.parents[bone] != carrier}
    best: tuple[float, Character, str] | None = None
    first = 1
    for poses in _iterate_frames(character):
        positions, rotations = compose_transforms(character.skeleton.parents, poses.offsets, poses.rotations)
        angles = measure_poses(np.nan_to_num(positions), bones)
        limits = zip(angles, (MAX_FRAME_TILT_DEG, MAX_FRAME_ASYMMETRY_DEG, MAX_FRAME_ARM_DEG), strict=False)
        is_standard = np.min([angle <= limit for angle, limit in limits], axis=0)
        is_whole = np.isfinite(poses.offsets).all(axis=(1, 2))
        is_standing = is_whole & (angles.tilt <= MAX_TILT_DEG)
        cost = np.where(is_standing, angles.cost + np.where(is_standard, 0.0, STANDING_COST), np.inf)
        frame = int(cost.argmin())
        if np.isfinite(cost[frame]) and (best is None or cost[frame] < best[0]):
            posed = _pose(character, poses, frame)
            if not is_standard[frame]:
                posed = _straighten(posed, BonePoses(positions[is_whole], rotations[is_whole]), is_standing[is_whole])
            best = float(cost[frame]), posed, f"frame {first + frame} of its file"
        first += len(cost)
    return None if best is None else _note_pose(reparent_bones(best[1], moved), best[2])


def _straighten(posed: Character, world: BonePoses, is_standing: Bool[np.ndarray, " T"]) -> Character:
    """Return a character that stands as in the poses of its file, which are given in the world.

    Trunk and head are turned as in the mean of the poses in which it stands, the feet as where they are lowest; on that height
    they stand. A foot that slopes more than the other one is on its toes in all poses, and is turned like that one.
    """
    bones, skeleton = posed.mapping.bones, posed.skeleton
    place, axes = skeleton.compute_rest_pose()
    standing = BonePoses(world.offsets[is_standing], world.rotations[is_standing])
    facing = compute_facings(place[None], bones)[0] @ compute_facings(standing.offsets, bones).swapaxes(1, 2)
    straight, lowest = axes.copy(), dict[int, float]()
    for segment in TRUNK_SEGMENTS:
        for bone in bones.get(segment, ()):
            straight[bone] = Rotation.from_matrix(facing @ standing.rotations[:, bone]).mean().as_matrix()
    slopes, lines = dict.fromkeys(SIDES, -np.inf), dict[str, Float[np.ndarray, " 3"]]()
    for side in SIDES:
        foot = [bones[f"{side}_{segment}"][0] for segment in ("foot", "toe") if bones.get(f"{side}_{segment}")]
        height = world.offsets[:, foot, 1].max(1)
        is_flat = height <= np.percentile(height, LOWEST_FOOT_PERCENTILE) + FLAT_FOOT_RANGE_M
        lowest[foot[-1]] = float(np.median(world.offsets[is_flat, foot[-1], 1]))
        for bone in foot:
            upward = np.median(world.rotations[is_flat, bone, 1], axis=0)
            straight[bone] = compute_shortest_rotation(axes[bone] @ upward, UP) @ axes[bone]
        if len(foot) > 1:
            lines[side] = straight[foot[0]] @ axes[foot[0]].T @ (place[foot[1]] - place[foot[0]])
            slopes[side] = measure_slope(UP, lines[side])
    flatter, steeper = sorted(SIDES, key=slopes.__getitem__, reverse=True)
    if len(lines) > 1 and slopes[flatter] - slopes[steeper] > MAX_SLOPE_DIFFERENCE_RAD:
        foot, along = bones[f"{steeper}_foot"][0], lines[steeper] * [1, 0, 1]
        sloping = along / np.linalg.norm(along) + np.tan(slopes[flatter]) * UP
        straight[foot] = compute_shortest_rotation(lines[steeper], sloping) @ straight[foot]
    turned = replace(skeleton, rest_rotations=compute_local_rotations(straight, skeleton.parents))
    drop = np.mean(turned.rest_positions[list(lowest), 1]) - min(lowest.values())
    offsets = turned.offsets - drop * UP * (skeleton.parents < 0)[:, None]
    return replace(posed, skeleton=replace(turned, offsets=offsets))
