"""Exceptions that mocapfix raises on purpose, and the sentence on any other.

Every message says what is wrong, where (file, marker, frame), and how to correct it.
"""

from pathlib import Path

MAX_DETAIL_LENGTH = 50
"""characters of an unexpected exception's own text in its sentence"""
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

    name     the option's name in Python
    flag     its flag on the command line
    job_key  its dotted key in a job file
    problem  what is wrong, as the end of a sentence that begins with the option's name, without a full stop
    """

    def __init__(self, name: str, flag: str, job_key: str, problem: str) -> None:
        super().__init__(f"{name} {problem}.")
        self.name = name
        self.flag = flag
        self.job_key = job_key
        self.problem = problem


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
