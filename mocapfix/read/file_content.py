"""The bytes of a file that is to be read, or one sentence on why there are none."""

import codecs
import csv
import re
from dataclasses import dataclass
from pathlib import Path

from mocapfix.errors import ReadError

# MERGED: mocapfix.read.opened
ARCHIVE_SIGNATURES = {
    b"\x1f\x8b": "gzip",
    b"PK\x03\x04": "zip",
    b"7z\xbc\xaf": "7z",
    b"BZh": "bzip2",
    b"\xfd7zXZ": "xz",
    b"Rar!": "rar",
}


def read_file_bytes(path: Path) -> bytes:
    """-> a file's bytes. Raises ReadError where it cannot be opened, is empty or is an archive."""
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
    for first, packer in ARCHIVE_SIGNATURES.items():
        if data.startswith(first):
            raise ReadError(f"{path}: is packed ({packer}); unpack it and name the file that was in it.")
    return data


# MERGED: mocapfix.read.text
# A text file's lines, whichever way they are encoded and end.
BYTE_ORDER_MARK = "\ufeff"
UTF_16_ENCODINGS = {codecs.BOM_UTF16_LE: "utf-16-le", codecs.BOM_UTF16_BE: "utf-16-be"}
DELIMITERS = "\t;,"
LINE_END_PATTERN = re.compile(r"\r\n?|\n")
NOT_A_NUMBER_PATTERN = re.compile(
    r"[-+]?(nan(\(\w*\))?|inf(inity)?|1\.#\w+)", re.IGNORECASE
)  # as programs write where a number is not one


@dataclass(frozen=True)
class TextDocument:
    """A text file: encoding its lines joined by `newline` gives its bytes again."""

    path: Path
    lines: list[str]
    encoding: str
    newline: str

    def get_line(self, index: int) -> str:
        """-> a line without its end or a byte-order mark."""
        return self.lines[index].removeprefix(BYTE_ORDER_MARK).rstrip("\r")

    def split_cells(self, index: int, delimiter: str) -> list[str]:
        """-> a line's cells without blanks and quotes around them; a delimiter in quotes is part of its cell."""
        line = self.get_line(index)
        try:
            row = next(csv.reader([line], delimiter=delimiter), []) if '"' in line else line.split(delimiter)
        except csv.Error as error:
            raise self.build_error(index, f"cannot be told into cells ({error}); export it again.") from error
        return [cell.strip() for cell in row]

    def build_error(self, index: int, sentence: str) -> ReadError:
        """-> the error that names the line at `index` as an editor numbers it."""
        return ReadError(f"{self.path}, line {index + 1}: {sentence}")


def parse_document(path: Path, data: bytes) -> TextDocument:
    """-> the text in `data`: UTF-8 or UTF-16 with a byte-order mark, UTF-8, else Latin-1, which any bytes are.

    Raises ReadError where UTF-16 is damaged.
    """
    text, encoding = decode_text(data)
    if text.encode(encoding, "replace") != data:
        raise ReadError(f"{path}: is UTF-16 text that is damaged; save it again as UTF-8.")
    newline = "\n" if "\n" in text or "\r" not in text else "\r"
    return TextDocument(path, text.split(newline), encoding, newline)


def decode_text(data: bytes) -> tuple[str, str]:
    """-> the text in `data`, a byte-order mark as its first character, and its encoding; what is damaged is replaced."""
    if encoding := UTF_16_ENCODINGS.get(data[:2]):
        return data.decode(encoding, "replace"), encoding
    try:
        return data.decode("utf-8"), "utf-8"
    except UnicodeDecodeError:
        return data.decode("latin-1"), "latin-1"


def split_head_lines(head: bytes) -> list[str]:
    """-> the lines of a file's head (in UTF-8), whichever way they end."""
    return LINE_END_PATTERN.split(head.decode("utf-8", "replace"))


def detect_delimiter(line: str) -> str:
    """-> what stands between a line's fields most often; empty where nothing does."""
    often = max(DELIMITERS, key=line.count)
    return often if often in line else ""
