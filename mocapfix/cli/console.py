"""The terminal: where the commands print, and how they show that they work."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import tyro
from rich.console import Console
from rich.markup import escape

FlagOption = tyro.conf.FlagCreatePairsOff[bool]
JsonOption = Annotated[FlagOption, tyro.conf.arg(name="json", help="print JSON instead of a table")]
EXIT_DONE, EXIT_FAILED, EXIT_USAGE = 0, 1, 2  # exit statuses

stdout_console = Console(highlight=False)
stderr_console = Console(stderr=True, highlight=False)


@contextmanager
def show_progress(name: str) -> Iterator:
    """Show on a terminal which stage a take is in; in a pipe, nothing but the one-time compilation."""
    from mocapfix.kernels.compilation_cache import is_solver_compiled

    if not is_solver_compiled():
        stderr_console.print("First run on this machine: compiling the kernels, which takes about half a minute and is kept.")
    with stderr_console.status(escape(name)) as status:
        yield lambda stage: status.update(f"{escape(name)}: {stage}")


def print_usage_error(message: str) -> int:
    """Say what is wrong with a command; -> its exit status."""
    stderr_console.print(escape(message), style="red", soft_wrap=True)
    return EXIT_USAGE
