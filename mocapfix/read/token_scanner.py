"""Tokens of a text and the numbers that they spell, scanned in one pass: a long animation has a million.

A number of up to fifteen digits times or divided by a power of ten up to 10^22 is exact after one operation (Clinger 1990,
"How to read floating point numbers accurately"). Python parses all others.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from mocapfix.read.file_content import NOT_A_NUMBER_PATTERN

MAX_EXACT_DIGITS = 15  # digits of a whole number that a double represents exactly
POWERS_OF_TEN = 10.0 ** np.arange(23)  # those that a double represents exactly
MAX_TOKEN_BYTES = 400  # of a token's text that are shown or parsed

# Kinds of tokens
NUMBER_TOKEN = 0
LONG_NUMBER_TOKEN = 1  # Python must parse it
WORD_TOKEN = 2


@dataclass(frozen=True)
class TextTokens:
    """The N tokens of a text, which are separated by white space.

    Attributes:
        data: The whole file.
        start_bytes: Byte at which each token begins.
        line_numbers: Line that each token is on; the first line of the file is 1.
        values: Number that each token spells, NaN if it spells none.
        is_number: Whether each token spells a number, or a missing one ("nan").
    """

    data: bytes
    start_bytes: Int[np.ndarray, " N"]
    line_numbers: Int[np.ndarray, " N"]
    values: Float[np.ndarray, " N"]
    is_number: Bool[np.ndarray, " N"]

    def __len__(self) -> int:
        return len(self.start_bytes)

    def get_text(self, index: int) -> str:
        """Return the text of a token."""
        return _extract_token(self.data, int(self.start_bytes[index]))


def scan_tokens(data: bytes, first_byte: int = 0) -> TextTokens:
    """Return the tokens of a file from `first_byte` on."""
    text = np.frombuffer(data, np.uint8)
    count = _count_tokens(text, first_byte)
    start_bytes, line_numbers = np.empty(count, np.int64), np.empty(count, np.int64)
    values, kinds = np.empty(count), np.empty(count, np.uint8)
    _fill_tokens(text, first_byte, POWERS_OF_TEN, start_bytes, line_numbers, values, kinds)
    for index in np.flatnonzero(kinds == LONG_NUMBER_TOKEN):
        values[index], kinds[index] = _parse_long_number(_extract_token(data, int(start_bytes[index])))
    begins_within_line = first_byte > 0 and data[first_byte - 1 : first_byte] not in (b"\n", b"\r")
    line_numbers += 1 + len(data[:first_byte].splitlines()) - begins_within_line
    return TextTokens(data, start_bytes, line_numbers, values, kinds != WORD_TOKEN)


def _extract_token(data: bytes, start: int) -> str:
    return data[start : start + MAX_TOKEN_BYTES].split(maxsplit=1)[0].decode("utf-8", "replace")


def _parse_long_number(token: str) -> tuple[float, int]:
    """Return the number that a token spells, and its kind."""
    try:
        value = np.nan if NOT_A_NUMBER_PATTERN.fullmatch(token) else float(token.replace("_", "?"))
    except ValueError:
        return np.nan, WORD_TOKEN
    return value, NUMBER_TOKEN


@njit(cache=True)
def _count_tokens(text, first_byte):
    count, inside = 0, False
    for i in range(first_byte, len(text)):
        is_black = text[i] > 32
        count += is_black and not inside
        inside = is_black
    return count


@njit(cache=True)
def _fill_tokens(text, first_byte, powers, start_bytes, line_numbers, values, kinds):
    """Fill in the start, line (the first is 0), value and kind of each token."""
    i, line, token = first_byte, 0, 0
    while i < len(text):
        if text[i] <= 32:
            line += text[i] == 10 or (text[i] == 13 and not (i + 1 < len(text) and text[i + 1] == 10))
            i += 1
            continue
        start_bytes[token], line_numbers[token] = i, line
        values[token], kinds[token], i = _parse_number(text, i, powers)
        token += 1


@njit(cache=True)
def _parse_number(text, i, powers):
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
    if not (is_complete and all_digits and digits <= MAX_EXACT_DIGITS and abs(power) < len(powers)):
        return np.nan, (WORD_TOKEN if _is_word_letter(text[start]) else LONG_NUMBER_TOKEN), i
    value = mantissa * powers[power] if power >= 0 else mantissa / powers[-power]
    return (-value if is_negative else value), NUMBER_TOKEN, i


@njit(cache=True)
def _is_word_letter(byte):
    """Return whether a byte is a letter with which no number begins; nan and inf begin with n and i."""
    lower = byte | 32
    return 97 <= lower <= 122 and lower != 105 and lower != 110


@njit(cache=True)
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
