"""The takes on which starts of the solver are compared.

Composed takes have gaps and spikes and need no data. Performed takes are recordings of subjects that no model was trained on,
acrobats included, performed by a random body with skin motion; their markers are removed, or jump, in ways that are difficult for
a start. Captures are recorded takes without known truth. In all of them the solver uses the calibrated body, which differs a
little from the true one.
"""

from collections.abc import Callable, Iterable, Iterator
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from mocapfix import marker_sets, synthetic
from mocapfix.bench.sound_takes import PerformedMotion, read_performed_motions
from mocapfix.calibrate import calibration
from mocapfix.detect.sample_faults import detect_sample_faults
from mocapfix.errors import ReadError
from mocapfix.marker_set import MarkerSet
from mocapfix.marker_sets.library import resolve_subject
from mocapfix.motion import Motion
from mocapfix.options import SubjectOptions
from mocapfix.pose_prior.mean_pose import load_mean_pose_prior
from mocapfix.read import capture
from mocapfix.skeleton import load_cmu31_body
from mocapfix.subject import Subject
from mocapfix.synthetic.synthetic_takes import draw_subject, simulate_markers
from mocapfix.take import Take

SINGLE_GAP_SHARE = 0.1  # fraction of the samples that is missing in gaps of single markers
MIN_SINGLE_GAP_S = 0.1
MAX_SINGLE_GAP_S = 2.0
GROUP_LOSS_INTERVAL_S = 1.0  # interval between losses of several markers
GROUP_LOSS_DURATION_S = 0.5
LOST_MARKER_SHARE = 0.5  # fraction of the markers that is lost at the same time
GHOST_SD_M = 0.4  # per axis: distance of a ghost


class InitialisationTake(NamedTuple):
    """A take of the body's K markers and the calibrated body; and if known, the true joint positions (T, J, 3) and motion.

    The true motion is that of a slightly different body.
    """

    name: str
    take: Take
    subject: Subject
    true_joint_positions: np.ndarray | None
    true_motion: Motion | None


MarkerLoss = Callable[[InitialisationTake, np.random.Generator], Bool[np.ndarray, "T K"]]


def compose_initialisation_takes(seeds: Iterable[int]) -> Iterator[InitialisationTake]:
    """Yield composed takes with gaps, without the samples of spikes."""
    for seed in seeds:
        truth = synthetic.compose_take(seed, asymmetric=True)
        markers = np.where(truth.spike_mask[..., None], np.nan, truth.damaged_positions)
        take = Take(markers, truth.labels, truth.rate)
        subject = calibrate_take(take, marker_sets.load_marker_set("cmu41"))
        yield InitialisationTake(f"seed {seed}", take, subject, truth.joint_positions, truth.motion)


def perform_test_recordings(motion_folder: Path) -> Iterator[InitialisationTake]:
    """Yield the undamaged recordings of the test subjects in the CMU marker set, calibrated on all recordings of each subject.

    Raises ReadError if the folder has no test.npz of motion.
    """
    recordings = groupby(read_performed_motions(motion_folder / "test.npz"), lambda each: each.name.split("_")[0])
    for number, (_, performances) in enumerate(recordings):
        yield from perform_subject_recordings(list(performances), np.random.default_rng(number))


def perform_subject_recordings(performances: list[PerformedMotion], rng: np.random.Generator) -> Iterator[InitialisationTake]:
    """Yield the performances of one subject with a random body."""
    body = draw_subject(rng, asymmetric=True)
    simulated = [simulate_markers(rng, body, each.motion, each.rate_hz) for each in performances]
    all_markers = np.concatenate([markers for _, markers in simulated])
    calibrated = calibrate_take(Take(all_markers, body.labels, performances[0].rate_hz), marker_sets.load_marker_set("cmu41"))
    for performance, (joint_positions, markers) in zip(performances, simulated, strict=True):
        take = Take(markers, body.labels, performance.rate_hz)
        yield InitialisationTake(performance.name, take, calibrated, joint_positions, performance.motion)


def damage_takes(cases: Iterable[InitialisationTake], draw_losses: MarkerLoss) -> Iterator[InitialisationTake]:
    """Yield takes without the samples that `draw_losses` returns."""
    for number, case in enumerate(cases):
        is_lost = draw_losses(case, np.random.default_rng(number))
        yield case._replace(take=case.take.replace_markers(np.where(is_lost[..., None], np.nan, case.take.markers)))


