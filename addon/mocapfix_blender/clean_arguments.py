"""The arguments of `mocapfix clean` that operators share."""

import os
import shlex
from pathlib import Path

from .process import ProcessError

FEET_ITEMS = (
    ("soft", "Smooth", "Standing feet move little"),
    ("lock", "Lock", "Standing feet stay at one place"),
    ("off", "As solved", "Feet are left as they were solved"),
)
DEFAULT_FEET = "soft"


def resolve_take(filepath: str) -> Path:
    """Return the absolute path of a take. Raises ProcessError if there is no such file."""
    path = Path(os.path.realpath(filepath))
    if not filepath or not path.is_file():
        raise ProcessError(f"{filepath or 'The take'} is not a file; select a take (.c3d, .trc, .csv or .bvh).")
    return path


def get_output_folder(take: Path) -> Path:
    """Return the folder beside the take in which mocapfix keeps what it writes."""
    return take.with_name(f"{take.stem}.mocapfix")


def build_arguments(take: Path, options: str, *, frame_rate: float, feet: str, use_decisions: bool) -> list[str]:
    """Return the arguments of `mocapfix clean` for a take.

    Args:
        options: Further options as on the command line.
        frame_rate: Of the motion, 0 for that of the take.
        feet: One of FEET_ITEMS.
        use_decisions: Whether to apply the decisions of an earlier review.

    Raises:
        ProcessError: If the options are no list of words.
    """
    try:
        words = shlex.split(options)
    except ValueError as error:
        raise ProcessError(f"The options {options} cannot be read ({error}); write them as on the command line.") from error
    arguments = [str(take), "--also", "npz", *words]
    if frame_rate:
        arguments += ["--fps", f"{frame_rate:g}"]
    if feet != DEFAULT_FEET:
        arguments += ["--feet", feet]
    if use_decisions and "--changes" not in words:
        for path in sorted(get_output_folder(take).glob("*.changes.yaml")):
            if path.name.startswith(f"{take.stem}."):
                arguments += ["--changes", str(path)]
    return arguments
