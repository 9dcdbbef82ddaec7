"""Benchmark of fault detection: recall, overlap, false alarms and repair errors on sound takes with injected faults.

A take with faults is written to a file and cleaned. An injected fault counts as found if a detected fault of its kind, and of no
other markers, overlaps it. Kinds are compared in groups: missing samples, replaced samples (a ghost may be reported as spikes),
and label errors, whether temporary or permanent.

Durations and sizes of faults have a log-uniform distribution, because short and small faults are frequent and long and large ones
rare. Places are drawn from all markers and frames without faults, exchanged markers from the three nearest neighbours. The shift
of a marker may be no larger than skin motion, and an exchange of labels may begin while the markers are hidden. Frozen samples
and polynomial fills are injected only where the marker moves.
"""

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.lab.common_task import clean_composed_take
from mocapfix.lab.sound_takes import SOUND_TAKE_RATE_HZ, iterate_sound_takes, remove_damage
from mocapfix.model import faults
from mocapfix.model.changes import compare_samples
from mocapfix.model.stage_timer import ProgressCallback
from mocapfix.options import CleanOptions, FillOptions, ReadOptions
from mocapfix.result import CleaningResult
from mocapfix.solve import kinematics
from mocapfix.stats.sequences import find_runs
from mocapfix.synthetic import SyntheticTake, compose_take

MIN_FAULT_DISTANCE_S = 0.3  # between two faults of a marker or of neighbouring markers
NEIGHBOUR_COUNT = 3  # markers that count as neighbours of a marker
NEIGHBOUR_FRAME_COUNT = 50  # frames in which the distances between markers are measured
MAX_PLACE_TRIES = 200  # attempts to draw a place without faults


class FaultPlace(NamedTuple):
    """Markers, all but the first neighbours of the first one, and the frames first..last."""

    markers: tuple[int, ...]
    first: int
    last: int

    @property
    def frames(self) -> slice:
        """The frames as a slice."""
        return slice(self.first, self.last + 1)

    @property
    def frame_count(self) -> int:
        """The number of frames."""
        return self.last - self.first + 1


