"""The terminal: where the commands print, and how they show that they work."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import tyro
from rich.console import Console
from rich.markup import escape

Flag = tyro.conf.FlagCreatePairsOff[bool]
Json = Annotated[Flag, tyro.conf.arg(name="json", help="print JSON instead of a table")]
DONE, FAILED, USAGE = 0, 1, 2  # exit statuses

out = Console(highlight=False)
err = Console(stderr=True, highlight=False)


@contextmanager
def staged(name: str) -> Iterator:
    """Show on a terminal which stage a take is in; in a pipe, nothing but the one-time compilation."""
    from mocapfix.kernels.problem import compiled

    if not compiled():
        err.print("First run on this machine: compiling the kernels, which takes about half a minute and is kept.")
    with err.status(escape(name)) as status:
        yield lambda stage: status.update(f"{escape(name)}: {stage}")


def usage(message: str) -> int:
    """Say what is wrong with a command; -> its exit status."""
    err.print(escape(message), style="red", soft_wrap=True)
    return USAGE
