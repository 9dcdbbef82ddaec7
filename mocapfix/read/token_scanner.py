"""The words of a text and the numbers they spell, found in one pass over its bytes: a long animation holds a million.

A number of up to fifteen digits times or over a power of ten up to the 22nd is exact in one operation (Clinger 1990, "How to
read floating point numbers accurately"); Python reads the others.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from mocapfix.read.file_content import NOT_A_NUMBER_PATTERN

MAX_EXACT_DIGITS = 15
POWERS_OF_TEN = 10.0 ** np.arange(23)
NUMBER_TOKEN, LONG_NUMBER_TOKEN, WORD_TOKEN = range(3)  # kinds of words: long ones are those that Python reads


@dataclass(frozen=True)
class TextTokens:
    """The N words of a text, that is what white space parts.

    data    the whole file
    starts  (N,) byte at which each begins
    lines   (N,) the line each is on, the file's first being 1
    values  (N,) the number it spells, NaN where it is none
    is_number  (N,) bool: does it spell a number, or that there is none?
    """

    data: bytes
    start_bytes: np.ndarray
    line_numbers: np.ndarray
    values: np.ndarray
    is_number: np.ndarray

    def __len__(self) -> int:
        return len(self.start_bytes)

    def get_text(self, index: int) -> str:
        return _extract_token(self.data, int(self.start_bytes[index]))


def scan_tokens(data: bytes, first_byte: int = 0) -> TextTokens:
    """-> the words of a file's bytes from the byte `first` on."""
    text = np.frombuffer(data, np.uint8)
    count = _count_tokens(text, first_byte)
    starts, lines = np.empty(count, np.int64), np.empty(count, np.int64)
    values, kinds = np.empty(count), np.empty(count, np.uint8)
    _fill_tokens(text, first_byte, POWERS_OF_TEN, starts, lines, values, kinds)
    for index in np.flatnonzero(kinds == LONG_NUMBER_TOKEN):
        values[index], kinds[index] = _parse_long_number(_extract_token(data, int(starts[index])))
    lines += (
        1 + len(data[:first_byte].splitlines()) - (first_byte > 0 and data[first_byte - 1 : first_byte] not in (b"\n", b"\r"))
    )
    return TextTokens(data, starts, lines, values, kinds != WORD_TOKEN)


def _extract_token(data: bytes, start: int) -> str:
    return data[start : start + 400].split(maxsplit=1)[0].decode("utf-8", "replace")


def _parse_long_number(word: str) -> tuple[float, int]:
    """-> the number that a word spells and its kind."""
    try:
        value = np.nan if NOT_A_NUMBER_PATTERN.fullmatch(word) else float(word.replace("_", "?"))
    except ValueError:
        return np.nan, WORD_TOKEN
    return value, NUMBER_TOKEN


@njit(cache=True)
def _count_tokens(text, first):
    count, inside = 0, False
    for i in range(first, len(text)):
        black = text[i] > 32
        count += black and not inside
        inside = black
    return count


@njit(cache=True)
def _fill_tokens(text, first, powers, starts, lines, values, kinds):
    """Fill in the words' starts, lines (the first being 0), values and kinds, as far as they are plain."""
    i, line, at = first, 0, 0
    while i < len(text):
        if text[i] <= 32:
            line += text[i] == 10 or (text[i] == 13 and not (i + 1 < len(text) and text[i + 1] == 10))
            i += 1
            continue
        starts[at], lines[at] = i, line
        values[at], kinds[at], i = _parse_number(text, i, powers)
        at += 1


@njit(cache=True)
def _parse_number(text, i, powers):
    """-> the number spelled at byte i, its kind, and the byte after the word."""
    start = i
    negative = text[i] == 45  # -
    if negative or text[i] == 43:  # +
        i += 1
    mantissa, digits, power, point, figures = 0, 0, 0, False, 0
    while i < len(text) and (48 <= text[i] <= 57 or (text[i] == 46 and not point)):
        if text[i] == 46:
            point = True
        else:
            mantissa = mantissa * 10 + (text[i] - 48) if digits < 18 else mantissa
            digits += mantissa > 0
            figures += 1
            power -= point
        i += 1
    if i < len(text) and (text[i] == 69 or text[i] == 101) and figures:  # E, e
        i, exponent = _parse_integer(text, i + 1)
        power += exponent
    plain = i >= len(text) or text[i] <= 32
    while i < len(text) and text[i] > 32:
        i += 1
    if not (plain and figures and digits <= MAX_EXACT_DIGITS and abs(power) < len(powers)):
        return np.nan, (WORD_TOKEN if _is_word_letter(text[start]) else LONG_NUMBER_TOKEN), i
    value = mantissa * powers[power] if power >= 0 else mantissa / powers[-power]
    return (-value if negative else value), NUMBER_TOKEN, i


@njit(cache=True)
def _is_word_letter(byte):
    """Is it one with which no number begins, as nan and inf do?"""
    small = byte | 32
    return 97 <= small <= 122 and small != 105 and small != 110


@njit(cache=True)
def _parse_integer(text, i):
    """-> the byte after the whole number spelled at byte i, and the number, a very large one where there is none."""
    sign, value, there = 1, 0, False
    if i < len(text) and (text[i] == 45 or text[i] == 43):
        sign = -1 if text[i] == 45 else 1
        i += 1
    while i < len(text) and 48 <= text[i] <= 57:
        value, there = min(value * 10 + (text[i] - 48), 99999), True
        i += 1
    return i, (sign * value if there else 99999)
