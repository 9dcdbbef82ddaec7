"""What the rest pose of a character shows about it: swapped sides, limbs that are posed, and whether its soles lie flat."""

import numpy as np
from jaxtyping import Float

from mocapfix.characters.character import SIDES, Character
from mocapfix.errors import SceneError
from mocapfix.model.skeleton import load_cmu31_skeleton
from mocapfix.stats.rigid_alignment import compute_shortest_rotation

MAX_BACKWARD_COSINE = -0.5
"""cosine of the horizontal angle between a foot and the front, below which it points backwards"""
MIN_HORIZONTAL_FOOT_SHARE = 0.3
"""horizontal length of a foot, as a share of its length, from which it points anywhere; on high heels it may not"""
MAX_REST_TILT_DEG = 40.0
"""angle of the trunk, the thighs and the shins from the vertical in T- and A-poses"""
MAX_REST_DIFFERENCE_DEG = 25.0
"""angle between a limb and the mirrored one of the other side in T- and A-poses"""
MIN_SPREAD_RAD, MAX_SPREAD_RAD = np.deg2rad(12.0), np.deg2rad(30.0)
"""of the shins from the vertical, in skeletons like those of CMU's recordings, whose legs are spread by 20 degrees"""
MAX_SPREAD_DIFFERENCE_RAD = np.deg2rad(3.0)
MAX_STRAIGHT_YAW_RAD = np.deg2rad(2.0)
"""angle between the front and a foot that points straight ahead"""
LIMB_SEGMENTS = (("upper_arm", "forearm"), ("forearm", "hand"), ("thigh", "shin"), ("shin", "foot"))
"""segments of limbs, and the segments at which they end"""


def check_sides(character: Character, name: str) -> None:
    """Raise SceneError, which begins with `name`, if left and right are swapped.

    The front follows from left and right. They are swapped if both feet point backwards, or if the arms give another front than
    the legs. Feet without toes point nowhere, and a rest pose that is not upright shows no front.
    """
    if _measure_trunk_tilt_deg(character) > MAX_REST_TILT_DEG:
        return
    position, _ = character.compute_rest_pose()
    bones = character.mapping.bones
    what_to_do = "exchange the bones of both sides in a mapping file (--character-map) or in their names"
    legs, arms = (position[bones[f"left_{each}"][0]] - position[bones[f"right_{each}"][0]] for each in ("thigh", "upper_arm"))
    if legs @ arms < 0:
        pairs = " and ".join(repr(character.names[bones[f"left_{each}"][0]]) for each in ("thigh", "upper_arm"))
        raise SceneError(f"{name}: {pairs}, both of the left, are on different sides of the body; {what_to_do}.")
    axes = _compute_body_axes(character)
    toes: list[str] = []
    for side in SIDES:
        if toe := bones.get(f"{side}_toe"):
            foot = axes.T @ (position[toe[0]] - position[bones[f"{side}_foot"][0]])
            length = float(np.hypot(foot[0], foot[2]))
            is_horizontal = length > MIN_HORIZONTAL_FOOT_SHARE * np.linalg.norm(foot)
            if is_horizontal and foot[2] < MAX_BACKWARD_COSINE * length:
                toes.append(repr(character.names[toe[0]]))
    if len(toes) == len(SIDES):
        problem = "point backwards, so the bones of left and right are swapped, or the feet are"
        raise SceneError(f"{name}: the toes {' and '.join(toes)} {problem}; {what_to_do}.")


def describe_posed_limbs(character: Character) -> str:
    """Return a sentence if the limbs of the rest pose are neither those of a T-pose nor of an A-pose, otherwise nothing.

    The rest pose is then one of an animation, as exporters may write it, and rotations relative to it are wrong.
    """
    axes, vectors = _compute_body_axes(character), _list_limb_vectors(character)
    tilted: list[tuple[float, str]] = []
    different: list[tuple[float, str]] = []
    if (tilt := _measure_trunk_tilt_deg(character)) > MAX_REST_TILT_DEG:
        tilted.append((tilt, f"trunk {tilt:.0f} degrees from the vertical"))
    for segment, _ in LIMB_SEGMENTS:
        pair = [axes.T @ vectors[f"{side}_{segment}"] for side in SIDES if f"{side}_{segment}" in vectors]
        if len(pair) < len(SIDES):
            continue
        label = segment.replace("_", " ")
        angle = _measure_angle_deg(pair[0], pair[1] * [-1, 1, 1])
        if angle > MAX_REST_DIFFERENCE_DEG:
            different.append((angle, f"{label}s differ by {angle:.0f} degrees"))
        for side, vector in zip(SIDES, pair, strict=True):
            angle = _measure_angle_deg(vector, np.array([0.0, -1.0, 0.0]))
            if segment in ("thigh", "shin") and angle > MAX_REST_TILT_DEG:
                tilted.append((angle, f"{side} {label} {angle:.0f} degrees from the vertical"))
    if not (found := tilted or different):
        return ""
    worst = max(found)[1]
    return f"Its bones are not in a T- or A-pose ({worst}), so its limbs may be turned wrongly: export it in its rest pose."


