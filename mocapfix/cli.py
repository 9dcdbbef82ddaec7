"""The command line. It, its cli_*.py and console.py alone print, parse arguments or draw progress."""

import json
import sys
from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape
from rich.table import Table

from mocapfix.cli_bench import BENCHES
from mocapfix.cli_marker_set import MARKER_SETS
from mocapfix.cli_run import run
from mocapfix.cli_train import TRAININGS
from mocapfix.console import DONE, FAILED, USAGE, Flag, err, out, staged
from mocapfix.errors import MocapfixError, ReadError, WriteError
from mocapfix.scenes import PRIOR, START, STARTS

Takes = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="TAKE...", help="C3D files")]
OneTake = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TAKE", help="a C3D file")]
MarkerSetName = Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE", help="which markers; by default chosen by the labels")]
SubjectFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE", help="a calibrated subject; by default from the take itself")]
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
    from mocapfix.result import make_folder

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
    as_json: Annotated[Flag, tyro.conf.arg(name="json", help="print JSON instead of a table")] = False,
) -> int:
    """Say what is wrong with a take: all that clean would find. Nothing is written."""
    from mocapfix import marker_set as sets
    from mocapfix import pipeline, record

    with staged(take.name) as progress:
        found, looked, worn = pipeline.inspected(take, marker_set, subject, progress)
    said = {
        "take": record.of_take(found, worn.name if worn else None),
        "faults": record.of_faults(found, looked.faults),
        "notes": [sets.fit(worn, found.labels) if worn else sets.choose(found.labels).reason],
    }
    if as_json:
        sys.stdout.write(json.dumps(said, indent=1) + "\n")
        return DONE
    first, last = found.first_frame, found.frame_number(found.frames - 1)
    size = f"{len(found.labels)} markers, frames {first} to {last} at {found.rate:g} Hz"
    out.print(f"{escape(found.name)}: {size}. {escape(' '.join(said['notes']))}", soft_wrap=True)
    table = Table("marker", "kind", "frames", "severity, mm", "sure", "reason")
    for fault in said["faults"]:
        severity = "" if fault["severity_m"] is None else f"{fault['severity_m'] * 1e3:.0f}"
        where = f"{fault['first']}-{fault['last']}"
        sure = f"{fault['confidence']:.0%}"
        table.add_row(escape(fault["marker"]), fault["kind"], where, severity, sure, escape(fault["reason"]))
    if said["faults"]:
        out.print(table)
    else:
        out.print("Nothing is wrong with it.")
    return DONE


def calibrate(
    takes: Takes,
    subject: Annotated[
        Path, tyro.conf.arg(name="output", aliases=["-o"], metavar="SUBJECT.yaml", help="the subject file to write")
    ],
    marker_set: MarkerSetName = None,
    prior: PriorName = "mean-pose",
    overwrite: Annotated[Flag, tyro.conf.arg(help="replace a subject file that is there")] = False,
) -> int:
    """Find a person's bones and marker places from takes of them, to be given to `clean --subject`."""
    from mocapfix import pipeline, subject_file
    from mocapfix.result import check_not_there

    if not takes:
        raise SystemExit(usage("calibrate: name at least one take (a C3D file)."))
    check_not_there([subject], overwrite)
    with staged(", ".join(take.name for take in takes)) as progress:
        progress("calibrate")
        known = pipeline.calibrated(takes, marker_set, prior)
        subject_file.save(subject, known)
    what = f"{len(known.labels)} markers on {len(known.skeleton.names)} joints, from {known.frames} frames"
    out.print(f"{escape(str(subject))}: {what}.", soft_wrap=True)
    return DONE


