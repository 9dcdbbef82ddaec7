"""Where the samples of a C3D file lie, derived from its header, its parameters and the size of its data together.

Programs write some of these words wrongly: the number of analog channels in place of the analog values of a frame, a scale of
integers before floats, a first block that is none. If all sources agree and the data have the size that they say, that is the
answer. Otherwise every combination of what they say is compared with the size of the data, and those that fit with the values.
"""

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mocapfix.errors import ReadError
from mocapfix.io.c3d_parameters import C3dParameters
from mocapfix.io.coordinates import find_valid_points
from mocapfix.model.take import C3D_BLOCK_BYTES, MAX_C3D_WORD, C3dLayout

FRAME_PAIRS = 48  # of consecutive frames whose values are looked at, spread over the take
MIN_SAMPLES = 30  # visible in both frames of a pair: with fewer, the values say nothing
# The 90th percentile of the steps of points from frame to frame, over the median distance of any two samples. At most 0.052 in
# the 36 C3D captures at hand, at 30 to 250 Hz; at least 0.3 in nine of ten wrong readings of them.
MAX_ROUGHNESS = 0.25
MIN_SANE_SHARE = 0.9  # of coordinates that are 0 or of a size that a program writes; at least 0.987 in these captures
SANE_COORDINATES = 1e-6, 1e7  # file units
ROUGHNESS_MARGIN = 2.0  # a reading is better by its steps if they are smaller by this factor
RESIDUAL_MARGIN = 0.05  # and by its residual words if the share of whole numbers is larger by this; 1.0 in these captures
MAX_FILLED_STEPS = 32  # numbers of analog values that are tried because the end of a file is within its last block
MAX_RATIO_ERROR = 0.05  # of analog and point rate from a whole number


class SampleBlocks(NamedTuple):
    """One reading of the data section: frames of points and analog values, one after the other."""

    point_count: int  # points in a frame
    analog_words: int  # analog values in a frame, after its points
    is_float: bool  # whether words are floats of 4 bytes; otherwise integers of 2
    start_byte: int  # offset of the first frame
    frame_count: int  # number of frames

    @property
    def frame_bytes(self) -> int:
        return (4 * self.point_count + self.analog_words) * (4 if self.is_float else 2)

    def count_rest_bytes(self, file_bytes: int) -> int:
        """Return the bytes behind the last frame, below 0 if frames are missing."""
        return file_bytes - self.start_byte - self.frame_count * self.frame_bytes

    def is_exact(self, file_bytes: int) -> bool:
        """Return whether the file ends with the last frame, or with the rest of its block."""
        return self.frame_bytes > 0 and 0 <= self.count_rest_bytes(file_bytes) < C3D_BLOCK_BYTES

    def build_layout(self, processor_type: int, scale_factor: float = 1.0, unit_m: float = 1.0) -> C3dLayout:
        """Return the layout without a rotation."""
        counts = self.start_byte, self.frame_bytes, self.point_count, self.frame_count
        return C3dLayout(processor_type, self.is_float, scale_factor, *counts, unit_m, np.eye(3))


class _Source(NamedTuple):
    """What one place in a file says about a field of `SampleBlocks`."""

    name: str
    field: str
    value: int

    @property
    def place(self) -> tuple[str, str]:
        """The word or parameter without that with which it is multiplied: two products of one word are one source."""
        return self.name.split(" with ")[0], self.field


class _Evidence(NamedTuple):
    """How the values look in a reading."""

    roughness: float  # as for MAX_ROUGHNESS; NaN if too few samples are visible
    sane_share: float  # as for MIN_SANE_SHARE
    whole_share: float  # share of residual words that are whole numbers

    @property
    def is_absurd(self) -> bool:
        return self.sane_share < MIN_SANE_SHARE

    @property
    def is_unknown(self) -> bool:
        return bool(np.isnan(self.roughness)) and not self.is_absurd

    @property
    def is_plausible(self) -> bool:
        return self.roughness <= MAX_ROUGHNESS and not self.is_absurd

    def is_better(self, other: "_Evidence") -> bool:
        """Return whether these values look better than others by their steps or residual words, and as good by the other."""
        is_smoother = self.roughness * ROUGHNESS_MARGIN < other.roughness
        is_rougher = self.roughness > other.roughness * ROUGHNESS_MARGIN
        gain = self.whole_share - other.whole_share
        return (is_smoother and gain >= -RESIDUAL_MARGIN) or (gain > RESIDUAL_MARGIN and not is_rougher)


