"""Damage for the benchmark of contacts: the markers of a foot are lost while it stands."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.contacts.contacts import CONTACT_JOINTS, FOOT_JOINTS
from mocapfix.contacts.standing import compute_speed, remove_short_runs
from mocapfix.stats.sequences import find_runs
from mocapfix.synthetic import SyntheticTake

TRUE_STANDING_SPEED_M_S = 0.1
"""Speed of a true joint below which it stands."""
MAX_TRUE_HEIGHT_M = 0.06
"""Height above its lowest standing places up to which it stands on the floor."""
LOWEST_SHARE_PERCENT = 10.0
LOSS_DURATION_S = (0.5, 2.0)
"""Shortest and longest time for which the markers of a foot are lost."""
LOSSES_PER_FOOT = 3
MIN_SEEN_S = 0.1
"""Time before and after a loss in which the foot stands and its markers are visible."""
MAX_FOOT_MARKER_DISTANCE_M = 0.13
"""Mean distance of a marker from ankle or toes up to which it is lost with the foot; the ankle's marker is on the shin."""


class FootLoss(NamedTuple):
    """The frames `first` to `last` in which all markers of a foot are lost."""

    side: str
    first: int
    last: int


def find_true_contacts(joint_position: Float[np.ndarray, "T 3"], rate: float) -> Bool[np.ndarray, " T"]:
    """Return when a joint of a foot truly stands: slow, for a while, and about as low as it ever is while slow."""
    is_slow = compute_speed(joint_position, rate) < TRUE_STANDING_SPEED_M_S
    if not is_slow.any():
        return is_slow
    base = np.percentile(joint_position[is_slow, 1], LOWEST_SHARE_PERCENT)
    return remove_short_runs(is_slow & (joint_position[:, 1] < base + MAX_TRUE_HEIGHT_M), rate)


def find_all_true_contacts(truth: SyntheticTake) -> Bool[np.ndarray, "T C"]:
    """Return when each of CONTACT_JOINTS truly stands."""
    joints = [truth.subject.skeleton.find_joint(name) for name in CONTACT_JOINTS]
    return np.stack([find_true_contacts(truth.joint_positions[:, joint], truth.rate) for joint in joints], axis=1)


def draw_foot_losses(truth: SyntheticTake, rng: np.random.Generator) -> list[FootLoss]:
    """Return times in which a foot stands with heel and toes; never both feet at once."""
    is_contact, losses = find_all_true_contacts(truth), list[FootLoss]()
    is_free = np.ones(len(is_contact), bool)
    margin, shortest = round(MIN_SEEN_S * truth.rate), round(LOSS_DURATION_S[0] * truth.rate)
    for _ in range(LOSSES_PER_FOOT):
        for side, joints in FOOT_JOINTS.items():
            is_flat = is_contact[:, [CONTACT_JOINTS.index(joint) for joint in joints]].all(axis=1) & is_free
            runs = [run for run in find_runs(is_flat) if run[1] + 1 - run[0] >= shortest + 2 * margin]
            if not runs:
                continue
            first, last = runs[int(rng.integers(len(runs)))]
            longest = min(last + 1 - first - 2 * margin, round(LOSS_DURATION_S[1] * truth.rate))
            length = int(rng.integers(shortest, longest + 1))
            start = int(rng.integers(first + margin, last + 2 - margin - length))
            losses.append(FootLoss(side, start, start + length - 1))
            is_free[max(0, start - margin) : start + length + margin] = False
    return losses


def find_foot_markers(truth: SyntheticTake, side: str) -> Bool[np.ndarray, " M"]:
    """Return the markers on and about a foot."""
    joints = [truth.subject.skeleton.find_joint(name) for name in FOOT_JOINTS[side]]
    offsets = truth.marker_positions[:, :, None] - truth.joint_positions[:, None, joints]
    return np.linalg.norm(offsets, axis=-1).mean(0).min(1) <= MAX_FOOT_MARKER_DISTANCE_M


def lose_feet(truth: SyntheticTake, losses: Sequence[FootLoss]) -> SyntheticTake:
    """Return the take without the markers of feet in some frames."""
    missing = truth.missing_mask.copy()
    for side, first, last in losses:
        missing[first : last + 1, find_foot_markers(truth, side)] = True
    damaged = np.where(missing[..., None], np.nan, truth.damaged_positions)
    return replace(truth, missing_mask=missing, damaged_positions=damaged)