def clean(
    takes: Takes,
    folder: Annotated[
        Path | None, tyro.conf.arg(name="out", metavar="DIR", help="where outputs go; TAKE.mocapfix/ by the take")
    ] = None,
    marker_set: MarkerSetName = None,
    subject: SubjectFile = None,
    prior: Annotated[str, tyro.conf.arg(metavar="NAME|none", help="a trained prior, to tell of limbs that are lost")] = PRIOR,
    prior_scale: Annotated[
        float, tyro.conf.arg(metavar="X", help="times the prior's standard deviations: 2 believes it half as much")
    ] = 1.0,
    init: Annotated[str, tyro.conf.arg(metavar="START", help=f"the way to each frame's first pose: {', '.join(STARTS)}")] = START,
    overwrite: Annotated[Flag, tyro.conf.arg(help="replace outputs that are there")] = False,
    as_json: Annotated[
        Flag, tyro.conf.arg(name="json", help="print the report as JSON (an array for several takes), nothing else")
    ] = False,
    max_gap: Annotated[float, tyro.conf.arg(metavar="SECONDS", help="longer gaps are left empty")] = 600.0,
    limit: Annotated[
        float, tyro.conf.arg(metavar="MM", help="what could be placed no better than this, per axis, is left empty")
    ] = 250.0,
    keep: Annotated[str, tyro.conf.arg(metavar="MARKER,...", help="markers left exactly as they are")] = "",
    frames: Annotated[
        str, tyro.conf.arg(metavar="FIRST:LAST", help="the only frames that may be touched (the file's numbers)")
    ] = ":",
    refill: Annotated[
        Flag, tyro.conf.arg(help="replace what another program filled, where what was measured contradicts it")
    ] = False,
    only: Annotated[
        str, tyro.conf.arg(metavar="KIND,...", help="the only kinds of fault that are mended: gap, spike, swap, ...")
    ] = "",
    changes: Annotated[
        Path | None, tyro.conf.arg(metavar="FILE", help="an earlier changes file of the take, with your decisions")
    ] = None,
) -> int:
    """Clean takes: labels put right, spikes mended, gaps filled; a C3D, a BVH, the changes, a report, a recording."""
    from mocapfix import pipeline
    from mocapfix.faults import MENDED
    from mocapfix.fill import FillOptions
    from mocapfix.result import check_free

    if not takes:
        raise SystemExit(usage("clean: name at least one take (a C3D file)."))
    if not max_gap > 0:
        raise SystemExit(usage(f"--max-gap must be more than 0 seconds, not {max_gap:g}."))
    if not limit > 0:
        raise SystemExit(usage(f"--limit must be more than 0 millimetres, not {limit:g}."))
    if not 0 < prior_scale < float("inf"):
        raise SystemExit(usage(f"--prior-scale must be more than 0 and finite, not {prior_scale:g}."))
    if changes and len(takes) > 1:
        raise SystemExit(usage("--changes is about one take; clean the others by themselves."))
    if strange := [kind for kind in listed(only) if kind not in MENDED]:
        raise SystemExit(usage(f"--only knows no {strange[0]!r}; choose of: {', '.join(MENDED)}."))
    options = FillOptions(max_gap=max_gap, keep=listed(keep), frames=between(frames), limit=limit / 1e3, refill=refill)
    reports, written = [], set()
    for take in takes:
        where = folder or take.with_name(f"{take.stem}.mocapfix")
        try:
            if where / take.stem in written:
                raise WriteError(f"{take}: another take of this name was written into {where}; clean it into another folder.")
            check_free(where, take.stem, overwrite, take)
            with staged(take.name) as progress:
                given = {"marker_set": marker_set, "subject": subject, "prior": prior, "prior_scale": prior_scale}
                given |= {"init": init, "only": listed(only), "changes": changes}
                result = pipeline.clean(take, **given, options=options, progress=progress)
                outputs = result.write(where, overwrite, progress)
        except MocapfixError as error:
            err.print(escape(str(error)), style="red", soft_wrap=True)
            continue
        written.add(where / take.stem)
        reports.append(json.loads(outputs["report.json"].read_text(encoding="utf-8")))
        if not as_json:
            tell(reports[-1], outputs)
    if as_json and reports:
        sys.stdout.write(json.dumps(reports if len(takes) > 1 else reports[0], indent=1) + "\n")
    return DONE if len(reports) == len(takes) else FAILED


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
            description="Cleans optical motion capture: C3D in; a mended C3D, a BVH, a report and a before/after out.",
            args=arguments,
        )
    except MocapfixError as error:
        err.print(escape(str(error)), style="red", soft_wrap=True)
        status = FAILED
    except KeyboardInterrupt:
        err.print("Stopped; nothing was left half-written.")
        status = FAILED
    raise SystemExit(status)


def tell(report: dict, outputs: dict[str, Path]) -> None:
    """Print what a cleaning did, in a few lines."""
    from mocapfix.show.kinds import counted

    fill, take = report["fill"], report["take"]
    relabelled = f", {fill['relabelled']} put under their own labels" if fill["relabelled"] else ""
    out.print(
        f"[bold]{escape(take['file'])}[/]: {fill['missing_before']} samples were missing, {fill['filled']} are filled; "
        f"{fill['mended']} faulty ones mended{relabelled}; {fill['left_empty']} left empty. {report['seconds']['total']:.1f} s.",
        soft_wrap=True,
    )
    if report["solve"]:
        residual = report["solve"]["marker_residual_mm"]
        out.print(f"  {take['marker_set']}, markers {residual['mean']:.1f} mm from the body on average.", soft_wrap=True)
    if changes := [change for change in report["changes"] if change["decision"] == "accept"]:
        against = len(report["changes"]) - len(changes)
        decided = f"; {against} not made, by decision" if against else ""
        out.print(f"  changed: {counted(change['kind'] for change in changes)}{decided}.", soft_wrap=True)
    for each in fill["left"][:5]:
        out.print(
            f"  left empty: {escape(each['marker'])}, frames {each['first']}-{each['last']}: {each['reason']}.", soft_wrap=True
        )
    if len(fill["left"]) > 5:
        out.print(f"  ... and {len(fill['left']) - 5} more, in the report.")
    for note in report["notes"]:
        out.print(f"  {escape(note)}", soft_wrap=True)
    folder = outputs["c3d"].parent
    out.print(f"  {escape(str(folder))}/: {', '.join(escape(path.name) for path in outputs.values())}", soft_wrap=True)
    if report["changes"]:
        again = f"--changes {escape(str(outputs['changes.yaml']))} --overwrite"
        out.print(f"  To take a change back, decide so in the changes file and clean again: {again}", soft_wrap=True)


def listed(names: str) -> tuple[str, ...]:
    """-> the names in a list with commas."""
    return tuple(name.strip() for name in names.split(",") if name.strip())


def between(frames: str) -> tuple[int, int] | None:
    """-> the first and last frame that FIRST:LAST names; None for all of them."""
    first, colon, last = frames.partition(":")
    try:
        if not colon:
            raise ValueError
        return None if frames == ":" else (int(first) if first else -(2**62), int(last) if last else 2**62)
    except ValueError:
        raise SystemExit(usage(f"--frames must be FIRST:LAST, as in 100:250, not {frames!r}.")) from None


def usage(message: str) -> int:
    err.print(escape(message), style="red", soft_wrap=True)
    return USAGE
