"""The command line: how a command is run, and the parsing of the most frequent ones. The commands: `mocapfix.cli.commands`.

The modules of this package are the only ones that print, parse arguments or draw progress.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable
from functools import partial
from itertools import pairwise
from pathlib import Path

from mocapfix.cli import console
from mocapfix.errors import OptionError, describe_error
from mocapfix.io.shipped import get_version
from mocapfix.model.system import get_system
from mocapfix.options import UP_AXES, parse_arguments

DEBUG_FLAG = "--debug"
LAB_PACKAGES = ("sklearn", "torch")  # what only the commands that measure and train import: the extra `train`


def run_command_line(arguments: list[str] | None = None) -> None:
    """Run a command and exit with its status: 0 done, 1 something failed, 2 wrong usage, 141 broken pipe."""
    arguments = sys.argv[1:] if arguments is None else arguments
    os.environ[console.DEBUG_VARIABLE] = "1" if DEBUG_FLAG in arguments else os.environ.get(console.DEBUG_VARIABLE, "")
    arguments = join_axis_arguments(each for each in arguments if each != DEBUG_FLAG)
    if arguments[:2] == ["bench", "--baseline"]:
        arguments = ["bench", "baseline", *arguments[2:]]
    try:
        console.replace_unknown_characters()
        status = run_command(arguments)
        console.flush_output()
    except BrokenPipeError:
        console.discard_output()
        status = console.EXIT_BROKEN_PIPE
    except OSError as error:  # the output cannot be written: a full disk
        console.print_error(f"The output cannot be written ({error.strerror}).")
        console.discard_output()
        status = console.EXIT_FAILED
    raise SystemExit(status)


def join_axis_arguments(arguments: Iterable[str]) -> list[str]:
    """Return arguments in which a negative up axis is no flag: ["--up=-y"] for ["--up", "-y"]."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] == "--up" and argument.upper() in UP_AXES:
            joined[-1] = f"--up={argument}"
        else:
            joined.append(argument)
    return joined


def run_command(arguments: list[str]) -> int:
    """Run a command, and print what is raised as a sentence; return the exit status."""
    if arguments == ["--version"]:
        console.print_line(f"mocapfix {get_version()}")
        return console.EXIT_DONE
    if threading.current_thread() is threading.main_thread():
        for number in get_system().stop_signals:
            signal.signal(number, signal.default_int_handler)  # ends the command as an interrupt from the keyboard does
    try:
        if command := parse_plain_command(*arguments):
            return command()
        from mocapfix.cli.commands import parse_all_commands

        return parse_all_commands(arguments)
    except SystemExit as end:  # help, or wrong usage
        return end.code if isinstance(end.code, int) else console.EXIT_DONE
    except OptionError as error:
        return console.print_usage_error(describe_error(error))
    except KeyboardInterrupt:
        console.stderr_console.print("Stopped; no file was left incomplete.")
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and error.name in LAB_PACKAGES:
            command = " ".join(arguments[:2])
            console.print_error(f"mocapfix {command} needs {error.name}; install it with: pip install 'mocapfix[train]'.")
            return console.EXIT_FAILED
        files = [each for each in arguments if Path(each).is_file()]
        console.print_failure(error, files[0] if len(files) == 1 else f"mocapfix {' '.join(arguments[:1])}")
    return console.EXIT_FAILED


def parse_plain_command(name: str = "", *arguments: str) -> Callable[[], int] | None:
    """Return the call of a `clean`, or of an `inspect` without options; None for what tyro must parse or explain.

    To import tyro, and to describe all arguments to it, takes as long as to read a minute of motion.
    """
    lacks_folder = any(argument in ("--out", "-o") and after.startswith("-") for argument, after in pairwise([*arguments, "-"]))
    if name not in ("clean", "inspect") or lacks_folder:
        return None
    options, rest = parse_arguments(arguments)
    takes, flags, folder = list[Path](), set[str](), None
    while rest:
        each = rest.pop(0)
        if each in ("--out", "-o"):
            folder = Path(rest.pop(0))
        elif each.startswith("-"):
            flags.add(each)
        else:
            takes.append(Path(each))
    from mocapfix.cli.clean import clean_takes, inspect_take

    as_json = "--json" in flags
    if name == "inspect" and len(takes) == 1 and len(arguments) == 1 + len(flags) and flags <= {"--json"}:
        return partial(inspect_take, takes[0], options, as_json)
    if name == "clean" and flags <= {"--json", "--overwrite"}:
        return partial(clean_takes, takes, folder, options, overwrite="--overwrite" in flags, as_json=as_json)
    return None
