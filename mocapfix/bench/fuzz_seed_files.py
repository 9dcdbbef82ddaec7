"""Small valid files of every format that mocapfix reads, of which the fuzzing of the readers makes damaged ones."""

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from mocapfix.calibrate.subject_file import write_subject
from mocapfix.changes import Change, SampleState
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.motion import Motion
from mocapfix.review.changes_file import Review, write_changes_file
from mocapfix.review.corrections import locate_correction
from mocapfix.review.file_models import CorrectionModel
from mocapfix.skeleton import Skeleton, load_cmu31_body
from mocapfix.synthetic import compose_take
from mocapfix.take import Take
from mocapfix.write import write_asf_amc, write_bvh, write_c3d, write_csv, write_trc

SEED_FRAME_COUNT = 4
SEED_MARKER_COUNT = 5
SEED_RATE_HZ = 120.0
SEED_CORRECTIONS = (
    CorrectionModel(kind="wrong", markers=["Jim:LFHD"], first=1, last=2),
    CorrectionModel(kind="swap", markers=["Jim:LFHD", "Jim:RFHD"], first=2, last=3, note="seen: twice"),
    CorrectionModel(kind="fill", markers=["Jim:RFHD"], first=1, last=3, method="spline"),
)
SHIPPED_SEEDS = (
    "scenes/demo.yaml", "scenes/session.yaml", "scenes/keypoints-2d.yaml", "scenes/marker-sets/davis.yaml",
    "scenes/hierarchies/rokoko.yaml", "scenes/rigs/blender.yaml", "priors/pca.safetensors", "priors/twist.safetensors",
)  # fmt: skip


class SeedFile(NamedTuple):
    """A valid file.

    kind       name of the reader, see `fuzz_readers.READERS`
    name       of the file
    companion  name and content of a file that it needs beside it: the skeleton of an AMC
    """

    kind: str
    name: str
    data: bytes
    companion: tuple[str, bytes] | None = None


@cache
def list_seed_files() -> tuple[SeedFile, ...]:
    """Return a valid file of each format."""
    truth = compose_take(0, 1.0, SEED_RATE_HZ)
    markers, labels = truth.damaged_positions[:SEED_FRAME_COUNT, :SEED_MARKER_COUNT], truth.labels[:SEED_MARKER_COUNT]
    take = Take(markers, tuple(f"Jim:{label}" for label in labels), SEED_RATE_HZ)
    body = load_cmu31_body().skeleton
    motion = truth.motion.select_frames(np.arange(3))
    before, after = SampleState(0, 9.0), SampleState(0, None)
    change = Change("spike-LFHD-2", "spike", ("Jim:LFHD",), 2, 3, 2, "0.1 m off", "body", before, after, 2.0)
    review = Review(corrections=tuple(locate_correction(each, take, "seed") for each in SEED_CORRECTIONS))
    millimetres = np.where(np.isnan(markers), 0.0, 1000 * markers[..., [2, 0, 1]])
    texts = {
        "motive.csv": build_motive_text(millimetres, labels),
        "motive-rows.csv": build_motive_rows_text(millimetres / 1000, labels),
        "nexus.csv": build_nexus_text(millimetres, labels),
        "qualisys.tsv": build_qualisys_text(millimetres, labels),
        "points.json": build_keypoint_text(markers, labels),
    }
    seeds = [SeedFile("capture", name, text.encode()) for name, text in texts.items()]
    seeds += [
        SeedFile("capture", "walk.c3d", _write_bytes("walk.c3d", lambda path: write_c3d(path, take))),
        SeedFile("capture", "walk.trc", _write_bytes("walk.trc", lambda path: write_trc(path, take))),
        SeedFile("capture", "walk.csv", _write_bytes("walk.csv", lambda path: write_csv(path, take))),
        SeedFile("capture", "walk.bvh", _write_bytes("walk.bvh", lambda path: write_bvh(path, body, motion, SEED_RATE_HZ))),
        SeedFile("subject", "subject.yaml", _write_bytes("subject.yaml", lambda path: write_subject(path, truth.subject))),
        SeedFile(
            "changes",
            "changes.yaml",
            _write_bytes("changes.yaml", lambda path: write_changes_file(path, take, [change], review)),
        ),
    ]
    asf, amc = _write_motion_pair(body, motion)
    seeds += [SeedFile("capture", "walk.amc", amc, ("walk.asf", asf)), SeedFile("skeleton", "alone.asf", asf)]
    root = find_shipped_folder("scenes").parent
    kinds = {"demo": "job", "session": "job", "keypoints-2d": "job", "davis": "marker set", "rokoko": "hierarchy"}
    kinds |= {"blender": "rig", "pca": "pose prior", "twist": "twist"}
    seeds += [SeedFile(kinds[Path(name).stem], Path(name).name, (root / name).read_bytes()) for name in SHIPPED_SEEDS]
    return tuple(seeds)


