"""The terminal: where the commands print, how they show progress, and their exit statuses."""

import json
import os
import sys
import traceback
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from mocapfix.errors import MAX_MESSAGE_LENGTH, MocapfixError, describe_error, shorten_message
from mocapfix.model.stage_timer import STAGE_LINE_PREFIX, STAGE_LINES_VARIABLE

EXIT_DONE = 0
EXIT_FAILED = 1  # something could not be done
EXIT_USAGE = 2  # the command line is wrong
EXIT_BROKEN_PIPE = 141  # the reader of the output has ended; shells give this status to a process that the signal SIGPIPE ends
DEBUG_VARIABLE = "MOCAPFIX_DEBUG"  # environment variable, set by --debug: print the traceback of unexpected errors

COMPILATION_MESSAGE = "Compiling the kernels (first run on this machine)"
READ_STAGE = "read"  # the first stage of the pipeline, the only one that needs no kernels


class _Terminal(Console):
    """A console whose broken pipe ends the command, as `run_command_line` does it."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


stdout_console = _Terminal(highlight=False, emoji=False)  # frames as 900:100: are no emoji
stderr_console = _Terminal(stderr=True, highlight=False, emoji=False)


@contextmanager
def show_progress(name: str, *, needs_kernels: bool = False) -> Generator[Callable[[str], None]]:
    """Yield a function that shows on a terminal which stage a take is in.

    Args:
        needs_kernels: Whether to compile the kernels, unless this has been done. This is done after the stage "read": a file that
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
    from mocapfix.kernels.compilation import is_precompiled, precompile_kernels

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


def print_note(note: str) -> None:
    """Print a note of the report to standard output, indented: of a long one the first sentences, as the report has the whole."""
    while len(note) > MAX_MESSAGE_LENGTH and ". " in note:
        note = f"{note.rpartition('. ')[0]}."
    print_line(f"  {escape(shorten_message(note))}")


def print_error(message: str) -> None:
    """Print one message of at most two lines to standard error."""
    stderr_console.print(escape(shorten_message(message)), style="red", soft_wrap=True)


def print_usage_error(message: str) -> int:
    """Print what is wrong with a command; return its exit status."""
    print_error(message)
    return EXIT_USAGE


def print_failure(error: Exception, name: str) -> None:
    """Print one sentence on an exception, and with --debug its traceback.

    Args:
        name: The file that was worked on, or the command; messages of mocapfix itself name the file.

    Raises:
        BrokenPipeError: If it is one. It is no failure of a take.
    """
    if isinstance(error, BrokenPipeError):
        raise error
    if os.environ.get(DEBUG_VARIABLE) and not isinstance(error, MocapfixError):
        sys.stderr.write("".join(traceback.format_exception(error)))
    sentence = describe_error(error)
    print_error(sentence if isinstance(error, MocapfixError) else f"{name}: {sentence}")


class TakeAttempts:
    """Takes that are worked on one after the other: what is raised for one of them is printed, and the others go on."""

    def __init__(self) -> None:
        self.failed: list[Path] = []

    @contextmanager
    def attempt(self, take: Path) -> Generator[None]:
        """Run the block for one take. An exception in it is printed, and the take added to the failed ones."""
        try:
            yield
        except Exception as error:
            print_failure(error, str(take))
            self.failed.append(take)


def replace_unknown_characters() -> None:
    """Let characters that the encoding of the terminal lacks be printed as "?" (cp1252, ASCII)."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")


def flush_output() -> None:
    """Write what is left to be printed, where there is a standard output."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()


def discard_output() -> None:
    """Send all that is still to be printed nowhere, so that the end of the process raises no further error."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):  # not a file
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
