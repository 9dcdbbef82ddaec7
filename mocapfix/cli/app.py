"""The command line: its commands, and the shorter ones of them.

The modules of this package are the only ones that print, parse arguments or draw progress.
"""

import importlib.util
import json
import os
import signal
import subprocess
import sys
import threading
import webbrowser
from collections.abc import Callable
from contextlib import ExitStack, redirect_stderr, suppress
from functools import partial, wraps
from io import StringIO
from pathlib import Path
from pkgutil import resolve_name
from types import FrameType
from typing import Annotated

import tyro
from rich.markup import escape
from rich.table import Table

from mocapfix.cli import console
from mocapfix.cli.arguments import JsonOption, describe_option, join_axis_arguments
from mocapfix.errors import OptionError, ReadError, describe_error, format_name_list
from mocapfix.io.shipped import get_version
from mocapfix.model.system import get_system


def run_demo(
    output_folder: Annotated[
        Path, tyro.conf.arg(name="out", aliases=["-o"], metavar="DIR", help="folder for demo.c3d and demo.mocapfix/")
    ] = Path(),
    seed: Annotated[int, tyro.conf.arg(metavar="N", help="seed of the synthetic person, motion and damage")] = 0,
) -> int:
    """Clean a synthetic take and compare the errors with the known truth.

    The take shows a person who walks, reaches, crouches and turns; markers are missing, those of an arm among them, and have
    spikes. It is written as demo.c3d and cleaned like any other file; the output files are in demo.mocapfix/.
    """
    from mocapfix import pipeline
    from mocapfix.cli.clean import print_summary
    from mocapfix.io.files import make_output_folder
    from mocapfix.synthetic import compose_take, compute_fill_errors, write_synthetic_take

    make_output_folder(output_folder)
    truth, path = compose_take(seed=seed), output_folder / "demo.c3d"
    write_synthetic_take(path, truth)
    frame_count, marker_count = truth.marker_positions.shape[:2]
    console.stdout_console.print(
        f"Wrote {escape(str(path))}: {frame_count / truth.rate:.0f} s of {marker_count} markers, "
        f"{truth.missing_mask.sum()} samples missing."
    )
    with console.show_progress(path.name, needs_kernels=True) as progress:
        result = pipeline.clean(path, progress=progress)
        outputs = result.write(output_folder / "demo.mocapfix", overwrite=True, report_progress=progress)
    table = Table("root mean square error, mm", title="Compared with the known truth", title_justify="left")
    errors_mm = compute_fill_errors(truth, result)
    for method in errors_mm:
        table.add_column(method, justify="right")
    for damage in errors_mm["mocapfix"]:
        table.add_row(damage, *(f"{of_method[damage]:.1f}" for of_method in errors_mm.values()))
    console.stdout_console.print(table)
    print_summary(json.loads(outputs["report.json"].read_text(encoding="utf-8")), outputs)
    console.print_line(f"  To see the recording: mocapfix view {escape(str(output_folder / 'demo.mocapfix'))}")
    return console.EXIT_DONE


def run_view(
    recording: Annotated[
        Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR|FILE.rrd", help="output folder of clean, or a recording in it")
    ],
) -> int:
    """Show a take before and after cleaning in the rerun viewer."""
    files = sorted(recording.glob("*.rrd")) if recording.is_dir() else [recording]
    if not files or not all(file.is_file() and file.suffix == ".rrd" for file in files):
        raise ReadError(f"{recording}: holds no recording (.rrd); name the output folder of clean, or a recording in it.")
    done = subprocess.run([sys.executable, "-m", "rerun", "--bind", "127.0.0.1", *map(str, files)], check=False)
    if done.returncode:
        raise ReadError(f"{files[0]}: rerun could not show it (exit {done.returncode}); check that this machine has a display.")
    return console.EXIT_DONE


REVIEW_PACKAGES = ("nicegui", "starlette", "uvicorn")

FolderArgument = Annotated[
    Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR", help="output folder of `mocapfix clean` or `mocapfix batch`")
]


def run_review(
    folder: FolderArgument,
    *,
    take: Annotated[str | None, describe_option("NAME", "open this take first", "the first that is not approved")] = None,
    port: Annotated[int, tyro.conf.arg(metavar="N", help="port on this computer; 0 for any free one")] = 0,
    browser: Annotated[bool, tyro.conf.arg(help="open the page in the browser")] = True,
) -> int:
    """Review the changes to cleaned takes in the browser: see each where it happened, and accept or reject it with a key.

    The page is served to this computer only. Every decision is saved at once in the changes file of the take.
    """
    if missing := [name for name in REVIEW_PACKAGES if importlib.util.find_spec(name) is None]:
        raise ReadError(f"The review needs {' and '.join(missing)}; install it with: pip install 'mocapfix[review]'.")
    from mocapfix.batch.records import BATCH_LOCK_NAME
    from mocapfix.io.files import hold_process_lock
    from mocapfix.review.review_session import ReviewSession, describe_other_review
    from mocapfix.review.server import ReviewServer, find_three_module

    find_three_module()  # raises ReadError if it is not installed
    session = ReviewSession(folder)
    start = ""
    if take is not None:
        matching = [each for each in session.ids if take in (each, Path(each).name)]
        if not matching:
            raise ReadError(f"{folder}: has no take {take!r}; its takes are {format_name_list(session.ids)}.")
        start = f"#{matching[0]}"

    with ExitStack() as locks:
        if (folder / BATCH_LOCK_NAME).exists():
            locks.enter_context(hold_process_lock(folder / BATCH_LOCK_NAME, partial(describe_other_review, folder)))
        if len(session.ids) == 1:
            session.open_take(session.ids[0])  # refuses at once what another process reviews
        server = ReviewServer(session, port)
        console.print_line(f"Review of {escape(str(folder))}: {escape(server.address + start)}")
        console.print_line("End it with Ctrl-C, or by closing the page.")
        console.stdout_console.file.flush()
        if browser:
            webbrowser.open(server.address + start)
        try:
            server.serve()
        except KeyboardInterrupt:
            console.print_line("The review has ended; every decision is saved.")
    return console.EXIT_DONE


