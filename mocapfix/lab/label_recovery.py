"""Benchmark of labelling: labels are taken away from takes whose labels are known, and found again.

The recall is the share of the markers' samples that have their own label again, the precision the share of the labelled samples
whose label is right, and F1 their harmonic mean. With several people the label includes the person. Two people are put together
beside each other, and crossing.

Trajectories end where a marker is lost, and at random besides. The random damage per frame is the test noise of SOMA (Ghorbani &
Black 2021): per frame a few markers are missing, a few ghosts are drawn from a normal distribution about the body, and the
columns are permuted; in the harder variant a number of trajectories are broken too.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from time import process_time
from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float, Int

from mocapfix.errors import ReadError, SceneError
from mocapfix.io.capture import read_capture
from mocapfix.labels.labeller import label_people, separate_people
from mocapfix.labels.tracklets import PointLabels, UnlabelledPoints, find_tracklets
from mocapfix.model.animation import Animation
from mocapfix.model.marker_set import MarkerSet
from mocapfix.stats.sequences import find_runs
from mocapfix.subject.library import choose_marker_set, load_marker_set
from mocapfix.synthetic import compose_take

SHIFT_STEP_M = 0.05  # in which the distance of the second person is found
MAX_SHIFT_M = 20.0
HALF_TURN = np.diag([-1.0, 1.0, -1.0])  # about the vertical axis
PERSON_NAMES = ("P1", "P2")


@dataclass(frozen=True)
class TwoPersonTake:
    """The markers of two people: those of the first, then those of the second."""

    markers: Float[np.ndarray, "T M 3"]  # metres, Y up
    labels: tuple[str, ...]  # M labels with the names of the people before them
    first_count: int  # number of markers of the first person


def place_two_people(
    first: Float[np.ndarray, "T1 M1 3"],
    second: Float[np.ndarray, "T2 M2 3"],
    labels: tuple[tuple[str, ...], tuple[str, ...]],
    distance_m: float = 1.0,
    *,
    crossing: bool = False,
) -> TwoPersonTake:
    """Return the markers of two people, of the frames that both have, with a smallest distance between their centres.

    Args:
        first: Markers (metres, Y up, NaN where missing) of the first person, who stays in place.
        second: Those of the second person.
        labels: Their labels.
        distance_m: Smallest horizontal distance between the centres of their markers.
        crossing: Turn the second person round, so that both pass each other in the middle of the take; otherwise the second
            person is beside the first.
    """
    frame_count = min(len(first), len(second))
    first, second = first[:frame_count], second[:frame_count] @ (HALF_TURN if crossing else np.eye(3))
    one, other = _compute_centres(first), _compute_centres(second)
    frames = slice(frame_count // 2, frame_count // 2 + 1) if crossing else slice(None)
    alignment = np.nanmean(one[frames], axis=0) - np.nanmean(other[frames], axis=0)
    path = one - np.nanmean(one, axis=0)
    _, _, axes = np.linalg.svd(path[~np.isnan(path[:, 0])], full_matrices=False)
    for shift_m in np.arange(0.0, MAX_SHIFT_M, SHIFT_STEP_M):
        shift = alignment + shift_m * axes[1]  # across the direction in which the first person mostly moves
        if np.nanmin(np.linalg.norm(other + shift - one, axis=1)) >= distance_m:
            markers = np.concatenate([first, second + np.array([shift[0], 0.0, shift[1]])], 1)
            names = [f"{name}:{label}" for name, own in zip(PERSON_NAMES, labels, strict=True) for label in own]
            return TwoPersonTake(markers, tuple(names), first.shape[1])
    raise SceneError(f"The two people cannot be placed {distance_m:g} m apart.")


def _compute_centres(markers: np.ndarray) -> np.ndarray:
    """Return the horizontal centre (T, 2) of the markers of each frame."""
    return np.nanmedian(markers[..., [0, 2]], axis=1)


UnlabelledKind = Literal["tracks", "ghosts", "cloud", "noise", "broken"]
"""trajectories; with ghosts; points in random order in each frame; random damage per frame; the same with broken trajectories"""

TRAJECTORY_LIFE_S = 20.0  # mean time until a trajectory is cut at random
CUT_DURATION_S = (0.02, 0.3)  # for which the marker is lost at a cut
GHOST_INTERVAL_S = 2.0  # mean time between ghosts
GHOST_DURATION_S = (0.05, 1.0)
GHOST_DISTANCE_M = (0.1, 0.5)  # from the marker that a ghost follows
MAX_FRAME_OCCLUSIONS = 4  # markers missing at random in a frame
MAX_FRAME_GHOSTS = 3  # ghosts drawn at random in a frame
BROKEN_TRAJECTORIES = 50
MIN_BROKEN_S = 0.05  # shortest piece of a broken trajectory


@dataclass(frozen=True)
class UnlabelledTake:
    """Points without labels, and what they show."""

    points: Float[np.ndarray, "T C 3"]  # metres, NaN where missing
    # (T, C) index of the marker that each point shows, -1 for a ghost or where there is no point
    marker_indices: Int[np.ndarray, "T C"]
    rate: float  # Hz


def remove_labels(kind: UnlabelledKind, markers: Float[np.ndarray, "T M 3"], rate: float, seed: int = 0) -> UnlabelledTake:
    """Return the points of markers (metres, NaN where missing) without their labels; the same for the same arguments."""
    rng = np.random.default_rng(seed)
    if kind in ("noise", "broken"):
        return _add_frame_noise(rng, markers, rate, BROKEN_TRAJECTORIES if kind == "broken" else 0)
    take = _cut_trajectories(rng, markers, rate)
    if kind == "ghosts":
        take = _add_ghosts(rng, take, markers)
    return _shuffle_frames(rng, take, markers.shape[1]) if kind == "cloud" else _permute_columns(rng, take)


def _cut_trajectories(rng: np.random.Generator, markers: np.ndarray, rate: float) -> UnlabelledTake:
    """Return a column for each trajectory: the runs in which a marker is visible, cut at random."""
    pieces: list[tuple[int, int, int]] = []
    for m in range(markers.shape[1]):
        for first, last in find_runs(~np.isnan(markers[:, m, 0])):
            start = first
            while start <= last:
                end = min(last, start + max(2, round(rng.exponential(TRAJECTORY_LIFE_S) * rate)))
                pieces.append((m, start, end))
                start = end + 1 + max(1, round(rng.uniform(*CUT_DURATION_S) * rate))
    points = np.full((len(markers), len(pieces), 3), np.nan)
    marker_indices = np.full(points.shape[:2], -1)
    for column, (m, first, last) in enumerate(pieces):
        points[first : last + 1, column] = markers[first : last + 1, m]
        marker_indices[first : last + 1, column] = m
    return UnlabelledTake(points, marker_indices, rate)


def _add_ghosts(rng: np.random.Generator, take: UnlabelledTake, markers: np.ndarray) -> UnlabelledTake:
    """Add columns with points that follow a marker at a constant distance for a while."""
    frame_count, ghosts = len(markers), list[np.ndarray]()
    for _ in range(rng.poisson(frame_count / take.rate / GHOST_INTERVAL_S)):
        length = min(frame_count, max(2, round(rng.uniform(*GHOST_DURATION_S) * take.rate)))
        first, direction = int(rng.integers(0, frame_count - length + 1)), rng.normal(size=3)
        offset = direction / np.linalg.norm(direction) * rng.uniform(*GHOST_DISTANCE_M)
        ghost = np.full((frame_count, 3), np.nan)
        ghost[first : first + length] = markers[first : first + length, rng.integers(markers.shape[1])] + offset
        if not np.isnan(ghost[first : first + length]).any():
            ghosts.append(ghost)
    return _append_columns(take, np.stack(ghosts, 1)) if ghosts else take


def _append_columns(take: UnlabelledTake, points: np.ndarray) -> UnlabelledTake:
    """Add points (T, N, 3) that are no markers."""
    marker_indices = np.full(points.shape[:2], -1)
    return replace(
        take,
        points=np.concatenate([take.points, points], 1),
        marker_indices=np.concatenate([take.marker_indices, marker_indices], 1),
    )


def _permute_columns(rng: np.random.Generator, take: UnlabelledTake) -> UnlabelledTake:
    order = rng.permutation(take.points.shape[1])
    return replace(take, points=take.points[:, order], marker_indices=take.marker_indices[:, order])


def _shuffle_frames(rng: np.random.Generator, take: UnlabelledTake, column_count: int) -> UnlabelledTake:
    """Return the points of each frame in random order in at most `column_count` columns."""
    points = np.full((len(take.points), column_count, 3), np.nan)
    marker_indices = np.full(points.shape[:2], -1)
    for t in range(len(points)):
        present = np.flatnonzero(~np.isnan(take.points[t, :, 0]))
        columns = rng.permutation(column_count)[: len(present)]
        points[t, columns], marker_indices[t, columns] = take.points[t, present], take.marker_indices[t, present]
    return UnlabelledTake(points, marker_indices, take.rate)


def _add_frame_noise(rng: np.random.Generator, markers: np.ndarray, rate: float, broken_count: int) -> UnlabelledTake:
    """Return the markers in random columns with random occlusions and ghosts in each frame, and with broken trajectories."""
    frame_count, marker_count = markers.shape[:2]
    points, ghosts = markers.copy(), np.full((frame_count, MAX_FRAME_GHOSTS, 3), np.nan)
    for t in range(frame_count):
        points[t, rng.permutation(marker_count)[: rng.integers(MAX_FRAME_OCCLUSIONS + 1)]] = np.nan
        present = markers[t][~np.isnan(markers[t, :, 0])]
        count = rng.integers(MAX_FRAME_GHOSTS + 1) if len(present) > 1 else 0
        ghosts[t, rng.permutation(MAX_FRAME_GHOSTS)[:count]] = rng.multivariate_normal(
            np.median(present, axis=0) if len(present) else np.zeros(3), np.cov(present.T) if count else np.eye(3), count
        )
    marker_indices = np.where(np.isnan(points[..., 0]), -1, np.arange(marker_count))
    pieces, piece_indices = [points], [marker_indices]
    for _ in range(broken_count):
        m, first = int(rng.integers(marker_count)), int(rng.integers(frame_count))
        last = min(frame_count - 1, first + max(round(MIN_BROKEN_S * rate), int(rng.integers(1, frame_count // 2 + 2))))
        piece, index = np.full((frame_count, 1, 3), np.nan), np.full((frame_count, 1), -1)
        piece[first : last + 1, 0], index[first : last + 1, 0] = points[first : last + 1, m], marker_indices[first : last + 1, m]
        points[first : last + 1, m], marker_indices[first : last + 1, m] = np.nan, -1
        pieces.append(piece)
        piece_indices.append(index)
    take = UnlabelledTake(np.concatenate(pieces, 1), np.concatenate(piece_indices, 1), rate)
    return _permute_columns(rng, _append_columns(take, ghosts))


COMPOSED_TAKE_COUNT = 3
COMPOSED_DURATION_S = 10.0
COMPOSED_RATE_HZ = 120.0
COMPOSED_MARKER_SET = "cmu41"
TWO_PEOPLE = {"two people": (1.0, False), "two people crossing": (0.6, True)}
"""smallest distance in metres of two people, and whether they cross"""


class LabelledMarkers(NamedTuple):
    """The markers (T, M, 3) in metres of a take in which every label is known, as indices (M,) of its marker set."""

    name: str
    markers: Float[np.ndarray, "T M 3"]
    set_indices: Int[np.ndarray, " M"]
    marker_set: MarkerSet
    rate: float


@dataclass(frozen=True)
class LabelScore:
    """How well the labels of one take were found again."""

    kind: str  # kind, take: what was done to which take
    take: str
    purity: float  # share of the samples whose tracklet mostly shows their marker
    tracklets: int  # number of tracklets
    recall: float  # recall, precision, f1: of the labels
    precision: float
    f1: float
    seconds_per_second: float  # processor time for a second of motion


def measure_label_recovery(
    captures: Path | None = None, seed: int = 0, report_progress: Callable[[str], None] | None = None
) -> list[LabelScore]:
    """Measure how well labels are found again in composed takes, or in the C3D files of a folder with a known marker set.

    Raises:
        ReadError: If the folder holds no such file.
    """
    takes = list(iterate_captures(captures) if captures else compose_takes())
    if not takes:
        raise ReadError(f"{captures}: holds no C3D file of a whole body with the labels of a shipped marker set.")
    scores: list[LabelScore] = []
    for take in takes:
        for kind in get_args(UnlabelledKind):
            if report_progress:
                report_progress(f"{take.name}, {kind}")
            scores.append(score_labels(kind, take, seed))
    for one, other in pairwise(takes):
        for kind, (distance_m, crossing) in TWO_PEOPLE.items():
            if one.marker_set.name == other.marker_set.name and one.rate == other.rate:
                if report_progress:
                    report_progress(f"{one.name} and {other.name}, {kind}")
                both = _place(one, other, distance_m, crossing)
                scores += [score_labels("cloud", both, seed, kind)] if both else []
    return scores


def summarise_label_scores(scores: Iterable[LabelScore]) -> dict[str, dict[str, float]]:
    """Return the means by kind, the worst F1, and the number of takes."""
    rows: dict[str, dict[str, float]] = {}
    scores = list(scores)
    for kind in dict.fromkeys(score.kind for score in scores):
        own = [score for score in scores if score.kind == kind]
        names = ("purity", "tracklets", "recall", "precision", "f1", "seconds_per_second")
        means = {name: float(np.mean([getattr(score, name) for score in own])) for name in names}
        rows[kind] = {"takes": len(own), **means, "worst_f1": min(score.f1 for score in own)}
    return rows


def compose_takes() -> Iterator[LabelledMarkers]:
    """Yield composed takes with gaps and without spikes."""
    marker_set = load_marker_set(COMPOSED_MARKER_SET)
    for seed in range(COMPOSED_TAKE_COUNT):
        take = compose_take(seed, COMPOSED_DURATION_S, COMPOSED_RATE_HZ, asymmetric=True)
        markers = np.where(take.missing_mask[..., None], np.nan, take.marker_positions)
        yield LabelledMarkers(f"seed {seed}", markers, np.arange(len(take.labels)), marker_set, take.rate)


def iterate_captures(folder: Path) -> Iterator[LabelledMarkers]:
    """Yield the markers of the C3D files below a folder in whose labels a shipped set finds a whole body."""
    for path in sorted(folder.rglob("*.c3d")):
        try:
            take = read_capture(path)
        except ReadError:  # such as a deliberately broken file
            continue
        marker_set = None if isinstance(take, Animation) else choose_marker_set(take.labels).marker_set
        if isinstance(take, Animation) or marker_set is None:
            continue
        found = marker_set.match_labels(take.labels)
        if not marker_set.describe_incomplete_body(found):
            indices = np.array([marker_set.labels.index(label) for label in found])
            yield LabelledMarkers(path.stem, take.markers[:, list(found.values())], indices, marker_set, take.rate)


def score_labels(kind: UnlabelledKind, take: LabelledMarkers, seed: int, name: str | None = None) -> LabelScore:
    """Take the labels of a take away, label it, and compare. `name` is the kind in the table if it is another."""
    unlabelled = remove_labels(kind, take.markers, take.rate, seed)
    start_s = process_time()
    points = find_tracklets(unlabelled.points, take.rate)
    labels, _ = separate_people(label_people(points, take.marker_set), take.marker_set.labels)
    seconds_per_second = (process_time() - start_s) * take.rate / len(take.markers)
    is_marker, is_labelled = unlabelled.marker_indices >= 0, labels.marker_indices >= 0
    right = count_right_labels(np.append(take.set_indices, -1)[unlabelled.marker_indices], labels, len(take.marker_set.labels))
    recall, precision = right / max(1, is_marker.sum()), right / max(1, is_labelled.sum())
    f1 = 2 * right / max(1, is_marker.sum() + is_labelled.sum())
    purity = compute_tracklet_purity(points, unlabelled.marker_indices)
    return LabelScore(name or kind, take.name, purity, points.tracklet_count, recall, precision, f1, seconds_per_second)


def count_right_labels(true_indices: Int[np.ndarray, "T C"], labels: PointLabels, set_size: int) -> int:
    """Return the number of right labels, for the better of both names of two people.

    Indices are those of the set, for the second person from `set_size` on.
    """
    found = labels.marker_indices
    turned = np.where(found >= set_size, found - set_size, found + set_size)
    return max(int(((each == true_indices) & (found >= 0)).sum()) for each in (found, turned))


def compute_tracklet_purity(points: UnlabelledPoints, marker_indices: Int[np.ndarray, "T C"]) -> float:
    """Return the share of the points whose tracklet mostly shows the same marker, or a ghost (-1), as they do."""
    is_point = points.tracklet_indices >= 0
    sources = marker_indices.max(initial=-1) + 2
    pairs = points.tracklet_indices[is_point].astype(int) * sources + marker_indices[is_point] + 1
    counts = np.bincount(pairs, minlength=points.tracklet_count * sources).reshape(points.tracklet_count, sources)
    return float(counts.max(1).sum() / max(1, counts.sum()))


def _place(one: LabelledMarkers, other: LabelledMarkers, distance_m: float, crossing: bool) -> LabelledMarkers | None:
    """Return both people in one take, None if they cannot be that far apart."""
    labels = tuple(tuple(each.marker_set.labels[k] for k in each.set_indices) for each in (one, other))
    try:
        both = place_two_people(one.markers, other.markers, (labels[0], labels[1]), distance_m, crossing=crossing)
    except SceneError:
        return None
    indices = np.concatenate([one.set_indices, other.set_indices + len(other.marker_set.labels)])
    return LabelledMarkers(f"{one.name} and {other.name}", both.markers, indices, one.marker_set, one.rate)