def _write_bytes(name: str, write: Callable[[Path], object]) -> bytes:
    with TemporaryDirectory() as folder:
        write(Path(folder) / name)
        return (Path(folder) / name).read_bytes()


def _write_motion_pair(skeleton: Skeleton, motion: Motion) -> tuple[bytes, bytes]:
    with TemporaryDirectory() as folder:
        asf, amc = Path(folder) / "walk.asf", Path(folder) / "walk.amc"
        write_asf_amc(asf, amc, skeleton, motion, SEED_RATE_HZ)
        return asf.read_bytes(), amc.read_bytes()


def format_row(points: np.ndarray, decimals: int = 3) -> list[str]:
    """Return the coordinates of points (P, 3) as fields."""
    return [f"{value:.{decimals}f}" for value in points.ravel()]


def build_motive_text(points: np.ndarray, labels: Sequence[str]) -> str:
    """Return a Motive CSV of points (T, P, 3) in millimetres."""
    head = ["Format Version,1.23,Take Name,walk,Capture Frame Rate,120.0,Export Frame Rate,120.0,Rotation Type,Quaternion"]
    head[0] += f",Total Exported Frames,{len(points)},Length Units,Millimeters,Coordinate Space,Global"
    columns = [("Type", "Marker"), ("Name", ""), ("ID", "1"), ("", "Position")]
    head += ["", *(",".join(["", key, *(value or label for label in labels for _ in "XYZ")]) for key, value in columns)]
    head.append(",".join(["Frame", "Time (Seconds)", *("XYZ" * len(labels))]))
    rows = [",".join([str(t), f"{t / SEED_RATE_HZ:.6f}", *format_row(row)]) for t, row in enumerate(points)]
    return "\r\n".join(head + rows) + "\r\n"


def build_motive_rows_text(points: np.ndarray, labels: Sequence[str]) -> str:
    """Return an OptiTrack CSV 1.1 of points (T, P, 3) in metres, which lists the visible markers of each frame."""
    lines = ['comment,"OptiTrack Export Data"', "righthanded", "info,version,1.1", f"info,framecount,{len(points)}"]
    for t, row in enumerate(points):
        cells = [cell for m, point in enumerate(row) for cell in (*format_row(point, 6), str(40 + m), labels[m])]
        lines.append(",".join(["frame", str(t), f"{t / SEED_RATE_HZ:.6f}", "0", str(len(labels)), *cells]))
    return "\r\n".join(lines) + "\r\n"


def build_nexus_text(points: np.ndarray, labels: Sequence[str]) -> str:
    """Return a Nexus CSV of points (T, P, 3) in millimetres."""
    names = ["", "", *(cell for label in labels for cell in (f"Jim:{label}", "", ""))]
    head = ["Trajectories", "120", ",".join(names), ",".join(["Frame", "Sub Frame", *("XYZ" * len(labels))])]
    head.append(",".join(["", "", *(["mm"] * 3 * len(labels))]))
    return "\n".join(head + [",".join([str(t + 1), "0", *format_row(row)]) for t, row in enumerate(points)]) + "\n"


def build_qualisys_text(points: np.ndarray, labels: Sequence[str]) -> str:
    """Return a QTM TSV of points (T, P, 3) in millimetres."""
    head = [f"NO_OF_FRAMES\t{len(points)}", "NO_OF_CAMERAS\t10", f"NO_OF_MARKERS\t{len(labels)}", "FREQUENCY\t120"]
    head += ["TIME_STAMP\t2026-01-19, 10:19:43.755\t2063631.9", "DATA_INCLUDED\t3D", "EVENT\tjump\t3\t0.02"]
    head.append("\t".join(["MARKER_NAMES", *labels]))
    head.append("\t".join(["Frame", "Time", *(f"{label} {axis}" for label in labels for axis in "XYZ")]))
    rows = ["\t".join([str(t + 1), f"{t / SEED_RATE_HZ:.5f}", *format_row(row)]) for t, row in enumerate(points)]
    return "\r\n".join(head + rows) + "\r\n"


def build_keypoint_text(points: np.ndarray, labels: Sequence[str]) -> str:
    """Return a JSON of 3-D keypoints (T, P, 3) in metres."""
    rows = [[[None if np.isnan(value) else round(float(value), 4) for value in point] for point in row] for row in points]
    names = ", ".join(f'"{label}"' for label in labels)
    return f'{{"labels": [{names}], "rate": 30.0, "unit": "m", "frames": {rows}}}\n'.replace("None", "null")
