"""The heel and the tip of each foot: markers where the foot has them, otherwise points of the solved body."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.contacts.contacts import FOOT_JOINTS
from mocapfix.motion import Motion
from mocapfix.solve import kinematics
from mocapfix.subject import Subject

HEEL_PER_FOOT = -0.35
"""The heel along the foot, as a share of the length from the ankle to the toe base; negative is behind the ankle."""
MAX_HEEL_MARKER_M = 0.02
"""The foremost place along the foot, before the ankle, of a marker that stands for the heel."""
MIN_TOE_MARKER_M = 0.08
"""The rearmost place along the foot, before the ankle, of a marker that stands for the toes."""
MIN_SHOWN_SHARE = 0.8
"""Share of frames in which such a marker is visible; the body shows where it is in the others."""


class FootPoints(NamedTuple):
    """The paths (T, 3) in metres of the heel and the toes of one foot."""

    heel: Float[np.ndarray, "T 3"]
    toe: Float[np.ndarray, "T 3"]


def build_foot_points(
    subject: Subject,
    motion: Motion,
    markers: Float[np.ndarray, "T K 3"],
    body_markers: Float[np.ndarray, "T K 3"],
) -> Mapping[str, FootPoints]:
    """Return the points of the feet, by side.

    markers       (T, K, 3) m: the subject's markers as measured, NaN where they are missing or faulty
    body_markers  (T, K, 3) m: where the body carries them
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
        if rearmost is not None and place[rearmost] < MAX_HEEL_MARKER_M:
            heel = shown[:, rearmost]
        if foremost is not None and place[foremost] > MIN_TOE_MARKER_M:
            tip = shown[:, foremost]
        points[side] = FootPoints(heel, tip)
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