def locate_samples(path: Path, parameters: C3dParameters, data: bytes) -> tuple[SampleBlocks, tuple[str, ...]]:
    """Return where the samples lie, and notes on words of the header and parameters that are wrong.

    Raises:
        ReadError: If frames are missing, or two readings remain possible.
    """
    declared, sources = _read_declared(parameters), _list_sources(parameters)
    stored = declared._replace(frame_count=_count_frames(parameters, len(data), declared))
    do_agree = len({each.field for each in sources}) == len({(each.field, each.value) for each in sources})
    do_agree &= declared.start_byte >= parameters.section_end_byte
    is_filled = 0 <= stored.count_rest_bytes(len(data)) < max(C3D_BLOCK_BYTES, stored.frame_bytes)
    is_filled &= not stored._replace(is_float=not stored.is_float).is_exact(len(data))  # within a block both types may fit
    is_counted = stored.frame_count in parameters.frame_counts or stored.frame_count > max(parameters.frame_counts)
    if not (do_agree and is_filled and is_counted):
        stored = _choose(path, parameters, data, stored, sources, do_agree)
    if not stored.frame_count:
        _refuse_frames(path, parameters, len(data), declared)
    notes, count = _describe_errors(sources, stored), max(parameters.frame_counts)
    if stored.frame_count not in (count, parameters.header_frame_count):
        notes.append(f"The header declares {count} frames; the file has {stored.frame_count}.")
    return stored, tuple(notes)


def _read_declared(parameters: C3dParameters) -> SampleBlocks:
    """Return the reading by the sources that count if all is right; its frames are the most that any of them says."""
    block = parameters.header_data_block or parameters.data_start_block
    start_byte = C3D_BLOCK_BYTES * (block - 1) if block else parameters.section_end_byte
    words = parameters.point_count, parameters.header_analog_words, parameters.scale_factor < 0
    return SampleBlocks(*words, start_byte, max(parameters.frame_counts))


def _list_sources(parameters: C3dParameters) -> list[_Source]:
    """Return what header and parameters say about each field, except for the number of frames."""
    sources = [
        _Source("POINT:USED", "point_count", parameters.point_count),
        _Source("the header", "point_count", parameters.header_point_count),
        _Source("the header", "analog_words", parameters.header_analog_words),
        _Source("POINT:SCALE", "is_float", parameters.scale_factor < 0),
    ]
    if np.isfinite(parameters.header_scale_factor) and parameters.header_scale_factor:
        sources.append(_Source("the header", "is_float", parameters.header_scale_factor < 0))
    blocks = {"the header": parameters.header_data_block, "POINT:DATA_START": parameters.data_start_block}
    sources += [_Source(name, "start_byte", C3D_BLOCK_BYTES * (block - 1)) for name, block in blocks.items() if block]
    if parameters.analog_channel_count is not None:
        per_frame = {"the header's samples per frame": parameters.header_samples_per_frame}
        per_frame["the rates"] = _divide_rates(parameters.analog_rate, parameters.rate)
        sources += [
            _Source(f"ANALOG:USED with {name}", "analog_words", parameters.analog_channel_count * count)
            for name, count in per_frame.items()
            if count
        ]
    return sources


def _divide_rates(analog_rate: float, rate: float) -> int:
    """Return the analog samples in a frame; 0 if these rates give no whole number."""
    ratio = analog_rate / rate if rate > 0 else 0.0
    return round(ratio) if 0.5 < ratio <= MAX_C3D_WORD and abs(ratio - round(ratio)) < MAX_RATIO_ERROR else 0


