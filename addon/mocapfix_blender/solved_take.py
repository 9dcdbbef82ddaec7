"""A cleaned take as mocapfix wrote it, in metres and in Blender's axes (Z up, facing -Y)."""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from .axes import BLENDER_FROM_Y_UP, align_signs, convert_points, make_matrices, make_quaternions, rotate_quaternions
from .process import ProcessError

NPZ_FORMAT = "mocapfix 1"
"""the form of the file that this add-on reads"""
HAND_BONES = ("Palm", "ThumbMetacarpal", "ThumbProximal", "ThumbDistal") + tuple(
    f"{finger}{bone}" for finger in ("Index", "Middle", "Ring", "Little") for bone in ("Proximal", "Intermediate", "Distal")
)
"""the bones of a hand after its side, as in the BVH of a take: the palm, and three joints of each finger"""


@dataclass(frozen=True)
class SkeletonMotion:
    """A tree of J joints and its motion over T frames. In the rest pose the axes of all joints are Blender's.

    Attributes:
        names, parents: J names, and the index of each joint's parent, -1 for the root; parents come first.
        offsets: (J, 3) m: each joint in its parent's axes.
        ends: (J, 3) m: end of a last bone in its joint's axes, NaN for other joints.
        root: (T, 3) m: the root in the world.
        rotations: (T, J, 4): quaternions x, y, z, w of each joint relative to its parent, without changes of sign.
        rate: Frames per second.
        is_solved: (J,) whether the markers show the joint; the others stay in their rest pose.
        translations: (T, 3) m for each joint below the root whose position in its parent's axes changes, by its index.
    """

    names: tuple[str, ...]
    parents: np.ndarray
    offsets: np.ndarray
    ends: np.ndarray
    root: np.ndarray
    rotations: np.ndarray
    rate: float
    is_solved: np.ndarray
    translations: dict[int, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class SolvedTake:
    """One subject of a take: its markers, and its body if it has one."""

    name: str  # name of the take, with that of the subject if the take has several: "walk", "walk.Jim"
    subject: str  # name of the subject if the take has several, else empty
    labels: tuple[str, ...]  # M labels of markers (joints of an animation)
    markers: np.ndarray  # (F, M, 3) m, NaN where missing
    marker_sd: np.ndarray  # (F, M) m: predicted standard deviation per axis of samples that mocapfix estimated, NaN elsewhere
    marker_rate: float  # frames per second of the markers
    first_frame: int  # the file's number of the first frame
    body: SkeletonMotion | None  # None if the take has no body
    pose_status: np.ndarray  # (T,) the confidence in each pose: an index into status_texts
    status_texts: tuple[str, ...]
    report: dict = field(repr=False)  # the contents of the JSON report

    def replace_body(self, body: SkeletonMotion) -> "SolvedTake":
        """Return the take with another body, of the same frames."""
        return replace(self, body=body)

    @property
    def is_animation(self) -> bool:
        """Whether the points are the joints of an animation."""
        return bool(self.report["take"].get("animation"))

    @property
    def is_filled(self) -> np.ndarray:
        """(F, M): whether mocapfix estimated the sample."""
        return np.isfinite(self.marker_sd) & np.isfinite(self.markers[..., 0])

    @property
    def frame_count(self) -> int:
        """Frames of the motion, of the markers without a body."""
        return len(self.markers) if self.body is None else len(self.body.root)

    @property
    def rate(self) -> float:
        """Frames per second of the motion, of the markers without a body."""
        return self.marker_rate if self.body is None else self.body.rate


def read_solved_takes(folder: Path, since: float = 0.0) -> list[SolvedTake]:
    """Read the subjects of the take that mocapfix has cleaned into a folder.

    Args:
        since: Ignore older files: a time in seconds since the epoch.

    Raises:
        ProcessError: If files are missing or have an unknown form.
    """
    paths = [path for path in sorted(folder.glob("*.npz")) if get_report_path(path).exists() and path.stat().st_mtime >= since]
    if not paths:
        raise ProcessError("mocapfix wrote no result; check that the executable in the add-on's preferences is mocapfix.")
    try:
        return [read_solved_take(path) for path in paths]
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise ProcessError("The result of mocapfix cannot be read; update the add-on and mocapfix.") from error


def get_report_path(path: Path) -> Path:
    """Return the path of the report beside an NPZ file."""
    return path.with_name(f"{path.stem}.report.json")


def read_subject(path: Path) -> str:
    """Return the subject of an NPZ file if its take has several, else an empty text."""
    return json.loads(get_report_path(path).read_text(encoding="utf-8"))["take"].get("person", "")


def read_solved_take(path: Path) -> SolvedTake:
    """Read one subject of a take from its NPZ file and the report beside it."""
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    if str(arrays.get("format")) != NPZ_FORMAT:
        raise ProcessError(f"mocapfix wrote a file of another version ({arrays.get('format')}); update the add-on and mocapfix.")
    report = json.loads(get_report_path(path).read_text(encoding="utf-8"))
    has_body = "names" in arrays
    return SolvedTake(
        path.stem,
        report["take"].get("person", ""),
        tuple(map(str, arrays["labels"])),
        convert_points(arrays["markers"]),
        arrays["marker_sd"],
        float(arrays["marker_rate"]),
        int(arrays["first_frame"]),
        _build_body(arrays) if has_body else None,
        arrays["status"] if has_body else np.zeros(0, int),
        tuple(map(str, arrays["status_texts"])) if has_body else (),
        report,
    )


def _build_body(arrays: dict[str, np.ndarray]) -> SkeletonMotion:
    body = SkeletonMotion(
        tuple(map(str, arrays["names"])),
        arrays["parents"],
        convert_points(arrays["offsets"]),
        convert_points(arrays["ends"]),
        convert_points(arrays["root"]),
        rotate_quaternions(arrays["rotations"], BLENDER_FROM_Y_UP),
        float(arrays["rate"]),
        arrays["solved_joints"],
    )
    for side in ("Left", "Right"):
        if f"{side.lower()}_hand_wrist" in arrays:
            body = _add_hand(body, side, arrays)
    return body


def _add_hand(body: SkeletonMotion, side: str, arrays: dict[str, np.ndarray]) -> SkeletonMotion:
    """Return a body with the palm and the fingers of a hand below its joint LeftHand or RightHand."""
    frames = np.rint(np.arange(len(body.root)) * float(arrays["marker_rate"]) / body.rate).astype(int)
    frames = np.minimum(frames, len(arrays[f"{side.lower()}_hand_wrist"]) - 1)
    wrist, points, palm, turns = (
        arrays[f"{side.lower()}_hand_{name}"][frames] for name in ("wrist", "points", "palm", "rotations")
    )
    wrist, points = convert_points(wrist), convert_points(points)
    palm, turns = (rotate_quaternions(each, BLENDER_FROM_Y_UP) for each in (palm, turns))
    carrier, position, axes = body.names.index(f"{side}Hand"), body.root, make_matrices(body.rotations[:, 0])
    path = [carrier]
    while body.parents[path[0]] > 0:
        path.insert(0, int(body.parents[path[0]]))
    for joint in path:
        position, axes = position + axes @ body.offsets[joint], axes @ make_matrices(body.rotations[:, joint])
    axes = axes.swapaxes(-1, -2)
    place = (axes @ (wrist - position)[..., None])[..., 0]
    palm_axes = make_matrices(palm)
    fingers = [np.repeat(palm_axes[:, None], 5, axis=1)]
    for number in range(3):
        fingers.append(fingers[-1] @ make_matrices(turns[:, number::3]))
    joints, tips = points[:, :15].reshape(-1, 5, 3, 3), points[:, 15:, None]
    chains = np.concatenate([np.broadcast_to(wrist[:, None, None], tips.shape), joints, tips], axis=2)
    vectors = np.diff(chains, axis=2)[..., None]
    bones = np.median((np.stack(fingers, axis=2).swapaxes(-1, -2) @ vectors)[..., 0], axis=0)  # in the axes of the parents
    first, ends = len(body.names), np.full((16, 3), np.nan)
    ends[3::3] = bones[:, 3]
    parents = [carrier, *(first + number if number % 3 else first for number in range(15))]
    return replace(
        body,
        names=(*body.names, *(side + name for name in HAND_BONES)),
        parents=np.concatenate([body.parents, parents]),
        offsets=np.concatenate([body.offsets, np.median(place, axis=0)[None], bones[:, :3].reshape(15, 3)]),
        ends=np.concatenate([body.ends, ends]),
        rotations=np.concatenate([body.rotations, align_signs(make_quaternions(axes @ palm_axes))[:, None], turns], axis=1),
        is_solved=np.concatenate([body.is_solved, np.ones(16, bool)]),
        translations=body.translations | {first: place},
    )
