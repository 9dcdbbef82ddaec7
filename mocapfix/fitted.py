"""How the 31 joints lie in a file's body, whatever its rest pose is.

The two rest poses differ: a file's arms may hang, its legs stand straight. In a pose in which the file's figure stands, ours
is put likewise: hips, trunk and head turned to where it faces, each limb's bone laid along its own. There a joint of ours
stands to its counterpart by a rotation A, and as both move with the same part of the body it does always:
W = V A, for the world rotation W of ours and V of the file's.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.animation import Animation
from mocapfix.hierarchies import Mapped, ancestor, below, way
from mocapfix.kernels.aligned import shortest_turn
from mocapfix.skeleton import Skeleton, cmu31

SIDES = ("Left", "Right")
# bone of ours: the next joint, towards which it points
BONES = {side + a: side + b for side in SIDES for a, b in (("UpLeg", "Leg"), ("Leg", "Foot"), ("Foot", "ToeBase"))}
BONES |= {side + a: side + b for side in SIDES for a, b in (("Arm", "ForeArm"), ("ForeArm", "Hand"))}
WITH_PARENT = ("Hand", "FingerBase", "HandIndex1", "Thumb", "ToeBase")  # turned as what they hang on
UPRIGHT = 0.8  # cosine: a figure stands where trunk, thighs and shins are within 37 degrees of upright
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
    moving = few.world()
    resting = animation.resting()[None], np.tile(np.eye(3), (1, len(animation.names), 1, 1))
    for positions, rotations in (resting, moving):
        straight = np.nan_to_num(_straight(positions, mapped.joints), nan=-1.0)
        best = int(np.argmax(straight))
        if straight[best] > UPRIGHT:
            stands = _Standing(animation, positions[best], rotations[best], mapped.joints)
            turns = _turns(stands)
            return Fitted(mapped.joints, turns, _skeleton(animation, *moving, mapped.joints, turns))
    return None


@dataclass(frozen=True)
class _Standing:
    """A file's figure in a pose in which it stands: its joints' positions (J, 3) and rotations (J, 3, 3) in the world."""

    animation: Animation
    positions: np.ndarray
    rotations: np.ndarray
    joints: np.ndarray

    def between(self, first: str, second: str) -> np.ndarray:
        """-> (3,) metres: the way from one of the 31 joints to another, both of them known."""
        names = cmu31().skeleton.names
        return self.positions[self.joints[names.index(second)]] - self.positions[self.joints[names.index(first)]]

    def bone(self, name: str) -> np.ndarray:
        """-> (3,) the way from a joint to the next, or to its end site where the figure ends there; zero where it is unknown."""
        names = cmu31().skeleton.names
        own = self.joints[names.index(name)]
        if own >= 0 and self.joints[names.index(BONES[name])] >= 0:
            return self.between(name, BONES[name])
        ends = self.animation.ends[own] if own >= 0 else np.empty((0, 3))
        return self.rotations[own] @ self.animation.axes @ ends[0] if len(ends) else np.zeros(3)


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


def _turns(stands: _Standing) -> np.ndarray:
    """-> (31, 3, 3) A, of a figure that stands."""
    ours, joints = cmu31().skeleton, stands.joints
    across = stands.between("RightUpLeg", "LeftUpLeg")
    facing = Rotation.from_euler("y", np.arctan2(-across[2], across[0])).as_matrix()
    world = np.tile(facing, (len(ours.names), 1, 1))
    for joint, name in enumerate(ours.names):
        if name.endswith(WITH_PARENT):
            world[joint] = world[ours.parents[joint]]
        elif name in BONES and (bone := stands.bone(name)).any():
            world[joint] = shortest_turn(facing @ ours.offsets[ours.index(BONES[name])], bone) @ facing
    known = joints >= 0
    turns = np.tile(np.eye(3), (len(ours.names), 1, 1))
    turns[known] = np.swapaxes(stands.rotations[joints[known]], 1, 2) @ world[known]
    return turns


def _skeleton(
    animation: Animation, positions: np.ndarray, rotations: np.ndarray, joints: np.ndarray, turns: np.ndarray
) -> Skeleton:
    """-> the 31 joints with the lengths of the file's, whose joints are at positions (T, J, 3), turned (T, J, 3, 3).

    Where unknown joints lie between two known ones they are put at the lower one, so that it lies where it does however
    they turn. What has no counterpart at the body's tips has an average body's lengths, at this one's size.
    """
    ours, known = cmu31().skeleton, joints >= 0
    offsets, ends, own, average = ours.offsets.copy(), ours.ends.copy(), 0.0, 0.0
    offsets[0] = 0.0
    for joint in np.flatnonzero(known)[1:].tolist():
        above = ancestor(joint, ours.parents, known)
        between = way(joint, above, ours.parents)
        leading = rotations[:, joints[above]] @ turns[above]
        apart = positions[:, joints[joint]] - positions[:, joints[above]]
        average += np.linalg.norm(ours.offsets[between].sum(0))
        offsets[between] = 0.0
        offsets[between[0]] = np.nanmean(np.einsum("tij,ti->tj", leading, apart), axis=0)
        own += np.linalg.norm(offsets[between[0]])
    for joint in range(len(offsets)):
        ends[joint] *= own / average
        if not below(joint, ours.parents, known):
            offsets[joint] *= own / average
    for joint in np.flatnonzero(known & ~np.isnan(ends[:, 0])):
        if len(there := animation.ends[joints[joint]]) and there[0].any():
            ends[joint] = animation.axes @ there[0] * animation.unit @ turns[joint]
    return replace(ours, offsets=offsets, ends=ends)
