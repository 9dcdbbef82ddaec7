"""What happens to labels: they are exchanged for a while or all the time, or a trajectory goes on under another."""

from collections.abc import Callable
from functools import partial

import numpy as np

from mocapfix.bench.damaged_take import DamagedTake, FaultPlace
from mocapfix.faults import Fault, FaultKind, Fragment, MarkerShift
from mocapfix.solve import kinematics

# MERGED: mocapfix.bench.injected_labels
HIDDEN_BEFORE_SWAP_S = (0.05, 0.25)  # seconds: how long exchanged markers are out of sight before
MAX_FRAGMENT_PAUSE_S = 0.05  # seconds: how long a trajectory is lost at most, before it goes on under another label
FRAGMENT_LABELS = ("{label}-{n}", "*{n}", "C_{n}", "{label}-{n}")
MIRRORED_LIMB_JOINTS = {"arm": ("Arm", "Hand", "Shoulder", "Finger", "Thumb"), "leg": ("Leg", "Foot", "Toe"), "body": ("",)}


def inject_label_exchange(damaged_take: DamagedTake, place: FaultPlace) -> None:
    """Labels go round the ring: half the time after their markers were hidden, a fifth of the time for good."""
    ring = list(place.markers)
    if damaged_take.rng.random() < 0.2:
        good = place._replace(last=damaged_take.frame_count - 1)
        place = good if damaged_take.is_free(good) else place
    if damaged_take.rng.random() < 0.5:
        length = round(damaged_take.rate_hz * damaged_take.draw_log_uniform(*HIDDEN_BEFORE_SWAP_S))
        for marker in ring:
            damaged_take.hide_samples(marker, place.first - length, place.first - 1)
    exchange_labels(damaged_take, ring, place.first, place.last, "swap")


def exchange_labels(damaged_take: DamagedTake, ring: list[int], first: int, last: int, kind: FaultKind) -> None:
    """The samples of each marker in the ring are under the next one's label."""
    frames = slice(first, last + 1)
    damaged_take.markers[frames, ring[1:] + ring[:1]] = damaged_take.markers[frames, ring]
    damaged_take.record_fault(Fault(kind, ring[0], first, last, np.nan, "", other_markers=tuple(ring[1:])))


def inject_fragment(damaged_take: DamagedTake, place: FaultPlace) -> None:
    """A piece of a trajectory goes on under another label, half the time with a pause before and after it."""
    marker, n = place.markers[0], len(damaged_take.labels) - damaged_take.marker_count + 1
    pause = (
        round(damaged_take.rng.uniform(0, MAX_FRAGMENT_PAUSE_S) * damaged_take.rate_hz) if damaged_take.rng.random() < 0.5 else 0
    )
    path, frames = np.full((damaged_take.frame_count, 3), np.nan), place.frames
    path[frames] = damaged_take.markers[frames, marker]
    damaged_take.hide_samples(marker, place.first - pause, place.last + pause)
    damaged_take.add_trajectory(
        FRAGMENT_LABELS[damaged_take.rng.integers(len(FRAGMENT_LABELS))].format(label=damaged_take.labels[marker], n=n), path
    )
    donor = len(damaged_take.labels) - 1
    damaged_take.record_fault(
        Fragment("fragment", marker, place.first, place.last, np.nan, "", donor=donor, relation="continues")
    )


def inject_mislabelled(damaged_take: DamagedTake) -> None:
    """Two markers near one another bear each other's label all the time."""
    marker = int(damaged_take.rng.integers(damaged_take.marker_count))
    other = int(damaged_take.rng.choice(damaged_take.neighbours[marker, :2]))
    exchange_labels(damaged_take, [marker, other], 0, damaged_take.frame_count - 1, "mislabelled")


def inject_mirrored_labels(damaged_take: DamagedTake) -> None:
    """Left and right are taken for one another all the time, in the markers of the arms, of the legs or of the whole body."""
    words = MIRRORED_LIMB_JOINTS[damaged_take.rng.choice(list(MIRRORED_LIMB_JOINTS))]
    joints = [damaged_take.sound_truth.subject.skeleton.names[j] for j in damaged_take.sound_truth.subject.joints]
    for m, label in enumerate(damaged_take.labels):
        other = "R" + label[1:]
        if label.startswith("L") and other in damaged_take.labels and any(word in joints[m] for word in words):
            exchange_labels(damaged_take, [m, damaged_take.labels.index(other)], 0, damaged_take.frame_count - 1, "mislabelled")