def run_status(folder: FolderArgument, as_json: JsonOption = False) -> int:
    """List the cleaned takes in a folder, and how far the review of each is."""
    from mocapfix.review.review_session import describe_take
    from mocapfix.review.take_files import find_cleaned_takes

    takes = [describe_take(take) for take in find_cleaned_takes(folder)]
    if as_json:
        console.print_json(takes)
        return console.EXIT_DONE
    table = Table("Take", "State", "Changes", "Reviewed", "Worst, mm", "Approved")
    for each in takes:
        worst = "" if each["worst_mm"] is None else f"{each['worst_mm']:.1f}"
        approved = f"{each['approved_by']}, {each['approved_at'][:16].replace('T', ' ')}" if each["approved_by"] else ""
        counts = (str(each["change_count"]), str(each["reviewed_count"]))
        table.add_row(escape(each["id"]), "unreadable" if each["error"] else each["state"], *counts, worst, escape(approved))
    console.stdout_console.print(table)
    for each in takes:
        if each["error"]:
            console.print_error(each["error"])
    return console.EXIT_FAILED if any(each["error"] for each in takes) else console.EXIT_DONE


DEBUG_FLAG = "--debug"

# The commands, with the module and the function of each: one command needs not those of the others.
COMMANDS = {
    "demo": "mocapfix.cli.app.run_demo",
    "inspect": "mocapfix.cli.clean.run_inspect",
    "label": "mocapfix.cli.marker_sets.run_label",
    "calibrate": "mocapfix.cli.marker_sets.run_calibrate",
    "clean": "mocapfix.cli.clean.run_clean",
    "batch": "mocapfix.cli.batch.run_batch",
    "view": "mocapfix.cli.app.run_view",
    "review": "mocapfix.cli.app.run_review",
    "status": "mocapfix.cli.app.run_status",
    "run": "mocapfix.cli.clean.run_scene",
}
LAB_PACKAGES = ("sklearn", "torch")  # what only the commands that measure and train import: the extra `train`
# The groups of commands, with their help and their table. Only their own commands need the modules of `lab`.
COMMAND_GROUPS = {
    "marker-set": ("List and show marker sets, and learn new ones from takes.", "mocapfix.cli.marker_sets.MARKER_SET_COMMANDS"),
    "bench": ("Measure mocapfix against known truth.", "mocapfix.lab.command.BENCH_COMMANDS"),
    "train": ("Train the pose priors and the twist model on motion.", "mocapfix.lab.train_command.TRAIN_COMMANDS"),
}


def _stop(_number: int, _frame: FrameType | None) -> None:
    """End the command when the system asks for it, as an interrupt from the keyboard does."""
    raise KeyboardInterrupt


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


def run_command(arguments: list[str]) -> int:
    """Run a command, and print what is raised as a sentence; return the exit status."""
    if arguments == ["--version"]:
        console.print_line(f"mocapfix {get_version()}")
        return console.EXIT_DONE
    if threading.current_thread() is threading.main_thread():
        for number in get_system().stop_signals:
            signal.signal(number, _stop)
    try:
        command = parse_command(*arguments)
        return command() if command else parse_all_commands(arguments)
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


def parse_command(name: str = "", *arguments: str) -> Callable[[], int] | None:
    """Return the call of a command with its arguments; None for help and wrong usage, which the parser of all commands shows."""
    if name not in COMMANDS:
        return None
    command = resolve_name(COMMANDS[name])
    deferred = wraps(command)(lambda *values, **named_values: partial(command, *values, **named_values))
    with redirect_stderr(StringIO()), suppress(SystemExit):
        return tyro.cli(deferred, args=arguments, console_outputs=False)


def parse_all_commands(arguments: list[str]) -> int:
    """Run a command by the parser that knows all of them: it prints help, and which of them an argument is for."""
    app = tyro.extras.SubcommandApp()
    for name, function in COMMANDS.items():
        app.command(name=name)(resolve_name(function))
    for group_name, (help_text, table) in COMMAND_GROUPS.items():
        group = tyro.extras.SubcommandApp()
        if not table.startswith("mocapfix.lab") or arguments[:1] == [group_name]:
            for name, command in resolve_name(table).items():
                group.command(name=name)(command)
        app.command(group, name=group_name, help=help_text)
    return app.cli(
        prog="mocapfix",
        description="Clean optical motion capture: writes the cleaned file, a BVH, a report and a before/after recording. "
        "--version prints the version. After an unexpected error, --debug shows where in mocapfix it was raised.",
        args=arguments,
    )