def _choose(
    path: Path, parameters: C3dParameters, data: bytes, declared: SampleBlocks, sources: list[_Source], do_agree: bool
) -> SampleBlocks:
    """Return the reading that the size of the data and their values support; without frames if frames are missing.

    The readings are tried in groups, the next only if none of a group has plausible values, or in the first too few to say: those
    that end with the file and of which each field is declared; those whose analog values, or else frames, follow from the size of
    the data; those that are followed by other bytes. `declared` has the number of frames that it can have, 0 for none. Raises
    ReadError if two readings remain possible, or none although the file is large enough.
    """
    size = len(data)
    candidates = [declared, *_combine_sources(parameters, declared, sources)]
    exact = [each for each in candidates if each.frame_count in parameters.frame_counts and each.is_exact(size)]
    with_analog = [each for start in candidates for each in _derive_analog_words(start, size, parameters)]
    with_frames = [each for start in candidates for each in _derive_frame_count(start, size, parameters)]
    behind = [each for each in candidates if each.frame_bytes and each.count_rest_bytes(size) >= C3D_BLOCK_BYTES]
    is_readable = declared.frame_count > 0
    own = _inspect_values(parameters, data, declared)
    if is_readable and do_agree and own.is_plausible:
        return declared
    possible: list[SampleBlocks] = []
    looks = {declared: own}
    for group in (exact, with_analog, with_frames, behind):
        longest = {each[:-1]: each for each in sorted(group)}.values()  # of readings that differ in the number of frames only
        looks |= {each: _inspect_values(parameters, data, each) for each in longest}
        possible = [each for each in longest if looks[each].is_plausible]
        if possible or (group is exact and any(looks[each].is_unknown for each in longest)):
            break
    is_proved = bool(possible)
    is_doubtful = not declared.is_exact(size) or own.roughness > MAX_ROUGHNESS
    is_refuted = own.is_absurd or (is_doubtful and any(looks[each].is_unknown for each in exact if each in looks))
    if not is_proved and (not is_readable or (do_agree and not is_refuted)):
        return declared
    if not is_proved:
        possible = _list_unproved(parameters, size, sources, looks, declared)
    if not possible and declared.frame_count not in parameters.frame_counts:
        return declared._replace(frame_count=0)
    if after := [each for each in possible if each.start_byte >= parameters.section_end_byte]:
        possible = after
    best = [each for each in possible if not any(looks[other].is_better(looks[each]) for other in possible)]
    if len(best) > 1 and not is_proved:
        labels = _Source("POINT:LABELS", "point_count", len(parameters.labels))
        support = {each: len({s.place for s in (*sources, labels) if getattr(each, s.field) == s.value}) for each in best}
        best = [each for each in best if support[each] == max(support.values())]
    if len(best) != 1:
        raise ReadError(f"{path}: its header and parameters contradict one another, {_describe_choice(sources, best)}.")
    return best[0]


def _list_unproved(
    parameters: C3dParameters, size: int, sources: list[_Source], looks: dict[SampleBlocks, _Evidence], declared: SampleBlocks
) -> list[SampleBlocks]:
    """Return the readings that end with the file and of which each field is declared, though their values prove nothing.

    If they speak against a reading, it is one of them only if header and parameters agree on the content of a frame.
    """
    declared_values = {(each.field, each.value) for each in sources} | {("frame_count", each) for each in parameters.frame_counts}
    declared_values.add(("point_count", len(parameters.labels)))
    is_frame_known = all(each.value == getattr(declared, each.field) for each in sources if each.field != "start_byte")
    unproved = [
        each
        for each in looks
        if not looks[each].is_absurd and each.is_exact(size) and declared_values.issuperset(each._asdict().items())
        if is_frame_known or not each.count_rest_bytes(size) or not size % C3D_BLOCK_BYTES
    ]
    return [each for each in unproved if looks[each].is_unknown] or unproved * is_frame_known


def _combine_sources(parameters: C3dParameters, declared: SampleBlocks, sources: list[_Source]) -> Iterator[SampleBlocks]:
    """Yield all combinations of what the sources say and may mean, with both types of words."""
    values = {field: {each.value for each in sources if each.field == field} for field in SampleBlocks._fields}
    by_header_rate = (parameters.analog_channel_count or 0) * _divide_rates(parameters.analog_rate, parameters.header_rate)
    by_channels = parameters.header_analog_words * max(1, parameters.header_samples_per_frame)
    fields = product(
        sorted((values["point_count"] | {len(parameters.labels)}) - {0}),
        sorted(values["analog_words"] | {0, by_channels, by_header_rate}),
        (True, False),
        sorted(values["start_byte"] | {declared.start_byte, parameters.section_end_byte}),
        sorted({each for each in parameters.frame_counts if each > 0}),
    )
    return (SampleBlocks(*each) for each in fields)


