"""Small valid files of every format that mocapfix reads, and damage to them that knows their formats.

A mutation is a function of the bytes of a file and a source of random numbers, and returns other bytes: with other numbers,
counts, lengths, units, encodings or sections, or with bytes at random.
"""

import re
import struct
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from mocapfix.io.asf_amc import write_asf_amc
from mocapfix.io.bvh import write_bvh
from mocapfix.io.c3d import write_c3d
from mocapfix.io.changes_file import Review, locate_correction, write_changes_file
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.io.text_tables import write_csv, write_trc
from mocapfix.io.yaml_files import CorrectionModel
from mocapfix.model.changes import Change, SampleState
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.subject.library import write_subject
from mocapfix.synthetic import compose_take

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
    """A valid file."""

    kind: str  # name of the reader, see `fuzz_readers.READERS`
    name: str  # of the file
    data: bytes
    companion: tuple[str, bytes] | None = None  # name and content of a file that it needs beside it: the skeleton of an AMC


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
            "changes", "changes.yaml", _write_bytes("changes.yaml", lambda path: write_changes_file(path, take, [change], review))
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


Mutation = Callable[[bytes, np.random.Generator], bytes]

STRANGE_NUMBERS = (
    "0", "-1", "1", "-0.0", "nan", "NaN", "-inf", "1e308", "1e400", "-1e-320", "1,5", "0x10", "1_000", "1" * 40, "9" * 5000, "",
    "-", ".", "+", "1e", "--5", "1.2.3", "65536", "4294967296", "-2147483649", "1.#QNAN", "\u0663", "\u00b2", "true", "1e9",
)  # fmt: skip
STRANGE_WORDS = (
    "", " ", '"', "'", "{", "}", "[", "]", ":", ",", "#", "!!python/object:os.system x", "&a *a", "*a", "<<: *a", "~", "|", ">",
    "2024-13-45", "0o9", ".nan", "12:61:61", "!!binary x", "!!timestamp x", "!!int x", "? - x", "mm", "furlong", "Frames:", "%",
    "JOINT", "End Site", "CHANNELS 3", ":root", "begin", "end", "\x00", "\ufeff", "\u2028", "\u00e9", "A" * 300, "MOTION",
)  # fmt: skip
STRANGE_UINT16 = (0, 1, 2, 127, 128, 255, 256, 32767, 32768, 65534, 65535)
STRANGE_FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-45, 1e38, -1e38, 0.1, 1e6, float("nan"), float("inf"), float("-inf"))
STRANGE_BYTES = (0, 1, 2, 4, 80, 84, 85, 86, 127, 128, 129, 253, 254, 255)
TEXT_TOKEN_PATTERN = re.compile(rb"[^\s,;:{}\[\]\"']+")
NUMBER_PATTERN = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
HEAD_LINE_COUNT = 12
MAX_DEPTH = 20_000  # of brackets in brackets
MAX_REPEATS = 20_000  # of a line or a token
C3D_BLOCK = 512
C3D_HEADER_FLOATS = (12, 20)  # byte offsets of the scale and of the rate


def replace_span(data: bytes, start: int, end: int, new: bytes) -> bytes:
    """Return the bytes with those from `start` to `end` replaced."""
    return data[:start] + new + data[end:]


def change_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    """Change a few bytes anywhere, or near the beginning."""
    changed = bytearray(data)
    reach = len(data) if rng.random() < 0.5 else min(len(data), 2 * C3D_BLOCK)
    for position in rng.integers(0, max(reach, 1), int(rng.integers(1, 9))):
        if position < len(changed):
            changed[position] = int(rng.choice(STRANGE_BYTES)) if rng.random() < 0.5 else int(rng.integers(256))
    return bytes(changed)


