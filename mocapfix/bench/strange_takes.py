"""Valid files with strange content: takes of a person to whom several things at once have happened that no capture room shows.

Each strangeness is a function of a `Strange` take that changes it in place. Some are nonsense, some are exports with wrong
settings, some are only rare; cleaning any of them must end in a result or in one sentence.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.synthetic.synthetic_takes import SyntheticTake, compose_take

BASE_SEEDS = (0, 1, 2)
BASE_RATES_HZ = (30.0, 120.0)
BASE_FRAME_COUNTS = (40, 40, 100, 200)
"""of the takes to which the strange things happen"""
STRANGE_RATES_HZ = (0.01, 1.0, 5.0, 15.0, 500.0, 1_000.0, 10_000.0)
STRANGE_SCALES = (1e-3, 0.01, 0.1, 10.0, 1e3)
MAX_STRANGE_FRAMES = 5
MAX_STRANGE_MARKERS = 6
JUMP_M = 5.0
STRANGE_NOISE_M = (0.1, 1.0)
FAR_AWAY_M = 1e4
STRANGE_LABELS = (
    "",
    " ",
    "LFHD",
    "*7",
    "C_12",
    "<b>x</b>",
    "Jim:",
    ":",
    "\u00dc" * 60,
    "a,b",
    "LFWT'",
    "..",
    "Jim:Tom:LFHD",
    "X",
    "-",
)
PREFIXES = ("Jim", "Tom", "a b")


@dataclass
class Strange:
    """A take while strange things happen to it: positions (T, M, 3) in metres, NaN where missing."""

    markers: np.ndarray
    labels: list[str]
    rate: float
    rng: np.random.Generator

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return len(self.markers)

    @property
    def marker_count(self) -> int:
        """Number of markers."""
        return self.markers.shape[1]

    def select(self, columns: np.ndarray) -> None:
        """Keep some of the markers, in this order."""
        self.markers = self.markers[:, columns]
        self.labels = [self.labels[column] for column in columns]

    def draw_mask(self, share: float) -> np.ndarray:
        """Return a mask (T, M) with this share of samples, one by one."""
        return self.rng.random(self.markers.shape[:2]) < share


def cut_to_few_frames(take: Strange) -> None:
    """Leave one to five frames."""
    count = int(take.rng.integers(1, MAX_STRANGE_FRAMES + 1))
    first = int(take.rng.integers(0, max(take.frame_count - count, 0) + 1))
    take.markers = take.markers[first : first + count]


def change_rate(take: Strange) -> None:
    """Declare another rate."""
    take.rate = float(take.rng.choice(STRANGE_RATES_HZ))


def collapse_all_markers(take: Strange) -> None:
    """Place all markers of each frame at one point."""
    take.markers = np.repeat(take.markers[:, :1], take.marker_count, axis=1)


def freeze_all(take: Strange) -> None:
    """Repeat one frame."""
    take.markers = np.repeat(take.markers[take.rng.integers(take.frame_count)][None], take.frame_count, axis=0)


def place_at_origin(take: Strange) -> None:
    """Place everything at nearly the origin of the room."""
    take.markers = np.where(np.isnan(take.markers), np.nan, 1e-6)


def mirror(take: Strange) -> None:
    """Mirror the person without exchanging the labels."""
    take.markers = take.markers * np.array([-1.0, 1.0, 1.0])


def turn_upside_down(take: Strange) -> None:
    """Rotate the whole take by a random rotation."""
    take.markers = take.markers @ Rotation.from_quat(take.rng.normal(size=4)).as_matrix()


def scale(take: Strange) -> None:
    """Export in the wrong unit."""
    take.markers = take.markers * float(take.rng.choice(STRANGE_SCALES))


def stretch_axis(take: Strange) -> None:
    """Flatten the person, or stretch it, along one axis."""
    factors = np.ones(3)
    factors[take.rng.integers(3)] = take.rng.choice([0.0, 0.01, 5.0])
    take.markers = take.markers * factors


def shuffle_half_of_labels(take: Strange) -> None:
    """Permute half of the labels among one another."""
    chosen = take.rng.permutation(take.marker_count)[: take.marker_count // 2]
    order = np.arange(take.marker_count)
    order[chosen] = take.rng.permutation(chosen)
    take.markers = take.markers[:, order]


def shuffle_labels_in_each_frame(take: Strange) -> None:
    """Permute all labels in many frames, each time otherwise."""
    for frame in np.flatnonzero(take.rng.random(take.frame_count) < take.rng.choice([0.05, 0.5, 1.0])):
        take.markers[frame] = take.markers[frame, take.rng.permutation(take.marker_count)]


def hide_nearly_all(take: Strange) -> None:
    """Hide 90 to 99 % of the samples, one by one."""
    take.markers[take.draw_mask(float(take.rng.choice([0.9, 0.97, 0.99])))] = np.nan


def hide_frames(take: Strange) -> None:
    """Hide everything in nearly all frames."""
    take.markers[take.rng.random(take.frame_count) < take.rng.choice([0.5, 0.9, 0.99])] = np.nan


def hide_blocks(take: Strange) -> None:
    """Hide markers for long."""
    for _ in range(int(take.rng.integers(5, 100))):
        first = int(take.rng.integers(take.frame_count))
        take.markers[first : first + int(take.rng.integers(1, take.frame_count + 1)), take.rng.integers(take.marker_count)] = (
            np.nan
        )


def hide_markers(take: Strange) -> None:
    """Hide some markers in the whole take."""
    take.markers[:, take.rng.random(take.marker_count) < take.rng.uniform(0.1, 0.9)] = np.nan


def spin(take: Strange) -> None:
    """Turn the person about the vertical, up to many times a second."""
    turns_per_frame = float(take.rng.choice([0.01, 0.1, 0.37, 0.5]))
    angles = 2 * np.pi * turns_per_frame * np.arange(take.frame_count)
    centre = np.nanmean(take.markers, axis=(0, 1)) if np.isfinite(take.markers).any() else np.zeros(3)
    rotations = Rotation.from_rotvec(np.outer(angles, [0.0, 1.0, 0.0])).as_matrix()
    take.markers = np.einsum("tab,tmb->tma", rotations, take.markers - centre) + centre


def jump(take: Strange) -> None:
    """Displace the person, or single markers, by metres at some frames."""
    for _ in range(int(take.rng.integers(1, 10))):
        columns = slice(None) if take.rng.random() < 0.5 else take.rng.integers(take.marker_count)
        take.markers[int(take.rng.integers(take.frame_count)) :, columns] += take.rng.normal(0, JUMP_M, 3)


def add_strange_noise(take: Strange) -> None:
    """Add noise of 0.1 to 1 m to all samples, or to some."""
    noise_m = take.rng.uniform(*STRANGE_NOISE_M)
    share = float(take.rng.choice([0.1, 1.0]))
    take.markers += take.rng.normal(0, noise_m, take.markers.shape) * take.draw_mask(share)[..., None]


def move_far_away(take: Strange) -> None:
    """Record far from the origin."""
    take.markers = take.markers + take.rng.normal(0, FAR_AWAY_M, 3)


def keep_few_markers(take: Strange) -> None:
    """Leave one to six markers."""
    take.select(take.rng.permutation(take.marker_count)[: int(take.rng.integers(1, MAX_STRANGE_MARKERS + 1))])


def repeat_labels(take: Strange) -> None:
    """Give some markers the label of another."""
    for _ in range(int(take.rng.integers(1, 8))):
        to, origin = take.rng.integers(take.marker_count, size=2)
        take.labels[to] = take.labels[origin]


def repeat_markers(take: Strange) -> None:
    """Hold some trajectories twice, under two labels."""
    for _ in range(int(take.rng.integers(1, 8))):
        to, origin = take.rng.integers(take.marker_count, size=2)
        take.markers[:, to] = take.markers[:, origin]


def number_labels(take: Strange) -> None:
    """Replace all labels, or some, by numbers."""
    share = float(take.rng.choice([0.3, 1.0]))
    take.labels = [f"*{m + 1}" if take.rng.random() < share else label for m, label in enumerate(take.labels)]


def replace_labels(take: Strange) -> None:
    """Replace some labels by words that no marker has."""
    share = float(take.rng.choice([0.1, 1.0]))
    take.labels = [str(take.rng.choice(STRANGE_LABELS)) if take.rng.random() < share else label for label in take.labels]


def rename_labels(take: Strange) -> None:
    """Give all markers labels of no known set."""
    take.labels = [f"m{m}" for m in range(take.marker_count)]


def add_prefixes(take: Strange) -> None:
    """Divide the markers among subjects that they do not belong to."""
    count = int(take.rng.integers(1, len(PREFIXES) + 1))
    take.labels = [f"{PREFIXES[int(take.rng.integers(count))]}:{label}" for label in take.labels]


def add_second_person(take: Strange) -> None:
    """Add the same person once more, as another subject, beside or inside the first."""
    offset = np.array([float(take.rng.choice([0.0, 0.3, 2.0])), 0.0, 0.0])
    take.markers = np.concatenate([take.markers, take.markers + offset], axis=1)
    take.labels = [*(f"Jim:{label}" for label in take.labels), *(f"Tom:{label}" for label in take.labels)]


def add_loose_points(take: Strange) -> None:
    """Add points that belong to no person, at rest or wandering."""
    count = int(take.rng.integers(1, 30))
    wander = np.cumsum(take.rng.normal(0, float(take.rng.choice([0.0, 0.01, 0.3])), (take.frame_count, count, 3)), axis=0)
    take.markers = np.concatenate([take.markers, wander + take.rng.uniform(-3, 3, (count, 3))], axis=1)
    take.labels += [f"*{100 + m}" if take.rng.random() < 0.5 else f"extra{m}" for m in range(count)]


def reverse_half(take: Strange) -> None:
    """Play the second half backwards."""
    middle = take.frame_count // 2
    take.markers[middle:] = take.markers[middle:][::-1].copy()


def stutter(take: Strange) -> None:
    """Repeat each frame several times."""
    times = int(take.rng.integers(2, 20))
    take.markers = np.repeat(take.markers, times, axis=0)[: take.frame_count]


def shuffle_frames(take: Strange) -> None:
    """Put the frames into a random order."""
    take.markers = take.markers[take.rng.permutation(take.frame_count)]


STRANGENESSES: tuple[Callable[[Strange], None], ...] = (
    cut_to_few_frames, change_rate, collapse_all_markers, freeze_all, place_at_origin, mirror, turn_upside_down, scale,
    stretch_axis, shuffle_half_of_labels, shuffle_labels_in_each_frame, hide_nearly_all, hide_frames, hide_blocks, hide_markers,
    spin, jump, add_strange_noise, move_far_away, keep_few_markers, repeat_labels, repeat_markers, number_labels,
    replace_labels, rename_labels, add_prefixes, add_second_person, add_loose_points, reverse_half, stutter, shuffle_frames,
)  # fmt: skip


def compose_strange_take(rng: np.random.Generator, strangenesses: tuple[Callable[[Strange], None], ...]) -> Strange:
    """Return a take of a few seconds to which these things happened, in this order."""
    base = _compose_base(int(rng.choice(BASE_SEEDS)), float(rng.choice(BASE_RATES_HZ)))
    frames = int(rng.choice(BASE_FRAME_COUNTS))
    take = Strange(base.damaged_positions[:frames].copy(), list(base.labels), base.rate, rng)
    for each in strangenesses:
        each(take)
    return take


@cache
def _compose_base(seed: int, rate: float) -> SyntheticTake:
    return compose_take(seed, max(BASE_FRAME_COUNTS) / rate, rate)
