"""An animation's own file, BVH or AMC, with only the numbers that were changed spelled anew."""

from pathlib import Path

import numpy as np
from numba import njit

from mocapfix.animation import Animation
from mocapfix.errors import WriteError
from mocapfix.files import replacing
from mocapfix.write.numbers import LARGEST, MOST, WIDTH, spelled
from mocapfix.write.original import original

DECIMALS = 6  # where all of a file's numbers are whole


def patched(target: str | Path, before: Animation, values: np.ndarray) -> None:
    """Write `before`'s file to `target` with the numbers that differ in `values` (T, C), in its own units.

    Every other byte stays as it is: the hierarchy, names, channel orders, line ends, and how the other numbers are spelled.
    New ones have as many decimals as most of the file's that have any.

    Raises WriteError where `target` is the input itself, where the input is no longer as it was read, where a changed number
    is not finite, or where `target` cannot be written.
    """
    target = Path(target)
    if (starts := before.starts) is None:
        raise WriteError(f"{before.name}: no file holds just these numbers, to change them there.")
    data = original(target, before.path, int(starts.max(initial=-1)) + 1)
    same = (values == before.values) | (np.isnan(values) & np.isnan(before.values))
    places, numbers = starts[~same], _as_spelled(before, values)[~same]
    order = np.argsort(places)
    text = np.frombuffer(data, np.uint8)
    counts = np.bincount(_decimals(text, starts.ravel()))
    decimals = min(int(counts[1:].argmax()) + 1, MOST) if counts[1:].any() else DECIMALS
    power = 10.0**decimals
    if not (np.abs(numbers) * power < LARGEST).all():
        frame, column = np.argwhere(~same & ~(np.abs(values) * power < LARGEST))[0]
        joint = next(name for name, own in zip(before.names, before.columns, strict=True) if column in own)
        would = f"in frame {before.first_frame + frame} {joint} would be {values[frame, column]}"
        raise WriteError(f"{target}: {would}; no file can hold that.")
    out = np.empty(len(text) + len(places) * (WIDTH + decimals), np.uint8)
    size = _spliced(text, places[order], numbers[order], decimals, power, out)
    with replacing(target) as part:
        part.write_bytes(out[:size].data)


def _as_spelled(before: Animation, values: np.ndarray) -> np.ndarray:
    """-> (T, C) the values in the file's own units."""
    if not before.radians:
        return values
    turning = np.concatenate([before.turning(joint)[0] for joint in range(len(before.names))])
    told = values.copy()
    told[:, turning] = np.radians(values[:, turning])
    return told


@njit(cache=True)
def _decimals(text, starts):
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
def _spliced(text, places, numbers, decimals, power, out):
    """Copy `text` into `out` with the words that begin at `places` replaced by `numbers`; -> how long it became."""
    i, at = 0, 0
    for n in range(len(places)):
        while i < places[n]:
            out[at] = text[i]
            i, at = i + 1, at + 1
        while i < len(text) and text[i] > 32:
            i += 1
        at = spelled(numbers[n], decimals, power, out, at)
    while i < len(text):
        out[at] = text[i]
        i, at = i + 1, at + 1
    return at
