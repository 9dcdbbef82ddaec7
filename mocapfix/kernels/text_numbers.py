"""Parse and format numbers in the bytes of a text.

A number of up to fifteen digits times or divided by a power of ten up to 10^22 is exact after one operation (Clinger 1990, "How
to read floating point numbers accurately"). Formatting computes the product of a number and a power of ten as the nearest
double and its rounding error (Dekker 1971, "A floating-point technique for extending the available precision"), so that the
last decimal is that of the exact product, with halves rounded to even.
"""

import numpy as np

from mocapfix.kernels.compilation import compile_inner_kernel, compile_kernel

MAX_EXACT_DIGITS = 15  # digits of a whole number that a double represents exactly
POWERS_OF_TEN = 10.0 ** np.arange(23)  # those that a double represents exactly

NUMBER_TOKEN = 0  # kinds of tokens
LONG_NUMBER_TOKEN = 1  # Python must parse it
WORD_TOKEN = 2

MAX_EXACT_PRODUCT = 2.0**52  # of a number and its power of ten; larger doubles have no fraction to round
DEKKER_SPLITTER = 134217729.0  # 2^27 + 1
INTEGER_PART_BYTES = 18  # for the sign, the point and the digits before it


@compile_kernel(nogil=True)
def count_tokens(text, first_byte):
    """Return the number of tokens, separated by white space, from `first_byte` on."""
    count, inside = 0, False
    for i in range(first_byte, len(text)):
        is_black = text[i] > 32
        count += is_black and not inside
        inside = is_black
    return count


@compile_kernel(nogil=True)
def fill_tokens(text, first_byte, start_bytes, line_numbers, values, kinds):
    """Fill in the start, line (the first is 0), value and kind of each token."""
    i, line, token = first_byte, 0, 0
    while i < len(text):
        if text[i] <= 32:
            line += text[i] == 10 or (text[i] == 13 and not (i + 1 < len(text) and text[i + 1] == 10))
            i += 1
            continue
        start_bytes[token], line_numbers[token] = i, line
        values[token], kinds[token], i = _parse_number(text, i)
        token += 1


@compile_inner_kernel
def _parse_number(text, i):
    """Return the number spelled at byte i, its kind, and the byte after the token."""
    start = i
    is_negative = text[i] == 45  # -
    if is_negative or text[i] == 43:  # +
        i += 1
    # `digits` counts significant digits, `all_digits` leading zeros too.
    mantissa, digits, power, after_point, all_digits = 0, 0, 0, False, 0
    while i < len(text) and (48 <= text[i] <= 57 or (text[i] == 46 and not after_point)):
        if text[i] == 46:
            after_point = True
        else:
            mantissa = mantissa * 10 + (text[i] - 48) if digits < 18 else mantissa
            digits += mantissa > 0
            all_digits += 1
            power -= after_point
        i += 1
    if i < len(text) and (text[i] == 69 or text[i] == 101) and all_digits:  # E, e
        i, exponent = _parse_integer(text, i + 1)
        power += exponent
    is_complete = i >= len(text) or text[i] <= 32
    while i < len(text) and text[i] > 32:
        i += 1
    if not (is_complete and all_digits and digits <= MAX_EXACT_DIGITS and abs(power) < len(POWERS_OF_TEN)):
        return np.nan, (WORD_TOKEN if _is_word_letter(text[start]) else LONG_NUMBER_TOKEN), i
    value = mantissa * POWERS_OF_TEN[power] if power >= 0 else mantissa / POWERS_OF_TEN[-power]
    return (-value if is_negative else value), NUMBER_TOKEN, i


@compile_inner_kernel
def _is_word_letter(byte):
    """Return whether a byte is a letter with which no number begins; nan and inf begin with n and i."""
    lower = byte | 32
    return 97 <= lower <= 122 and lower != 105 and lower != 110


@compile_inner_kernel
def _parse_integer(text, i):
    """Return the byte after the whole number spelled at byte i, and the number; a very large one if there is none."""
    sign, value, has_digits = 1, 0, False
    if i < len(text) and (text[i] == 45 or text[i] == 43):
        sign = -1 if text[i] == 45 else 1
        i += 1
    while i < len(text) and 48 <= text[i] <= 57:
        value, has_digits = min(value * 10 + (text[i] - 48), 99999), True
        i += 1
    return i, (sign * value if has_digits else 99999)


@compile_kernel
def write_rows(values, decimals, power, separator, line_end, out):
    """Write the rows of `values` (T, C) into the bytes `out`, and return the number of bytes written."""
    at = 0
    for t in range(values.shape[0]):
        for c in range(values.shape[1]):
            if c:
                at = _copy_bytes(separator, out, at)
            at = write_number(values[t, c], decimals, power, out, at)
        at = _copy_bytes(line_end, out, at)
    return at


@compile_inner_kernel
def _copy_bytes(source, out, at):
    for i in range(len(source)):
        out[at + i] = source[i]
    return at + len(source)


@compile_inner_kernel
def write_number(value, decimals, power, out, at):
    """Write a number into `out` from `at` on, return the byte after it; abs(value) * 10^decimals < MAX_EXACT_PRODUCT."""
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


@compile_inner_kernel
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


@compile_kernel
def count_decimals(text, starts):
    """Return the digits after the point of each number that begins at `starts` (N,); 0 for a number with an exponent."""
    out = np.zeros(len(starts), np.int64)
    for n in range(len(starts)):
        i, after_point = starts[n], False
        while i < len(text) and text[i] > 32:
            if text[i] == 46:
                after_point = True
            elif text[i] < 48 or text[i] > 57:
                out[n] = 0
                after_point = False
            elif after_point:
                out[n] += 1
            i += 1
    return out


@compile_kernel
def splice_numbers(text, offsets, numbers, decimals, power, out):
    """Copy `text` into `out`, with the tokens at `offsets` replaced by `numbers`. Return the length of the result."""
    i, at = 0, 0
    for n in range(len(offsets)):
        while i < offsets[n]:
            out[at] = text[i]
            i, at = i + 1, at + 1
        while i < len(text) and text[i] > 32:
            i += 1
        at = write_number(numbers[n], decimals, power, out, at)
    while i < len(text):
        out[at] = text[i]
        i, at = i + 1, at + 1
    return at
