"""Twist bones beside the chain of a limb: children that lie on its axis and carry a share of its twist."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from mocapfix.characters.character import SIDES, TWISTING_SEGMENTS

NEXT_SEGMENTS = {
    f"{side}_{name}": f"{side}_{following}"
    for side in SIDES
    for name, following in (("upper_arm", "forearm"), ("forearm", "hand"), ("thigh", "shin"), ("shin", "foot"))
}
"""the segment at the end of each segment that may have twist bones"""
MIN_TWIST_SHARE, MAX_TWIST_SHARE = 0.05, 0.98
"""positions along the segment between which a bone without a telling name is a twist bone; others are helpers of the joints"""
NAMED_TWIST_MARGIN = 0.1
"""share of the segment by which a bone named as a twist bone may lie outside it"""
MAX_AXIS_DISTANCE_SHARE = 0.1
"""distance of a twist bone from the axis, as a share of the segment's length"""
TWIST_WORDS = ("twist", "roll")
CORRECTIVE_WORDS = ("cor", "corrective", "drv")
"""ends of the names of bones that correct the skin at a twist bone"""


def find_side_twists(
    names: Sequence[str],
    parents: Int[np.ndarray, " J"],
    positions: Float[np.ndarray, "J 3"],
    bones: Mapping[str, tuple[int, ...]],
) -> dict[str, tuple[int, ...]]:
    """Find the twist bones beside the chains of the limbs.

    Args:
        names: Names of the bones; those with "twist" or "roll" may lie a little outside their segment.
        parents: (J,) index of each bone's parent.
        positions: (J, 3) m, world, in the rest pose.
        bones: Segment to the bones of its chain.

    Returns:
        Segment to its twist bones, from near to far; segments without any are missing.
    """
    used = {bone for chain in bones.values() for bone in chain}
    found: dict[str, tuple[int, ...]] = {}
    for segment in TWISTING_SEGMENTS:
        chain, following = bones.get(segment, ()), bones.get(NEXT_SEGMENTS[segment], ())
        if not chain or not following:
            continue
        start, axis = positions[chain[0]], positions[following[0]] - positions[chain[0]]
        length = float(np.linalg.norm(axis))
        shares: dict[int, float] = {}
        for bone in np.flatnonzero(np.isin(parents, chain)).tolist():
            if bone in used or length == 0.0:
                continue
            share = float((positions[bone] - start) @ axis) / length**2
            distance = float(np.linalg.norm(positions[bone] - start - share * axis))
            if distance <= MAX_AXIS_DISTANCE_SHARE * length and _is_twist(names[bone], share):
                shares[bone] = share
        if shares:
            found[segment] = tuple(sorted(shares, key=shares.__getitem__))
    return found


def _is_twist(name: str, share: float) -> bool:
    name = name.lower()
    if any(word in name for word in TWIST_WORDS):
        stem = name.removesuffix(")").rstrip("_.0123456789lr")
        is_corrective = any(stem.endswith(word) for word in CORRECTIVE_WORDS) or "twistcor" in name
        return not is_corrective and -NAMED_TWIST_MARGIN < share < 1 + NAMED_TWIST_MARGIN
    return MIN_TWIST_SHARE < share < MAX_TWIST_SHARE
