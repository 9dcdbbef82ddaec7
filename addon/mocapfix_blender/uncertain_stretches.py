"""The stretches of a take that deserve a look: uncertain fills, poses that are guessed, and samples that stay empty."""

from dataclasses import dataclass

import numpy as np

from .solved_take import SolvedTake

CERTAIN_STATUSES = ("solved", "placed")
"""beginnings of the sentences on poses that need no look"""
JOINING_GAP_S = 0.1
"""stretches of the same kind that lie closer together are one"""
MAX_NAMED_LABELS = 3


@dataclass(frozen=True)
class UncertainStretch:
    """A stretch from its first to its last frame, in seconds after the first frame of the take, and why it is uncertain."""

    first_s: float
    last_s: float
    text: str


def find_uncertain_stretches(take: SolvedTake, max_sd_m: float) -> list[UncertainStretch]:
    """Return the uncertain stretches of a take by their time.

    Args:
        max_sd_m: Fills with a larger predicted standard deviation per axis are uncertain.
    """
    stretches = [*_find_uncertain_fills(take, max_sd_m), *_find_uncertain_poses(take), *_find_empty_stretches(take)]
    return sorted(stretches, key=lambda each: (each.first_s, each.last_s))


def _find_uncertain_fills(take: SolvedTake, max_sd_m: float) -> list[UncertainStretch]:
    sd = np.where(take.is_filled, np.nan_to_num(take.marker_sd), 0.0)
    is_uncertain = sd > max_sd_m
    found = []
    for first, last in _find_runs(np.asarray(is_uncertain.any(1)), JOINING_GAP_S * take.marker_rate):
        window = slice(first, last + 1)
        labels = [take.labels[m] for m in np.flatnonzero(is_uncertain[window].any(0))]
        text = f"{_list_labels(labels)} filled ±{1e3 * sd[window].max():.0f} mm"
        found.append(UncertainStretch(first / take.marker_rate, last / take.marker_rate, text))
    return found


def _find_uncertain_poses(take: SolvedTake) -> list[UncertainStretch]:
    found = []
    for index, text in enumerate(take.status_texts):
        if not text.startswith(CERTAIN_STATUSES):
            runs = _find_runs(take.pose_status == index, JOINING_GAP_S * take.rate)
            found += [UncertainStretch(first / take.rate, last / take.rate, f"pose {text}") for first, last in runs]
    return found


def _find_empty_stretches(take: SolvedTake) -> list[UncertainStretch]:
    is_empty = np.zeros(take.markers.shape[:2], bool)
    for run in take.report["fill"]["unfilled"]:
        if run["marker"] in take.labels:
            first, last = run["first"] - take.first_frame, run["last"] - take.first_frame
            is_empty[max(first, 0) : last + 1, take.labels.index(run["marker"])] = True
    found = []
    for first, last in _find_runs(np.asarray(is_empty.any(1)), JOINING_GAP_S * take.marker_rate):
        labels = [take.labels[m] for m in np.flatnonzero(is_empty[first : last + 1].any(0))]
        found.append(UncertainStretch(first / take.marker_rate, last / take.marker_rate, f"{_list_labels(labels)} left empty"))
    return found


def _find_runs(mask: np.ndarray, joining_gap: float) -> list[tuple[int, int]]:
    """Return the first and last index of each run of True, runs with at most `joining_gap` between them joined."""
    indices = np.flatnonzero(mask)
    if not indices.size:
        return []
    breaks = np.flatnonzero(np.diff(indices) > max(joining_gap, 1))
    starts, ends = indices[np.concatenate([[0], breaks + 1])], indices[np.concatenate([breaks, [len(indices) - 1]])]
    return [(int(first), int(last)) for first, last in zip(starts, ends, strict=True)]


def _list_labels(labels: list[str]) -> str:
    more = len(labels) - MAX_NAMED_LABELS
    return ", ".join(labels[:MAX_NAMED_LABELS]) + (f" and {more} more" if more > 0 else "")
