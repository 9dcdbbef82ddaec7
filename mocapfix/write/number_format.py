"""Format rows of numbers as "%.6f" does, many times as fast.

The product of a number and a power of ten is computed as the nearest double and its rounding error (Dekker 1971, "A
floating-point technique for extending the available precision"), so that the last decimal is that of the exact product, with
halves rounded to even.
"""

import numpy as np
from jaxtyping import Float
from numba import njit

MAX_EXACT_PRODUCT = 2.0**52  # of a number and its power of ten; larger doubles have no fraction to round
DEKKER_SPLITTER = 134217729.0  # 2^27 + 1
INTEGER_PART_BYTES = 18  # for the sign, the point and the digits before it
MAX_WRITTEN_DECIMALS = 15


def format_rows(values: Float[np.ndarray, "T C"], decimals: int, separator: str = " ", line_end: str = "\n") -> bytes:
    """Return one line of text for each row.

    Numbers are exactly those of f"{value:.6f}" with `decimals` (0 to 15) decimals, including the sign of -0.0.

    Raises:
        ValueError: If a number is not finite.
    """
    values = np.ascontiguousarray(values, float)
    if not np.isfinite(values).all():
        raise ValueError("a number that is not finite cannot be written")
    power = 10.0**decimals
    if values.size == 0 or decimals > MAX_WRITTEN_DECIMALS or np.abs(values).max() >= MAX_EXACT_PRODUCT / power:
        template = separator.join([f"%.{decimals}f"] * values.shape[1]) + line_end
        return "".join([template % tuple(row) for row in values.tolist()]).encode()
    separator_bytes = np.frombuffer(separator.encode(), np.uint8)
    line_end_bytes = np.frombuffer(line_end.encode(), np.uint8)
    size = values.size * (INTEGER_PART_BYTES + decimals + len(separator_bytes)) + len(values) * len(line_end_bytes)
    out = np.empty(size, np.uint8)
    return out[: _write_rows(values, decimals, power, separator_bytes, line_end_bytes, out)].tobytes()


@njit(cache=True)
def _write_rows(values, decimals, power, separator, line_end, out):
    at = 0
    for t in range(values.shape[0]):
        for c in range(values.shape[1]):
            if c:
                at = _copy_bytes(separator, out, at)
            at = write_number(values[t, c], decimals, power, out, at)
        at = _copy_bytes(line_end, out, at)
    return at


@njit(cache=True)
def _copy_bytes(source, out, at):
    for i in range(len(source)):
        out[at + i] = source[i]
    return at + len(source)


@njit(cache=True)
def write_number(value, decimals, power, out, at):
    """Write a number into the bytes `out` from `at` on, and return the byte after it.

    power is 10^decimals, and abs(value) * power must be less than MAX_EXACT_PRODUCT.
    """
    if np.signbit(value):
        out[at] = 45
        at += 1
    number = round_product(abs(value), power)
    digits, rest = 1, number // 10
    while rest > 0 or digits <= decimals:
        digits, rest = digits + 1, rest // 10
    point = at + digits - decimals
    stop = at + digits + (decimals > 0)
    i = stop - 1
    while i >= at:
        if decimals > 0 and i == point:
            out[i] = 46
        else:
            out[i] = 48 + number % 10
            number //= 10
        i -= 1
    return stop


@njit(cache=True)
def round_product(value, power):
    """Return the whole number nearest to value * power, exactly, with halves rounded to even; value >= 0."""
    product = value * power
    value_split, power_split = value * DEKKER_SPLITTER, power * DEKKER_SPLITTER
    value_high, power_high = value_split - (value_split - value), power_split - (power_split - power)
    value_low, power_low = value - value_high, power - power_high
    error = ((value_high * power_high - product) + value_high * power_low + value_low * power_high) + value_low * power_low
    whole = np.floor(product)
    above_half = (product - whole) - 0.5
    is_up = above_half > 0 or (above_half == 0 and (error > 0 or (error == 0 and whole % 2 == 1)))
    return np.int64(whole) + is_up