def are_soles_flat(character: Character) -> bool:
    """Return whether the soles lie flat in the rest pose of a character that is no YAML file, which has this itself.

    They do, except in skeletons like those of CMU's recordings: their legs are spread to the sides, and the feet are turned with
    the shins, straight ahead only when the shins are vertical. A mesh in a glTF stands on its soles; that of a solved skeleton,
    which shows its 31 joints, does not.
    """
    kind = character.source.kind if character.source else "yaml"
    is_bare = kind == "bvh" or (kind == "gltf" and set(load_cmu31_skeleton().names) <= set(character.names))
    bones = character.mapping.bones
    if not is_bare or not all(bones.get(f"{side}_toe") for side in SIDES):
        return True
    position, _ = character.compute_rest_pose()
    axes, vectors = _compute_body_axes(character), _list_limb_vectors(character)
    spreads: list[float] = []
    for side, outward in zip(SIDES, (1.0, -1.0), strict=True):
        shin = axes.T @ vectors[f"{side}_shin"]
        foot = axes.T @ (position[bones[f"{side}_toe"][0]] - position[bones[f"{side}_foot"][0]])
        turned = compute_shortest_rotation(shin, np.array([0.0, -1.0, 0.0])) @ foot
        yaw, turned_yaw = (float(np.arctan2(outward * each[0], each[2])) for each in (foot, turned))
        spreads.append(float(np.arctan2(outward * shin[0], -shin[1])))
        if not MIN_SPREAD_RAD < spreads[-1] < MAX_SPREAD_RAD or abs(turned_yaw) > min(MAX_STRAIGHT_YAW_RAD, abs(yaw)):
            return True
    return bool(np.ptp(spreads) > MAX_SPREAD_DIFFERENCE_RAD)


def _compute_body_axes(character: Character) -> Float[np.ndarray, "3 3"]:
    """Return the axes of the body in the world: to its left, up, and to its front, as left and right give them."""
    position, _ = character.compute_rest_pose()
    leftward = np.zeros(3)
    for segment in ("thigh", "upper_arm"):
        left, right = (position[character.mapping.bones[f"{side}_{segment}"][0]] for side in SIDES)
        leftward += (left - right) * [1.0, 0.0, 1.0]
    length = float(np.linalg.norm(leftward))
    x = leftward / length if length > 0 else np.array([1.0, 0.0, 0.0])
    return np.stack([x, [0.0, 1.0, 0.0], [-x[2], 0.0, x[0]]], axis=1)


def _measure_trunk_tilt_deg(character: Character) -> float:
    """Return the angle between the vertical and the direction from the hips to the shoulders."""
    position, _ = character.compute_rest_pose()
    hips, shoulders = (
        np.mean([position[character.mapping.bones[f"{side}_{segment}"][0]] for side in SIDES], axis=0)
        for segment in ("thigh", "upper_arm")
    )
    return _measure_angle_deg(shoulders - hips, np.array([0.0, 1.0, 0.0]))


def _list_limb_vectors(character: Character) -> dict[str, Float[np.ndarray, " 3"]]:
    """Return the vector along each segment of a limb in the world, of those that end at another segment."""
    position, _ = character.compute_rest_pose()
    bones = character.mapping.bones
    return {
        f"{side}_{segment}": position[bones[f"{side}_{end}"][0]] - position[bones[f"{side}_{segment}"][0]]
        for side in SIDES
        for segment, end in LIMB_SEGMENTS
        if bones.get(f"{side}_{end}")
    }


def _measure_angle_deg(one: Float[np.ndarray, " 3"], other: Float[np.ndarray, " 3"]) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other)))
