"""The command line. It, its cli_*.py and console.py alone print, parse arguments or draw progress."""

import json
import sys
from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape
from rich.table import Table

from mocapfix.cli.arguments import (
    HierarchyOption,
    MarkerSetOption,
    SubjectOption,
    SubjectPrefixOption,
    TakeArgument,
    TakesArgument,
    UpAxisOption,
    describe_option,
)
from mocapfix.cli.bench import BENCH_COMMANDS
from mocapfix.cli.clean import format_take_name, print_summary, run_clean
from mocapfix.cli.console import (
    EXIT_DONE,
    EXIT_FAILED,
    FlagOption,
    print_usage_error,
    show_progress,
    stderr_console,
    stdout_console,
)
from mocapfix.cli.marker_sets import MARKER_SET_COMMANDS
from mocapfix.cli.run import run_scene
from mocapfix.cli.train import TRAIN_COMMANDS
from mocapfix.errors import MocapfixError, ReadError

PoseModelOption = Annotated[str, tyro.conf.arg(metavar="NAME|none", help="what people's poses are like")]


def run_demo(
    output_folder: Annotated[
        Path, tyro.conf.arg(name="out", metavar="DIR", help="where demo.c3d and demo.mocapfix/ go")
    ] = Path(),
    seed: Annotated[int, tyro.conf.arg(metavar="N", help="which person, skin and damage are drawn (a number)")] = 0,
) -> int:
    """Clean a take that mocapfix composes itself, and compare the errors with the known truth.

    Somebody walks, reaches, crouches and turns; markers are lost, an arm among them, and jump. The take is written as
    demo.c3d and cleaned as any other file is; demo.mocapfix/ holds what came out.
    """
    from mocapfix import pipeline, synthetic
    from mocapfix.bench.demo import compute_fill_errors
    from mocapfix.files.output_files import make_output_folder

    make_output_folder(output_folder)
    truth, path = synthetic.compose_take(seed=seed), output_folder / "demo.c3d"
    synthetic.write_synthetic_take(path, truth)
    seconds, markers = len(truth.marker_positions) / truth.rate, truth.marker_positions.shape[1]
    stdout_console.print(
        f"Composed {escape(str(path))}: {seconds:.0f} s of {markers} markers, {truth.missing_mask.sum()} samples missing."
    )
    with show_progress(path.name) as progress:
        result = pipeline.clean(path, progress=progress)
        outputs = result.write(output_folder / "demo.mocapfix", overwrite=True, report_progress=progress)
    table = Table("error, mm (root mean square)", title="From the known truth", title_justify="left")
    rows = compute_fill_errors(truth, result)
    for way in rows:
        table.add_column(way, justify="right")
    for damage in rows["mocapfix"]:
        table.add_row(damage, *(f"{rows[way][damage]:.1f}" for way in rows))
    stdout_console.print(table)
    print_summary(json.loads(outputs["report.json"].read_text(encoding="utf-8")), outputs)
    stdout_console.print(f"See it move: mocapfix view {escape(str(output_folder / 'demo.mocapfix'))}", soft_wrap=True)
    return EXIT_DONE


def run_inspect(
    take: TakeArgument,
    marker_set: MarkerSetOption = None,
    subject: SubjectOption = None,
    subject_prefix: SubjectPrefixOption = None,
    up: UpAxisOption = None,
    hierarchy: HierarchyOption = None,
    as_json: Annotated[
        FlagOption, tyro.conf.arg(name="json", help="print JSON, not a table (an array for several people)")
    ] = False,
) -> int:
    """Say what is wrong with a take: all that clean would find. Nothing is written."""
    from mocapfix import pipeline

    with show_progress(take.name) as progress:
        said = pipeline.inspect(take, marker_set, subject, progress, subject_prefix, up, hierarchy)
    if as_json:
        sys.stdout.write(json.dumps(said if len(said) > 1 else said[0], indent=1) + "\n")
        return EXIT_DONE
    for each in said:
        print_faults(each)
    return EXIT_DONE


