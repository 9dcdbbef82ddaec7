"""The one family of errors that mocapfix raises on purpose.

A message is a sentence for a technician: what is wrong, where (file, marker, frame), and what to do about it.
"""


class MocapfixError(Exception):
    """Something the user can mend: a file that cannot be read, a label that is not there, an output that exists."""


class ReadError(MocapfixError):
    """A file that cannot be taken in; the message names it."""


class WriteError(MocapfixError):
    """An output that must not or cannot be written; nothing was left half-written."""


class TakeError(MocapfixError):
    """A take that was read but cannot be cleaned, and why."""


class SceneError(MocapfixError):
    """A marker set, subject or prior file that does not say what it must; the message names the key."""


class ConstraintError(MocapfixError):
    """A constraint on a pose that does not say what it must; the message names it."""