# MERGED: mocapfix.bench.injected_moves
# What happens to a marker's place: it is knocked, or slides, and stays elsewhere on its segment.
MARKER_SHIFT_RANGE_M = (0.015, 0.06)  # metres on the segment
LATER_GAP_S = 0.5  # seconds: a gap of a marker that moved, after it did


def inject_marker_shift(
    damaged_take: DamagedTake, kind: FaultKind, begin_range: tuple[float, float], duration_range: tuple[float, float]
) -> None:
    """A marker goes elsewhere on its segment and stays there; `begins` and `lasts` are parts of the take. Later it has a gap."""
    first = round(damaged_take.frame_count * damaged_take.rng.uniform(*begin_range))
    settled = first + round(damaged_take.frame_count * damaged_take.rng.uniform(*duration_range))
    marker, way = int(damaged_take.rng.integers(damaged_take.marker_count)), damaged_take.draw_displacement(*MARKER_SHIFT_RANGE_M)
    if not damaged_take.is_free(FaultPlace((marker,), 0, damaged_take.frame_count - 1)):
        return
    _, rotation = kinematics.compute_world_poses(damaged_take.sound_truth.subject.skeleton, damaged_take.sound_truth.motion)
    share = np.clip((np.arange(damaged_take.frame_count) - first + 1) / (settled - first + 1), 0, 1)
    shift = share[:, None] * (rotation[:, damaged_take.sound_truth.subject.joints[marker]] @ way)
    damaged_take.markers[:, marker] += shift
    damaged_take.true_markers[:, marker] += shift
    size = float(np.linalg.norm(way))
    damaged_take.record_fault(MarkerShift(kind, marker, first, damaged_take.frame_count - 1, size, "", settled_frame=settled))
    length = round(LATER_GAP_S * damaged_take.rate_hz)
    start = int(damaged_take.rng.integers(settled + 1, damaged_take.frame_count - length - 1))
    damaged_take.hide_samples(marker, start, start + length - 1)


# MERGED: mocapfix.bench.injected_samples
# What happens to a marker's samples: they are missing, off, held, drawn straight, or somewhere else altogether.
INJECTED_JITTER_RANGE_M = (0.008, 0.025)  # metres per axis
SPIKE_RANGE_M, GHOST_RANGE_M = (0.03, 0.3), (0.05, 0.5)  # metres


def inject_gap(damaged_take: DamagedTake, place: FaultPlace) -> None:
    damaged_take.hide_samples(place.markers[0], place.first, place.last, is_main=True)


def inject_spike(damaged_take: DamagedTake, place: FaultPlace) -> None:
    displace_samples(damaged_take, place, "spike", damaged_take.draw_displacement(*SPIKE_RANGE_M))


def inject_jitter(damaged_take: DamagedTake, place: FaultPlace) -> None:
    displace_samples(
        damaged_take,
        place,
        "jitter",
        damaged_take.rng.normal(0, damaged_take.draw_log_uniform(*INJECTED_JITTER_RANGE_M), (place.frame_count, 3)),
    )


def displace_samples(damaged_take: DamagedTake, place: FaultPlace, kind: FaultKind, shift: np.ndarray) -> None:
    """Add `shift`, (3,) or (N, 3) metres, to a marker's samples."""
    marker = place.markers[0]
    damaged_take.markers[place.frames, marker] += shift
    size = float(np.linalg.norm(shift, axis=-1).max())
    damaged_take.record_fault(Fault(kind, marker, place.first, place.last, size, ""))


def inject_frozen(damaged_take: DamagedTake, place: FaultPlace) -> None:
    """A gap that another program filled with the value before it."""
    replace_samples(damaged_take, place, "stuck", damaged_take.markers[[place.first - 1], place.markers[0]])


def inject_polynomial_fill(damaged_take: DamagedTake, place: FaultPlace) -> None:
    """A gap that another program filled: with a line or, as often, with the cubic that goes on as the samples about it go."""
    path, (a, b) = damaged_take.markers[:, place.markers[0]], (place.first - 1, place.last + 1)
    span = b - a
    s = (np.arange(place.first, b) - a)[:, None] / span
    line = path[a] + s * (path[b] - path[a])
    leaving, coming = (span * (path[t + 1] - path[t]) - (path[b] - path[a]) for t in (a - 1, b))
    bow = s * (1 - s) * ((1 - s) * leaving - s * coming) if damaged_take.rng.random() < 0.5 else 0.0
    replace_samples(damaged_take, place, "straight", line + bow)