def _derive_analog_words(blocks: SampleBlocks, file_bytes: int, parameters: C3dParameters) -> Iterator[SampleBlocks]:
    """Yield the readings whose analog values fill the data, to the end of the file or to within its last block."""
    if blocks.frame_count > 0 and blocks.frame_count in parameters.frame_counts:
        step_bytes = blocks.frame_count * (4 if blocks.is_float else 2)
        most, rest_bytes = divmod(file_bytes - blocks.start_byte, step_bytes)
        largest_rest = 0 if file_bytes % C3D_BLOCK_BYTES else C3D_BLOCK_BYTES - 1
        for less in range(1 + min(MAX_FILLED_STEPS, (largest_rest - rest_bytes) // step_bytes)):
            if (analog_words := most - less - 4 * blocks.point_count) >= 0:
                yield blocks._replace(analog_words=analog_words)


def _derive_frame_count(blocks: SampleBlocks, file_bytes: int, parameters: C3dParameters) -> Iterator[SampleBlocks]:
    """Yield the reading with fewer frames that end with the file, if it was shortened: it does not end with a block then."""
    frame_count, odd_bytes = divmod(file_bytes - blocks.start_byte, max(1, blocks.frame_bytes))
    if not odd_bytes and file_bytes % C3D_BLOCK_BYTES and 0 < frame_count < max(parameters.frame_counts):
        yield blocks._replace(frame_count=frame_count)


def _inspect_values(parameters: C3dParameters, data: bytes, blocks: SampleBlocks) -> _Evidence:
    """Return how the values look in a reading."""
    if blocks.frame_count < 2 or blocks.count_rest_bytes(len(data)) < 0:
        return _Evidence(np.nan, 1.0, 0.0)
    layout = blocks.build_layout(parameters.processor_type)
    words = layout.view_words(data)
    first = np.unique(np.linspace(0, blocks.frame_count - 2, FRAME_PAIRS).astype(int))
    before, after = layout.decode_words(words[first]), layout.decode_words(words[first + 1])
    both = np.logical_and(*(find_valid_points(each[..., :3]) & ~(each[..., 3] < 0) for each in (before, after)))
    residual, size = before[..., 3], np.abs(before[..., :3])
    with np.errstate(invalid="ignore"):
        whole_share = float((residual == np.rint(residual)).mean())
        sane_share = float((np.isnan(size) | (size == 0) | ((size > SANE_COORDINATES[0]) & (size < SANE_COORDINATES[1]))).mean())
    points = before[both][:, :3]
    if len(points) < MIN_SAMPLES:
        return _Evidence(np.nan, sane_share, whole_share)
    steps = np.linalg.norm(after[both][:, :3] - points, axis=1)
    distance = np.median(np.linalg.norm(points - points[np.random.default_rng(0).permutation(len(points))], axis=1))
    return _Evidence(float(np.percentile(steps, 90) / distance) if distance > 0 else np.nan, sane_share, whole_share)


def _count_frames(parameters: C3dParameters, file_bytes: int, declared: SampleBlocks) -> int:
    """Return the number of frames: the declared one, if the file is large enough; 0 if frames are missing.

    A file that ends with the last frame of its header is complete even if a parameter, left over from a longer trial, declares
    more. So is a file that was shortened without changing its header: it ends with a frame and not with a block, as a file
    that was cut off in a transfer may. A file may also have more frames than a word can declare.
    """
    count, data_bytes, frame_bytes = declared.frame_count, file_bytes - declared.start_byte, declared.frame_bytes
    if count < 1 or not frame_bytes:
        return 0
    stored = max(0, data_bytes) // frame_bytes
    if count <= stored:
        has_more = parameters.is_count_saturated and (stored - count) * frame_bytes >= C3D_BLOCK_BYTES
        return stored if has_more else count
    header_count = parameters.header_frame_count
    if header_count > 0 and declared._replace(frame_count=header_count).is_exact(file_bytes):
        return header_count
    return stored if not data_bytes % frame_bytes and file_bytes % C3D_BLOCK_BYTES else 0


def _refuse_frames(path: Path, parameters: C3dParameters, file_bytes: int, declared: SampleBlocks) -> None:
    """Raise ReadError about missing frames."""
    if declared.frame_count < 1:
        raise ReadError(f"{path}: has no frames; export the trial again.")
    stored = max(0, file_bytes - declared.start_byte) // declared.frame_bytes
    problem = f"is cut off: {declared.frame_count} frames are declared and {stored} are there"
    raise ReadError(f"{path}: {problem}; copy or export it again.")


def _describe_value(field: str, value: int) -> str:
    match field:
        case "point_count":
            return f"{value} points"
        case "analog_words":
            return f"{value} analog values in a frame"
        case "is_float":
            return "floats" if value else "integers"
        case "frame_count":
            return f"{value} frames"
        case _:
            return f"data from block {value // C3D_BLOCK_BYTES + 1}"


def _describe_errors(sources: list[_Source], blocks: SampleBlocks) -> list[str]:
    """Return a note on each source that says something else than what the file has."""
    notes: dict[str, None] = {}
    for name, field, value in sources:
        if value != (right := getattr(blocks, field)):
            given, found = _describe_value(field, value), _describe_value(field, right)
            notes[f"{name[0].upper()}{name[1:]} says {given}; by size and values the file has {found}."] = None
    return list(notes)


def _describe_choice(sources: list[_Source], possible: list[SampleBlocks]) -> str:
    """Return in which fields the readings that remain possible differ, or in which the sources do, and what to do."""
    parts: list[str] = []
    for field in SampleBlocks._fields:
        values = {getattr(each, field) for each in possible} or {each.value for each in sources if each.field == field}
        if len(values) > 1:
            parts.append(" or ".join(_describe_value(field, value) for value in sorted(values)))
    which = "and several readings fit its data" if possible else "and none fits its data"
    return f"{which} ({'; '.join(parts) or 'values that are no positions'}); export it again"
