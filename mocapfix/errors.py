"""Exceptions that mocapfix raises on purpose, the sentence on any other, and lists in such sentences.

Every message says what is wrong, where (file, marker, frame), and how to correct it.
"""

from collections.abc import Sequence
from pathlib import Path

MAX_MESSAGE_LENGTH = 220  # characters of a message, which are two lines of a terminal; a path before it is not counted
MAX_LISTED_NAMES = 6  # names that a sentence lists
MAX_LIST_LENGTH = 66  # characters of such a list, of names of usual length
MAX_NAME_LENGTH = 40  # characters of a name in it
MAX_DETAIL_LENGTH = 50  # characters of an unexpected exception's own text in its sentence
REPORT_REQUEST = "please report it (CONTRIBUTING.md says where), if possible with the file"


class MocapfixError(Exception):
    """Base class: an error that the user can correct, such as an unreadable file or an existing output."""


class ReadError(MocapfixError):
    """An input file cannot be read. The message names the file."""


class WriteError(MocapfixError):
    """An output cannot or must not be written. No partial file remains."""


class TakeError(MocapfixError):
    """A take was read but cannot be processed. The message gives the reason."""


class SceneError(MocapfixError):
    """A marker set, subject, prior or job file is invalid. The message names the key."""


class ConstraintError(MocapfixError):
    """A constraint on a pose is invalid. The message names the constraint."""


class OptionError(MocapfixError):
    """An option whose value is not allowed.

    Attributes:
        name: The option's name in Python.
        flag: Its flag on the command line.
        job_key: Its dotted key in a job file.
        problem: What is wrong, as the end of a sentence that begins with the option's name, without a full stop.
    """

    def __init__(self, name: str, flag: str, job_key: str, problem: str) -> None:
        super().__init__(f"{name} {problem}.")
        self.name, self.flag, self.job_key, self.problem = name, flag, job_key, problem


def describe_error(error: BaseException) -> str:
    """Return the sentence of an error without the name of the file, unless mocapfix or the system explains it with one."""
    if isinstance(error, MocapfixError):
        return f"{error.flag} {error.problem}." if isinstance(error, OptionError) else str(error)
    if isinstance(error, MemoryError):
        return "There is not enough memory; close other programs, or clean fewer frames or takes at a time."
    if isinstance(error, OSError) and error.strerror:
        place = f" ({error.filename})" if error.filename else ""
        return f"The system refused{place}: {error.strerror}; check the disk and the permissions."
    traceback, place = error.__traceback__, ""
    while traceback is not None:
        place = f" in {Path(traceback.tb_frame.f_code.co_filename).name}, line {traceback.tb_lineno}"
        traceback = traceback.tb_next
    detail = " ".join(str(error).split())
    if len(detail) > MAX_DETAIL_LENGTH:
        detail = f"{detail[:MAX_DETAIL_LENGTH]}..."
    return f"An error in mocapfix{place} ({type(error).__name__}{detail and ': '}{detail}); {REPORT_REQUEST}."


def format_name_list(names: Sequence[str], max_count: int = MAX_LISTED_NAMES) -> str:
    """Return names as a list in a sentence: the first ones that fit into it, and the number of the others."""
    if not names:
        return "(none)"
    listed = [name if len(name) <= MAX_NAME_LENGTH else f"{name[: MAX_NAME_LENGTH - 3]}..." for name in names[:max_count]]
    while len(listed) > 1 and len(", ".join(listed)) > MAX_LIST_LENGTH:
        listed.pop()
    more = f" and {len(names) - len(listed):,} more" if len(names) > len(listed) else ""
    return ", ".join(listed) + more


def join_names(names: Sequence[str]) -> str:
    """Return "a, b and c", of many names the list of `format_name_list`."""
    is_short = len(names) <= MAX_LISTED_NAMES and len(", ".join(names)) <= MAX_LIST_LENGTH
    return join_words(names) if is_short else format_name_list(names)


def join_words(words: Sequence[str]) -> str:
    """Return "a, b and c"."""
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


def shorten_message(message: str) -> str:
    """Return a message of at most MAX_MESSAGE_LENGTH characters: of a longer one the beginning and the end, where the remedy is.

    The path of a file before the first colon is kept and not counted.
    """
    place, colon, _ = message.partition(": ")
    start = len(place + colon) if colon and ("/" in place or "\\" in place) else 0
    if len(message) - start <= MAX_MESSAGE_LENGTH:
        return message
    head, tail = message[start : start + 2 * MAX_MESSAGE_LENGTH // 3 - 3], message[-MAX_MESSAGE_LENGTH // 3 + 3 :]
    return f"{message[:start]}{head.rpartition(' ')[0]} ... {tail.partition(' ')[2]}"
