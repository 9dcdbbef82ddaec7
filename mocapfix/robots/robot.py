"""A robot: a tree of links with joints of one axis, its limits and collision primitives, and which links form a body.

Inside this package lengths are metres, Z is up and X forward, as robots have them: at zero angles a robot stands and looks along
X. Joint positions are those of MuJoCo's `qpos`: radians, metres for slides, in the order of the file.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.solve.trajectory import CollisionTerm

SIDES = ("left", "right")
LIMBS = tuple(f"{side}_{limb}" for side in SIDES for limb in ("upper_arm", "forearm", "thigh", "shin"))
"""The segments whose directions a robot keeps."""
SOLE_CORNERS = ("heel left", "heel right", "toe left", "toe right")


@dataclass(frozen=True)
class Robot:
    """A humanoid of L links and N joints of one axis each; the root, link 0, moves freely.

    Links that are fixed to others stay links of their own. A link is where its file has it at zero angles.
    """

    name: str
    link_names: tuple[str, ...]
    parents: Int[np.ndarray, " L"]  # -1 for the root; parents come before their children
    link_positions: Float[np.ndarray, "L 3"]  # in the parent's axes, metres
    link_rotations: Float[np.ndarray, "L 3 3"]  # link axes to parent axes, of the root to the world
    masses: Float[np.ndarray, " L"]  # kg
    mass_centres: Float[np.ndarray, "L 3"]  # in the axes of the link, metres
    joint_names: tuple[str, ...]
    joint_links: Int[np.ndarray, " N"]  # the link that a joint moves, ascending; the joints of one link act one after the other
    joint_axes: Float[np.ndarray, "N 3"]  # unit vectors in the axes of the link
    joint_anchors: Float[np.ndarray, "N 3"]  # in the axes of the link, metres
    is_slide: Bool[np.ndarray, " N"]
    zero_positions: Float[np.ndarray, " N"]  # joint positions at which the links are where the file has them
    limits: Float[np.ndarray, "N 2"]  # of positions, infinite without a limit
    speed_limits: Float[np.ndarray, " N"]  # radians or metres per second, infinite where no file states one
    # joints that follow others: follower, leader, offset, factor
    couplings: tuple[tuple[int, int, float, float], ...]
    # in the axes of the links: capsules, whose ends coincide where they are spheres, and boxes, each also with a row of capsules
    # inside it, for pairs of two boxes; pairs are of links that the file lets meet and that are more than two joints apart
    collision: CollisionTerm
    outline: tuple[tuple[int, Float[np.ndarray, "P 3"]], ...] = ()  # links and corners of their meshes, or their sites, metres
    notes: tuple[str, ...] = ()  # sentences for the report on how the file was read


@dataclass(frozen=True)
class LinkPoint:
    """A point of a link, in its axes, metres."""

    link: int
    position: Float[np.ndarray, " 3"]


@dataclass(frozen=True)
class RobotMap:
    """Which links form the body of a robot; all rotations are relative to the robot at zero angles.

    Attributes:
        limbs: Segment (of LIMBS) to the points from which and to which it runs.
        feet: Side to the link of the foot.
        soles: Side to the corners of the sole, in the order of SOLE_CORNERS, in the axes of the foot's link, metres.
        pelvis, trunk, head: Links; the same link where no joint is between. `trunk` carries the arms.
        hands: Side to the outermost link of the arm, if a joint moves it relative to the forearm.
        standing: Joint positions of an upright stance with straight knees, (N,), those of the file where it stands so:
            rotations of pelvis, trunk, head and feet are compared with the performer's from this pose.
        reason: Sentence on how the map was found.
        keeps_balance: Whether the centre of mass is kept over standing feet as far as the performer's is.
    """

    limbs: Mapping[str, tuple[LinkPoint, LinkPoint]]
    feet: Mapping[str, int]
    soles: Mapping[str, Float[np.ndarray, "4 3"]]
    pelvis: int
    trunk: int
    head: int
    hands: Mapping[str, int]
    standing: Float[np.ndarray, " N"]
    reason: str = ""
    keeps_balance: bool = False