def print_faults(inspection: dict) -> None:
    """Print what is wrong with a take, or with one person's part of it."""
    take, last = inspection["take"], inspection["take"]["first_frame"] + inspection["take"]["frames"] - 1
    point = "joint" if "animation" in take else "marker"
    size = f"{take['markers']} {point}s, frames {take['first_frame']} to {last} at {take['rate_hz']:g} Hz"
    stdout_console.print(f"{escape(format_take_name(take))}: {size}. {escape(' '.join(inspection['notes']))}", soft_wrap=True)
    table = Table(point, "kind", "frames", "severity" if "animation" in take else "severity, mm", "sure", "reason")
    for fault in inspection["faults"]:
        severity = "" if fault["severity_m"] is None else f"{fault['severity_m'] * 1e3:.0f}"
        if "animation" in take:
            turned = fault.get("severity_deg")
            severity = severity and f"{severity} mm" if turned is None else f"{turned:.0f} degrees"
        where = f"{fault['first']}-{fault['last']}"
        sure = f"{fault['confidence']:.0%}"
        table.add_row(escape(fault["marker"]), fault["kind"], where, severity, sure, escape(fault["reason"]))
    if inspection["faults"]:
        stdout_console.print(table)
    else:
        stdout_console.print("Nothing is wrong with it.")


def run_calibrate(
    takes: TakesArgument,
    subject: Annotated[
        Path, tyro.conf.arg(name="output", aliases=["-o"], metavar="SUBJECT.yaml", help="the subject file to write")
    ],
    marker_set: MarkerSetOption = None,
    subject_prefix: Annotated[str | None, describe_option("NAME", 'whose bones: "Jim" of Jim:LFHD', "the only person's")] = None,
    up: UpAxisOption = None,
    prior: PoseModelOption = "mean-pose",
    overwrite: Annotated[FlagOption, tyro.conf.arg(help="replace a subject file that is there")] = False,
) -> int:
    """Find a person's bones and marker places from takes of them, to be given to `clean --subject`."""
    from mocapfix import pipeline
    from mocapfix.calibrate import subject_file
    from mocapfix.files.output_files import check_outputs_absent

    if not takes:
        raise SystemExit(print_usage_error("calibrate: name at least one take."))
    check_outputs_absent([subject], overwrite)
    with show_progress(", ".join(take.name for take in takes)) as progress:
        progress("calibrate")
        known = pipeline.calibrate(takes, marker_set, prior, subject_prefix, up)
        subject_file.write_subject(subject, known)
    what = f"{len(known.labels)} markers on {len(known.skeleton.names)} joints, from {known.frame_count} frames"
    stdout_console.print(f"{escape(str(subject))}: {what}.", soft_wrap=True)
    return EXIT_DONE


def run_view(
    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR|FILE.rrd", help="what clean wrote")],
) -> int:
    """Open the before/after in rerun."""
    import subprocess

    files = sorted(recording.glob("*.rrd")) if recording.is_dir() else [recording]
    if not files or not all(file.is_file() and file.suffix == ".rrd" for file in files):
        raise ReadError(f"{recording}: holds no recording (.rrd); give the folder that clean wrote, or a file in it.")
    done = subprocess.run([sys.executable, "-m", "rerun", "--bind", "127.0.0.1", *map(str, files)], check=False)
    if done.returncode:
        raise ReadError(f"{files[0]}: rerun could not show it (exit {done.returncode}); is there a screen on this machine?")
    return EXIT_DONE


COMMANDS = {
    "demo": run_demo,
    "inspect": run_inspect,
    "calibrate": run_calibrate,
    "clean": run_clean,
    "view": run_view,
    "run": run_scene,
}


def run_command_line(arguments: list[str] | None = None) -> None:
    """Run a command and leave with its exit status: 0 done, 1 something could not be, 2 wrong usage."""
    app, bench, train, sets = (tyro.extras.SubcommandApp() for _ in range(4))
    for name, command in BENCH_COMMANDS.items():
        bench.command(name=name)(command)
    for name, command in TRAIN_COMMANDS.items():
        train.command(name=name)(command)
    for name, command in MARKER_SET_COMMANDS.items():
        sets.command(name=name)(command)
    for name, command in COMMANDS.items():
        app.command(name=name)(command)
    app.command(sets, name="marker-set", help="Look at marker sets, and learn new ones from takes.")
    app.command(bench, name="bench", help="Measure mocapfix against what is known to be true.")
    app.command(train, name="train", help="Fit what mocapfix knows of people to motion.")
    try:
        status = app.cli(
            prog="mocapfix",
            description="Cleans optical motion capture: a take in; the same file mended, a BVH, a report and a before/after out.",
            args=arguments,
        )
    except MocapfixError as error:
        stderr_console.print(escape(str(error)), style="red", soft_wrap=True)
        status = EXIT_FAILED
    except KeyboardInterrupt:
        stderr_console.print("Stopped; nothing was left half-written.")
        status = EXIT_FAILED
    raise SystemExit(status)
