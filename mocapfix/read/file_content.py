"""Contents of input files: raw bytes, and text with any encoding and line ends."""

import codecs
import csv
import re
from dataclasses import dataclass
from pathlib import Path

from mocapfix.errors import ReadError

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
UTF_16_ENCODINGS = {codecs.BOM_UTF16_LE: "utf-16-le", codecs.BOM_UTF16_BE: "utf-16-be"}
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
    """The lines of a text file. The lines, joined by `newline` and encoded, are the bytes of the file.

    Attributes:
        path: The file.
        lines: The lines; with line ends "\\r\\n" each ends with "\\r". The first may begin with a byte-order mark.
        encoding: "utf-8", "utf-16-le", "utf-16-be" or "latin-1".
        newline: "\\n", or "\\r" if the file has no "\\n".
    """

    path: Path
    lines: list[str]
    encoding: str
    newline: str

    def get_line(self, index: int) -> str:
        """Return a line without its end and without a byte-order mark."""
        return self.lines[index].removeprefix(BYTE_ORDER_MARK).rstrip("\r")

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
    """Return the lines of a text file: UTF-8 or UTF-16 with a byte-order mark, UTF-8 without one, else Latin-1.

    Raises:
        ReadError: If UTF-16 text is damaged.
    """
    text, encoding = decode_text(data)
    if text.encode(encoding, "replace") != data:
        raise ReadError(f"{path}: is damaged UTF-16 text; save it again as UTF-8.")
    newline = "\n" if "\n" in text or "\r" not in text else "\r"
    return TextDocument(path, text.split(newline), encoding, newline)


def decode_text(data: bytes) -> tuple[str, str]:
    """Return the text of a file, including a byte-order mark, and its encoding. Damaged characters are replaced."""
    if encoding := UTF_16_ENCODINGS.get(data[:2]):
        return data.decode(encoding, "replace"), encoding
    try:
        return data.decode("utf-8"), "utf-8"
    except UnicodeDecodeError:
        return data.decode("latin-1"), "latin-1"


def split_head_lines(head: bytes) -> list[str]:
    """Return the lines of the beginning of a file, in UTF-8 with any line ends."""
    return LINE_END_PATTERN.split(head.decode("utf-8", "replace"))


def detect_delimiter(line: str) -> str:
    """Return the most frequent delimiter in a line, "" if there is none."""
    delimiter = max(DELIMITERS, key=line.count)
    return delimiter if delimiter in line else ""
