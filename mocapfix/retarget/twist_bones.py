"""The shares of a limb's twist that its bones take, so that the skin does not wring at one joint.

An upper arm or thigh twists relative to the bone before it: near that bone its parts take little of the twist, at the far end
all. A forearm or shin twists with the hand or foot: near the elbow or knee its parts take none of the hand's twist, near the
wrist most.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.characters.character import SIDES
from mocapfix.retarget.body_frames import LIMB_DIRECTIONS, OUTER_BONE_SEGMENTS, BodyFrame

LEG_AXIS = np.array([0.0, 1.0, 0.0])
NEIGHBOUR_SEGMENTS = {"upper_arm": "clavicle", "thigh": "pelvis", "forearm": "hand", "shin": "foot"}
"""The segment relative to which each limb segment twists."""
LIMB_ENDS = {"upper_arm": "forearm", "forearm": "hand", "thigh": "shin", "shin": "foot"}


def compute_twisted_bones(
    frame: BodyFrame, rotation: dict[str, Float[np.ndarray, "T 3 3"]]
) -> dict[int, Float[np.ndarray, "T 3 3"]]:
    """Return the world rotations (T, 3, 3) of the bones that share a twist, by bone.

    rotation  segment to S (T, 3, 3)
    """
    mapping = frame.character.mapping
    twisted: dict[int, Float[np.ndarray, "T 3 3"]] = {}
    for side in SIDES:
        for segment, neighbour in NEIGHBOUR_SEGMENTS.items():
            name, other = f"{side}_{segment}", neighbour if neighbour == "pelvis" else f"{side}_{neighbour}"
            chain, beside = mapping.bones.get(name, ()), mapping.twists.get(name, ())
            if len(chain) + len(beside) < 2 or other not in rotation:
                continue
            axis = LIMB_DIRECTIONS[side] if segment in ("upper_arm", "forearm") else LEG_AXIS
            is_outer = segment in OUTER_BONE_SEGMENTS
            relative = np.swapaxes(rotation[name], 1, 2) @ rotation[other]  # in the segment's axes
            angle = compute_twist_angle(relative, axis)
            shares = {bone: k / (len(chain) - 1) for k, bone in enumerate(chain)} if len(chain) > 1 else {}
            shares |= {bone: _find_share_along(frame, bone, name, f"{side}_{LIMB_ENDS[segment]}") for bone in beside}
            for bone, share in shares.items():
                turn = (1.0 - share) * angle if is_outer else share * angle
                twisted[bone] = (
                    rotation[name] @ Rotation.from_rotvec(turn[:, None] * axis).as_matrix() @ frame.standard_rotations[bone]
                )
    return twisted


def compute_twist_angle(rotation: Float[np.ndarray, "T 3 3"], axis: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " T"]:
    """Return the angle in radians of the part of rotations that turns about an axis (swing-twist), without jumps by a turn.

    The median over the frames is within half a turn, so that a limb is not twisted the long way round for a whole take.
    """
    quaternion = Rotation.from_matrix(rotation).as_quat(canonical=True)  # the scalar part is not negative
    angle = np.unwrap(2.0 * np.arctan2(quaternion[:, :3] @ axis, quaternion[:, 3]))
    return angle - 2 * np.pi * np.round(np.median(angle) / (2 * np.pi)) if len(angle) else angle


def _find_share_along(frame: BodyFrame, bone: int, start: str, end: str) -> float:
    """Return how far along a segment a bone begins, from 0 to 1."""
    if end not in frame.segment_bones:
        return 0.5
    vector = frame.find_head(end) - frame.find_head(start)
    return float(np.clip((frame.rest_position[bone] - frame.find_head(start)) @ vector / (vector @ vector), 0.0, 1.0))
