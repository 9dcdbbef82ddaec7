"""Benchmark of labelling: labels are taken away from takes whose labels are known, and found again.

Each take is damaged in every way of `synthetic.unlabelled_takes`. Pairs of takes are also put together, as two people beside each
other and crossing. The recall is the share of the markers' samples that have their own label again, the precision the share of
the labelled samples whose label is right, and F1 their harmonic mean. With several people the label includes the person.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from time import process_time
from typing import NamedTuple, get_args

import numpy as np
from jaxtyping import Float, Int

from mocapfix import synthetic
from mocapfix.animation import Animation
from mocapfix.errors import ReadError, SceneError
from mocapfix.labelling.labeller import label_points
from mocapfix.labelling.linking import find_tracklets
from mocapfix.labelling.points import PointLabels, UnlabelledPoints
from mocapfix.labelling.several_people import label_people, separate_people
from mocapfix.marker_set import MarkerSet
from mocapfix.marker_sets.library import choose_marker_set, load_marker_set
from mocapfix.read.capture import read_capture
from mocapfix.synthetic.two_people import place_two_people
from mocapfix.synthetic.unlabelled_takes import UnlabelledKind, remove_labels

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
    """How well the labels of one take were found again.

    kind, take             what was done to which take
    purity                 share of the samples whose tracklet mostly shows their marker
    tracklets              number of tracklets
    recall, precision, f1  of the labels
    seconds_per_second     processor time for a second of motion
    """

    kind: str
    take: str
    purity: float
    tracklets: int
    recall: float
    precision: float
    f1: float
    seconds_per_second: float


def measure_label_recovery(
    captures: Path | None = None, seed: int = 0, report_progress: Callable[[str], None] | None = None
) -> list[LabelScore]:
    """Measure how well labels are found again in composed takes, or in the C3D files of a folder with a known marker set.

    Raises ReadError if the folder holds no such file.
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
        take = synthetic.compose_take(seed, COMPOSED_DURATION_S, COMPOSED_RATE_HZ, asymmetric=True)
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
    labels, _ = separate_people(label_people(points, take.marker_set, label_points), take.marker_set.labels)
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
