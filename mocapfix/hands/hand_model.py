"""The hand: a palm with five rays of three joints each, the limits of its joints, and a prior on its poses.

A hand is a skeleton of its own, whose root is the palm. Each ray begins with a joint that does not turn and gives the ray its
axes: x along the straight ray, y out of the back (of the thumb: of the nail), z to the thumb's side of a left hand. Flexion,
abduction and twist of a joint are then the numbers of its rotation vector. A right hand is the mirror image of a left one: its
x points to the wrist, and the same angles are turns about y and z in the opposite sense.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.errors import SceneError
from mocapfix.io.shipped import find_shipped_folder, read_yaml
from mocapfix.model.skeleton import UNLIMITED_RAD, Skeleton
from mocapfix.solve.mean_pose import JointLimits
from mocapfix.solve.pose_prior import GaussianModel
from mocapfix.stats.rigid_alignment import compute_rotation_vectors

Side: TypeAlias = Literal["Left", "Right"]
RAYS = ("Thumb", "Index", "Middle", "Ring", "Pinky")
JOINTS_PER_RAY = 3
RAY_ROOTS = np.array([1 + 4 * ray for ray in range(len(RAYS))])  # in the tree: palm, then for each ray its root and its joints
RAY_BASES = RAY_ROOTS + (np.array(RAYS) != "Thumb")  # whose offset is the place of a ray's first joint on the palm
HAND_JOINTS = np.concatenate([root + np.arange(1, 4) for root in RAY_ROOTS])  # the 15 joints, ray by ray
TIP_JOINTS = HAND_JOINTS[2::3]  # the joints that carry the tips
ANGLES = ("twist", "abduction", "flexion")
ANGLE_SIGNS = np.array([1.0, -1.0, -1.0])  # of each angle in the rotation vector (x, y, z) of a left hand
MIRROR = np.array([-1.0, 1.0, 1.0])  # of vectors from a left hand to a right one; of rotation vectors its negative


@dataclass(frozen=True)
class HandPrior(GaussianModel):
    """A Gaussian on the poses of a hand: synergies as its code, and a deviation of its own for every angle."""

    axis_sd_rad: np.ndarray  # (J, 3) about the parents' axes, given the code; infinite for palm and roots of rays
    within_axis_sd_rad: np.ndarray  # (J, 3) the same within a take
    mean_axis_sd_rad: np.ndarray  # (J, 3) of the takes' means, which differ with the hand too; 0 for palm and roots of rays
    within_share: float  # of the variance of the code within a take

    @property
    def residual_information(self) -> Float[np.ndarray, "J 3 3"]:
        return np.eye(3) * self.axis_sd_rad[:, None, :] ** -2.0

    def condition_on_take(self, mean_code: Float[np.ndarray, " P"], mean_angles: Float[np.ndarray, "J 3"]) -> "HandPrior":
        """Return the prior within a take.

        Args:
            mean_code: Of the take, in standard deviations of the code's means.
            mean_angles: Of the take beside those of the code, in standard deviations of theirs, in the parents' axes.
        """
        mean = self.mean_vectors + self.mean_axis_sd_rad * mean_angles
        mean += np.sqrt(1 - self.within_share) * np.tensordot(mean_code, self.components, 1)
        components = np.sqrt(self.within_share) * self.components
        return replace(self, mean_vectors=mean, components=components, axis_sd_rad=self.within_axis_sd_rad)


@dataclass(frozen=True)
class HandModel:
    """A hand of one side: its 21 joints (the palm, five roots of rays, 15 joints), limits and prior."""

    side: Side
    skeleton: Skeleton
    free_joints: Bool[np.ndarray, " J"]
    limits: JointLimits
    limit_sd_rad: float
    prior: HandPrior
    length_m: float  # of the hand
    length_relative_sd: float
    bone_relative_sd: float
    base_sd_m: float  # per axis, of the place of a ray's first joint on the palm, besides its distance from the wrist
    palm_position: Float[np.ndarray, "3"]  # m: the wrist's centre in the axes of the body's forearm
    palm_position_sd_m: float  # per axis, over people
    palm_rotation_sd_rad: float  # of the palm about the axes of the body's hand joint
    palm_marker_sd_m: float  # of a marker on the back of the hand about where the calibrated body has it

    @property
    def tips(self) -> Float[np.ndarray, "5 3"]:
        """The tips in metres, in the axes of the joints that carry them (TIP_JOINTS)."""
        return self.skeleton.ends[TIP_JOINTS]

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The names of the 15 joints, ray by ray from the palm."""
        return tuple(self.skeleton.names[j] for j in HAND_JOINTS)

    @property
    def ray_offsets(self) -> Float[np.ndarray, "15 3"]:
        """Each of the 15 joints from the one before, the first of a ray from the palm, in the rest pose: m, the palm's axes."""
        rest = self.skeleton.rest_positions
        above = np.where(np.arange(len(HAND_JOINTS)) % JOINTS_PER_RAY, np.roll(HAND_JOINTS, 1), 0)
        return rest[HAND_JOINTS] - rest[above]

    @property
    def tip_names(self) -> tuple[str, ...]:
        """The names of the five tips, thumb to little finger."""
        return tuple(f"{self.side}Hand{ray}Tip" for ray in RAYS)

    def scale(self, factors: Float[np.ndarray, " B"], base_shifts: Float[np.ndarray, "5 3"] | None = None) -> "HandModel":
        """Return the hand with other lengths.

        Args:
            factors: Of the offsets of the 15 joints, and then of the five tips.
            base_shifts: Of the joints in RAY_BASES, before the scaling, in metres in their parents' axes.
        """
        offsets, ends = self.skeleton.offsets.copy(), self.skeleton.ends.copy()
        offsets[RAY_BASES] += np.zeros(3) if base_shifts is None else base_shifts
        offsets[HAND_JOINTS] *= factors[: len(HAND_JOINTS), None]
        offsets[RAY_ROOTS[0]] *= factors[0]  # the saddle joint of the thumb is its ray's root
        ends[TIP_JOINTS] *= factors[len(HAND_JOINTS) :, None]
        return replace(self, skeleton=replace(self.skeleton, offsets=offsets, ends=ends))

    def compute_angles(self, rotation_vectors: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Return twist, abduction and flexion in radians from rotation vectors in the axes of the joints' parents.

        The same function returns rotation vectors from angles.
        """
        return rotation_vectors * (ANGLE_SIGNS if self.side == "Left" else ANGLE_SIGNS * -MIRROR)

    def convert_to_palm_axes(self, local_rotations: Float[np.ndarray, "T J 3 3"]) -> Float[np.ndarray, "T 15 3 3"]:
        """Return the rotations of the 15 joints for axes that are parallel to those of the palm in the rest pose."""
        return self._ray_axes @ local_rotations[:, HAND_JOINTS] @ self._ray_axes.swapaxes(-1, -2)

    def convert_from_palm_axes(self, rotations: Float[np.ndarray, "T 15 3 3"]) -> Float[np.ndarray, "T 15 3 3"]:
        """Return the rotations of the 15 joints in their parents' axes from those of `convert_to_palm_axes`."""
        return self._ray_axes.swapaxes(-1, -2) @ rotations @ self._ray_axes

    def compute_rotation_vectors(self, rotations: Float[np.ndarray, "T 15 3 3"]) -> Float[np.ndarray, "T 15 3"]:
        """Return the rotation vectors, in radians in the axes of the rays, of rotations from `convert_to_palm_axes`."""
        return np.einsum("jba,tjb->tja", self._ray_axes, compute_rotation_vectors(rotations))

    @property
    def _ray_axes(self) -> Float[np.ndarray, "15 3 3"]:
        return np.repeat(self.skeleton.rest_rotations[RAY_ROOTS], JOINTS_PER_RAY, axis=0)


@cache
def load_hand(side: Side) -> HandModel:
    """Return the hand of priors/hand.yaml. Raises SceneError with the file and the invalid key."""
    path = find_shipped_folder("priors") / "hand.yaml"
    data, key = read_yaml(path), "rays"
    try:
        skeleton = _build_skeleton(side, data["rays"], float(data["hand_length"]["average_m"]))
        key = "angles"
        angles = _read_angles(data)
        key = "modes"
        prior = _build_prior(side, skeleton, data, angles)
        key = "hand_length, bone_relative_sd, base_sd, palm, limit_sd"
        palm, length = data["palm"], data["hand_length"]
        return HandModel(
            side,
            skeleton,
            np.isin(np.arange(len(skeleton.names)), [0, *HAND_JOINTS]),
            _build_limits(side, len(skeleton.names), angles),
            np.radians(data["limit_sd"]),
            prior,
            float(length["average_m"]),
            float(length["relative_sd"]),
            float(data["bone_relative_sd"]),
            float(data["base_sd"]),
            _mirror(side, np.array(palm["position"], float)),
            float(palm["position_sd"]),
            np.radians(palm["rotation_sd"]),
            float(palm["marker_sd"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise SceneError(f"{path}: {key}: is incomplete or no number ({error}).") from error


def _mirror(side: Side, vectors: np.ndarray) -> np.ndarray:
    return vectors if side == "Left" else vectors * MIRROR


def _build_skeleton(side: Side, rays: dict[str, Any], length_m: float) -> Skeleton:
    """Return the palm and its rays, straight; NaN ends where a joint has a child."""
    names, parents = [f"{side}Hand"], [-1]
    count = 1 + (1 + JOINTS_PER_RAY) * len(RAYS)
    offsets, ends, rest = np.zeros((count, 3)), np.full((count, 3), np.nan), np.tile(np.eye(3), (count, 1, 1))
    along = _mirror(side, np.array([1.0, 0.0, 0.0]))
    for name, root in zip(RAYS, RAY_ROOTS, strict=True):
        ray, base = rays[name], _mirror(side, length_m * np.array(rays[name]["base"], float))
        bones = length_m * np.array(ray["bones"], float)
        if len(bones) != JOINTS_PER_RAY:
            raise ValueError(f"{name} must have {JOINTS_PER_RAY} bones")
        axes = _compute_ray_axes(*np.radians([ray["fan"], ray["palmar"], ray["roll"]]))
        rest[root] = axes if side == "Left" else MIRROR[:, None] * axes * MIRROR
        names += [f"{side}InHand{name}", *(f"{side}Hand{name}{number}" for number in (1, 2, 3))]
        parents += [0, root, root + 1, root + 2]
        if name == "Thumb":
            offsets[root] = base
        else:
            offsets[root + 1] = rest[root].T @ base
        offsets[root + 2], offsets[root + 3], ends[root + 3] = bones[:, None] * along
    return Skeleton(tuple(names), np.array(parents), offsets, ends, rest)


def _compute_ray_axes(fan: float, palmar: float, roll: float) -> Float[np.ndarray, "3 3"]:
    """Return the axes of a ray of a left hand in the palm's, as columns."""
    along = np.array([np.cos(palmar) * np.cos(fan), -np.sin(palmar), np.cos(palmar) * np.sin(fan)])
    back = np.array([0.0, 1.0, 0.0]) - along * along[1]
    back /= np.linalg.norm(back)
    back = back * np.cos(roll) - np.cross(along, back) * np.sin(roll)
    return np.stack([along, back, np.cross(along, back)], axis=1)


def _expand_finger_names(name: str) -> list[str]:
    """Return the names of an angle: those of all fingers for "finger1.flexion"."""
    return [name.replace("finger", ray) for ray in RAYS[1:]] if name.startswith("finger") else [name]


def _find_angle(name: str) -> tuple[int, int]:
    """Return the joint in the tree and the axis of an angle such as "Index1.flexion". Raises ValueError."""
    joint, _, angle = name.partition(".")
    return int(RAY_ROOTS[RAYS.index(joint[:-1])]) + 1 + "123".index(joint[-1]), ANGLES.index(angle)


def _read_angles(data: dict[str, Any]) -> dict[tuple[int, int], Float[np.ndarray, "4"]]:
    """Return mean, lower and upper limit and remaining deviation in radians of the angles by joint and axis."""
    angles: dict[tuple[int, int], np.ndarray] = {}
    for name, entry in data["angles"].items():
        for each in _expand_finger_names(name):
            angles[_find_angle(each)] = np.radians([entry["mean"], *entry["range"], entry["sd"]])
    return angles


def _build_limits(side: Side, count: int, angles: dict[tuple[int, int], np.ndarray]) -> JointLimits:
    """Return the ranges of the angles; those of locked angles, which the prior keeps, are infinite."""
    bounds = np.tile(UNLIMITED_RAD, (count, 1, 1))
    sign = ANGLE_SIGNS if side == "Left" else ANGLE_SIGNS * -MIRROR
    for (joint, axis), (_, low, high, _) in angles.items():
        bounds[joint, axis] = sorted((sign[axis] * low, sign[axis] * high))
    lower, upper = np.ascontiguousarray(bounds[..., 0]), np.ascontiguousarray(bounds[..., 1])
    return JointLimits(np.tile(np.eye(3), (count, 1, 1)), lower, upper)


def _build_prior(side: Side, skeleton: Skeleton, data: dict[str, Any], angles: dict[tuple[int, int], np.ndarray]) -> HandPrior:
    """Return the Gaussian: the modes, one more for what is left of each finger's middle joint, and the deviations beside them."""
    count = len(skeleton.names)
    mean, axis_sd = np.zeros((count, 3)), np.full((count, 3), np.radians(data["locked_sd"]))
    axis_sd[[0, *RAY_ROOTS]] = np.inf
    for key, (middle, _, _, sd) in angles.items():
        mean[key], axis_sd[key] = middle, sd
    modes: list[np.ndarray] = []
    for loadings in data["modes"].values():
        modes.append(np.zeros((count, 3)))
        for name, degrees in loadings.items():
            for each in _expand_finger_names(name):
                modes[-1][_find_angle(each)] += np.radians(degrees)
    flexion = ANGLES.index("flexion")
    for middle_joint in RAY_ROOTS[1:] + 2:
        own = np.zeros((count, 3))
        own[middle_joint, flexion] = axis_sd[middle_joint, flexion]
        axis_sd[middle_joint, flexion] = np.radians(data["locked_sd"])
        modes.append(own)
    components = np.stack(modes)
    followed = RAY_ROOTS[1:] + 2
    components[:, followed + 1, flexion] = float(data["coupling"]["ratio"]) * components[:, followed, flexion]
    sign = ANGLE_SIGNS if side == "Left" else ANGLE_SIGNS * -MIRROR
    identity, share = np.tile(np.eye(3), (count, 1, 1)), float(data["within_take_share"])
    is_listed = np.zeros((count, 3), bool)
    for key in angles:
        is_listed[key] = True
    within_sd = np.where(is_listed, np.sqrt(share), 1.0) * axis_sd
    mean_sd = np.hypot(np.radians(data["axis_sd"]), np.where(is_listed, np.sqrt(1 - share) * axis_sd, 0.0))
    mean_sd[[0, *RAY_ROOTS]] = 0.0
    return HandPrior(
        skeleton.names,
        identity,
        axis_sd.mean(1),
        sign * mean,
        np.ascontiguousarray(sign * components),
        np.radians(data["locked_sd"]),
        axis_sd,
        within_sd,
        mean_sd,
        share,
    )
