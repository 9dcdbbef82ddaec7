"""The bytes of a file that is to be read, or one sentence on why there are none."""

from pathlib import Path

from mocapfix.errors import ReadError

PACKED = {b"\x1f\x8b": "gzip", b"PK\x03\x04": "zip", b"7z\xbc\xaf": "7z", b"BZh": "bzip2", b"\xfd7zXZ": "xz", b"Rar!": "rar"}


def file_bytes(path: Path) -> bytes:
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
    for first, packer in PACKED.items():
        if data.startswith(first):
            raise ReadError(f"{path}: is packed ({packer}); unpack it and name the file that was in it.")
    return data