def inject_ghost(damaged_take: DamagedTake, place: FaultPlace) -> None:
    """The label jumps to a reflection, which stays where it is or, as often, goes along with the marker."""
    marker, way = place.markers[0], damaged_take.draw_displacement(*GHOST_RANGE_M)
    stays = damaged_take.rng.random() < 0.5
    there = damaged_take.markers[[place.first] if stays else place.frames, marker] + way
    replace_samples(damaged_take, place, "ghost", there + damaged_take.rng.normal(0, 0.0005, (place.frame_count, 3)))


def replace_samples(damaged_take: DamagedTake, place: FaultPlace, kind: FaultKind, path: np.ndarray) -> None:
    """Put `path`, (N, 3) or (1, 3), in place of a marker's samples."""
    marker = place.markers[0]
    damaged_take.markers[place.frames, marker] = path
    size = float(
        np.linalg.norm(
            damaged_take.markers[place.frames, marker] - damaged_take.true_markers[place.frames, marker], axis=-1
        ).max()
    )
    damaged_take.record_fault(Fault(kind, marker, place.first, place.last, size, ""))


# MERGED: mocapfix.bench.injections
# Faults as stages have them, put into sound takes: how often, how long and how bad each kind is.
#
# All is drawn. Lengths and sizes are spread evenly over their logarithm, for short and small faults are many and long and large
# ones few; places are drawn alike from all markers and frames that nothing has happened to, markers that are exchanged from
# the three nearest. Nothing here is made easy: a knock may be no larger than what skin does on lively people, an exchange may
# begin while its markers are hidden and so without a leap. Only where a marker rests nothing is held or drawn straight, for
# there it makes no difference.
MIN_MOTION_M = 0.01  # metres: what goes less far meanwhile is at rest


def inject_often(
    inject: Callable[[DamagedTake, FaultPlace], None],
    count_per_minute: float,
    duration_range_s: tuple[float, float],
    marker_count: int = 1,
    min_motion_m: float = 0.0,
) -> Callable[[DamagedTake], None]:
    """-> what lets it happen so often a minute, for so many seconds each time (see Stage.place)."""

    def happens(stage: DamagedTake) -> None:
        for _ in range(round(count_per_minute * stage.frame_count / stage.rate_hz / 60)):
            if place := stage.draw_place(duration_range_s, marker_count, min_motion_m):
                inject(stage, place)

    return happens


def inject_twice(inject: Callable[[DamagedTake], None]) -> Callable[[DamagedTake], None]:
    def happens(stage: DamagedTake) -> None:
        inject(stage)
        inject(stage)

    return happens


FAULT_INJECTIONS: dict[str, Callable[[DamagedTake], None]] = {
    "gap": inject_often(inject_gap, 60, (0.03, 4.0)),
    "flicker": inject_often(inject_gap, 90, (0.008, 0.017)),
    "spike": inject_often(inject_spike, 90, (0.008, 0.025)),
    "jitter": inject_often(inject_jitter, 18, (0.2, 1.0)),
    "stuck": inject_often(inject_frozen, 24, (0.1, 2.0), min_motion_m=MIN_MOTION_M),
    "straight": inject_often(inject_polynomial_fill, 24, (0.1, 2.0), min_motion_m=MIN_MOTION_M),
    "swap": inject_often(inject_label_exchange, 12, (0.2, 3.0), marker_count=2),
    "ring": inject_often(inject_label_exchange, 9, (0.2, 3.0), marker_count=3),
    "ghost": inject_often(inject_ghost, 18, (0.1, 2.0)),
    "fragment": inject_often(inject_fragment, 18, (0.2, 3.0)),
    "moved": inject_twice(partial(inject_marker_shift, kind="moved", begin_range=(0.2, 0.8), duration_range=(0.0, 0.0))),
    "drift": inject_twice(partial(inject_marker_shift, kind="drift", begin_range=(0.1, 0.35), duration_range=(0.3, 0.45))),
    "mislabelled": inject_mislabelled,
    "mirrored": inject_mirrored_labels,
}
