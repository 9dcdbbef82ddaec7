"""The takes on which starts are compared.

Composed takes have gaps and spikes and need nothing but mocapfix. Performed ones are recordings of people whom no model was
trained on, acrobats among them, each put on by one drawn person whose skin slides; their markers are lost, or jump, in ways
that are hard on a start. Captures are whatever somebody recorded, and nobody knows the truth of them. In all of them the body
that is solved is the one that calibration finds, and so not quite the one that there is.
"""

from collections.abc import Callable, Iterable, Iterator
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mocapfix import calibrate, detect, marker_set, pipeline, prior, read, synthetic
from mocapfix.bench.limb import Performance, performed
from mocapfix.errors import ReadError
from mocapfix.marker_set import MarkerSet
from mocapfix.motion import Motion
from mocapfix.skeleton import cmu31
from mocapfix.subject import Subject
from mocapfix.synthetic.truth import person, worn
from mocapfix.take import Take

SHARE, SHORTEST, LONGEST = 0.1, 0.1, 2.0  # of the samples, and seconds: gaps of single markers
EVERY, FOR = 1.0, 0.5  # seconds: how often markers are lost together, and for how long
HALF = 0.5  # of the markers
THROWN = 0.4  # metres per axis: how far off a label's ghost is


class Case(NamedTuple):
    """A take as the body's K markers (T, K, 3), and the calibrated body; where that is known, where the joints (T, J, 3) were,
    and the true motion, of a body that was a little different.
    """

    name: str
    worn: Take
    subject: Subject
    joints: np.ndarray | None
    motion: Motion | None


def composed(seeds: Iterable[int]) -> Iterator[Case]:
    """Yield mocapfix's own takes with their gaps, without the samples that jump."""
    for seed in seeds:
        truth = synthetic.take(seed, crooked=True)
        take = Take(np.where(truth.moved[..., None], np.nan, truth.damaged), truth.labels, truth.rate)
        yield Case(f"seed {seed}", take, calibrated(take, marker_set.load("cmu41")), truth.joints, truth.motion)


def whole(data: Path) -> Iterator[Case]:
    """Yield the recordings of the test people, undamaged, in the CMU marker set; each calibrated from all that one performs.

    Raises ReadError where `data` holds no test.npz of motion.
    """
    for number, (_, theirs) in enumerate(groupby(performed(data / "test.npz"), lambda each: each.name.split("_")[0])):
        yield from performances(list(theirs), np.random.default_rng(number))


def performances(theirs: list[Performance], rng: np.random.Generator) -> Iterator[Case]:
    """Yield one person's performances, a body being drawn for them."""
    body = person(rng, crooked=True)
    shown = [worn(rng, body, each.motion, each.rate) for each in theirs]
    together = Take(np.concatenate([markers for _, markers in shown]), body.labels, theirs[0].rate)
    known = calibrated(together, marker_set.load("cmu41"))
    for each, (joints, markers) in zip(theirs, shown, strict=True):
        yield Case(each.name, Take(markers, body.labels, each.rate), known, joints, each.motion)


def damaged(cases: Iterable[Case], lost: Callable[[Case, np.random.Generator], np.ndarray]) -> Iterator[Case]:
    """Yield cases without the samples that are `lost`."""
    for number, case in enumerate(cases):
        gone = lost(case, np.random.default_rng(number))
        yield case._replace(worn=case.worn.with_markers(np.where(gone[..., None], np.nan, case.worn.markers)))


def in_gaps(case: Case, rng: np.random.Generator) -> np.ndarray:
    """-> (T, K) bool: a part of the samples, in gaps of single markers, short ones more often than long ones."""
    gone, rate = np.zeros_like(case.worn.seen), case.worn.rate
    while gone.mean() < SHARE:
        length = round(rate * SHORTEST * (LONGEST / SHORTEST) ** rng.random())
        first = rng.integers(1 - length, len(gone))
        gone[max(0, first) : first + length, rng.integers(gone.shape[1])] = True
    return gone


def of_a_segment(case: Case, rng: np.random.Generator) -> np.ndarray:
    """-> (T, K) bool: now and again all markers of a segment, another every time."""
    return now_and_again(case, lambda: case.subject.joints == rng.choice(np.unique(case.subject.joints)))


def of_the_pelvis(case: Case, rng: np.random.Generator) -> np.ndarray:
    """-> (T, K) bool: now and again all markers of the pelvis."""
    return now_and_again(case, lambda: case.subject.joints == 0)


def half(case: Case, rng: np.random.Generator) -> np.ndarray:
    """-> (T, K) bool: now and again half of the markers, others every time."""
    return now_and_again(case, lambda: rng.random(len(case.subject.joints)) < HALF)


def with_ghosts(cases: Iterable[Case]) -> Iterator[Case]:
    """Yield cases in which now and again one marker is somewhere else, another every time: its label has jumped to a ghost."""
    for number, case in enumerate(cases):
        rng, labels = np.random.default_rng(number), np.arange(len(case.subject.joints))
        jumped = now_and_again(case, lambda rng=rng, labels=labels: labels == rng.integers(len(labels)))
        ghosts = rng.normal(0, THROWN, (len(labels), 3))
        yield case._replace(worn=case.worn.with_markers(case.worn.markers + jumped[..., None] * ghosts))


def now_and_again(case: Case, which: Callable[[], np.ndarray]) -> np.ndarray:
    """-> (T, K) bool: `which` (K,) markers are lost FOR seconds of EVERY so many, in the middle of these."""
    gone, rate = np.zeros_like(case.worn.seen), case.worn.rate
    for begin in np.arange((EVERY - FOR) / 2, case.worn.frames / rate, EVERY):
        gone[round(begin * rate) : round((begin + FOR) * rate), which()] = True
    return gone


LOSSES = {"gaps": in_gaps, "a segment lost": of_a_segment, "the pelvis lost": of_the_pelvis, "half lost": half}


def captured(folder: Path) -> Iterator[Case]:
    """Yield the captures in a folder that wear a known marker set. Raises ReadError where there is none."""
    found = False
    for path in sorted(folder.glob("*.c3d")):
        take = read.take(path)
        _, worn_set, _ = pipeline.wearing(take, None, None)
        if worn_set is not None:
            found, heard = True, take.worn(worn_set.columns(take.labels), detect.faults(take).heard(take))
            yield Case(path.stem, heard, calibrated(heard, worn_set), None, None)
    if not found:
        raise ReadError(f"{folder}: holds no capture (.c3d) that wears a known marker set.")


def calibrated(take: Take, worn_set: MarkerSet) -> Subject:
    """-> the body that calibration finds in a take."""
    body = cmu31()
    return calibrate.subject(take, worn_set, body, prior.load("mean-pose", body.skeleton))
