"""The command line. It, its cli_*.py and console.py alone print, parse arguments or draw progress."""

import json
import sys
from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape
from rich.table import Table

from mocapfix.cli_arguments import Hierarchy, MarkerSetName, OneTake, PrefixName, SubjectFile, Takes, Up, shown
from mocapfix.cli_bench import BENCHES
from mocapfix.cli_clean import clean
from mocapfix.cli_marker_set import MARKER_SETS
from mocapfix.cli_run import run
from mocapfix.cli_tell import named, tell
from mocapfix.cli_train import TRAININGS
from mocapfix.console import DONE, FAILED, Flag, err, out, staged, usage
from mocapfix.errors import MocapfixError, ReadError

PriorName = Annotated[str, tyro.conf.arg(metavar="NAME|none", help="what people's poses are like")]


def demo(
    folder: Annotated[Path, tyro.conf.arg(name="out", metavar="DIR", help="where demo.c3d and demo.mocapfix/ go")] = Path(),
    seed: Annotated[int, tyro.conf.arg(metavar="N", help="which person, skin and damage are drawn (a number)")] = 0,
) -> int:
    """Clean a take that mocapfix composes itself, and compare the errors with the known truth.

    Somebody walks, reaches, crouches and turns; markers are lost, an arm among them, and jump. The take is written as
    demo.c3d and cleaned as any other file is; demo.mocapfix/ holds what came out.
    """
    from mocapfix import pipeline, synthetic
    from mocapfix.bench.demo import errors
    from mocapfix.files import make_folder

    make_folder(folder)
    truth, path = synthetic.take(seed=seed), folder / "demo.c3d"
    synthetic.write(path, truth)
    seconds, markers = len(truth.markers) / truth.rate, truth.markers.shape[1]
    out.print(f"Composed {escape(str(path))}: {seconds:.0f} s of {markers} markers, {truth.struck.sum()} samples missing.")
    with staged(path.name) as progress:
        result = pipeline.clean(path, progress=progress)
        outputs = result.write(folder / "demo.mocapfix", overwrite=True, progress=progress)
    table = Table("error, mm (root mean square)", title="From the known truth", title_justify="left")
    rows = errors(truth, result)
    for way in rows:
        table.add_column(way, justify="right")
    for damage in rows["mocapfix"]:
        table.add_row(damage, *(f"{rows[way][damage]:.1f}" for way in rows))
    out.print(table)
    tell(json.loads(outputs["report.json"].read_text(encoding="utf-8")), outputs)
    out.print(f"See it move: mocapfix view {escape(str(folder / 'demo.mocapfix'))}", soft_wrap=True)
    return DONE


def inspect(
    take: OneTake,
    marker_set: MarkerSetName = None,
    subject: SubjectFile = None,
    subject_prefix: PrefixName = None,
    up: Up = None,
    hierarchy: Hierarchy = None,
    as_json: Annotated[Flag, tyro.conf.arg(name="json", help="print JSON, not a table (an array for several people)")] = False,
) -> int:
    """Say what is wrong with a take: all that clean would find. Nothing is written."""
    from mocapfix import pipeline

    with staged(take.name) as progress:
        said = pipeline.inspected(take, marker_set, subject, progress, subject_prefix, up, hierarchy)
    if as_json:
        sys.stdout.write(json.dumps(said if len(said) > 1 else said[0], indent=1) + "\n")
        return DONE
    for each in said:
        tell_faults(each)
    return DONE


def tell_faults(said: dict) -> None:
    """Print what is wrong with a take, or with one person's part of it."""
    take, last = said["take"], said["take"]["first_frame"] + said["take"]["frames"] - 1
    point = "joint" if "animation" in take else "marker"
    size = f"{take['markers']} {point}s, frames {take['first_frame']} to {last} at {take['rate_hz']:g} Hz"
    out.print(f"{escape(named(take))}: {size}. {escape(' '.join(said['notes']))}", soft_wrap=True)
    table = Table(point, "kind", "frames", "severity" if "animation" in take else "severity, mm", "sure", "reason")
    for fault in said["faults"]:
        severity = "" if fault["severity_m"] is None else f"{fault['severity_m'] * 1e3:.0f}"
        if "animation" in take:
            turned = fault.get("severity_deg")
            severity = severity and f"{severity} mm" if turned is None else f"{turned:.0f} degrees"
        where = f"{fault['first']}-{fault['last']}"
        sure = f"{fault['confidence']:.0%}"
        table.add_row(escape(fault["marker"]), fault["kind"], where, severity, sure, escape(fault["reason"]))
    if said["faults"]:
        out.print(table)
    else:
        out.print("Nothing is wrong with it.")


def calibrate(
    takes: Takes,
    subject: Annotated[
        Path, tyro.conf.arg(name="output", aliases=["-o"], metavar="SUBJECT.yaml", help="the subject file to write")
    ],
    marker_set: MarkerSetName = None,
    subject_prefix: Annotated[str | None, shown("NAME", 'whose bones: "Jim" of Jim:LFHD', "the only person's")] = None,
    up: Up = None,
    prior: PriorName = "mean-pose",
    overwrite: Annotated[Flag, tyro.conf.arg(help="replace a subject file that is there")] = False,
) -> int:
    """Find a person's bones and marker places from takes of them, to be given to `clean --subject`."""
    from mocapfix import pipeline, subject_file
    from mocapfix.files import check_not_there

    if not takes:
        raise SystemExit(usage("calibrate: name at least one take."))
    check_not_there([subject], overwrite)
    with staged(", ".join(take.name for take in takes)) as progress:
        progress("calibrate")
        known = pipeline.calibrated(takes, marker_set, prior, subject_prefix, up)
        subject_file.save(subject, known)
    what = f"{len(known.labels)} markers on {len(known.skeleton.names)} joints, from {known.frames} frames"
    out.print(f"{escape(str(subject))}: {what}.", soft_wrap=True)
    return DONE


def view(recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR|FILE.rrd", help="what clean wrote")]) -> int:
    """Open the before/after in rerun."""
    import subprocess

    files = sorted(recording.glob("*.rrd")) if recording.is_dir() else [recording]
    if not files or not all(file.is_file() and file.suffix == ".rrd" for file in files):
        raise ReadError(f"{recording}: holds no recording (.rrd); give the folder that clean wrote, or a file in it.")
    done = subprocess.run([sys.executable, "-m", "rerun", "--bind", "127.0.0.1", *map(str, files)], check=False)
    if done.returncode:
        raise ReadError(f"{files[0]}: rerun could not show it (exit {done.returncode}); is there a screen on this machine?")
    return DONE


COMMANDS = {"demo": demo, "inspect": inspect, "calibrate": calibrate, "clean": clean, "view": view, "run": run}


def main(arguments: list[str] | None = None) -> None:
    """Run a command and leave with its exit status: 0 done, 1 something could not be, 2 wrong usage."""
    app, bench, train, sets = (tyro.extras.SubcommandApp() for _ in range(4))
    for name, command in BENCHES.items():
        bench.command(name=name)(command)
    for name, command in TRAININGS.items():
        train.command(name=name)(command)
    for name, command in MARKER_SETS.items():
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
        err.print(escape(str(error)), style="red", soft_wrap=True)
        status = FAILED
    except KeyboardInterrupt:
        err.print("Stopped; nothing was left half-written.")
        status = FAILED
    raise SystemExit(status)
