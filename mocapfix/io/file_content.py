"""Contents of input files: raw bytes, text with any encoding and line ends, and the tokens of a text, scanned in one pass."""

import codecs
import csv
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.errors import ReadError
from mocapfix.kernels.text_numbers import LONG_NUMBER_TOKEN, NUMBER_TOKEN, WORD_TOKEN, count_tokens, fill_tokens

ARCHIVE_SIGNATURES = {
    b"\x1f\x8b": "gzip",
    b"PK\x03\x04": "zip",
    b"7z\xbc\xaf": "7z",
    b"BZh": "bzip2",
    b"\xfd7zXZ": "xz",
    b"Rar!": "rar",
}
MAX_QUOTED_CHARACTERS = 40  # of a file, in messages
BYTE_ORDER_MARK = "\ufeff"
# By the bytes of their byte-order mark; that of UTF-32 begins with that of UTF-16.
WIDE_ENCODINGS = {
    codecs.BOM_UTF32_LE: "utf-32-le",
    codecs.BOM_UTF32_BE: "utf-32-be",
    codecs.BOM_UTF16_LE: "utf-16-le",
    codecs.BOM_UTF16_BE: "utf-16-be",
}
INSPECTED_CHARACTERS = 16  # by which UTF-16 without a byte-order mark is recognised: its beginning is ASCII in all formats
ASCII_TEXT_BYTES = frozenset((9, 10, 13, *range(32, 127)))
LEADING_COMMENTS_PATTERN = re.compile(rb"(?:[ \t]*(?:(?:#|//|%)[^\r\n]*)?(?:\r\n?|\n))+")  # and blank lines
COMMENT_LINE_PATTERN = re.compile(r"\s*(#|//|%)")
DECIMAL_COMMA_TOKEN_PATTERN = re.compile(rb"(?<!\S)[-+]?\d*,\d+(?:[eE][-+]?\d+)?(?!\S)")
DELIMITERS = "\t;,"
LINE_END_PATTERN = re.compile(r"\r\n?|\n")
# Spellings of a number that is not one or not finite: nan, nan(ind), inf, 1.#QNAN, ...
NOT_A_NUMBER_PATTERN = re.compile(r"[-+]?(nan(\(\w*\))?|inf(inity)?|1\.#\w+)", re.IGNORECASE)


def check_path_encoding(path: Path) -> None:
    """Raise ReadError if the path is not valid UTF-8: reports and other outputs could not name the file."""
    try:
        str(path).encode("utf-8")
    except UnicodeEncodeError as error:
        shown = str(path).encode("utf-8", "backslashreplace").decode()
        raise ReadError(f"{shown}: its name or folder is not valid UTF-8; rename it.") from error


def read_file_bytes(path: Path) -> bytes:
    """Return the content of a file. Raise ReadError if the file is misnamed, missing, unreadable, empty or an archive."""
    check_path_encoding(path)
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise ReadError(f"{path}: there is no such file; check the name and the folder.") from error
    except IsADirectoryError as error:
        raise ReadError(f"{path}: is a folder; name the files in it.") from error
    except OSError as error:
        raise ReadError(f"{path}: cannot be read ({error.strerror}).") from error
    if not data:
        raise ReadError(f"{path}: is empty (0 bytes); copy or export it again.")
    for signature, packer in ARCHIVE_SIGNATURES.items():
        if data.startswith(signature):
            raise ReadError(f"{path}: is compressed ({packer}); extract it and name the extracted file.")
    return data


@dataclass(frozen=True)
class TextDocument:
    """The lines of a text file. The lines, joined by `newline` and encoded, are the bytes of the file."""

    path: Path  # the file
    lines: list[str]  # The lines; with line ends "\\r\\n" each ends with "\\r". The first may begin with a byte-order mark.
    encoding: str  # "utf-8", "utf-16-le", "utf-16-be", "utf-32-le", "utf-32-be" or "latin-1"
    newline: str  # "\\n", or "\\r" if the file has no "\\n"

    def get_line(self, index: int) -> str:
        """Return a line without its end and without a byte-order mark."""
        return self.lines[index].removeprefix(BYTE_ORDER_MARK).rstrip("\r")

    def find_first_line(self) -> int:
        """Return the index of the first line that is neither blank nor a comment, 0 if all are."""
        texts = ((index, self.get_line(index)) for index in range(len(self.lines)))
        return next((index for index, text in texts if text.strip() and not COMMENT_LINE_PATTERN.match(text)), 0)

    def split_cells(self, index: int, delimiter: str) -> list[str]:
        """Return the cells of a line, without surrounding blanks and quotes. A delimiter inside quotes does not split."""
        line = self.get_line(index)
        try:
            row = next(csv.reader([line], delimiter=delimiter), []) if '"' in line else line.split(delimiter)
        except csv.Error as error:
            raise self.build_error(index, f"cannot be split into cells ({error}); export it again.") from error
        return [cell.strip() for cell in row]

    def build_error(self, index: int, sentence: str) -> ReadError:
        """Return an error that names the file and the line, counted from 1 as in an editor."""
        return ReadError(f"{self.path}, line {index + 1}: {sentence}")


