"""The terminal: where the commands print, how they show progress, and their exit statuses."""

import json
import os
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager

from rich.console import Console
from rich.markup import escape

from mocapfix.files.progress_lines import STAGE_LINE_PREFIX, STAGE_LINES_VARIABLE

EXIT_DONE = 0
EXIT_FAILED = 1
"""something could not be done"""
EXIT_USAGE = 2
"""the command line is wrong"""

COMPILATION_MESSAGE = "Compiling the kernels (first run on this machine)"
READ_STAGE = "read"
"""the first stage of the pipeline, the only one that needs no kernels"""

stdout_console = Console(highlight=False)
stderr_console = Console(stderr=True, highlight=False)


@contextmanager
def show_progress(name: str, *, needs_kernels: bool = False) -> Generator[Callable[[str], None]]:
    """Yield a function that shows on a terminal which stage a take is in.

    needs_kernels  whether to compile the kernels, unless this has been done. This is done after the stage "read": a file that
                   cannot be read is refused at once.
    """
    with stderr_console.status(escape(name)) as status:
        are_compiled = not needs_kernels

        def show_stage(stage: str) -> None:
            nonlocal are_compiled
            if not are_compiled and stage != READ_STAGE:
                compile_kernels_first(status.update)
                are_compiled = True
            status.update(f"{escape(name)}: {stage}")
            if os.environ.get(STAGE_LINES_VARIABLE):
                sys.stderr.write(f"{STAGE_LINE_PREFIX}{stage}\n")
                sys.stderr.flush()

        yield show_stage


def compile_kernels_first(show: Callable[[str], None]) -> None:
    """Compile the kernels that cleaning markers needs, unless this has been done, and show how many are compiled.

    On a terminal the number rises; in a pipe one line says what is happening.
    """
    from mocapfix.kernels.precompilation import is_precompiled, precompile_kernels

    if is_precompiled():
        return
    if not stderr_console.is_terminal:
        stderr_console.print(f"{COMPILATION_MESSAGE}; this takes some seconds, once.", soft_wrap=True)
    precompile_kernels(lambda done, total: show(f"{COMPILATION_MESSAGE}: {done} of {total}"))


def print_line(text: str) -> None:
    """Print one line of rich markup to standard output, without wrapping it."""
    stdout_console.print(text, soft_wrap=True)


def print_json(data: object) -> None:
    """Print a JSON document to standard output."""
    sys.stdout.write(json.dumps(data, indent=1) + "\n")


def print_error(message: str) -> None:
    """Print one message to standard error."""
    stderr_console.print(escape(message), style="red", soft_wrap=True)


def print_usage_error(message: str) -> int:
    """Print what is wrong with a command; return its exit status."""
    print_error(message)
    return EXIT_USAGE