class DamagedTake:
    """A take with injected faults.

    Attributes:
        markers: (T, M + E, 3) metres: the content of the file, E trajectories more than the M markers; labels of all of them.
        true_markers: (T, M, 3) metres: the true positions.
        injected_faults: The faults to be found.
        secondary_faults: Further faults that these imply, such as a gap before an exchange of labels.
    """

    def __init__(self, sound_truth: SyntheticTake, rng: np.random.Generator) -> None:
        self.sound_truth, self.rng, self.rate_hz = sound_truth, rng, sound_truth.rate
        positions = sound_truth.marker_positions
        self.markers, self.true_markers, self.labels = positions.copy(), positions.copy(), sound_truth.labels
        self.frame_count, self.marker_count = sound_truth.missing_mask.shape
        self.injected_faults: list[faults.Fault] = []
        self.secondary_faults: list[faults.Fault] = []
        self._has_fault = np.zeros(sound_truth.missing_mask.shape, bool)
        sampled = positions[:: max(1, self.frame_count // NEIGHBOUR_FRAME_COUNT)]
        distances = np.linalg.norm(sampled[:, :, None] - sampled[:, None], axis=-1).mean(0)
        self.neighbours = np.argsort(distances, axis=1)[:, 1:]

    def draw_log_uniform(self, low: float, high: float) -> float:
        """Return a number in a range from a log-uniform distribution."""
        return low * (high / low) ** self.rng.random()

    def draw_displacement(self, low: float, high: float) -> Float[np.ndarray, "3"]:
        """Return a vector of random direction and log-uniform length."""
        direction = self.rng.normal(size=3)
        return direction / np.linalg.norm(direction) * self.draw_log_uniform(low, high)

    def draw_place(
        self, duration_range_s: tuple[float, float], marker_count: int = 1, min_motion_m: float = 0.0
    ) -> FaultPlace | None:
        """Return a place inside the take without faults, of log-uniform duration, or None if none was found.

        Args:
            marker_count: Number of neighbouring markers.
            min_motion_m: Minimum range of the first marker's motion along one axis.
        """
        for _ in range(MAX_PLACE_TRIES):
            marker = int(self.rng.integers(self.marker_count))
            length = max(1, round(self.rate_hz * self.draw_log_uniform(*duration_range_s)))
            if length > self.frame_count - 4:
                continue
            first = int(self.rng.integers(2, self.frame_count - length - 1))
            others = self.rng.permutation(self.neighbours[marker, :NEIGHBOUR_COUNT])[: marker_count - 1]
            place = FaultPlace((marker, *others.tolist()), first, first + length - 1)
            if self.is_free(place) and np.ptp(self.true_markers[place.frames, marker], axis=0).max() >= min_motion_m:
                return place
        return None

    def is_free(self, place: FaultPlace) -> bool:
        """Return whether a place and its surroundings have no faults."""
        margin = round(MIN_FAULT_DISTANCE_S * self.rate_hz)
        own = np.array(place.markers)
        markers = np.concatenate([own, self.neighbours[own, :NEIGHBOUR_COUNT].ravel()])
        frames = slice(max(0, place.first - margin), place.last + margin + 1)
        return not self._has_fault[frames, markers].any()

    def record_fault(self, fault: faults.Fault, *, is_main: bool = True) -> None:
        """Record a fault; one that is not a main fault need not be found."""
        (self.injected_faults if is_main else self.secondary_faults).append(fault)
        self._has_fault[fault.frame_slice, list(fault.markers)] = True

    def hide_samples(self, marker: int, first: int, last: int, *, is_main: bool = False) -> None:
        """Remove a marker's samples in the frames first..last."""
        first, last = max(first, 0), min(last, self.frame_count - 1)
        self.markers[first : last + 1, marker] = np.nan
        self.record_fault(faults.Fault("gap", marker, first, last, np.nan, ""), is_main=is_main)

    def add_trajectory(self, label: str, path: Float[np.ndarray, "T 3"]) -> None:
        """Add a trajectory to the file."""
        self.labels += (label,)
        self.markers = np.concatenate([self.markers, path[:, None]], axis=1)

    @property
    def damaged_truth(self) -> SyntheticTake:
        """The synthetic take whose measured markers and labels are the damaged ones."""
        is_missing = np.isnan(self.markers[..., 0])
        return replace(self.sound_truth, damaged_positions=self.markers, missing_mask=is_missing, labels=self.labels)


PERMANENT_EXCHANGE_PROBABILITY = 0.2  # of an exchange of labels to last to the end of the take
HIDDEN_BEFORE_SWAP_S = (0.05, 0.25)  # how long exchanged markers may be hidden before the exchange
MAX_FRAGMENT_PAUSE_S = 0.05  # how long a trajectory may be missing before it continues under another label
FRAGMENT_LABELS = ("{label}-{n}", "*{n}", "C_{n}", "{label}-{n}")
MIRRORED_LIMB_JOINTS = {"arm": ("Arm", "Hand", "Shoulder", "Finger", "Thumb"), "leg": ("Leg", "Foot", "Toe"), "body": ("",)}
MARKER_SHIFT_RANGE_M = (0.015, 0.06)  # distance by which a marker shifts on its segment
LATER_GAP_S = 0.5  # duration of a gap after the shift of a marker
INJECTED_JITTER_RANGE_M = (0.008, 0.025)  # standard deviation per axis
SPIKE_RANGE_M = (0.03, 0.3)
GHOST_RANGE_M = (0.05, 0.5)  # distance of a ghost from the marker
GHOST_NOISE_SD_M = 0.0005
MIN_MOTION_M = 0.01  # a marker that moves less along every axis is at rest


def inject_label_exchange(damaged_take: DamagedTake, place: FaultPlace) -> None:
    """Exchange labels cyclically; half of the time the markers are hidden before, a fifth of the time the exchange is
    permanent.
    """
    cycle = list(place.markers)
    if damaged_take.rng.random() < PERMANENT_EXCHANGE_PROBABILITY:
        permanent = place._replace(last=damaged_take.frame_count - 1)
        place = permanent if damaged_take.is_free(permanent) else place
    if damaged_take.rng.random() < 0.5:
        length = round(damaged_take.rate_hz * damaged_take.draw_log_uniform(*HIDDEN_BEFORE_SWAP_S))
        for marker in cycle:
            damaged_take.hide_samples(marker, place.first - length, place.first - 1)
    exchange_labels(damaged_take, cycle, place.first, place.last, "swap")


def exchange_labels(damaged_take: DamagedTake, cycle: list[int], first: int, last: int, kind: faults.FaultKind) -> None:
    """Move the samples of each marker of a cycle to the label of the next one."""
    frames = slice(first, last + 1)
    damaged_take.markers[frames, cycle[1:] + cycle[:1]] = damaged_take.markers[frames, cycle]
    damaged_take.record_fault(faults.Fault(kind, cycle[0], first, last, np.nan, "", other_markers=tuple(cycle[1:])))


def inject_fragment(damaged_take: DamagedTake, place: FaultPlace) -> None:
    """Move a part of a trajectory to a new label; half of the time with a short gap before and after it."""
    rng, marker = damaged_take.rng, place.markers[0]
    number = len(damaged_take.labels) - damaged_take.marker_count + 1
    has_pause = rng.random() < 0.5
    pause = round(rng.uniform(0, MAX_FRAGMENT_PAUSE_S) * damaged_take.rate_hz) if has_pause else 0
    path, frames = np.full((damaged_take.frame_count, 3), np.nan), place.frames
    path[frames] = damaged_take.markers[frames, marker]
    damaged_take.hide_samples(marker, place.first - pause, place.last + pause)
    label = FRAGMENT_LABELS[rng.integers(len(FRAGMENT_LABELS))].format(label=damaged_take.labels[marker], n=number)
    damaged_take.add_trajectory(label, path)
    donor = len(damaged_take.labels) - 1
    fault = faults.Fragment("fragment", marker, place.first, place.last, np.nan, "", donor=donor, relation="continues")
    damaged_take.record_fault(fault)


def inject_mislabelled(damaged_take: DamagedTake) -> None:
    """Exchange the labels of two neighbouring markers in the whole take."""
    marker = int(damaged_take.rng.integers(damaged_take.marker_count))
    other = int(damaged_take.rng.choice(damaged_take.neighbours[marker, :2]))
    exchange_labels(damaged_take, [marker, other], 0, damaged_take.frame_count - 1, "mislabelled")


def inject_mirrored_labels(damaged_take: DamagedTake) -> None:
    """Exchange left and right in the whole take, for the markers of the arms, of the legs or of the whole body."""
    subject = damaged_take.sound_truth.subject
    joint_parts = MIRRORED_LIMB_JOINTS[damaged_take.rng.choice(list(MIRRORED_LIMB_JOINTS))]
    joints = [subject.skeleton.names[j] for j in subject.joints]
    for m, label in enumerate(damaged_take.labels):
        other = "R" + label[1:]
        if label.startswith("L") and other in damaged_take.labels and any(part in joints[m] for part in joint_parts):
            exchange_labels(damaged_take, [m, damaged_take.labels.index(other)], 0, damaged_take.frame_count - 1, "mislabelled")


def inject_marker_shift(
    damaged_take: DamagedTake, kind: faults.FaultKind, begin_range: tuple[float, float], duration_range: tuple[float, float]
) -> None:
    """Shift a marker permanently on its segment, followed by a gap; begin and duration are fractions of the take."""
    rng, frame_count = damaged_take.rng, damaged_take.frame_count
    first = round(frame_count * rng.uniform(*begin_range))
    settled = first + round(frame_count * rng.uniform(*duration_range))
    marker = int(rng.integers(damaged_take.marker_count))
    displacement = damaged_take.draw_displacement(*MARKER_SHIFT_RANGE_M)
    if not damaged_take.is_free(FaultPlace((marker,), 0, frame_count - 1)):
        return
    subject, motion = damaged_take.sound_truth.subject, damaged_take.sound_truth.motion
    _, rotation = kinematics.compute_world_poses(subject.skeleton, motion)
    share = np.clip((np.arange(frame_count) - first + 1) / (settled - first + 1), 0, 1)
    shift = share[:, None] * (rotation[:, subject.joints[marker]] @ displacement)
    damaged_take.markers[:, marker] += shift
    damaged_take.true_markers[:, marker] += shift
    size = float(np.linalg.norm(displacement))
    damaged_take.record_fault(faults.MarkerShift(kind, marker, first, frame_count - 1, size, "", settled_frame=settled))
    length = round(LATER_GAP_S * damaged_take.rate_hz)
    start = int(rng.integers(settled + 1, frame_count - length - 1))
    damaged_take.hide_samples(marker, start, start + length - 1)


def inject_gap(damaged_take: DamagedTake, place: FaultPlace) -> None:
    """Remove a marker's samples."""
    damaged_take.hide_samples(place.markers[0], place.first, place.last, is_main=True)


def inject_spike(damaged_take: DamagedTake, place: FaultPlace) -> None:
    """Displace a marker's samples by a constant."""
    displace_samples(damaged_take, place, "spike", damaged_take.draw_displacement(*SPIKE_RANGE_M))


def inject_jitter(damaged_take: DamagedTake, place: FaultPlace) -> None:
    """Add noise to a marker's samples."""
    sd_m = damaged_take.draw_log_uniform(*INJECTED_JITTER_RANGE_M)
    displace_samples(damaged_take, place, "jitter", damaged_take.rng.normal(0, sd_m, (place.frame_count, 3)))


def displace_samples(
    damaged_take: DamagedTake, place: FaultPlace, kind: faults.FaultKind, shift: Float[np.ndarray, "3"] | Float[np.ndarray, "N 3"]
) -> None:
    """Add a shift in metres to a marker's samples."""
    marker = place.markers[0]
    damaged_take.markers[place.frames, marker] += shift
    size = float(np.linalg.norm(shift, axis=-1).max())
    damaged_take.record_fault(faults.Fault(kind, marker, place.first, place.last, size, ""))


def inject_frozen(damaged_take: DamagedTake, place: FaultPlace) -> None:
    """Repeat the previous sample of a marker, as programs do that fill gaps with the last value."""
    replace_samples(damaged_take, place, "stuck", damaged_take.markers[[place.first - 1], place.markers[0]])


def inject_polynomial_fill(damaged_take: DamagedTake, place: FaultPlace) -> None:
    """Replace samples by a line or, half of the time, by the cubic with the velocities at both ends, as programs fill gaps."""
    path, (a, b) = damaged_take.markers[:, place.markers[0]], (place.first - 1, place.last + 1)
    span = b - a
    s = (np.arange(place.first, b) - a)[:, None] / span
    line = path[a] + s * (path[b] - path[a])
    start_slope, end_slope = (span * (path[t + 1] - path[t]) - (path[b] - path[a]) for t in (a - 1, b))
    cubic = s * (1 - s) * ((1 - s) * start_slope - s * end_slope) if damaged_take.rng.random() < 0.5 else 0.0
    replace_samples(damaged_take, place, "straight", line + cubic)


def inject_ghost(damaged_take: DamagedTake, place: FaultPlace) -> None:
    """Move a label to a reflection, which is stationary or, half of the time, moves with the marker."""
    marker, displacement = place.markers[0], damaged_take.draw_displacement(*GHOST_RANGE_M)
    is_stationary = damaged_take.rng.random() < 0.5
    position = damaged_take.markers[[place.first] if is_stationary else place.frames, marker] + displacement
    noise = damaged_take.rng.normal(0, GHOST_NOISE_SD_M, (place.frame_count, 3))
    replace_samples(damaged_take, place, "ghost", position + noise)


def replace_samples(damaged_take: DamagedTake, place: FaultPlace, kind: faults.FaultKind, path: Float[np.ndarray, "_ 3"]) -> None:
    """Replace a marker's samples by a path, or by one position."""
    marker, frames = place.markers[0], place.frames
    damaged_take.markers[frames, marker] = path
    distance = np.linalg.norm(damaged_take.markers[frames, marker] - damaged_take.true_markers[frames, marker], axis=-1)
    damaged_take.record_fault(faults.Fault(kind, marker, place.first, place.last, float(distance.max()), ""))


def inject_often(
    inject: Callable[[DamagedTake, FaultPlace], None],
    count_per_minute: float,
    duration_range_s: tuple[float, float],
    marker_count: int = 1,
    min_motion_m: float = 0.0,
) -> Callable[[DamagedTake], None]:
    """Return a function that injects faults at this frequency, of durations in this range (see DamagedTake.draw_place)."""

    def inject_all(damaged_take: DamagedTake) -> None:
        for _ in range(round(count_per_minute * damaged_take.frame_count / damaged_take.rate_hz / 60)):
            if place := damaged_take.draw_place(duration_range_s, marker_count, min_motion_m):
                inject(damaged_take, place)

    return inject_all


def inject_twice(inject: Callable[[DamagedTake], None]) -> Callable[[DamagedTake], None]:
    """Return a function that injects two faults."""

    def inject_both(damaged_take: DamagedTake) -> None:
        inject(damaged_take)
        inject(damaged_take)

    return inject_both


FAULT_INJECTIONS: dict[str, Callable[[DamagedTake], None]] = {
    "gap": inject_often(inject_gap, 60.0, (0.03, 4.0)),
    "flicker": inject_often(inject_gap, 90.0, (0.008, 0.017)),
    "spike": inject_often(inject_spike, 90.0, (0.008, 0.025)),
    "jitter": inject_often(inject_jitter, 18.0, (0.2, 1.0)),
    "stuck": inject_often(inject_frozen, 24.0, (0.1, 2.0), min_motion_m=MIN_MOTION_M),
    "straight": inject_often(inject_polynomial_fill, 24.0, (0.1, 2.0), min_motion_m=MIN_MOTION_M),
    "swap": inject_often(inject_label_exchange, 12.0, (0.2, 3.0), marker_count=2),
    "ring": inject_often(inject_label_exchange, 9.0, (0.2, 3.0), marker_count=3),
    "ghost": inject_often(inject_ghost, 18.0, (0.1, 2.0)),
    "fragment": inject_often(inject_fragment, 18.0, (0.2, 3.0)),
    "moved": inject_twice(partial(inject_marker_shift, kind="moved", begin_range=(0.2, 0.8), duration_range=(0.0, 0.0))),
    "drift": inject_twice(partial(inject_marker_shift, kind="drift", begin_range=(0.1, 0.35), duration_range=(0.3, 0.45))),
    "mislabelled": inject_mislabelled,
    "mirrored": inject_mirrored_labels,
}


REPLACED_KINDS = (*faults.REPLACED_SAMPLE_KINDS, *faults.EXTERNAL_FILL_KINDS)
REFILL_OPTIONS = CleanOptions(read=ReadOptions(accept_contradictions=True), fill=FillOptions(refill=True))
FAULT_MIXES: dict[str, tuple[str, ...]] = {
    "samples": ("gap", "flicker", "spike", "jitter"),
    "fills": ("stuck", "straight", "ghost"),
    "labels": ("swap", "ring", "fragment"),
    "placements": ("moved", "drift"),
    "whole takes": ("mislabelled",),
}
"""kinds of FAULT_INJECTIONS that the short version of the benchmark injects into one take"""
MIXED_TAKE_S = 10.0  # duration of a take of the short version
FaultRow = dict[str, float | None]  # a row of the benchmark's table


class FaultScore(NamedTuple):
    """The detection and repair of the faults of one take."""

    # (N,) intersection over union of the samples of each injected fault and those found of it; NaN if not found
    overlap: np.ndarray
    false_alarms: list[faults.Fault]  # detected faults that were not injected
    minutes: float  # duration of the take
    predicted_error: np.ndarray  # (S,) metres: predicted error of each sample that was changed within the injected faults
    true_error: np.ndarray  # (S,) metres


def measure_fault_detection(
    motion_folder: Path | None, take_count: int, progress: ProgressCallback = lambda _: None
) -> dict[str, FaultRow]:
    """Return the scores by kind of FAULT_INJECTIONS; a score without data is None.

    The scores are recall, overlap, false_alarms_per_minute, predicted_mm and true_mm. "all" has those of all kinds together, and
    the false alarms in the same takes without faults.

    Args:
        motion_folder: Holds test.npz of motion; None for composed takes.

    Raises:
        SceneError: If `take_count` is less than one.
        ReadError: If there is no such motion.
    """
    sound_takes = list(iterate_sound_takes(motion_folder, take_count))
    scores: dict[str, list[FaultScore]] = {}
    for number, (kind, inject) in enumerate(FAULT_INJECTIONS.items()):
        for n, (name, truth) in enumerate(sound_takes):
            progress(f"{kind}, {name}")
            damaged_take = DamagedTake(truth, np.random.default_rng([number, n]))
            inject(damaged_take)
            result = clean_composed_take(damaged_take.damaged_truth, REFILL_OPTIONS)
            scores.setdefault(kind, []).append(score_take(damaged_take, result))
    sound_scores: list[FaultScore] = []
    for name, truth in sound_takes:
        progress(f"no faults, {name}")
        sound_take = DamagedTake(truth, np.random.default_rng(0))
        sound_scores.append(score_take(sound_take, clean_composed_take(sound_take.damaged_truth, REFILL_OPTIONS)))
    return summarise_fault_kinds(scores, sound_scores)


def measure_mixed_faults(progress: ProgressCallback = lambda _: None) -> dict[str, FaultRow]:
    """Return the scores of the short version, as `measure_fault_detection` does: one take for each of FAULT_MIXES."""
    scores: dict[str, list[FaultScore]] = {}
    sound_scores: list[FaultScore] = []
    for seed, (name, kinds) in enumerate(FAULT_MIXES.items()):
        progress(name)
        truth = remove_damage(compose_take(seed, MIXED_TAKE_S, SOUND_TAKE_RATE_HZ, asymmetric=True))
        damaged_take = DamagedTake(truth, np.random.default_rng(seed))
        for kind in kinds:
            FAULT_INJECTIONS[kind](damaged_take)
        scores[name] = [score_take(damaged_take, clean_composed_take(damaged_take.damaged_truth, REFILL_OPTIONS))]
        if not sound_scores:
            sound_scores = [
                score_take(DamagedTake(truth, np.random.default_rng(seed)), clean_composed_take(truth, REFILL_OPTIONS))
            ]
    return summarise_fault_kinds(scores, sound_scores)


def summarise_fault_kinds(scores: dict[str, list[FaultScore]], sound_scores: list[FaultScore]) -> dict[str, FaultRow]:
    """Return the row of each kind, and "all" with those of all kinds together and the false alarms in takes without faults."""
    rows = {kind: summarise_fault_scores(each) for kind, each in scores.items()}
    total = summarise_fault_scores([score for each in scores.values() for score in each])
    alarms = summarise_fault_scores(sound_scores)["false_alarms_per_minute"]
    return rows | {"all": total | {"false_alarms_per_minute": alarms}}


def score_take(damaged_take: DamagedTake, result: CleaningResult) -> FaultScore:
    """Return the comparison of detected and injected faults."""
    detected, minutes = merge_label_exchanges(result).items, damaged_take.frame_count / damaged_take.rate_hz / 60
    injected = [*damaged_take.injected_faults, *damaged_take.secondary_faults]
    has_fault = faults.build_fault_mask(injected, damaged_take.markers.shape[:2])
    has_fault[:, damaged_take.marker_count :] = True  # additional trajectories exist only because they were injected
    alarms = [fault for fault in detected if not all(has_fault[fault.frame_slice, m].any() for m in fault.markers)]
    visible = ~damaged_take.damaged_truth.missing_mask
    overlap = np.array([compute_fault_overlap(fault, detected, visible) for fault in damaged_take.injected_faults])
    predicted_error, true_error = compute_repair_errors(damaged_take, result)
    return FaultScore(overlap, alarms, minutes, predicted_error, true_error)


def merge_label_exchanges(result: CleaningResult) -> faults.Faults:
    """Return the detected faults, with exchanges of the same labels replaced by their net effect, since some revert others."""
    sources, own_sources = result.relabelled_take.source_points, result.input_take.source_points
    cycles = {tuple(sorted(fault.markers)): fault for fault in result.faults.select_kinds(*faults.LABEL_KINDS)}
    merged = [fault for fault in result.faults.items if fault.kind not in faults.LABEL_KINDS]
    for cycle, fault in cycles.items():
        cycle_sources, own = sources[:, cycle], own_sources[:, cycle]
        is_permuted = (np.sort(cycle_sources) == np.sort(own)).all(1)
        exchanged = find_runs(is_permuted & (cycle_sources != own).all(1))
        merged += [replace(fault, first=first, last=last) for first, last in exchanged]
    return faults.Faults().add_faults(merged)


def compute_fault_overlap(fault: faults.Fault, detected: Iterable[faults.Fault], visible: Bool[np.ndarray, "T M"]) -> float:
    """Return the intersection over union of a fault's samples and those of all that was detected of it; NaN if nothing was.

    Missing samples do not count, except for faults about missing samples.
    """
    matches = [
        each
        for each in detected
        if each.overlaps(fault) and is_same_kind(each, fault) and set(each.markers) <= set(fault.markers)
    ]
    if {m for each in matches for m in each.markers} != set(fault.markers):
        return float("nan")
    counts = np.ones_like(visible) if fault.kind in (*faults.MISSING_KINDS, "fragment") else visible
    injected, found = (
        faults.build_fault_mask([fault], visible.shape) & counts,
        faults.build_fault_mask(matches, visible.shape) & counts,
    )
    return float((injected & found).sum() / (injected | found).sum())


def is_same_kind(detected: faults.Fault, injected: faults.Fault) -> bool:
    """Return whether a detected fault is of the kind, or the group of kinds, of an injected one."""
    if isinstance(detected, faults.Fragment) and detected.relation not in faults.JOINED_RELATIONS:
        return False
    groups = (faults.MISSING_KINDS, REPLACED_KINDS, faults.LABEL_KINDS)
    return detected.kind == injected.kind or any(detected.kind in group and injected.kind in group for group in groups)


def compute_repair_errors(
    damaged_take: DamagedTake, result: CleaningResult
) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, " S"]]:
    """Return the predicted and the true errors in metres of the visible samples that were changed within the injected faults."""
    after, count = result.take, damaged_take.marker_count
    has_fault = faults.build_fault_mask(damaged_take.injected_faults, damaged_take.markers.shape[:2])[:, :count]
    is_changed = (compare_samples(result.input_take, after) & after.visible)[:, :count] & has_fault
    sd_m = np.zeros(is_changed.shape) if after.sample_sd is None else np.nan_to_num(after.sample_sd[:, :count])
    error_m = np.linalg.norm(after.markers[:, :count] - damaged_take.true_markers, axis=-1)
    return np.sqrt(3) * sd_m[is_changed], error_m[is_changed]


def summarise_fault_scores(scores: list[FaultScore]) -> FaultRow:
    """Return the row of the table for several takes."""
    overlap = np.concatenate([score.overlap for score in scores])
    is_found = ~np.isnan(overlap)
    predicted = np.concatenate([score.predicted_error for score in scores])
    true = np.concatenate([score.true_error for score in scores])
    return {
        "recall": float(is_found.mean()) if len(is_found) else None,
        "overlap": float(overlap[is_found].mean()) if is_found.any() else None,
        "false_alarms_per_minute": sum(len(score.false_alarms) for score in scores) / sum(score.minutes for score in scores),
        "predicted_mm": 1e3 * float(np.sqrt((predicted**2).mean())) if len(predicted) else None,
        "true_mm": 1e3 * float(np.sqrt((true**2).mean())) if len(true) else None,
    }
