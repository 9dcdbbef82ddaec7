"""Generated C3D files, valid and nearly valid, read by mocapfix and by ezc3d: both must find what was put into them.

A file is generated in one of six encodings, with points, residuals, analog values, labels, events, groups and sizes by chance. A
nearly valid one has words in its header or parameters that contradict the rest, as files of some programs have: mocapfix must
find the same samples, or refuse the file. What ezc3d is known to read otherwise is listed in docs/robustness.md and is not
compared: see `_compare_with_ezc3d`.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped

from mocapfix.errors import ReadError
from mocapfix.io.c3d_events import read_c3d_events
from mocapfix.io.c3d_parameters import C3dHead
from mocapfix.io.capture import read_take
from mocapfix.io.force_plates import read_analog
from mocapfix.lab.fuzz_process import FuzzLimits
from mocapfix.model.take import (
    C3D_BLOCK_BYTES,
    DEC_PROCESSOR,
    INTEL_PROCESSOR,
    MAX_C3D_WORD,
    MAX_RESIDUAL_COUNTS,
    SGI_PROCESSOR,
    C3dLayout,
    Take,
)
from mocapfix.options import ReadOptions
from mocapfix.output_formats import write_cleaned_copy

C3D_FUZZ_LIMITS = FuzzLimits(slow_s=5.0, timeout_s=60.0)
READ_OPTIONS = ReadOptions(accept_contradictions=True)  # the points are those of no body, whatever their labels are
ODD_SHARE = 0.3  # of the files that are nearly valid only
SECOND_ODDITY_SHARE = 0.3  # of these that have two oddities
MANY_POINTS_SHARE, MANY_FRAMES_SHARE = 0.02, 0.002
CLEANED_SHARE = 0.05  # of the files of which a changed copy is written
MAX_HEADER_EVENTS = 18
EVENT_KEY = 12_345
UNITS = {"mm": 1.0, "cm": 0.1, "m": 0.001}
TEXT, BYTE, WORD, FLOAT = -1, 1, 2, 4
LABEL_WORDS = ("LFHD", "RFHD", "C7", "T10", "LANK", "RKNE", "Skeleton:Hips", "a", "", "Märker", "x" * 40)


@dataclass(frozen=True)
class C3dContent:
    """What is put into a generated file: T frames of P points and C analog channels with S samples in a frame.

    Attributes:
        processor_type: Intel, DEC or SGI.
        is_float: Whether words are floats.
        scale: Size of a count.
        unit: Name of the unit.
        rate: Frames per second.
        first_frame: Number of the first frame.
        counts: Coordinates in file units, or of an integer file in counts.
        residual_words: Cameras in the high byte, residual in the low byte; -1 for missing samples.
        analog_words: Stored analog values.
        is_unsigned: Whether analog integers are unsigned.
        analog_scales: Of each channel.
        analog_offsets: Of each channel, as stored.
        general_scale: Of all channels.
        labels: Of the points.
        header_events: Time and label.
        events: Time, label and side.
    """

    processor_type: int
    is_float: bool
    scale: float
    unit: str
    rate: float
    first_frame: int
    counts: Float[np.ndarray, "T P 3"]
    residual_words: Int[np.ndarray, "T P"]
    analog_words: Float[np.ndarray, "T S C"]
    is_unsigned: bool
    analog_scales: Float[np.ndarray, " C"]
    analog_offsets: Int[np.ndarray, " C"]
    general_scale: float
    labels: tuple[str, ...]
    header_events: tuple[tuple[float, str], ...] = ()
    events: tuple[tuple[float, str, str], ...] = ()

    @property
    def positions(self) -> Float[np.ndarray, "T P 3"]:
        """Coordinates in file units."""
        return self.counts if self.is_float else self.counts * self.scale

    @property
    def is_missing(self) -> Shaped[np.ndarray, "T P"]:
        """Which samples are missing."""
        return (self.residual_words < 0) | (self.counts == 0).all(-1)

    @property
    def is_long(self) -> bool:
        """Whether the size of the data tells integers from floats, which it does not within a block."""
        return 2 * self.counts.size + self.analog_words.size > C3D_BLOCK_BYTES

    @property
    def byte_order(self) -> str:
        """Order of bytes, as for `struct`."""
        return ">" if self.processor_type == SGI_PROCESSOR else "<"

    def encode_floats(self, values: Shaped[np.ndarray, "*shape"]) -> bytes:
        """Return floats as the file stores them; those of DEC are four times as large, and their words are exchanged."""
        if self.processor_type != DEC_PROCESSOR:
            return np.asarray(values).astype(f"{self.byte_order}f4").tobytes()
        halves = (np.asarray(values).astype("<f4") * np.float32(4)).astype("<f4").reshape(-1, 1).view("<u2")
        return halves[:, ::-1].tobytes()

    def encode_words(self, values: Shaped[np.ndarray, "*shape"]) -> bytes:
        """Return whole numbers as 16-bit words."""
        return (np.atleast_1d(values).astype(np.int64) & MAX_C3D_WORD).astype(f"{self.byte_order}u2").tobytes()


@dataclass(frozen=True)
class C3dOddity:
    """What is wrong in a nearly valid file.

    Attributes:
        name: Of the oddity.
        header_words: Values of words of the header, by their number from 1.
        parameters: Values of parameters, None for those that are missing.
        scale_sign: Factor of POINT:SCALE.
        header_scale_sign: Factor of the header's scale.
    """

    name: str = ""
    header_words: Mapping[int, int] = field(default_factory=dict[int, int])
    parameters: Mapping[str, Any] = field(default_factory=dict[str, Any])
    scale_sign: int = 1
    header_scale_sign: int = 1

    def combine(self, other: "C3dOddity") -> "C3dOddity":
        """Return both at once."""
        return C3dOddity(
            f"{self.name}; {other.name}",
            {**self.header_words, **other.header_words},
            {**self.parameters, **other.parameters},
            min(self.scale_sign, other.scale_sign),
            min(self.header_scale_sign, other.header_scale_sign),
        )


@dataclass(frozen=True)
class C3dCase:
    """A generated file.

    Attributes:
        content: What was put into it.
        data: Its bytes.
        oddity: What is wrong in it, "" for nothing.
        is_cleaned: Whether a changed copy is written as well.
    """

    content: C3dContent
    data: bytes
    oddity: str
    is_cleaned: bool

    @property
    def size_bytes(self) -> int:
        """Size of the file."""
        return len(self.data)

    def save(self, folder: Path) -> None:
        """Write the file."""
        (folder / "generated.c3d").write_bytes(self.data)

    def run(self, folder: Path) -> str:
        """Read the file with both readers and compare. A refused file must be odd."""
        self.save(folder)
        path = folder / "generated.c3d"
        try:
            take = read_take(path, READ_OPTIONS)
        except ReadError as error:
            if not self.oddity:
                raise AssertionError(f"a valid file is refused: {error}") from error
            return "odd, refused"
        self._compare_with_content(take)
        if self.is_cleaned:
            self._compare_copy(take, folder / "cleaned.c3d")
        if self.oddity:
            return "odd, read"
        if self.content.processor_type == SGI_PROCESSOR:
            return "equal; ezc3d refuses SGI"
        self._compare_with_ezc3d(path)
        return "equal"

    def _compare_with_content(self, take: Take) -> None:
        """Raise AssertionError if a take is not what was put into the file."""
        content, layout = self.content, take.layout
        assert isinstance(layout, C3dLayout)
        words = layout.decode_words(layout.view_words(self.data))
        sources = [each for each in (take, take.unlabelled, take.computed_points and take.computed_points.take) if each]
        assert words.shape[:2] == content.residual_words.shape, f"{words.shape} instead of {content.counts.shape}"
        assert take.rate == np.float32(content.rate), f"{take.rate} instead of {content.rate} Hz"
        if not self.oddity:
            assert take.first_frame == content.first_frame, f"first frame {take.first_frame}"
        assert np.array_equal(words[..., :3].astype(np.float32), content.counts.astype(np.float32)), "coordinates"
        assert np.array_equal(words[..., 3], content.residual_words), "residual words"
        for each in sources:
            expected = content.positions[:, each.point_indices] * layout.unit_m
            found = each.markers @ layout.rotation_y_up_file
            assert np.array_equal(each.visible, ~content.is_missing[:, each.point_indices]), "missing samples"
            assert np.allclose(found[each.visible], expected[each.visible], rtol=1e-6, atol=1e-12), "positions"
            labels = tuple(content.labels[i].strip() for i in each.point_indices)
            is_named = all(content.labels) and any(any(map(str.isalpha, label)) for label in content.labels)
            assert not is_named or each.labels == labels, f"labels {each.labels} instead of {labels}"
        analog = layout.view_analog_words(self.data)
        if content.is_unsigned and not content.is_float:
            analog = analog.view(analog.dtype.str.replace("i", "u"))
        expected_words = content.analog_words.reshape(len(analog), -1)
        assert np.array_equal(layout.decode_words(analog).astype(np.float32), expected_words.astype(np.float32)), "analog words"
        events = read_c3d_events(C3dHead(self.data[: layout.data_start_byte]))
        found_events = [(np.float32(each.time_s), each.label, each.context) for each in events]
        assert found_events == [(np.float32(time), *texts) for time, *texts in content.events], "events"

    def _read_scaled_analog(self, path: Path) -> Float[np.ndarray, "T S C"]:
        """Return the analog values as they are read for force plates."""
        if not self.content.analog_words.size:
            return np.zeros(self.content.analog_words.shape)
        layout = read_take(path, READ_OPTIONS).layout
        assert isinstance(layout, C3dLayout)
        return read_analog(C3dHead(self.data), layout)

    def _compare_copy(self, take: Take, target: Path) -> None:
        """Raise AssertionError if a copy with some changed samples differs in any other byte."""
        layout, frame = take.layout, take.frame_count // 2
        assert isinstance(layout, C3dLayout)
        markers = take.markers.copy()
        markers[frame] = np.where(np.isnan(markers[frame]), 0.25, markers[frame] + 0.125)
        target.unlink(missing_ok=True)
        write_cleaned_copy(target, take, take.replace_markers(markers))
        old, new = np.frombuffer(self.data, np.uint8), np.frombuffer(target.read_bytes(), np.uint8)
        start = layout.data_start_byte + frame * layout.frame_stride_bytes
        stop = start + 4 * layout.word_size_bytes * layout.point_count
        assert np.array_equal(old[:start], new[:start]), "bytes before the changed frame"
        assert np.array_equal(old[stop:], new[stop:]), "bytes behind the points of the changed frame"
        assert not len(take.labels) or not np.array_equal(old[start:stop], new[start:stop]), "nothing was changed"

    def _compare_with_ezc3d(self, path: Path) -> None:
        """Raise AssertionError if ezc3d reads a file otherwise, except for its known errors.

        It exchanges the bytes of a residual word, reads unsigned analog integers from 32,768 on as negative ones, and takes the
        absolute value of an analog offset. See also `_round_up_rate`.
        """
        import ezc3d  # for development only

        content, found = self.content, ezc3d.c3d(str(path))
        frame_count, point_count = content.residual_words.shape
        points = found["data"]["points"]
        assert points.shape[1:] == (point_count, frame_count), f"ezc3d: {points.shape}"
        valid = ~content.is_missing.T
        positions = np.moveaxis(points[:3], 0, -1)[valid]
        assert np.allclose(positions, content.positions.transpose(1, 0, 2)[valid], rtol=1e-5, atol=1e-6), "ezc3d: positions"
        words = content.residual_words.T[valid]
        residuals, masks = found["data"]["meta_points"]["residuals"][0], found["data"]["meta_points"]["camera_masks"]
        assert (residuals[~valid & (content.residual_words.T < 0)] < 0).all(), "ezc3d: missing samples"
        assert np.allclose(residuals[valid], (words >> 8) * content.scale, rtol=1e-5), "ezc3d: residuals"
        bits = (words & 0x7F) >> np.arange(masks.shape[0])[:, None] & 1
        assert np.array_equal(masks[:, valid], bits.astype(bool)), "ezc3d: cameras"
        stored = content.analog_words
        assert np.allclose(self._read_scaled_analog(path), _scale(content, stored, content.analog_offsets)), "analog values"
        if content.is_unsigned and not content.is_float:
            stored = np.where(stored > np.iinfo(np.int16).max, stored - MAX_C3D_WORD - 1, stored)
        if stored.size:
            expected, own = _scale(content, stored, np.abs(content.analog_offsets)), found["data"]["analogs"][0]
            expected = expected.reshape(-1, expected.shape[2]).T
            assert own.shape == expected.shape, f"ezc3d: analog {own.shape} instead of {expected.shape}"
            assert np.allclose(own, expected, rtol=1e-4, atol=1e-4), "ezc3d: analog values"
        if content.events:
            group = found["parameters"]["EVENT"]
            times = group["TIMES"]["value"]
            assert np.allclose(60 * times[0] + times[1], [time for time, *_ in content.events], atol=1e-4), "ezc3d: events"
            assert [*group["LABELS"]["value"]] == [label for _, label, _ in content.events], "ezc3d: labels of events"


def _scale(content: C3dContent, stored: Float[np.ndarray, "T S C"], offsets: Int[np.ndarray, " C"]) -> Float[np.ndarray, "T S C"]:
    """Return analog values in the units of their channels."""
    return (stored - offsets) * content.analog_scales.astype(np.float32) * content.general_scale


def _round_up_rate(rate: float, samples: int) -> float:
    """Return the analog rate in single precision, not below so many samples in a frame: ezc3d cuts off the ratio of the rates."""
    analog_rate = np.float32(rate * samples)
    while float(analog_rate) / rate < samples:
        analog_rate = np.nextafter(analog_rate, np.float32(np.inf))
    return float(analog_rate)


def build_c3d_case(seed: int) -> C3dCase:
    """Return the case of a seed."""
    rng = np.random.default_rng(seed)
    content = _choose_content(rng)
    oddity = _choose_oddity(rng, content) if rng.random() < ODD_SHARE else C3dOddity()
    if oddity.name and rng.random() < SECOND_ODDITY_SHARE:
        oddity = oddity.combine(_choose_oddity(rng, content))
    if oddity.scale_sign == oddity.header_scale_sign == -1 and not content.is_long:
        oddity = C3dOddity()
    return C3dCase(content, _build_file(rng, content, oddity), oddity.name, bool(rng.random() < CLEANED_SHARE))


def _choose_content(rng: np.random.Generator) -> C3dContent:
    kind = rng.random()
    frame_count, point_count = int(rng.integers(2, 41)), int(rng.integers(1, 13))
    if kind < MANY_FRAMES_SHARE:
        frame_count, point_count = int(rng.integers(MAX_C3D_WORD - 2, MAX_C3D_WORD + 3000)), 1
    elif kind < MANY_POINTS_SHARE:
        frame_count, point_count = int(rng.integers(2, 6)), int(rng.integers(250, 800))
    is_float, unit = bool(rng.random() < 0.5), str(rng.choice(list(UNITS)))
    scale = float(np.float32(rng.choice([0.1, 0.28118187, 1.0]) * UNITS[unit]))
    positions = _compose_motion(rng, frame_count, point_count) * UNITS[unit]
    counts = positions.astype(np.float32).astype(float) if is_float else np.rint(positions / scale)
    words = rng.integers(0, MAX_RESIDUAL_COUNTS + 1, (frame_count, point_count)) | (
        rng.integers(0, 128, (frame_count, point_count)) << 8
    )
    is_lost = rng.random((frame_count, point_count)) < rng.choice([0.0, 0.1, 0.6])
    words[is_lost] = -1
    counts[is_lost & bool(rng.random() < 0.7)] = 0
    channels, samples = int(rng.integers(0, 7)), int(rng.integers(1, 11))
    is_unsigned = bool(channels and rng.random() < 0.3)
    low, high = (0, MAX_C3D_WORD + 1) if is_unsigned and not is_float else (-32_768, 32_768)
    analog = rng.integers(low, high, (frame_count, samples, channels)).astype(float)
    if is_float:
        analog = (analog * 0.37).astype(np.float32).astype(float)
    duration_s, rate = frame_count / 100, float(np.float32(rng.choice([30, 50, 59.94, 100, 119.88, 120, 250])))
    header_events = tuple(
        (float(np.float32(time)), str(rng.choice(["RHS", "LTO", "E"])))
        for time in np.sort(rng.uniform(0, duration_s, int(rng.choice([0, 0, 1, 5, MAX_HEADER_EVENTS]))))
    )
    events = tuple(
        (float(time), str(rng.choice(["Foot Strike", "Foot Off", "Event"])), str(rng.choice(["Left", "Right", "General"])))
        for time in np.sort(rng.uniform(0, 130, int(rng.choice([0, 0, 1, 4, 30])))).astype(np.float32)
        if time % 60 == np.float32(time % 60)
    )
    return C3dContent(
        processor_type=int(rng.choice([INTEL_PROCESSOR, DEC_PROCESSOR, SGI_PROCESSOR])),
        is_float=is_float,
        scale=scale,
        unit=unit,
        rate=rate,
        first_frame=int(rng.choice([1, 1, 1, 0, 17, 65_000, 70_001])),
        counts=counts,
        residual_words=words,
        analog_words=analog,
        is_unsigned=is_unsigned,
        analog_scales=rng.choice([1.0, 0.5, 0.01, -2.0], channels),
        analog_offsets=rng.choice([0, 0, 10, 2048, -5] if not is_unsigned else [0, 2048], channels),
        general_scale=float(rng.choice([1.0, 0.5])),
        labels=_choose_labels(rng, point_count),
        header_events=header_events,
        events=events,
    )


def _compose_motion(rng: np.random.Generator, frame_count: int, point_count: int) -> Float[np.ndarray, "T P 3"]:
    """Return trajectories in mm that are as smooth as those of a body: slow sinusoids about places within 2 m."""
    phases = 0.06 * np.arange(frame_count)[:, None, None] * rng.uniform(0.2, 1, (1, point_count, 3))
    centres = rng.uniform(-1000, 1000, (1, point_count, 3)) + [0, 0, 1000]
    return centres + rng.uniform(20, 200, (1, point_count, 3)) * np.sin(phases + rng.uniform(0, 6, (1, point_count, 3)))


def _choose_labels(rng: np.random.Generator, count: int) -> tuple[str, ...]:
    if rng.random() < 0.2:  # duplicates, empty ones and foreign letters
        return tuple(str(rng.choice(LABEL_WORDS)) for _ in range(count))
    return tuple(f"M{k + 1}" for k in range(count))


def _choose_oddity(rng: np.random.Generator, content: C3dContent) -> C3dOddity:
    """Return one of the contradictions that are known from files, or any value in one of the words of the layout."""
    _, samples, channels = content.analog_words.shape
    points, analog_words = content.residual_words.shape[1], samples * channels
    any_word = int(rng.integers(0, 2000))
    oddities = (
        C3dOddity("channels in place of analog values", {3: channels}),
        C3dOddity("no analog values", {3: 0}),
        C3dOddity("any analog values", {3: any_word}),
        C3dOddity("no samples in a frame", {10: 0}),
        C3dOddity("channels, no samples in a frame", {3: channels, 10: 0}),
        C3dOddity("any samples in a frame", {10: any_word % 50}),
        C3dOddity("points in the header", {2: points + int(rng.integers(1, 9))}),
        C3dOddity("no points in the header", {2: 0}),
        C3dOddity("POINT:USED", parameters={"POINT:USED": points + int(rng.choice([-1, 1, 5])) or 2}),
        C3dOddity("POINT:SCALE of the other type", scale_sign=-1),
        C3dOddity("header's scale of the other type", header_scale_sign=-1),
        C3dOddity("both scales of the other type", scale_sign=-1, header_scale_sign=-1),
        C3dOddity("POINT:DATA_START", parameters={"POINT:DATA_START": any_word % 60}),
        C3dOddity("first block in the header", {9: any_word % 60}),
        C3dOddity("ANALOG:USED", parameters={"ANALOG:USED": channels + 1 + any_word % 5}),
        C3dOddity("ANALOG:RATE", parameters={"ANALOG:RATE": content.rate * (samples + 1)}),
        C3dOddity("no parameters of analog", {3: analog_words}, {"ANALOG:USED": None, "ANALOG:RATE": None}),
        C3dOddity("frames in POINT:FRAMES", parameters={"POINT:FRAMES": any_word}),
        C3dOddity("channels and another scale", {3: channels}, scale_sign=-1),
        C3dOddity("channels and points", {3: channels, 2: points + 3}),
    )
    return oddities[int(rng.integers(len(oddities)))]


Parameter = tuple[int, tuple[int, ...], bytes]  # type, dimensions and values


def _build_file(rng: np.random.Generator, content: C3dContent, oddity: C3dOddity) -> bytes:
    """Return the bytes of a file with a content."""
    sign = -1 if content.is_float else 1
    given: dict[str, Any] = _list_parameters(rng, content)
    given["POINT:SCALE"] = sign * content.scale * oddity.scale_sign
    has_data_start, order = bool(rng.random() < 0.8), int(rng.integers(2**31))
    data_start, section = 2, b""
    for _ in range(2):  # the length of the section does not depend on where the data begin
        given["POINT:DATA_START"] = data_start if has_data_start else None
        parameters = {name: value for name, value in {**given, **oddity.parameters}.items() if value is not None}
        section = _build_section(np.random.default_rng(order), content, parameters)
        data_start = 2 + len(section) // C3D_BLOCK_BYTES
    header = _build_header(content, data_start, sign * content.scale * oddity.header_scale_sign)
    for number, value in oddity.header_words.items():
        struct.pack_into(f"{content.byte_order}H", header, 2 * (number - 1), value)
    data = bytes(header) + section + _build_data(content)
    is_counted = content.first_frame + len(content.counts) - 1 <= MAX_C3D_WORD  # otherwise ezc3d takes padding for frames
    return data + bytes(-len(data) % C3D_BLOCK_BYTES) if is_counted and rng.random() < 0.5 else data


def _build_header(content: C3dContent, data_block: int, scale: float) -> bytearray:
    frame_count, samples, channels = content.analog_words.shape
    last = content.first_frame + frame_count - 1
    words = (content.residual_words.shape[1], samples * channels, content.first_frame, last)
    start = struct.pack(f"{content.byte_order}4H", *(min(each, MAX_C3D_WORD) for each in words))
    start += content.encode_words(np.array([10])) + content.encode_floats(np.array([scale]))
    start += content.encode_words(np.array([data_block, samples])) + content.encode_floats(np.array([content.rate]))
    header = bytearray((bytes([2, 80]) + start).ljust(C3D_BLOCK_BYTES, b"\0"))
    if content.header_events:
        count = len(content.header_events)
        struct.pack_into(f"{content.byte_order}2H", header, 298, EVENT_KEY, count)
        times = content.encode_floats(np.array([time for time, _ in content.header_events]))
        labels = b"".join(label.ljust(4).encode() for _, label in content.header_events)
        header[304 : 304 + len(times)] = times
        header[376 : 376 + count] = bytes([1]) * count
        header[396 : 396 + len(labels)] = labels
    return header


def _list_parameters(rng: np.random.Generator, content: C3dContent) -> dict[str, Any]:
    """Return the values of the parameters by name, except for the scale and the first block of the points."""
    frame_count, samples, channels = content.analog_words.shape
    last = content.first_frame + frame_count - 1
    given: dict[str, Any] = {
        "POINT:USED": len(content.labels),
        "POINT:RATE": content.rate,
        "POINT:FRAMES": min(frame_count, MAX_C3D_WORD),
        "POINT:UNITS": content.unit,
        "POINT:X_SCREEN": "+X",
        "POINT:Y_SCREEN": "+Z",
    }
    for number, first in enumerate(range(0, len(content.labels), 255), 1):
        own = content.labels[first : first + 255]
        given[f"POINT:LABELS{number if number > 1 else ''}"] = list(own)
        given[f"POINT:DESCRIPTIONS{number if number > 1 else ''}"] = ["" for _ in own]
    if last > MAX_C3D_WORD or rng.random() < 0.3:
        for name, frame in (("START", content.first_frame), ("END", last)):
            given[f"TRIAL:ACTUAL_{name}_FIELD"] = np.array([frame & MAX_C3D_WORD, frame >> 16])
        given["POINT:LONG_FRAMES"] = float(frame_count) if rng.random() < 0.5 else None
    if channels or rng.random() < 0.5:
        given |= {
            "ANALOG:USED": channels,
            "ANALOG:RATE": _round_up_rate(content.rate, samples),
            "ANALOG:GEN_SCALE": content.general_scale,
            "ANALOG:LABELS": [f"A{k}" for k in range(channels)] or [""],
            "ANALOG:DESCRIPTIONS": [""] * max(1, channels),
            "ANALOG:UNITS": ["V"] * max(1, channels),
            "ANALOG:SCALE": content.analog_scales.astype(float),
            "ANALOG:OFFSET": content.analog_offsets.astype(int),
            "ANALOG:FORMAT": "UNSIGNED" if content.is_unsigned else "SIGNED",
            "ANALOG:BITS": 16,
        }
    if content.events:
        times = [value for time, *_ in content.events for value in divmod(time, 60)]
        given |= {
            "EVENT:USED": len(content.events),
            "EVENT:TIMES": np.array(times).reshape(-1, 2),
            "EVENT:LABELS": [label for _, label, _ in content.events],
            "EVENT:CONTEXTS": [side for *_, side in content.events],
            "EVENT:DESCRIPTIONS": [""] * len(content.events),
        }
    if rng.random() < 0.3:
        given["MANUFACTURER:COMPANY"] = "mocapfix"
        given["SUBJECT:WEIGHT"] = 71.5
    return given


def _build_section(rng: np.random.Generator, content: C3dContent, parameters: Mapping[str, Any]) -> bytes:
    """Return the parameter section, with an empty group now and then, and groups and parameters in any order."""
    names = [*dict.fromkeys(name.split(":")[0] for name in parameters), *(["EMPTY"] if rng.random() < 0.3 else [])]
    numbers = {name: k + 1 for k, name in enumerate(names)}
    records = [(name, -numbers[name], b"\0") for name in names]
    for key, value in parameters.items():
        group, name = key.split(":")
        kind, shape, payload = _encode_parameter(content, value)
        text = b"what it is" if rng.random() < 0.2 else b""
        records.append(
            (name, numbers[group], struct.pack("bB", kind, len(shape)) + bytes(shape) + payload + bytes([len(text)]) + text)
        )
    if rng.random() < 0.3:
        rng.shuffle(records)  # pyright: ignore[reportArgumentType]
    chain = b"".join(
        struct.pack("bb", len(name), number) + name.encode() + struct.pack(f"{content.byte_order}H", 2 + len(body)) + body
        for name, number, body in records
    )
    blocks = -(-(4 + len(chain) + 2) // C3D_BLOCK_BYTES)
    return (bytes([1, 80, blocks, content.processor_type]) + chain).ljust(C3D_BLOCK_BYTES * blocks, b"\0")


def _encode_parameter(content: C3dContent, value: Any) -> Parameter:
    if isinstance(value, str):
        return TEXT, (len(value),), value.encode()
    if isinstance(value, list):
        texts = [str(each).encode() for each in value]  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
        width = max(1, *map(len, texts))
        return TEXT, (width, len(texts)), b"".join(text.ljust(width) for text in texts)
    numbers = np.asarray(value)
    shape = tuple(reversed(numbers.shape))
    if numbers.dtype.kind == "f":
        return FLOAT, shape, content.encode_floats(numbers)
    return WORD, shape, content.encode_words(numbers)


def _build_data(content: C3dContent) -> bytes:
    frame_count, point_count = content.residual_words.shape
    points = np.concatenate([content.counts, content.residual_words[..., None]], axis=-1).reshape(frame_count, 4 * point_count)
    rows = np.concatenate([points, content.analog_words.reshape(frame_count, -1)], axis=1)
    return content.encode_floats(rows) if content.is_float else content.encode_words(rows)
