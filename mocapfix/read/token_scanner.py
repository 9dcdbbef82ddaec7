"""Tokens of a text and the numbers that they spell, scanned in one pass: a long animation has a million."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.kernels.text_numbers import LONG_NUMBER_TOKEN, NUMBER_TOKEN, WORD_TOKEN, count_tokens, fill_tokens
from mocapfix.read.file_content import NOT_A_NUMBER_PATTERN, has_decimal_commas

MAX_TOKEN_BYTES = 400  # of a token's text that are shown or parsed


@dataclass(frozen=True)
class TextTokens:
    """The N tokens of a text, which are separated by white space.

    Attributes:
        data: The whole file, with decimal points.
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
    """Return the tokens of a file from `first_byte` on. Decimal commas are read if all of its numbers have them."""
    if has_decimal_commas(data, first_byte):
        data = data[:first_byte] + data[first_byte:].replace(b",", b".")
    text = np.frombuffer(data, np.uint8)
    count = count_tokens(text, first_byte)
    start_bytes, line_numbers = np.empty(count, np.int64), np.empty(count, np.int64)
    values, kinds = np.empty(count), np.empty(count, np.uint8)
    fill_tokens(text, first_byte, start_bytes, line_numbers, values, kinds)
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
