"""Fuzzing of the readers with damaged files of every format, and of whole cleans with strange takes and random options.

A file must be read, or refused in one sentence; a clean must end in outputs that can be read again, or in one sentence. Each
strangeness is a function of a `Strange` take that changes it in place. Some are nonsense, some are exports with wrong settings,
some are only rare.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from shutil import rmtree
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.batch.job_files import read_cleaning_job
from mocapfix.characters.bone_mapping import load_naming_convention
from mocapfix.characters.character_yaml import load_rig
from mocapfix.errors import SceneError
from mocapfix.io.asf_amc import read_amc
from mocapfix.io.bvh import write_bvh
from mocapfix.io.c3d import write_c3d
from mocapfix.io.capture import read_capture
from mocapfix.io.changes_file import read_changes_file
from mocapfix.io.shipped import read_yaml
from mocapfix.io.text_tables import write_csv, write_trc
from mocapfix.keypoints.keypoint_scene import read_keypoint_scene
from mocapfix.lab.fuzz_files import SEED_FRAME_COUNT, SEED_RATE_HZ, SeedFile, choose_mutations, list_seed_files
from mocapfix.lab.fuzz_process import FuzzLimits
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.options import EXTRA_FORMAT_NAMES, RIG_NAMES, build_clean_options
from mocapfix.solve.hybrik import read_twist_regressor
from mocapfix.solve.trained_priors import load_pose_model
from mocapfix.subject.library import load_marker_set, read_subject
from mocapfix.synthetic import SyntheticTake, compose_motion, compose_take, draw_subject

READER_FUZZ_LIMITS = FuzzLimits(slow_s=3.0, timeout_s=30.0)
MAX_MUTATIONS = 4  # of one file
COMPANION_SHARE = 0.5  # of the files with a companion of which the companion is damaged instead


def read_job(path: Path) -> object:
    """Read a scene, as `mocapfix run` does."""
    kind = read_yaml(path).get("kind")
    readers: dict[object, Callable[[Path], object]] = {"clean": read_cleaning_job, "keypoints-2d": read_keypoint_scene}
    if not isinstance(kind, str) or kind not in readers:
        raise SceneError(f"{path}: kind: must be one of {', '.join(map(str, readers))}, not {kind!r}.")
    return readers[kind](path)


def read_changes(path: Path) -> object:
    """Read a changes file for the take of the seed file."""
    take = Take(np.zeros((SEED_FRAME_COUNT, 2, 3)), ("Jim:LFHD", "Jim:RFHD"), SEED_RATE_HZ)
    return read_changes_file(path, take)


READERS: Mapping[str, Callable[[Path], object]] = {
    "capture": read_capture,
    "skeleton": read_amc,
    "subject": read_subject,
    "changes": read_changes,
    "job": read_job,
    "marker set": load_marker_set,
    "hierarchy": load_naming_convention,
    "rig": load_rig,
    "pose prior": lambda path: load_pose_model(str(path), load_cmu31_body().skeleton),
    "twist": read_twist_regressor,
}


@dataclass(frozen=True)
class ReaderCase:
    """A damaged file, and the kind of its reader."""

    file: SeedFile

    @property
    def size_bytes(self) -> int:
        """Size of the file."""
        return len(self.file.data)

    def save(self, folder: Path) -> None:
        """Write the file, and its companion."""
        (folder / self.file.name).write_bytes(self.file.data)
        if self.file.companion:
            (folder / self.file.companion[0]).write_bytes(self.file.companion[1])

    def run(self, folder: Path) -> str:
        """Read the file."""
        own = folder / self.file.name.replace(".", "-")  # an AMC looks for its skeleton among the files beside it
        own.mkdir(exist_ok=True)
        self.save(own)
        READERS[self.file.kind](own / self.file.name)
        return "read"


def build_reader_case(seed: int, seed_files: tuple[SeedFile, ...] = ()) -> ReaderCase:
    """Return the case of a seed: one of the valid files with one to four mutations.

    Args:
        seed_files: The valid files; by default those of `list_seed_files`.
    """
    rng = np.random.default_rng(seed)
    files = seed_files or list_seed_files()
    file = files[int(rng.integers(len(files)))]
    count = int(rng.integers(1, MAX_MUTATIONS + 1))
    if file.companion and rng.random() < COMPANION_SHARE:
        name, data = file.companion
        return ReaderCase(file._replace(companion=(name, mutate(name, data, count, rng))))
    return ReaderCase(file._replace(data=mutate(file.name, file.data, count, rng)))


def mutate(name: str, data: bytes, count: int, rng: np.random.Generator) -> bytes:
    """Return the bytes of a file after `count` mutations that fit its format."""
    mutations = choose_mutations(name)
    for _ in range(count):
        data = mutations[int(rng.integers(len(mutations)))](data, rng)
    return data


def build_folder_builder(folder: Path) -> Callable[[int], ReaderCase]:
    """Return a builder of cases from the captures in a folder, in place of the generated files."""
    files = tuple(SeedFile("capture", path.name, path.read_bytes()) for path in sorted(folder.rglob("*")) if path.is_file())
    return partial(build_reader_case, seed_files=files)


BASE_SEEDS = (0, 1, 2)
BASE_RATES_HZ = (30.0, 120.0)
BASE_FRAME_COUNTS = (40, 40, 100, 200)  # of the takes to which the strange things happen
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


CLEAN_FUZZ_LIMITS = FuzzLimits(slow_s=10.0, timeout_s=90.0)
ANIMATION_SHARE = 0.12  # of the cases that are BVH files
MAX_STRANGENESSES = 3  # of one take
OPTION_SHARE = 0.35  # of the cases that are cleaned with other options than the default
RANDOM_OPTIONS: tuple[dict[str, object], ...] = (
    {"is_fast": True}, {"prior": "none"}, {"init_method": "registration"},
    {"prior_scope": "lost-limbs"}, {"known_sets_only": True}, {"marker_set": "cmu41"}, {"max_gap_s": 0.1},
    {"update_computed": True}, {"up_axis": "X"}, {"extra_formats": EXTRA_FORMAT_NAMES, "rigs": RIG_NAMES, "output_rate_hz": 24.0},
)  # fmt: skip
WRITERS = {"c3d": write_c3d, "trc": write_trc, "csv": write_csv}
WRITER_SHARES = (0.8, 0.1, 0.1)
ANIMATION_RATES_HZ = (30.0, 120.0)
ANIMATION_DURATION_S = 2.0
ANIMATION_FRAME_COUNTS = (1, 2, 3, 5, 30, 60)
STRANGE_FACTORS = (0.0, 0.01, 10.0, 1e3, -1.0)
STRANGE_CHANNEL_SDS = (0.1, 5.0, 90.0)  # standard deviations of noise in degrees, and in centimetres of the root


@dataclass(frozen=True)
class CleanCase:
    """A file, and the options with which it is cleaned."""

    name: str
    data: bytes
    options: Mapping[str, object]

    @property
    def size_bytes(self) -> int:
        """Size of the file."""
        return len(self.data)

    def save(self, folder: Path) -> None:
        """Write the file and the options."""
        (folder / self.name).write_bytes(self.data)
        (folder / "options.txt").write_text(f"{dict(self.options)}\n", encoding="utf-8")

    def run(self, folder: Path) -> str:
        """Clean the file, write all outputs and read the cleaned file again."""
        from mocapfix import pipeline  # as late as possible: it imports nearly everything

        path, output = folder / self.name, folder / "out"
        rmtree(output, ignore_errors=True)
        path.write_bytes(self.data)
        options = build_clean_options(**self.options)
        result = pipeline.clean(path, options)
        result.write(output, options=options.output)
        cleaned = read_capture(output / path.name)
        assert path.read_bytes() == self.data, "the input was changed"
        assert not isinstance(cleaned, Take) or not np.isinf(cleaned.markers).any(), "an output is infinite"
        return "body" if any(each.motion for each in result.subject_results or (result,)) else "no body"


def build_clean_case(seed: int) -> CleanCase:
    """Return the case of a seed."""
    rng = np.random.default_rng(seed)
    options = dict(RANDOM_OPTIONS[rng.integers(len(RANDOM_OPTIONS))]) if rng.random() < OPTION_SHARE else {}
    with TemporaryDirectory() as folder:
        is_animation = rng.random() < ANIMATION_SHARE
        suffix = "bvh" if is_animation else str(rng.choice(list(WRITERS), p=WRITER_SHARES))
        path = Path(folder) / f"strange-{seed}.{suffix}"
        if is_animation:
            path.write_bytes(compose_strange_animation(rng))
        else:
            take = draw_strange_take(rng)
            WRITERS[suffix](path, Take(take.markers, tuple(take.labels), take.rate))
        return CleanCase(path.name, path.read_bytes(), options)


def draw_strange_take(rng: np.random.Generator) -> Strange:
    """Return a take to which one to three strange things happened."""
    chosen = rng.permutation(len(STRANGENESSES))[: int(rng.integers(1, MAX_STRANGENESSES + 1))]
    return compose_strange_take(rng, tuple(STRANGENESSES[each] for each in chosen))


def compose_strange_animation(rng: np.random.Generator) -> bytes:
    """Return a BVH to whose channels, rate or joint names one to three strange things happened."""
    header, channels = _compose_animation(float(rng.choice(ANIMATION_RATES_HZ)))
    channels = channels[: int(rng.choice(ANIMATION_FRAME_COUNTS))].copy()
    hierarchy, frame_time = header.split("MOTION")[0], header.split()[-1]
    for kind in rng.permutation(9)[: int(rng.integers(1, MAX_STRANGENESSES + 1))]:
        columns = np.flatnonzero(rng.random(channels.shape[1]) < rng.choice([0.05, 0.5, 1.0]))
        frames = np.flatnonzero(rng.random(len(channels)) < rng.choice([0.02, 0.5, 1.0]))
        block = np.ix_(frames, columns)
        match kind:
            case 0:
                frame_time = repr(float(1 / rng.choice(STRANGE_RATES_HZ)))
            case 1:
                channels[block] = np.nan
            case 2:
                channels[block] += rng.normal(0, rng.choice(STRANGE_CHANNEL_SDS), (len(frames), len(columns)))
            case 3:
                channels[block] = 0.0
            case 4:
                channels[block] *= rng.choice(STRANGE_FACTORS)
            case 5:
                channels[:, columns] = channels[:1, columns]
            case 6:
                channels = channels[rng.permutation(len(channels))]
            case 7:
                hierarchy = re.sub(r"(JOINT|ROOT) \w+", lambda found: f"{found[1]} J{found.start()}", hierarchy)
            case _:
                factor = float(rng.choice(STRANGE_FACTORS))
                hierarchy = re.sub(r"-?\d+\.\d+", lambda found, factor=factor: f"{factor * float(found[0]):.6f}", hierarchy)
    rows = "\n".join(" ".join(f"{value:.4f}" for value in row) for row in channels.tolist())
    return f"{hierarchy}MOTION\nFrames: {len(channels)}\nFrame Time: {frame_time}\n{rows}\n".encode()


@cache
def _compose_animation(rate: float) -> tuple[str, np.ndarray]:
    """Return the text of a BVH before its rows of channels, and these."""
    subject = draw_subject(np.random.default_rng(0), asymmetric=False)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "animation.bvh"
        write_bvh(path, load_cmu31_body().skeleton, compose_motion(subject, ANIMATION_DURATION_S, rate), rate)
        lines = path.read_text(encoding="ascii").splitlines()
    first = next(index for index, line in enumerate(lines) if line.startswith("Frame Time")) + 1
    return "\n".join(lines[:first]), np.array([[float(value) for value in line.split()] for line in lines[first:] if line])
