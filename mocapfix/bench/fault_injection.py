"""Injection of faults into sound takes: how often, how long and how severe each kind is.

Durations and sizes have a log-uniform distribution, because short and small faults are frequent and long and large ones rare.
Places are drawn uniformly from all markers and frames without faults, exchanged markers from the three nearest neighbours. The
faults are as hard as real ones: the shift of a marker may be no larger than skin motion, and an exchange of labels may begin
while the markers are hidden, without a jump. Frozen samples and polynomial fills are injected only where the marker moves,
because they make no difference at rest.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from jaxtyping import Float

from mocapfix.bench.damaged_take import DamagedTake, FaultPlace
from mocapfix.faults import Fault, FaultKind, Fragment, MarkerShift
from mocapfix.solve import kinematics

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
    permanent."""
    cycle = list(place.markers)
    if damaged_take.rng.random() < PERMANENT_EXCHANGE_PROBABILITY:
        permanent = place._replace(last=damaged_take.frame_count - 1)
        place = permanent if damaged_take.is_free(permanent) else place
    if damaged_take.rng.random() < 0.5:
        length = round(damaged_take.rate_hz * damaged_take.draw_log_uniform(*HIDDEN_BEFORE_SWAP_S))
        for marker in cycle:
            damaged_take.hide_samples(marker, place.first - length, place.first - 1)
    exchange_labels(damaged_take, cycle, place.first, place.last, "swap")


def exchange_labels(damaged_take: DamagedTake, cycle: list[int], first: int, last: int, kind: FaultKind) -> None:
    """Move the samples of each marker of a cycle to the label of the next one."""
    frames = slice(first, last + 1)
    damaged_take.markers[frames, cycle[1:] + cycle[:1]] = damaged_take.markers[frames, cycle]
    damaged_take.record_fault(Fault(kind, cycle[0], first, last, np.nan, "", other_markers=tuple(cycle[1:])))


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
    fault = Fragment("fragment", marker, place.first, place.last, np.nan, "", donor=donor, relation="continues")
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
    damaged_take: DamagedTake, kind: FaultKind, begin_range: tuple[float, float], duration_range: tuple[float, float]
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
    damaged_take.record_fault(MarkerShift(kind, marker, first, frame_count - 1, size, "", settled_frame=settled))
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
    damaged_take: DamagedTake, place: FaultPlace, kind: FaultKind, shift: Float[np.ndarray, "3"] | Float[np.ndarray, "N 3"]
) -> None:
    """Add a shift in metres to a marker's samples."""
    marker = place.markers[0]
    damaged_take.markers[place.frames, marker] += shift
    size = float(np.linalg.norm(shift, axis=-1).max())
    damaged_take.record_fault(Fault(kind, marker, place.first, place.last, size, ""))


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


def replace_samples(damaged_take: DamagedTake, place: FaultPlace, kind: FaultKind, path: Float[np.ndarray, "_ 3"]) -> None:
    """Replace a marker's samples by a path, or by one position."""
    marker, frames = place.markers[0], place.frames
    damaged_take.markers[frames, marker] = path
    distance = np.linalg.norm(damaged_take.markers[frames, marker] - damaged_take.true_markers[frames, marker], axis=-1)
    damaged_take.record_fault(Fault(kind, marker, place.first, place.last, float(distance.max()), ""))


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
