"""Exceptions that mocapfix raises on purpose.

Every message says what is wrong, where (file, marker, frame), and how to correct it.
"""


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
