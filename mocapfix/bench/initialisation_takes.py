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

from mocapfix import marker_sets, pipeline, synthetic
from mocapfix.bench.sound_takes import PerformedMotion, read_performed_motions
from mocapfix.calibrate import calibration
from mocapfix.detect.sample_faults import detect_sample_faults
from mocapfix.errors import ReadError
from mocapfix.marker_sets import MarkerSet
from mocapfix.motion import Motion
from mocapfix.pose_prior import mean_pose
from mocapfix.read import capture
from mocapfix.skeleton import load_cmu31_body
from mocapfix.subject import Subject
from mocapfix.synthetic.synthetic_takes import draw_subject, simulate_markers
from mocapfix.take import Take

SINGLE_GAP_SHARE, MIN_SINGLE_GAP_S, MAX_SINGLE_GAP_S = 0.1, 0.1, 2.0  # of the samples, and seconds: gaps of single markers
GROUP_LOSS_INTERVAL_S, GROUP_LOSS_DURATION_S = 1.0, 0.5  # seconds: how often markers are lost together, and for how long
LOST_MARKER_SHARE = 0.5  # of the markers
GHOST_SD_M = 0.4  # metres per axis: how far off a label's ghost is


class InitialisationTake(NamedTuple):
    """A take as the body's K markers (T, K, 3), and the calibrated body; where that is known, where the joints (T, J, 3) were,
    and the true motion, of a body that was a little different.
    """

    name: str
    take: Take
    subject: Subject
    true_joint_positions: np.ndarray | None
    true_motion: Motion | None


def compose_initialisation_takes(seeds: Iterable[int]) -> Iterator[InitialisationTake]:
    """Yield mocapfix's own takes with their gaps, without the samples that jump."""
    for seed in seeds:
        truth = synthetic.compose_take(seed, asymmetric=True)
        take = Take(np.where(truth.spike_mask[..., None], np.nan, truth.damaged_positions), truth.labels, truth.rate)
        yield InitialisationTake(
            f"seed {seed}", take, calibrate_take(take, marker_sets.load_marker_set("cmu41")), truth.joint_positions, truth.motion
        )


def perform_test_recordings(motion_folder: Path) -> Iterator[InitialisationTake]:
    """Yield the recordings of the test people, undamaged, in the CMU marker set; each calibrated from all that one performs.

    Raises ReadError where `data` holds no test.npz of motion.
    """
    for number, (_, theirs) in enumerate(
        groupby(read_performed_motions(motion_folder / "test.npz"), lambda each: each.name.split("_")[0])
    ):
        yield from perform_subject_recordings(list(theirs), np.random.default_rng(number))


def perform_subject_recordings(theirs: list[PerformedMotion], rng: np.random.Generator) -> Iterator[InitialisationTake]:
    """Yield one person's performances, a body being drawn for them."""
    body = draw_subject(rng, asymmetric=True)
    shown = [simulate_markers(rng, body, each.motion, each.rate_hz) for each in theirs]
    together = Take(np.concatenate([markers for _, markers in shown]), body.labels, theirs[0].rate_hz)
    known = calibrate_take(together, marker_sets.load_marker_set("cmu41"))
    for each, (joints, markers) in zip(theirs, shown, strict=True):
        yield InitialisationTake(each.name, Take(markers, body.labels, each.rate_hz), known, joints, each.motion)


def damage_takes(
    cases: Iterable[InitialisationTake], draw_losses: Callable[[InitialisationTake, np.random.Generator], np.ndarray]
) -> Iterator[InitialisationTake]:
    """Yield cases without the samples that are `lost`."""
    for number, case in enumerate(cases):
        gone = draw_losses(case, np.random.default_rng(number))
        yield case._replace(worn=case.take.replace_markers(np.where(gone[..., None], np.nan, case.take.markers)))


