"""The words of a text and the numbers they spell, found in one pass over its bytes: a long animation holds a million.

A number of up to fifteen digits times or over a power of ten up to the 22nd is exact in one operation (Clinger 1990, "How to
read floating point numbers accurately"); Python reads the others.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from mocapfix.read.text import NO_NUMBER

EXACT_DIGITS = 15
POWERS = 10.0 ** np.arange(23)
NUMBER, LONG, WORD = range(3)  # kinds of words: long ones are those that Python reads


@dataclass(frozen=True)
class Words:
    """The N words of a text, that is what white space parts.

    data    the whole file
    starts  (N,) byte at which each begins
    lines   (N,) the line each is on, the file's first being 1
    values  (N,) the number it spells, NaN where it is none
    is_number  (N,) bool: does it spell a number, or that there is none?
    """

    data: bytes
    starts: np.ndarray
    lines: np.ndarray
    values: np.ndarray
    is_number: np.ndarray

    def __len__(self) -> int:
        return len(self.starts)

    def word(self, index: int) -> str:
        return _word(self.data, int(self.starts[index]))


def words(data: bytes, first: int = 0) -> Words:
    """-> the words of a file's bytes from the byte `first` on."""
    text = np.frombuffer(data, np.uint8)
    count = _count(text, first)
    starts, lines = np.empty(count, np.int64), np.empty(count, np.int64)
    values, kinds = np.empty(count), np.empty(count, np.uint8)
    _scan(text, first, POWERS, starts, lines, values, kinds)
    for index in np.flatnonzero(kinds == LONG):
        values[index], kinds[index] = _said(_word(data, int(starts[index])))
    lines += 1 + len(data[:first].splitlines()) - (first > 0 and data[first - 1 : first] not in (b"\n", b"\r"))
    return Words(data, starts, lines, values, kinds != WORD)


def _word(data: bytes, start: int) -> str:
    return data[start : start + 400].split(maxsplit=1)[0].decode("utf-8", "replace")


def _said(word: str) -> tuple[float, int]:
    """-> the number that a word spells and its kind."""
    try:
        value = np.nan if NO_NUMBER.fullmatch(word) else float(word.replace("_", "?"))
    except ValueError:
        return np.nan, WORD
    return value, NUMBER


@njit(cache=True)
def _count(text, first):
    count, inside = 0, False
    for i in range(first, len(text)):
        black = text[i] > 32
        count += black and not inside
        inside = black
    return count


@njit(cache=True)
def _scan(text, first, powers, starts, lines, values, kinds):
    """Fill in the words' starts, lines (the first being 0), values and kinds, as far as they are plain."""
    i, line, at = first, 0, 0
    while i < len(text):
        if text[i] <= 32:
            line += text[i] == 10 or (text[i] == 13 and not (i + 1 < len(text) and text[i + 1] == 10))
            i += 1
            continue
        starts[at], lines[at] = i, line
        values[at], kinds[at], i = _number(text, i, powers)
        at += 1


@njit(cache=True)
def _number(text, i, powers):
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
        i, exponent = _integer(text, i + 1)
        power += exponent
    plain = i >= len(text) or text[i] <= 32
    while i < len(text) and text[i] > 32:
        i += 1
    if not (plain and figures and digits <= EXACT_DIGITS and abs(power) < len(powers)):
        return np.nan, (WORD if _a_letter(text[start]) else LONG), i
    value = mantissa * powers[power] if power >= 0 else mantissa / powers[-power]
    return (-value if negative else value), NUMBER, i


@njit(cache=True)
def _a_letter(byte):
    """Is it one with which no number begins, as nan and inf do?"""
    small = byte | 32
    return 97 <= small <= 122 and small != 105 and small != 110


@njit(cache=True)
def _integer(text, i):
    """-> the byte after the whole number spelled at byte i, and the number, a very large one where there is none."""
    sign, value, there = 1, 0, False
    if i < len(text) and (text[i] == 45 or text[i] == 43):
        sign = -1 if text[i] == 45 else 1
        i += 1
    while i < len(text) and 48 <= text[i] <= 57:
        value, there = min(value * 10 + (text[i] - 48), 99999), True
        i += 1
    return i, (sign * value if there else 99999)