def truncate(data: bytes, rng: np.random.Generator) -> bytes:
    """Cut the file anywhere, or at a block."""
    stop = int(rng.integers(0, len(data) + 1))
    return data[: stop // C3D_BLOCK * C3D_BLOCK] if rng.random() < 0.3 else data[:stop]


def repeat_section(data: bytes, rng: np.random.Generator) -> bytes:
    """Insert a copy of some section elsewhere."""
    start, end = np.sort(rng.integers(0, len(data) + 1, 2))
    at = int(rng.integers(0, len(data) + 1))
    return data[:at] + data[start:end] + data[at:]


def remove_section(data: bytes, rng: np.random.Generator) -> bytes:
    """Remove some section."""
    start = int(rng.integers(0, len(data) + 1))
    return data[:start] + data[start + int(rng.integers(1, C3D_BLOCK)) :]


def append_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    """Append zeros, noise or the file itself."""
    tails = (bytes(int(rng.integers(1, 2000))), rng.bytes(int(rng.integers(1, 2000))), data)
    return data + tails[rng.integers(len(tails))]


def change_c3d_header(data: bytes, rng: np.random.Generator) -> bytes:
    """Set a word or a float of a C3D header to a value at the limits."""
    changed = bytearray(data.ljust(C3D_BLOCK, b"\0"))
    if rng.random() < 0.3:
        struct.pack_into("<f", changed, int(rng.choice(C3D_HEADER_FLOATS)), float(rng.choice(STRANGE_FLOATS)))
    elif rng.random() < 0.2:
        changed[int(rng.integers(2))] = int(rng.choice(STRANGE_BYTES))
    else:
        struct.pack_into("<H", changed, 2 * int(rng.integers(1, 13)), int(rng.choice(STRANGE_UINT16)))
    return bytes(changed)


def list_c3d_records(data: bytes) -> list[tuple[int, int]]:
    """Return first and last + 1 byte of the groups and parameters of a C3D, as far as their lengths lead."""
    records: list[tuple[int, int]] = []
    start = C3D_BLOCK * (data[0] - 1) + 4 if data and data[0] else C3D_BLOCK + 4
    while start + 4 < len(data) and data[start]:
        name_length = struct.unpack_from("b", data, start)[0]
        offset_at = start + 2 + abs(name_length)
        if offset_at + 2 > len(data):
            break
        end = offset_at + struct.unpack_from("<H", data, offset_at)[0]
        if end <= start:
            break
        records.append((start, min(end, len(data))))
        start = end
    return records


def change_c3d_record(data: bytes, rng: np.random.Generator) -> bytes:
    """Change a group or a parameter: its name's length, its group, its length, its type, its dimensions or its values."""
    records = list_c3d_records(data)
    if not records:
        return change_c3d_header(data, rng)
    start, end = records[rng.integers(len(records))]
    name_end = start + 2 + abs(struct.unpack_from("b", data, start)[0])
    changed = bytearray(data)
    match int(rng.integers(7)):
        case 0:
            return data[:end] + data[start:end] + data[end:]
        case 1:
            return data[:start] + data[end:] + bytes(end - start)
        case 2 | 3:  # type, number of dimensions, dimensions
            at = name_end + 2 + int(rng.integers(0, 4))
            changed[min(at, len(changed) - 1)] = int(rng.choice(STRANGE_BYTES))
        case 4:
            changed[start + int(rng.integers(2))] = int(rng.choice(STRANGE_BYTES))
        case 5:
            struct.pack_into("<H", changed, min(name_end, len(changed) - 2), int(rng.choice(STRANGE_UINT16)))
        case _:
            at = int(rng.integers(start, end))
            changed[at : at + 4] = struct.pack("<f", float(rng.choice(STRANGE_FLOATS)))[: len(changed) - at]
    return bytes(changed)


def change_c3d_samples(data: bytes, rng: np.random.Generator) -> bytes:
    """Overwrite some aligned words behind the parameters with floats at the limits."""
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 20))):
        at = 4 * int(rng.integers(0, max(len(changed) // 4 - 1, 1)))
        changed[at : at + 4] = struct.pack("<f", float(rng.choice(STRANGE_FLOATS)))
    return bytes(changed)


def change_processor(data: bytes, rng: np.random.Generator) -> bytes:
    """Declare another kind of processor, or integers for floats."""
    at = C3D_BLOCK * (data[0] - 1) + 3 if data and data[0] else 0
    changed = bytearray(data)
    if at < len(changed):
        changed[at] = int(rng.choice((83, 84, 85, 86, 87, 0)))
    return bytes(changed)


def change_number(data: bytes, rng: np.random.Generator) -> bytes:
    """Replace a number of a text, most often one near its beginning."""
    return _replace_match(data, NUMBER_PATTERN, STRANGE_NUMBERS, rng)


def change_word(data: bytes, rng: np.random.Generator) -> bytes:
    """Replace a word of a text, most often one near its beginning."""
    return _replace_match(data, TEXT_TOKEN_PATTERN, STRANGE_WORDS + STRANGE_NUMBERS, rng)


def exchange_words(data: bytes, rng: np.random.Generator) -> bytes:
    """Write one word of the text in place of another."""
    tokens = list(TEXT_TOKEN_PATTERN.finditer(data[: 1 << 14]))
    if not tokens:
        return data
    one, other = (tokens[int(rng.integers(len(tokens)))] for _ in range(2))
    return replace_span(data, *one.span(), other[0])


def _replace_match(data: bytes, pattern: re.Pattern[bytes], words: tuple[str, ...], rng: np.random.Generator) -> bytes:
    head = data[:400] if rng.random() < 0.5 else data[: 1 << 14]
    found = list(pattern.finditer(head))
    if not found:
        return data
    return replace_span(data, *found[int(rng.integers(len(found)))].span(), words[int(rng.integers(len(words)))].encode())


def change_lines(data: bytes, rng: np.random.Generator) -> bytes:
    """Remove, repeat, exchange or empty lines."""
    lines = data.split(b"\n")
    reach = min(len(lines), HEAD_LINE_COUNT) if rng.random() < 0.5 else len(lines)
    one, other = (int(rng.integers(reach)) for _ in range(2))
    match int(rng.integers(5)):
        case 0:
            del lines[one : one + int(rng.integers(1, 4))]
        case 1:
            lines.insert(other, lines[one])
        case 2:
            lines[one], lines[other] = lines[other], lines[one]
        case 3:
            lines[one] = b""
        case _:
            lines[one:one] = [lines[other]] * int(rng.choice([2, 100, MAX_REPEATS // max(len(lines[other]), 1) + 1]))
    return b"\n".join(lines)


def change_cells(data: bytes, rng: np.random.Generator) -> bytes:
    """Remove, repeat or add cells of a line."""
    lines = data.split(b"\n")
    index = int(rng.integers(len(lines)))
    delimiter = next((each for each in (b"\t", b",", b";", b" ") if each in lines[index]), b",")
    cells = lines[index].split(delimiter)
    at = int(rng.integers(len(cells)))
    match int(rng.integers(3)):
        case 0:
            del cells[at:]
        case 1:
            cells[at:at] = [cells[at]] * int(rng.choice([1, 2, 1000]))
        case _:
            cells[at] = b'"' + cells[at]
    lines[index] = delimiter.join(cells)
    return b"\n".join(lines)


def change_encoding(data: bytes, rng: np.random.Generator) -> bytes:
    """Write the text in another encoding, with other line ends or other delimiters."""
    text = data.decode("latin-1")
    match int(rng.integers(8)):
        case 0:
            return b"\xff\xfe" + text.encode("utf-16-le")
        case 1:
            return b"\xfe\xff" + text.encode("utf-16-be")[: int(rng.integers(1, 2 * len(text) + 2))]
        case 2:
            return b"\xef\xbb\xbf" + data
        case 3:
            return data.replace(b"\r\n", b"\n").replace(b"\n", b"\r")
        case 4:
            return data.replace(b"\n", b"\r\n" if rng.random() < 0.5 else b"\n\n")
        case 5:
            return data.replace(b",", rng.choice([b";", b"\t", b" "]).item())
        case 6:
            return data.replace(b".", b",")
        case _:
            return data.replace(b" ", bytes(1)) if rng.random() < 0.3 else data.replace(b"\t", b" ")


def nest_deeply(data: bytes, rng: np.random.Generator) -> bytes:
    """Insert brackets, blocks or joints that contain each other many times."""
    depth = int(rng.choice([10, 1000, MAX_DEPTH]))
    opening, closing = (
        (b"[", b"]"), (b"{", b"}"), (b"JOINT x\n{\nOFFSET 0 0 0\nCHANNELS 0\n", b"}\n"), (b'{"a":', b"}"), (b"begin\n", b"end\n"),
    )[rng.integers(5)]  # fmt: skip
    found = list(TEXT_TOKEN_PATTERN.finditer(data[: 1 << 14]))
    at = found[int(rng.integers(len(found)))].start() if found else 0
    return data[:at] + opening * depth + (closing * depth if rng.random() < 0.5 else b"") + data[at:]


def add_aliases(data: bytes, rng: np.random.Generator) -> bytes:
    """Insert YAML aliases that refer to each other, nine times ninefold."""
    levels = int(rng.integers(3, 10))
    text = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n"
    text += "".join(f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 9)}]\n" for level in range(1, levels))
    found = list(re.finditer(rb"(?m)^[a-z_]+:(.*)$", data))
    if not found:
        return text.encode() + data
    chosen = found[int(rng.integers(len(found)))]
    return text.encode() + replace_span(data, *chosen.span(1), f" *a{levels - 1}".encode())


ANY_MUTATIONS: tuple[Mutation, ...] = (change_bytes, truncate, repeat_section, remove_section, append_bytes)
C3D_MUTATIONS: tuple[Mutation, ...] = (
    *ANY_MUTATIONS, *(change_c3d_header, change_c3d_record) * 4, change_c3d_samples, change_processor,
)  # fmt: skip
TEXT_MUTATIONS: tuple[Mutation, ...] = (
    *ANY_MUTATIONS, *(change_number, change_word) * 4, exchange_words, change_lines, change_lines, change_cells, change_encoding,
    nest_deeply,
)  # fmt: skip
YAML_MUTATIONS: tuple[Mutation, ...] = (*TEXT_MUTATIONS, add_aliases)


def choose_mutations(name: str) -> tuple[Mutation, ...]:
    """Return the mutations for a file, by its suffix."""
    if name.endswith(".c3d"):
        return C3D_MUTATIONS
    if name.endswith(".safetensors"):
        return ANY_MUTATIONS
    return YAML_MUTATIONS if name.endswith(".yaml") else TEXT_MUTATIONS