def draw_single_gaps(case: InitialisationTake, rng: np.random.Generator) -> Bool[np.ndarray, "T K"]:
    """Return gaps of single markers of log-uniform duration."""
    is_lost, rate = np.zeros_like(case.take.visible), case.take.rate
    while is_lost.mean() < SINGLE_GAP_SHARE:
        length = round(rate * MIN_SINGLE_GAP_S * (MAX_SINGLE_GAP_S / MIN_SINGLE_GAP_S) ** rng.random())
        first = rng.integers(1 - length, len(is_lost))
        is_lost[max(0, first) : first + length, rng.integers(is_lost.shape[1])] = True
    return is_lost


def draw_segment_losses(case: InitialisationTake, rng: np.random.Generator) -> Bool[np.ndarray, "T K"]:
    """Return repeated losses of all markers of a segment, each time another one."""
    return draw_group_losses(case, lambda: case.subject.joints == rng.choice(np.unique(case.subject.joints)))


def draw_pelvis_losses(case: InitialisationTake, rng: np.random.Generator) -> Bool[np.ndarray, "T K"]:
    """Return repeated losses of all markers of the pelvis."""
    return draw_group_losses(case, lambda: case.subject.joints == 0)


def draw_half_losses(case: InitialisationTake, rng: np.random.Generator) -> Bool[np.ndarray, "T K"]:
    """Return repeated losses of half of the markers, each time others."""
    return draw_group_losses(case, lambda: rng.random(len(case.subject.joints)) < LOST_MARKER_SHARE)


def add_ghosts(cases: Iterable[InitialisationTake]) -> Iterator[InitialisationTake]:
    """Yield takes in which the label of one marker jumps to a ghost repeatedly, each time another marker."""
    for number, case in enumerate(cases):
        rng, marker_index = np.random.default_rng(number), np.arange(len(case.subject.joints))

        def choose_marker(rng: np.random.Generator = rng, marker_index: np.ndarray = marker_index) -> np.ndarray:
            return marker_index == rng.integers(len(marker_index))

        is_ghost = draw_group_losses(case, choose_marker)
        displacement = rng.normal(0, GHOST_SD_M, (len(marker_index), 3))
        yield case._replace(take=case.take.replace_markers(case.take.markers + is_ghost[..., None] * displacement))


def draw_group_losses(case: InitialisationTake, choose_markers: Callable[[], Bool[np.ndarray, " K"]]) -> Bool[np.ndarray, "T K"]:
    """Return a loss of some markers in the middle of each interval of GROUP_LOSS_INTERVAL_S."""
    is_lost, rate = np.zeros_like(case.take.visible), case.take.rate
    first_s, duration_s = (GROUP_LOSS_INTERVAL_S - GROUP_LOSS_DURATION_S) / 2, case.take.frame_count / rate
    for begin_s in np.arange(first_s, duration_s, GROUP_LOSS_INTERVAL_S):
        is_lost[round(begin_s * rate) : round((begin_s + GROUP_LOSS_DURATION_S) * rate), choose_markers()] = True
    return is_lost


MARKER_LOSSES: dict[str, MarkerLoss] = {
    "gaps": draw_single_gaps,
    "a segment lost": draw_segment_losses,
    "the pelvis lost": draw_pelvis_losses,
    "half lost": draw_half_losses,
}


def read_captures(folder: Path) -> Iterator[InitialisationTake]:
    """Yield the captures in a folder that have a known marker set. Raises ReadError if there is none."""
    is_empty = True
    for path in sorted(folder.glob("*.c3d")):
        take = capture.read_take(path)
        marker_set = resolve_subject(take, SubjectOptions()).marker_set
        if marker_set is not None:
            is_empty = False
            solver_mask = detect_sample_faults(take).compute_solver_mask(take)
            subject_take = take.select(marker_set.find_columns(take.labels), solver_mask)
            yield InitialisationTake(path.stem, subject_take, calibrate_take(subject_take, marker_set), None, None)
    if is_empty:
        raise ReadError(f"{folder}: holds no capture (.c3d) with a known marker set.")


def calibrate_take(take: Take, marker_set: MarkerSet) -> Subject:
    """Return the body that calibration estimates from a take."""
    body = load_cmu31_body()
    return calibration.calibrate_subject(take, marker_set, body, load_mean_pose_prior("mean-pose", body.skeleton))
