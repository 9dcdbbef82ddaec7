"""A file's body as one of the 31 joints, and poses of the 31 back into the file's joints.

The two rest poses differ: a file's arms may hang, its legs stand straight. In a pose in which the file's figure stands, ours
is put likewise: hips, trunk and head turned to where it faces, each limb's bone laid along its own. There a joint of ours
stands to its counterpart by a rotation A, and as both move with the same part of the body it does always:
W = V A, for the world rotation W of ours and V of the file's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.animation import Animation, carried
from mocapfix.hierarchies import Mapped, ancestor
from mocapfix.skeleton import Skeleton, cmu31

SIDES = ("Left", "Right")
# bone of ours: the next joint, towards which it points
BONES = {side + a: side + b for side in SIDES for a, b in (("UpLeg", "Leg"), ("Leg", "Foot"), ("Foot", "ToeBase"))}
BONES |= {side + a: side + b for side in SIDES for a, b in (("Arm", "ForeArm"), ("ForeArm", "Hand"))}
WITH_PARENT = ("Hand", "FingerBase", "HandIndex1", "Thumb", "ToeBase")  # turned as what they hang on
SHARING = ("LowerBack", "Spine", "Spine1", "Neck", "Neck1", "Head")  # of a bend between two known ones each takes its part
UPRIGHT = 0.5  # cosine: a figure stands where trunk, thighs and shins are within 60 degrees of upright
SOME = 200  # frames that tell lengths and how it stands


@dataclass(frozen=True)
class Fitted:
    """How the 31 joints lie in a file's body.

    joints    (31,) the file's joint for each of ours, -1 where there is none
    turns     (31, 3, 3) A: the axes of ours in the file's joint
    skeleton  the 31 joints with the file's lengths, in metres: it lies on the file's joints wherever these are rigid
    """

    joints: np.ndarray
    turns: np.ndarray
    skeleton: Skeleton


def fitted(animation: Animation, mapped: Mapped) -> Fitted | None:
    """-> how the 31 joints lie in the animation's body; None where the figure stands neither in the rest pose nor ever."""
    few = animation.with_values(animation.values[:: max(1, animation.frames // SOME)])
    positions, rotations = few.world()
    rest = animation.resting()[None], np.tile(np.eye(3), (1, len(animation.names), 1, 1))
    for places, turned in (rest, (positions, rotations)):
        straight = _straight(places, mapped.joints)
        best = int(np.nanargmax(np.append(straight, -1.0)))
        if best < len(straight) and straight[best] > UPRIGHT:
            turns = _turns(animation, places[best], turned[best], mapped.joints)
            return Fitted(mapped.joints, turns, _skeleton(animation, positions, rotations, mapped.joints, turns))
    return None


def to_cmu31(animation: Animation, fit: Fitted) -> tuple[np.ndarray, np.ndarray]:
    """-> root (T, 3) in metres and local rotations (T, 31, 3, 3) of `fit.skeleton`, in its axes: a T-pose facing +Z at rest.

    Joints without a counterpart rest on their parent, but those of the trunk and the neck, which share evenly in the turn
    between the two known joints they lie between.
    """
    positions, rotations = animation.world()
    parents, known = fit.skeleton.parents, fit.joints >= 0
    world = np.tile(np.eye(3), (animation.frames, len(parents), 1, 1))
    world[:, known] = rotations[:, fit.joints[known]] @ fit.turns[known]
    local = np.tile(np.eye(3), (animation.frames, len(parents), 1, 1))
    for joint in np.flatnonzero(known):
        above = ancestor(joint, parents, known)
        turn = np.swapaxes(world[:, above], 1, 2) @ world[:, joint] if above >= 0 else world[:, joint]
        chain = _sharing(joint, above, fit.skeleton)
        part = turn if len(chain) == 1 else _power(turn, 1 / len(chain))
        local[:, chain] = part[:, None]
    return positions[:, fit.joints[0]], local


def from_cmu31(
    animation: Animation, fit: Fitted, joints: Sequence[int], frames: np.ndarray, rotations: np.ndarray
) -> np.ndarray:
    """-> (T, C) the animation's values with some of the 31 joints (n,) in some frames (m,) turned as local rotations
    (m, 31, 3, 3) say; the inverse of `to_cmu31` for these.

    A joint without a counterpart turns the next below it that has one, if there is one. What lies between two counterparts in
    the file's tree stays as it is, and the lower of them takes the whole turn: its orientation in the world is exact.
    """
    skeleton, known = fit.skeleton, fit.joints >= 0
    local = animation.with_values(animation.values[frames]).rotations()
    wanted = {each for joint in joints for each in _counterparts(int(joint), skeleton, known)}
    turned = sorted(wanted)
    new = np.empty((len(frames), len(turned), 3, 3))
    for at, joint in enumerate(turned):
        above = ancestor(joint, skeleton.parents, known)
        turn = _product(rotations, _way(joint, above, skeleton.parents))
        lead = fit.turns[above] if above >= 0 else np.eye(3)
        theirs = fit.joints[joint]
        between = _way(int(animation.parents[theirs]), fit.joints[above] if above >= 0 else -1, animation.parents)
        new[:, at] = np.swapaxes(_product(local, between), 1, 2) @ lead @ turn @ fit.turns[joint].T
    return animation.with_rotations(fit.joints[turned], frames, new)


def _way(joint: int, above: int, parents: np.ndarray) -> list[int]:
    """-> the joints from below `above` down to `joint`, both of a tree parents (J,)."""
    way = []
    while joint != above:
        way.insert(0, joint)
        joint = int(parents[joint])
    return way


def _product(local: np.ndarray, way: list[int]) -> np.ndarray:
    """-> (m, 3, 3) the product of local rotations (m, J, 3, 3) along a way."""
    turn = np.tile(np.eye(3), (len(local), 1, 1))
    for joint in way:
        turn = turn @ local[:, joint]
    return turn


def _counterparts(joint: int, skeleton: Skeleton, known: np.ndarray) -> list[int]:
    """-> a joint of ours if it is known, else the known ones below it that are turned with it."""
    if known[joint]:
        return [joint]
    return [each for child in np.flatnonzero(skeleton.parents == joint) for each in _counterparts(int(child), skeleton, known)]


def _sharing(joint: int, above: int, skeleton: Skeleton) -> list[int]:
    """-> the joints that share in the turn from a known joint above to `joint`: those of the trunk, or it alone."""
    way = _way(joint, above, skeleton.parents)
    return way if all(skeleton.names[each] in SHARING for each in way) else [joint]


def _power(rotations: np.ndarray, part: float) -> np.ndarray:
    return Rotation.from_rotvec(Rotation.from_matrix(rotations).as_rotvec() * part).as_matrix()


def _straight(places: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """-> (T,) how upright figures at places (T, J, 3) stand: the least cosine of trunk, thighs and shins with the upright."""
    names = cmu31().skeleton.names
    at = {name: places[:, joints[names.index(name)]] for name in names if joints[names.index(name)] >= 0}
    arms = (at["LeftArm"] + at["RightArm"]) / 2
    ways = [arms - at["Hips"]]
    for side in SIDES:
        ways.append(at[side + "UpLeg"] - at[side + "Leg"])
        if side + "Foot" in at:
            ways.append(at[side + "Leg"] - at[side + "Foot"])
    upward = [way[:, 1] / np.maximum(np.linalg.norm(way, axis=1), 1e-9) for way in ways]
    return np.min(upward, axis=0)


def _turns(animation: Animation, places: np.ndarray, turned: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """-> (31, 3, 3) A, where the file's joints stand at places (J, 3), turned (J, 3, 3) in the world."""
    ours = cmu31().skeleton
    across = places[joints[ours.index("LeftUpLeg")]] - places[joints[ours.index("RightUpLeg")]]
    facing = Rotation.from_euler("y", np.arctan2(-across[2], across[0])).as_matrix()
    world = np.tile(facing, (len(ours.names), 1, 1))
    for joint, name in enumerate(ours.names):
        parent = ours.parents[joint]
        if name.endswith(WITH_PARENT):
            world[joint] = world[parent]
        elif name in BONES and (way := _bone(animation, places, turned, joints, ours, joint)) is not None:
            child = ours.index(BONES[name])
            world[joint] = shortest(facing @ ours.offsets[child], way) @ facing
    known = joints >= 0
    turns = np.tile(np.eye(3), (len(ours.names), 1, 1))
    turns[known] = np.swapaxes(turned[joints[known]], 1, 2) @ world[known]
    return turns


def _bone(
    animation: Animation, places: np.ndarray, turned: np.ndarray, joints: np.ndarray, ours: Skeleton, joint: int
) -> np.ndarray | None:
    """-> (3,) the way to the next joint in the file's figure, to its end site where the figure ends there; None where neither
    has a length."""
    own, child = joints[joint], joints[ours.index(BONES[ours.names[joint]])]
    if own < 0:
        return None
    ends = animation.ends[own] @ animation.axes.T
    way = places[child] - places[own] if child >= 0 else turned[own] @ ends[0] if len(ends) else np.zeros(3)
    return way if np.linalg.norm(way) > 0 else None


def _skeleton(animation: Animation, positions: np.ndarray, rotations: np.ndarray, joints: np.ndarray, turns: np.ndarray) -> Skeleton:
    """-> the 31 joints with the lengths of the file's, which stand at positions (T, J, 3), turned (T, J, 3, 3).

    Where unknown joints lie between two known ones, they are put at the lower one, so that it lies where it does however
    they turn. What has no counterpart at the body's tips has an average body's lengths, at this one's size.
    """
    ours, known = cmu31().skeleton, joints >= 0
    ends, offsets = ours.ends.copy(), ours.offsets.copy()
    lengths = np.zeros((2, 0))
    for joint in np.flatnonzero(known):
        above = ancestor(joint, ours.parents, known)
        if above < 0:
            continue
        way = _way(joint, above, ours.parents)
        axes = rotations[:, joints[above]] @ turns[above]
        between = positions[:, joints[joint]] - positions[:, joints[above]]
        length = np.linalg.norm(ours.offsets[way].sum(0))
        offsets[way] = 0.0
        offsets[way[0]] = np.nanmean(np.einsum("tij,ti->tj", axes, between), axis=0)
        lengths = np.c_[lengths, [np.linalg.norm(offsets[way[0]]), length]]
    size = lengths[0].sum() / lengths[1].sum()
    alone = np.array([not known[joint] and not _counterparts(joint, ours, known) for joint in range(len(known))])
    offsets[alone] *= size
    ends *= size
    offsets[0] = 0.0
    for joint in np.flatnonzero(known):
        own = animation.ends[joints[joint]]
        if len(own) and not np.isnan(ends[joint]).any() and np.linalg.norm(own[0]) > 0:
            ends[joint] = own[0] @ animation.axes.T * animation.unit @ turns[joint]
    return replace(ours, offsets=offsets, ends=ends)


def shortest(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """-> (3, 3) the rotation that takes the direction of a to that of b, neither of them opposite."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis)
    angle = np.arctan2(sine, a @ b)
    return Rotation.from_rotvec(axis * (angle / sine if sine > 1e-12 else 0.0)).as_matrix()
