"""The heel and the tip of each foot: markers where the foot has them, otherwise points of the solved body."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.contacts.contacts import CONTACT_JOINTS, FOOT_JOINTS
from mocapfix.model.motion import Motion
from mocapfix.model.subject import Subject
from mocapfix.solve import kinematics

HEEL_PER_FOOT = -0.35
"""The heel along the foot, as a share of the length from the ankle to the toe base; negative is behind the ankle."""
MAX_HEEL_MARKER_M = 0.02
"""The foremost place along the foot, before the ankle, of a marker that stands for the heel."""
MIN_TOE_MARKER_SHARE = 0.9
"""The rearmost place along the foot, before the ankle, of a marker that stands for the toes, as a share of the length from the
ankle to the toe base: one farther back leaves the floor before the toes do."""
MIN_SHOWN_SHARE = 0.8
"""Share of frames in which such a marker is visible; the body shows where it is in the others."""


@dataclass(frozen=True)
class FootPoints:
    """The heel and the toes of one foot.

    heel, toe  (T, 3) m
    is_seen    (T, 2): whether markers show each of both
    """

    heel: Float[np.ndarray, "T 3"]
    toe: Float[np.ndarray, "T 3"]
    is_seen: Bool[np.ndarray, "T 2"]

    @property
    def paths(self) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]:
        """The paths (T, 3) in metres of heel and toes."""
        return self.heel, self.toe


def build_foot_points(
    subject: Subject,
    motion: Motion,
    markers: Float[np.ndarray, "T K 3"],
    body_markers: Float[np.ndarray, "T K 3"],
    is_known: Bool[np.ndarray, "T C"],
) -> Mapping[str, FootPoints]:
    """Return the points of the feet, by side.

    Args:
        subject: The subject.
        motion: Its motion.
        markers: (T, K, 3) m: the subject's markers as measured, NaN where they are missing or faulty.
        body_markers: (T, K, 3) m: where the body carries them.
        is_known: (T, C): whether markers show the position of each joint, of which the first are CONTACT_JOINTS.
    """
    skeleton = subject.skeleton
    position, rotation = kinematics.compute_world_poses(skeleton, motion)
    visible = np.all(np.isfinite(markers), axis=-1)
    shown = np.where(visible[..., None], markers, body_markers)
    points: dict[str, FootPoints] = {}
    for side, joints in FOOT_JOINTS.items():
        foot, toe = (skeleton.names.index(joint) for joint in joints)
        bone, end = skeleton.offsets[toe], np.nan_to_num(skeleton.ends[toe])
        heel = position[:, foot] + rotation[:, foot] @ (bone * [HEEL_PER_FOOT, 1.0, HEEL_PER_FOOT])
        tip = position[:, toe] + rotation[:, toe] @ end
        place = _compute_place_along_foot(subject, foot, toe)
        is_usable = np.isfinite(place) & (visible.mean(0) >= MIN_SHOWN_SHARE) & np.isfinite(shown).all((0, 2))
        rearmost, foremost = _find_extreme_markers(place, is_usable)
        is_seen = is_known[:, [CONTACT_JOINTS.index(joint) for joint in joints]]
        if rearmost is not None and place[rearmost] < MAX_HEEL_MARKER_M:
            heel, is_seen[:, 0] = shown[:, rearmost], is_seen[:, 0] | visible[:, rearmost]
        if foremost is not None and place[foremost] > MIN_TOE_MARKER_SHARE * np.linalg.norm(bone):
            tip, is_seen[:, 1] = shown[:, foremost], is_seen[:, 1] | visible[:, foremost]
        points[side] = FootPoints(heel, tip, is_seen)
    return points


def _compute_place_along_foot(subject: Subject, foot: int, toe: int) -> Float[np.ndarray, " K"]:
    """Return how far before the ankle, in metres along the foot, each marker of a foot is; NaN for other markers."""
    bone = subject.skeleton.offsets[toe]
    direction = bone / np.linalg.norm(bone)
    along = subject.marker_offsets @ direction
    along = np.where(subject.joints == toe, along + np.linalg.norm(bone), along)
    return np.where(np.isin(subject.joints, (foot, toe)), along, np.nan)


def _find_extreme_markers(place: Float[np.ndarray, " K"], is_usable: Bool[np.ndarray, " K"]) -> tuple[int | None, int | None]:
    """Return the rearmost and the foremost usable marker."""
    usable = np.flatnonzero(is_usable)
    if not len(usable):
        return None, None
    return int(usable[place[usable].argmin()]), int(usable[place[usable].argmax()])