def parse_document(path: Path, data: bytes) -> TextDocument:
    """Return the lines of a text file: UTF-8, UTF-16 or UTF-32, with or without a byte-order mark, else Latin-1."""
    text, encoding = decode_text(data)
    if text.encode(encoding, "replace") != data:
        raise ReadError(f"{path}: is damaged {encoding[:6].upper()} text; save it again as UTF-8.")
    newline = "\n" if "\n" in text or "\r" not in text else "\r"
    return TextDocument(path, text.split(newline), encoding, newline)


def decode_text(data: bytes) -> tuple[str, str]:
    """Return the text of a file, including a byte-order mark, and its encoding. Damaged characters are replaced.

    UTF-16 without a byte-order mark is recognised by a beginning of which every second byte is zero and the others are ASCII.
    """
    if encoding := _detect_wide_encoding(data):
        return data.decode(encoding, "replace"), encoding
    try:
        return data.decode("utf-8"), "utf-8"
    except UnicodeDecodeError:
        return data.decode("latin-1"), "latin-1"


def _detect_wide_encoding(data: bytes) -> str:
    """Return the encoding of a text with two or four bytes for a character, "" for any other."""
    if encoding := next((name for mark, name in WIDE_ENCODINGS.items() if data.startswith(mark)), ""):
        return encoding
    head = data[: 2 * INSPECTED_CHARACTERS]
    for encoding, low, high in (("utf-16-le", head[::2], head[1::2]), ("utf-16-be", head[1::2], head[::2])):
        if len(head) == 2 * INSPECTED_CHARACTERS and not any(high) and ASCII_TEXT_BYTES.issuperset(low):
            return encoding
    return ""


def convert_to_utf_8(path: Path, data: bytes) -> bytes:
    """Return the bytes of a text in UTF-8 if they are UTF-16 or UTF-32, otherwise unchanged. `restore_encoding` reverses this."""
    if not _detect_wide_encoding(data):
        return data
    document = parse_document(path, data)
    return document.newline.join(document.lines).encode()


def restore_encoding(converted: bytes, original: bytes) -> bytes:
    """Return a text that `convert_to_utf_8` converted, as it is or changed, in the encoding of the original bytes."""
    encoding = _detect_wide_encoding(original)
    return converted.decode().encode(encoding) if encoding else converted


def has_decimal_commas(data: bytes, start: int = 0) -> bool:
    """Return whether the numbers of a text from byte `start` on have decimal commas: all commas are, and there is no point."""
    count = 0 if data.find(b".", start) >= 0 else data.count(b",", start)
    return 0 < count == sum(1 for _ in DECIMAL_COMMA_TOKEN_PATTERN.finditer(data, start))


def parse_number(word: str) -> float:
    """Return the number that a word spells, with a decimal point or comma. Raise ValueError if it spells none."""
    return float(word.replace(",", ".") if word.count(",") == 1 and "." not in word and not word.endswith(",") else word)


def split_head_lines(head: bytes) -> list[str]:
    """Return the lines of the beginning of a file, in UTF-8 with any line ends."""
    return LINE_END_PATTERN.split(head.decode("utf-8", "replace"))


def detect_delimiter(line: str) -> str:
    """Return the most frequent delimiter in a line, "" if there is none."""
    delimiter = max(DELIMITERS, key=line.count)
    return delimiter if delimiter in line else ""


MAX_TOKEN_BYTES = 400  # of a token's text that are shown or parsed


@dataclass(frozen=True)
class TextTokens:
    """The N tokens of a text, which are separated by white space."""

    data: bytes  # the whole file, with decimal points
    start_bytes: Int[np.ndarray, " N"]  # byte at which each token begins
    line_numbers: Int[np.ndarray, " N"]  # line that each token is on; the first line of the file is 1
    values: Float[np.ndarray, " N"]  # number that each token spells, NaN if it spells none
    is_number: Bool[np.ndarray, " N"]  # whether each token spells a number, or a missing one ("nan")

    def __len__(self) -> int:
        return len(self.start_bytes)

    def get_text(self, index: int) -> str:
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
        token = _extract_token(data, int(start_bytes[index]))
        values[index], kinds[index] = np.nan, NUMBER_TOKEN
        try:
            if not NOT_A_NUMBER_PATTERN.fullmatch(token):
                values[index] = float(token.replace("_", "?"))
        except ValueError:
            kinds[index] = WORD_TOKEN
    begins_within_line = first_byte > 0 and data[first_byte - 1 : first_byte] not in (b"\n", b"\r")
    line_numbers += 1 + len(data[:first_byte].splitlines()) - begins_within_line
    return TextTokens(data, start_bytes, line_numbers, values, kinds != WORD_TOKEN)


def _extract_token(data: bytes, start: int) -> str:
    return data[start : start + MAX_TOKEN_BYTES].split(maxsplit=1)[0].decode("utf-8", "replace")
