"""A text file's lines, whichever way they are encoded and end."""

import codecs
import csv
import re
from dataclasses import dataclass
from pathlib import Path

from mocapfix.errors import ReadError

BOM = "\ufeff"
UTF_16 = {codecs.BOM_UTF16_LE: "utf-16-le", codecs.BOM_UTF16_BE: "utf-16-be"}
DELIMITERS = "\t;,"
LINE_END = re.compile(r"\r\n?|\n")
NO_NUMBER = re.compile(r"[-+]?(nan(\(\w*\))?|inf(inity)?|1\.#\w+)", re.IGNORECASE)  # as programs write where a number is not one


@dataclass(frozen=True)
class Document:
    """A text file: encoding its lines joined by `newline` gives its bytes again."""

    path: Path
    lines: list[str]
    encoding: str
    newline: str

    def line(self, index: int) -> str:
        """-> a line without its end or a byte-order mark."""
        return self.lines[index].removeprefix(BOM).rstrip("\r")

    def cells(self, index: int, delimiter: str) -> list[str]:
        """-> a line's cells without blanks and quotes around them; a delimiter in quotes is part of its cell."""
        line = self.line(index)
        try:
            row = next(csv.reader([line], delimiter=delimiter), []) if '"' in line else line.split(delimiter)
        except csv.Error as error:
            raise self.fault(index, f"cannot be told into cells ({error}); export it again.") from error
        return [cell.strip() for cell in row]

    def fault(self, index: int, sentence: str) -> ReadError:
        """-> the error that names the line at `index` as an editor numbers it."""
        return ReadError(f"{self.path}, line {index + 1}: {sentence}")


def document(path: Path, data: bytes) -> Document:
    """-> the text in `data`: UTF-8 or UTF-16 with a byte-order mark, UTF-8, else Latin-1, which any bytes are.

    Raises ReadError where UTF-16 is damaged.
    """
    text, encoding = decoded(data)
    if text.encode(encoding, "replace") != data:
        raise ReadError(f"{path}: is UTF-16 text that is damaged; save it again as UTF-8.")
    newline = "\n" if "\n" in text or "\r" not in text else "\r"
    return Document(path, text.split(newline), encoding, newline)


def decoded(data: bytes) -> tuple[str, str]:
    """-> the text in `data`, a byte-order mark as its first character, and its encoding; what is damaged is replaced."""
    if encoding := UTF_16.get(data[:2]):
        return data.decode(encoding, "replace"), encoding
    try:
        return data.decode("utf-8"), "utf-8"
    except UnicodeDecodeError:
        return data.decode("latin-1"), "latin-1"


def head_lines(head: bytes) -> list[str]:
    """-> the lines of a file's head (in UTF-8), whichever way they end."""
    return LINE_END.split(head.decode("utf-8", "replace"))


def delimiter(line: str) -> str:
    """-> what stands between a line's fields most often; empty where nothing does."""
    often = max(DELIMITERS, key=line.count)
    return often if often in line else ""
