"""Rows of numbers as text, as "%.6f" writes them and many times as fast.

A number times a power of ten is told as the nearest double and what that leaves out (Dekker 1971, "A floating-point technique
for extending the available precision"), so that the last decimal is rounded as the exact product says, halves to even.
"""

import numpy as np
from numba import njit

MAX_EXACT_PRODUCT = 2.0**52  # of a number times its power of ten: from here on doubles have no fraction to round
DEKKER_SPLITTER = 134217729.0  # 2^27 + 1
INTEGER_PART_BYTES = 18  # bytes for sign, point and the digits before it
MAX_WRITTEN_DECIMALS = 15  # decimals


def format_rows(values: np.ndarray, decimals: int, separator: str = " ", line_end: str = "\n") -> bytes:
    """-> a line for each row of values (T, C), every number with as many decimals (0 to 15) as said, exactly as Python's
    f"{value:.6f}" has it, the sign of -0.0 too.

    Raises ValueError where a number is not finite.
    """
    values = np.ascontiguousarray(values, float)
    if not np.isfinite(values).all():
        raise ValueError("a number that is not finite cannot be written")
    power = 10.0**decimals
    if values.size == 0 or decimals > MAX_WRITTEN_DECIMALS or np.abs(values).max() >= MAX_EXACT_PRODUCT / power:
        row = separator.join([f"%.{decimals}f"] * values.shape[1]) + line_end
        return "".join([row % tuple(each) for each in values.tolist()]).encode()
    signs = np.frombuffer(separator.encode(), np.uint8), np.frombuffer(line_end.encode(), np.uint8)
    size = values.size * (INTEGER_PART_BYTES + decimals + len(signs[0])) + len(values) * len(signs[1])
    out = np.empty(size, np.uint8)
    return out[: _write_rows(values, decimals, power, *signs, out)].tobytes()


@njit(cache=True)
def _write_rows(values, decimals, power, between, end, out):
    at = 0
    for t in range(values.shape[0]):
        for c in range(values.shape[1]):
            if c:
                at = _copy_bytes(between, out, at)
            at = write_number(values[t, c], decimals, power, out, at)
        at = _copy_bytes(end, out, at)
    return at


@njit(cache=True)
def _copy_bytes(source, out, at):
    for i in range(len(source)):
        out[at + i] = source[i]
    return at + len(source)


@njit(cache=True)
def write_number(value, decimals, power, out, at):
    """Write a number into the bytes `out` from `at` on; -> the byte after it. power = 10^decimals; the product of the two is
    less than LARGEST."""
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
    """-> the whole number nearest to value * power, exactly, halves to even; value >= 0."""
    product = value * power
    big, other = value * DEKKER_SPLITTER, power * DEKKER_SPLITTER
    high, top = big - (big - value), other - (other - power)
    low, bottom = value - high, power - top
    left = ((high * top - product) + high * bottom + low * top) + low * bottom  # of the exact product
    whole = np.floor(product)
    beyond = (product - whole) - 0.5
    up = beyond > 0 or (beyond == 0 and (left > 0 or (left == 0 and whole % 2 == 1)))
    return np.int64(whole) + up
