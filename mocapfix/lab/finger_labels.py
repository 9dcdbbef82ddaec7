"""Benchmark of the labels of fingers: exchanges and ghosts on composed hands, which are not those of the model (`lab.hands`).

Labels of neighbouring fingers are exchanged at random, from where their markers are nearest, and from the end of a gap in which
both are missing; those of both hands where these are nearest. Ghosts stand still near a finger whose marker is missing.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Bool
from scipy.spatial.transform import Rotation

from mocapfix.io.c3d import write_c3d
from mocapfix.lab.hands import HAND_SEEDS, MARKER_COUNTS, compose_hands, select_columns
from mocapfix.model.detected import Detected
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions
from mocapfix.pipeline import plan_subject
from mocapfix.stats.sequences import find_runs

LABELLED_COUNTS, KINDS = (20, 10, 6), ("random", "near", "gap", "hands")  # markers of a hand pair; exchanges
EXCHANGES, MAX_TRIALS = 12, 2000  # of a take
EXCHANGE_FRAMES = (3, 300)  # their lengths are evenly distributed on a logarithmic scale
MARGIN_FRAMES, NEAR_FRAMES = 20, 60  # between exchanges of a label; within which the nearest frame is looked for
GHOSTS, GHOST_FRAMES, REFLECTION_RANGE_M = 6, (3, 40), (0.03, 0.12)
RAYS = ("THM", "IDX", "MID", "RNG", "PNK")
MAX_WRONG_SHARE = 0.1  # of the samples of an exchange that is undone: beside its ends a marker may be missing
LabelErrors: TypeAlias = tuple[Take, list[tuple[str, list[int], slice]], Bool[np.ndarray, "T M"]]


def make_label_errors(rng: np.random.Generator, take: Take, fingers: list[int]) -> LabelErrors:
    """Return a take with exchanged labels and ghosts, the exchanges (kind, markers, frames), and which samples are ghosts."""
    markers, busy, made = take.markers.copy(), np.zeros(take.visible.shape, bool), list[tuple[str, list[int], slice]]()
    is_ghost = busy.copy()
    for _ in range(MAX_TRIALS):
        kind, one, start = str(rng.choice(KINDS)), int(rng.choice(fingers)), int(rng.integers(5, take.frame_count))
        ray, most = RAYS.index(take.labels[one][1:4]), 3 if len(fingers) <= 6 else 1
        apart = [abs(RAYS.index(take.labels[m][1:4]) - ray) if take.labels[m][0] == take.labels[one][0] else -1 for m in fingers]
        others = [m for m, d in zip(fingers, apart, strict=True) if (d < 0 if kind == "hands" else 1 <= d <= most)]
        pair = [one, int(rng.choice(others))]
        distance_m = np.linalg.norm(markers[:, pair[0]] - markers[:, pair[1]], axis=-1)
        near = slice(max(5, start - NEAR_FRAMES), start + NEAR_FRAMES) if kind == "near" else slice(5, None)
        if kind in ("near", "hands") and np.isfinite(distance_m[near]).any():
            start = near.start + int(np.nanargmin(distance_m[near]))
        gaps = [gap for gap in find_runs(~take.visible[:, one]) if gap[1] < start] if kind == "gap" else []
        start = gaps[-1][1] + 1 if gaps else start
        part = slice(start, start + round(float(np.exp(rng.uniform(*np.log(EXCHANGE_FRAMES))))))
        around = slice(max(0, start - MARGIN_FRAMES), part.stop + MARGIN_FRAMES)
        is_shown = part.stop <= take.frame_count - 5 and take.visible[part, pair].mean(0).min() > 0.5
        if not is_shown or busy[around, pair].any() or (kind == "gap" and not gaps) or len(made) == EXCHANGES:
            continue
        busy[around, pair] = True
        if gaps:
            markers[gaps[-1][0] : start, pair] = np.nan
        markers[part, pair] = markers[part, pair[::-1]]
        made.append((kind, pair, part))
    free = [(m, *gap) for m in fingers for gap in find_runs(np.isnan(markers[:, m, 0])) if gap[1] - gap[0] >= GHOST_FRAMES[0] + 1]
    for m, first, last in (free[n] for n in rng.permutation(len(free))[:GHOSTS]):
        part = slice(first + 1, min(last, first + 1 + int(rng.integers(*GHOST_FRAMES))))
        away = rng.uniform(*REFLECTION_RANGE_M) * Rotation.random(None, rng).as_matrix()[0]
        if first and not busy[part, m].any():
            markers[part, m], is_ghost[part, m] = markers[first - 1, m] + away + rng.normal(0, 0.0003, 3), True
    return take.replace_markers(markers), made, is_ghost


def measure_finger_labels(
    seeds: Iterable[int] = HAND_SEEDS, report_progress: Callable[[str], None] = lambda _: None
) -> dict[str, dict[str, Any]]:
    """Return a row for each number of finger markers of a hand pair."""
    rows = {count: Counter[str]() for count in LABELLED_COUNTS}
    for seed in seeds:
        truth = compose_hands(seed)
        for count, row in rows.items():
            report_progress(f"labels of {count} markers, seed {seed}")
            kept = select_columns(truth, truth.take.labels, MARKER_COUNTS[count])
            take = replace(truth.take, markers=truth.take.markers[:, kept], labels=tuple(truth.take.labels[m] for m in kept))
            fingers = [m for m, label in enumerate(take.labels) if label[1:4] in RAYS and label[4:] in ("0", "3", "6")]
            wrong, exchanges, is_ghost = make_label_errors(np.random.default_rng(seed), take, fingers)
            is_wrong, detected = find_wrong_samples(take, wrong)
            for kind, pair, part in exchanges:
                is_undone = int(is_wrong[part][:, pair].mean() <= MAX_WRONG_SHARE)
                row.update({"exchanges": 1, "undone": is_undone, f"{kind}_exchanges": 1, f"{kind}_undone": is_undone})
                is_wrong[part, pair] = False
            row.update({"ghosts": int(is_ghost.sum()), "ghosts_found": int((is_ghost & ~detected.inlier_mask).sum())})
            row["invented_samples"] += int((is_wrong & ~is_ghost).sum()) + int(find_wrong_samples(take, take)[0].sum())
    return {f"{count} markers": {name: int(value) for name, value in sorted(row.items())} for count, row in rows.items()}


def find_wrong_samples(truth: Take, take: Take) -> tuple[Bool[np.ndarray, "T M"], Detected]:
    """Return the samples that are under another label than the true one after detection, and what was detected."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "hands.c3d"
        write_c3d(path, take)
        detected = plan_subject(path, CleanOptions(), "hands.c3d")[0].fit().detected
    return detected.take.visible & ~(np.abs(detected.take.markers - truth.markers).max(-1) < 1e-4), detected
