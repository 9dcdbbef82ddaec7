"""An animation's own file, BVH or AMC, with only the numbers that were changed spelled anew."""

from pathlib import Path

import numpy as np
from numba import njit

from mocapfix.animation import Animation
from mocapfix.errors import WriteError
from mocapfix.files.output_files import replace_atomically
from mocapfix.write.number_format import INTEGER_PART_BYTES, MAX_EXACT_PRODUCT, MAX_WRITTEN_DECIMALS, write_number
from mocapfix.write.source_file import read_source_bytes

DEFAULT_DECIMALS = 6  # where all of a file's numbers are whole


def patch_animation(target: str | Path, source: Animation, values: np.ndarray) -> None:
    """Write `before`'s file to `target` with the numbers that differ in `values` (T, C), in its own units.

    Every other byte stays as it is: the hierarchy, names, channel orders, line ends, and how the other numbers are spelled.
    New ones have as many decimals as most of the file's that have any.

    Raises WriteError where `target` is the input itself, where the input is no longer as it was read, where a changed number
    is not finite, or where `target` cannot be written.
    """
    target = Path(target)
    if (starts := source.value_byte_offsets) is None:
        raise WriteError(f"{source.name}: no file holds just these numbers, to change them there.")
    data = read_source_bytes(target, source.path, int(starts.max(initial=-1)) + 1)
    same = (values == source.values) | (np.isnan(values) & np.isnan(source.values))
    places, numbers = starts[~same], _convert_to_file_units(source, values)[~same]
    order = np.argsort(places)
    text = np.frombuffer(data, np.uint8)
    counts = np.bincount(_count_decimals(text, starts.ravel()))
    decimals = min(int(counts[1:].argmax()) + 1, MAX_WRITTEN_DECIMALS) if counts[1:].any() else DEFAULT_DECIMALS
    power = 10.0**decimals
    if not (np.abs(numbers) * power < MAX_EXACT_PRODUCT).all():
        frame, column = np.argwhere(~same & ~(np.abs(values) * power < MAX_EXACT_PRODUCT))[0]
        joint = next(name for name, own in zip(source.names, source.joint_columns, strict=True) if column in own)
        would = f"in frame {source.first_frame + frame} {joint} would be {values[frame, column]}"
        raise WriteError(f"{target}: {would}; no file can hold that.")
    out = np.empty(len(text) + len(places) * (INTEGER_PART_BYTES + decimals), np.uint8)
    size = _splice_numbers(text, places[order], numbers[order], decimals, power, out)
    with replace_atomically(target) as part:
        part.write_bytes(out[:size].data)


def _convert_to_file_units(before: Animation, values: np.ndarray) -> np.ndarray:
    """-> (T, C) the values in the file's own units."""
    if not before.uses_radians:
        return values
    turning = np.concatenate([before.get_rotation_channels(joint)[0] for joint in range(len(before.names))])
    told = values.copy()
    told[:, turning] = np.radians(values[:, turning])
    return told


@njit(cache=True)
def _count_decimals(text, starts):
    """-> (N,) how many figures follow the point of each number that begins at `starts` (N,), 0 with an exponent."""
    out = np.zeros(len(starts), np.int64)
    for n in range(len(starts)):
        i, point = starts[n], False
        while i < len(text) and text[i] > 32:
            if text[i] == 46:
                point = True
            elif text[i] < 48 or text[i] > 57:
                out[n] = 0
                point = False
            elif point:
                out[n] += 1
            i += 1
    return out


@njit(cache=True)
def _splice_numbers(text, places, numbers, decimals, power, out):
    """Copy `text` into `out` with the words that begin at `places` replaced by `numbers`; -> how long it became."""
    i, at = 0, 0
    for n in range(len(places)):
        while i < places[n]:
            out[at] = text[i]
            i, at = i + 1, at + 1
        while i < len(text) and text[i] > 32:
            i += 1
        at = write_number(numbers[n], decimals, power, out, at)
    while i < len(text):
        out[at] = text[i]
        i, at = i + 1, at + 1
    return at
