"""What is measured is not moved by what is inferred: the rule by which an inferred term yields to visible markers.

A term that is inferred, such as the contact of a foot, may increase the mean distance of a segment's visible markers from where
the body places them by at most MAX_RESIDUAL_GROWTH_M in any window of RESIDUAL_WINDOW_S, compared with the body without the term.
Where it does more, only a share of what it does is kept. Distances are convex in that share, so that a share of the growth is at
least as good as the same share of the displacement. The share changes slowly, so that nothing jumps.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from mocapfix.model.motion import Motion
from mocapfix.model.subject import Subject
from mocapfix.solve import kinematics
from mocapfix.stats.rigid_alignment import compute_lengths, scale_rotations
from mocapfix.stats.sequences import slide_windows, smooth_values

MAX_RESIDUAL_GROWTH_M = 0.002
"""Growth of a segment's mean distance that an inferred term may cause. Skin moves by 5 to 20 mm, cameras err by 0.2 to 1 mm."""
AIMED_GROWTH_SHARE = 0.9
"""Share of that growth to which a term is reduced, so that other windows of about the same length keep the limit too."""
RESIDUAL_WINDOW_S = 0.1  # time over which distances are averaged: noise cancels, and a strike does not
SHARE_SMOOTHING_S = 0.08
"""Standard deviation of the kernel that smooths a share: a displacement of 60 mm then changes by at most 2.3 m/s^2."""
MAX_REDUCTIONS = 5  # times that a share is reduced; it is usually small enough after one or two
SHARE_REACH_SD = 3.0  # half the length of that kernel, in standard deviations


def measure_residual_growth(
    joints: Int[np.ndarray, " K"],
    markers: Float[np.ndarray, "T K 3"],
    before: Float[np.ndarray, "T K 3"],
    after: Float[np.ndarray, "T K 3"],
    rate: float,
) -> dict[int, Float[np.ndarray, " W"]]:
    """Return by how much the mean distance of each segment's visible markers grows in each window of RESIDUAL_WINDOW_S.

    Args:
        markers: Measured positions in metres, NaN if not visible or faulty.
        before: Where the body without the inferred term places the markers, in metres.
        after: The same with the term.
        rate: Frames per second.

    Returns:
        By joint, the growth in metres of each window of w frames that begins at frames 0 to T - w; 0 in windows without markers.
    """
    growth = compute_lengths(markers - after) - compute_lengths(markers - before)
    length = min(max(1, round(RESIDUAL_WINDOW_S * rate)), len(growth))
    by_joint: dict[int, Float[np.ndarray, " W"]] = {}
    for joint in np.unique(joints).tolist():
        of_segment = growth[:, joints == joint]
        is_seen = ~np.isnan(of_segment)
        total, count = (np.r_[0.0, np.cumsum(each.sum(1))] for each in (np.where(is_seen, of_segment, 0.0), is_seen))
        by_joint[joint] = (total[length:] - total[:-length]) / np.maximum(count[length:] - count[:-length], 1)
    return by_joint


def compute_allowed_share(growth: Float[np.ndarray, " W"], frame_count: int) -> Float[np.ndarray, " T"]:
    """Return the share of an inferred displacement that may be kept in each frame: 1 where no window exceeds the limit.

    Args:
        growth: The growth in metres of each window of consecutive frames, as from `measure_residual_growth`.
        frame_count: T; windows have T + 1 - W frames.
    """
    excess = np.where(growth > MAX_RESIDUAL_GROWTH_M, growth / (AIMED_GROWTH_SHARE * MAX_RESIDUAL_GROWTH_M), 1.0)
    length = frame_count + 1 - len(growth)
    share = np.pad(1 / excess, (length - 1, length - 1), constant_values=1.0)
    return np.lib.stride_tricks.sliding_window_view(share, length).min(1)


def smooth_share(share: Float[np.ndarray, " T"], rate: float) -> Float[np.ndarray, " T"]:
    """Return a share that changes slowly and is nowhere above the given one."""
    sd = max(SHARE_SMOOTHING_S * rate, 1e-3)
    least = slide_windows(share, 2 * int(SHARE_REACH_SD * sd + 0.5) + 1).min(1)
    return smooth_values(least, sd, SHARE_REACH_SD)


def yield_to_markers(
    subject: Subject, markers: Float[np.ndarray, "T K 3"], before: Motion, inferred: Motion, rate: float
) -> Motion:
    """Return the inferred motion, with only a share of what was inferred where that moves visible markers too far.

    Args:
        markers: Measured positions in metres, NaN if not visible or faulty.
        before: The motion without what was inferred.
        rate: Frames per second.
    """
    place = kinematics.compute_joint_and_marker_positions
    places_before, limit, motion = place(subject, before)[1], np.ones(before.frame_count), inferred
    for _ in range(MAX_REDUCTIONS):
        growth = measure_residual_growth(subject.joints, markers, places_before, place(subject, motion)[1], rate)
        worst = np.max(list(growth.values()), axis=0)
        if not (worst > MAX_RESIDUAL_GROWTH_M).any():
            break
        limit = limit * compute_allowed_share(worst, len(limit))
        share = smooth_share(limit, rate)
        frames, joints = np.nonzero((share < 1)[:, None] & (inferred.local_rotations != before.local_rotations).any((2, 3)))
        start = before.local_rotations[frames, joints]
        turn = scale_rotations(start.swapaxes(1, 2) @ inferred.local_rotations[frames, joints], share[frames, None])
        local_rotations = inferred.local_rotations.copy()
        local_rotations[frames, joints] = start @ turn
        root_position = before.root_position + share[:, None] * (inferred.root_position - before.root_position)
        motion = replace(inferred, root_position=root_position, local_rotations=local_rotations)
    return motion