def draw_single_gaps(case: InitialisationTake, rng: np.random.Generator) -> np.ndarray:
    """-> (T, K) bool: a part of the samples, in gaps of single markers, short ones more often than long ones."""
    gone, rate = np.zeros_like(case.take.visible), case.take.rate
    while gone.mean() < SINGLE_GAP_SHARE:
        length = round(rate * MIN_SINGLE_GAP_S * (MAX_SINGLE_GAP_S / MIN_SINGLE_GAP_S) ** rng.random())
        first = rng.integers(1 - length, len(gone))
        gone[max(0, first) : first + length, rng.integers(gone.shape[1])] = True
    return gone


def draw_segment_losses(case: InitialisationTake, rng: np.random.Generator) -> np.ndarray:
    """-> (T, K) bool: now and again all markers of a segment, another every time."""
    return draw_group_losses(case, lambda: case.subject.joints == rng.choice(np.unique(case.subject.joints)))


def draw_pelvis_losses(case: InitialisationTake, rng: np.random.Generator) -> np.ndarray:
    """-> (T, K) bool: now and again all markers of the pelvis."""
    return draw_group_losses(case, lambda: case.subject.joints == 0)


def draw_half_losses(case: InitialisationTake, rng: np.random.Generator) -> np.ndarray:
    """-> (T, K) bool: now and again half of the markers, others every time."""
    return draw_group_losses(case, lambda: rng.random(len(case.subject.joints)) < LOST_MARKER_SHARE)


def add_ghosts(cases: Iterable[InitialisationTake]) -> Iterator[InitialisationTake]:
    """Yield cases in which now and again one marker is somewhere else, another every time: its label has jumped to a ghost."""
    for number, case in enumerate(cases):
        rng, labels = np.random.default_rng(number), np.arange(len(case.subject.joints))
        jumped = draw_group_losses(case, lambda rng=rng, labels=labels: labels == rng.integers(len(labels)))
        ghosts = rng.normal(0, GHOST_SD_M, (len(labels), 3))
        yield case._replace(worn=case.take.replace_markers(case.take.markers + jumped[..., None] * ghosts))


def draw_group_losses(case: InitialisationTake, choose_markers: Callable[[], np.ndarray]) -> np.ndarray:
    """-> (T, K) bool: `which` (K,) markers are lost FOR seconds of EVERY so many, in the middle of these."""
    gone, rate = np.zeros_like(case.take.visible), case.take.rate
    for begin in np.arange(
        (GROUP_LOSS_INTERVAL_S - GROUP_LOSS_DURATION_S) / 2, case.take.frame_count / rate, GROUP_LOSS_INTERVAL_S
    ):
        gone[round(begin * rate) : round((begin + GROUP_LOSS_DURATION_S) * rate), choose_markers()] = True
    return gone


MARKER_LOSSES = {
    "gaps": draw_single_gaps,
    "a segment lost": draw_segment_losses,
    "the pelvis lost": draw_pelvis_losses,
    "half lost": draw_half_losses,
}


def read_captures(folder: Path) -> Iterator[InitialisationTake]:
    """Yield the captures in a folder that wear a known marker set. Raises ReadError where there is none."""
    found = False
    for path in sorted(folder.glob("*.c3d")):
        take = capture.read_take(path)
        _, worn_set, _ = pipeline.select_subject(take, None, None)
        if worn_set is not None:
            found, heard = (
                True,
                take.select(worn_set.find_columns(take.labels), detect_sample_faults(take).compute_solver_mask(take)),
            )
            yield InitialisationTake(path.stem, heard, calibrate_take(heard, worn_set), None, None)
    if not found:
        raise ReadError(f"{folder}: holds no capture (.c3d) that wears a known marker set.")


def calibrate_take(take: Take, marker_set: MarkerSet) -> Subject:
    """-> the body that calibration finds in a take."""
    body = load_cmu31_body()
    return calibration.calibrate_subject(take, marker_set, body, mean_pose.load_mean_pose_prior("mean-pose", body.skeleton))
