"""How certain a held foot is while no marker shows it: it is where it stood before and after, up to its rolling."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.contacts.contacts import FOOT_JOINTS, BodyContacts
from mocapfix.motion import Motion
from mocapfix.stats.sequences import find_runs
from mocapfix.subject import Subject

ROLLING_SD_M = 0.006
"""Standard deviation per axis of ankle or toes of a standing foot about where they stand when markers show them."""
SHINS = {"left": "LeftLeg", "right": "RightLeg"}


def reduce_held_uncertainty(subject: Subject, motion: Motion, contacts: BodyContacts) -> Motion:
    """Return the motion with the standard deviations of feet, and of the markers on feet and shins, while these are held.

    subject  the body with all its markers, to which the motion's `marker_sd` belongs
    """
    joint_sd, marker_sd = motion.joint_sd.copy(), motion.marker_sd.copy()
    skeleton = subject.skeleton
    for side, joints in FOOT_JOINTS.items():
        feet = [skeleton.find_joint(joint) for joint in joints]
        columns = [contacts.joints.index(joint) for joint in joints]
        is_held = np.stack([_find_held_occlusions(contacts.is_contact[:, c], contacts.is_known[:, c]) for c in columns], axis=1)
        for joint, is_joint_held, column in zip(feet, is_held.T, columns, strict=True):
            usual = _compute_known_sd(motion.joint_sd[:, joint], contacts.is_known[:, column])
            joint_sd[is_joint_held, joint] = np.minimum(joint_sd[is_joint_held, joint], np.hypot(usual, ROLLING_SD_M))
        shin = skeleton.find_joint(SHINS[side])
        is_foot_held, is_ankle_known = np.all(is_held, axis=1), contacts.is_known[:, columns[0]]
        markers = np.flatnonzero(np.isin(subject.joints, [*feet, shin])) if marker_sd.size else []
        for k in markers:
            usual = _compute_known_sd(motion.marker_sd[:, k], is_ankle_known)
            share = _compute_place_on_shin(subject, int(k), feet[0]) if subject.joints[k] == shin else 1.0
            held = np.hypot(usual, share * ROLLING_SD_M + (1 - share) * motion.marker_sd[is_foot_held, k])
            marker_sd[is_foot_held, k] = np.minimum(marker_sd[is_foot_held, k], held)
    return replace(motion, joint_sd=joint_sd, marker_sd=marker_sd)


def _find_held_occlusions(is_contact: Bool[np.ndarray, " T"], is_known: Bool[np.ndarray, " T"]) -> Bool[np.ndarray, " T"]:
    """Return the unknown frames of those runs throughout which a joint stands."""
    is_held = np.zeros(len(is_contact), bool)
    for first, last in find_runs(~is_known):
        is_held[first : last + 1] = is_contact[first : last + 1].all()
    return is_held


def _compute_known_sd(sd: Float[np.ndarray, " T"], is_known: Bool[np.ndarray, " T"]) -> float:
    """Return the median of the standard deviations in known frames, 0 without any."""
    return float(np.median(sd[is_known])) if is_known.any() else 0.0


def _compute_place_on_shin(subject: Subject, marker: int, ankle: int) -> float:
    """Return how far along the shin a marker is: 0 at the knee, 1 at the ankle."""
    shin = subject.skeleton.offsets[ankle]
    return float(np.clip(subject.marker_offsets[marker] @ shin / (shin @ shin), 0, 1))
