"""What a cleaning is said to have done, in a few lines, out of its record."""

import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.markup import escape

from mocapfix.cli.arguments import (
    HierarchyOption,
    MarkerSetOption,
    SubjectOption,
    SubjectPrefixOption,
    TakesArgument,
    UpAxisOption,
    describe_option,
)
from mocapfix.cli.console import (
    EXIT_DONE,
    EXIT_FAILED,
    FlagOption,
    print_usage_error,
    show_progress,
    stderr_console,
    stdout_console,
)
from mocapfix.errors import MocapfixError, WriteError
from mocapfix.files.shipped import DEFAULT_INIT_METHOD, DEFAULT_PRIOR_NAME, INIT_METHODS, RIG_NAMES


# MERGED: mocapfix.cli_tell
def print_summary(report: dict, outputs: dict[str, Path], subject_prefix: str | None = None) -> None:
    """Print what a cleaning did, in a few lines; `subject_prefix` is what was given to it."""
    from mocapfix.report.terms import format_fault_counts

    fill, take = report["fill"], report["take"]
    relabelled = f", {fill['relabelled']} put under their own labels" if fill["relabelled"] else ""
    stdout_console.print(
        f"[bold]{escape(format_take_name(take))}[/]: {fill['missing_before']} samples were missing, {fill['filled']} are filled; "
        f"{fill['mended']} faulty ones mended{relabelled}; {fill['left_empty']} left empty. {report['seconds']['total']:.1f} s.",
        soft_wrap=True,
    )
    if report["solve"]:
        residual = report["solve"]["marker_residual_mm"]
        stdout_console.print(
            f"  {take['marker_set']}, markers {residual['mean']:.1f} mm from the body on average.", soft_wrap=True
        )
    if changes := [change for change in report["changes"] if change["decision"] == "accept"]:
        against = len(report["changes"]) - len(changes)
        decided = f"; {against} not made, by decision" if against else ""
        stdout_console.print(f"  changed: {format_fault_counts(change['kind'] for change in changes)}{decided}.", soft_wrap=True)
    for each in fill["left"][:5]:
        stdout_console.print(
            f"  left empty: {escape(each['marker'])}, frames {each['first']}-{each['last']}: {each['reason']}.", soft_wrap=True
        )
    if len(fill["left"]) > 5:
        stdout_console.print(f"  ... and {len(fill['left']) - 5} more, in the report.")
    for note in report["notes"]:
        stdout_console.print(f"  {escape(note)}", soft_wrap=True)
    folder = outputs["changes.yaml"].parent
    stdout_console.print(f"  {escape(str(folder))}/: {', '.join(escape(path.name) for path in outputs.values())}", soft_wrap=True)
    if report["changes"]:
        whose = ["--subject-prefix", subject_prefix] if subject_prefix else []
        again = escape(shlex.join([*whose, "--changes", str(outputs["changes.yaml"]), "--overwrite"]))
        stdout_console.print(f"  To take a change back, decide so in the changes file and clean again: {again}", soft_wrap=True)


def format_take_name(take: dict) -> str:
    """-> what a record's take is called."""
    return f"{take['file']} ({take['person']})" if "person" in take else take["file"]


# MERGED: mocapfix.cli_clean
# Cleaning takes from the command line, and saying what came of it.
if TYPE_CHECKING:
    from mocapfix.write.output_options import OutputOptions


def run_clean(
    takes: TakesArgument,
    output_folder: Annotated[
        Path | None, describe_option("DIR", "where outputs go", "TAKE.mocapfix/ by the take", name="out")
    ] = None,
    marker_set: MarkerSetOption = None,
    subject: SubjectOption = None,
    subject_prefix: SubjectPrefixOption = None,
    up: UpAxisOption = None,
    hierarchy: HierarchyOption = None,
    prior: Annotated[
        str, tyro.conf.arg(metavar="NAME|none", help="a trained prior, to tell of limbs that are lost")
    ] = DEFAULT_PRIOR_NAME,
    prior_scale: Annotated[
        float, tyro.conf.arg(metavar="X", help="times the prior's standard deviations: 2 believes it half as much")
    ] = 1.0,
    init: Annotated[
        str, tyro.conf.arg(metavar="START", help=f"the way to each frame's first pose: {', '.join(INIT_METHODS)}")
    ] = DEFAULT_INIT_METHOD,
    overwrite: Annotated[FlagOption, tyro.conf.arg(help="replace outputs that are there")] = False,
    as_json: Annotated[
        FlagOption,
        tyro.conf.arg(name="json", help="print the report as JSON (an array for several takes or people), nothing else"),
    ] = False,
    max_gap: Annotated[float, tyro.conf.arg(metavar="SECONDS", help="longer gaps are left empty")] = 600.0,
    limit: Annotated[
        float, tyro.conf.arg(metavar="MM", help="what could be placed no better than this, per axis, is left empty")
    ] = 250.0,
    keep: Annotated[
        str, describe_option("MARKER,...", "markers, or joints of an animation, left exactly as they are", "none")
    ] = "",
    frames: Annotated[
        str, describe_option("FIRST:LAST", "the only frames that may be touched (the file's numbers)", "all")
    ] = ":",
    refill: Annotated[
        FlagOption, tyro.conf.arg(help="replace what another program filled, where what was measured contradicts it")
    ] = False,
    only: Annotated[
        str, describe_option("KIND,...", "the only kinds of fault that are mended: gap, spike, swap, ...", "all")
    ] = "",
    changes: Annotated[
        tyro.conf.UseAppendAction[tuple[Path, ...]],
        tyro.conf.arg(metavar="FILE", help="an earlier changes file of the take, with your decisions; once for each person"),
    ] = (),
    bvh_for: Annotated[
        str, describe_option("PROGRAM,...", f"a BVH more for each: {', '.join(RIG_NAMES)}, or a rig's .yaml", "none")
    ] = "",
    also: Annotated[
        str, describe_option("KIND,...", "files of other kinds beside the usual: gltf, amc, npz, c3d, trc, csv", "none")
    ] = "",
    fps: Annotated[float | None, describe_option("N", "frames a second of what moves (BVH, glTF, ...)", "the take's")] = None,
    floor: Annotated[
        float, tyro.conf.arg(metavar="METRES", help="how high the floor lies in the file; what moves is written standing at 0")
    ] = 0.0,
) -> int:
    """Clean takes: labels put right, spikes mended, gaps filled; the file mended, a BVH, the changes, a report, a recording."""
    from mocapfix.faults import REPAIRABLE_KINDS
    from mocapfix.fill.gap_filling import FillOptions
    from mocapfix.write.output_options import OutputOptions

    if not takes:
        raise SystemExit(print_usage_error("clean: name at least one take."))
    if not max_gap > 0:
        raise SystemExit(print_usage_error(f"--max-gap must be more than 0 seconds, not {max_gap:g}."))
    if not limit > 0:
        raise SystemExit(print_usage_error(f"--limit must be more than 0 millimetres, not {limit:g}."))
    if not 0 < prior_scale < float("inf"):
        raise SystemExit(print_usage_error(f"--prior-scale must be more than 0 and finite, not {prior_scale:g}."))
    if changes and len(takes) > 1:
        raise SystemExit(print_usage_error("--changes is about one take; clean the others by themselves."))
    if strange := [kind for kind in parse_names(only) if kind not in REPAIRABLE_KINDS]:
        raise SystemExit(print_usage_error(f"--only knows no {strange[0]!r}; choose of: {', '.join(REPAIRABLE_KINDS)}."))
    try:
        wanted = OutputOptions(also=parse_names(also), bvh_for=parse_names(bvh_for), fps=fps, floor=floor)
    except MocapfixError as error:
        raise SystemExit(print_usage_error(str(error))) from None
    options = FillOptions(
        max_gap=max_gap, keep=parse_names(keep), frames=parse_frame_range(frames), limit=limit / 1e3, refill=refill
    )
    given = {"marker_set": marker_set, "subject": subject, "prior": prior, "prior_scale": prior_scale, "init": init, "up": up}
    given |= {"options": options, "only": parse_names(only), "changes": changes, "subject_prefix": subject_prefix}
    given |= {"hierarchy": hierarchy}
    return clean_takes(takes, output_folder, given, wanted, overwrite, as_json)


def clean_takes(
    takes: Sequence[Path],
    output_folder: Path | None,
    clean_arguments: dict[str, Any],
    output_options: "OutputOptions",
    overwrite: bool = False,
    as_json: bool = False,
) -> int:
    """Clean takes one after the other and tell of each; -> the exit status. What cannot be cleaned stops none of the others.

    folder  where outputs go; None: TAKE.mocapfix/ beside each take
    given   what `pipeline.clean` is told besides the take
    """
    from mocapfix import pipeline
    from mocapfix.result import check_outputs_free

    reports, written = [], set()
    for take in takes:
        where = output_folder or take.with_name(f"{take.stem}.mocapfix")
        try:
            if where / take.stem in written:
                raise WriteError(f"{take}: another take of this name was written into {where}; clean it into another folder.")
            check_outputs_free(where, take.stem, overwrite, take, output_options)
            with show_progress(take.name) as progress:
                result = pipeline.clean(take, **clean_arguments, progress=progress)
                result.write(where, overwrite, progress, output_options)
        except MocapfixError as error:
            stderr_console.print(escape(str(error)), style="red", soft_wrap=True)
            continue
        written.add(where / take.stem)
        for each in result.subject_results or (result,):
            outputs = each.get_output_paths(where, output_options)
            reports.append(json.loads(outputs["report.json"].read_text(encoding="utf-8")))
            if not as_json:
                print_summary(reports[-1], outputs, clean_arguments.get("subject_prefix"))
    if as_json and reports:
        sys.stdout.write(json.dumps(reports if len(takes) > 1 or len(reports) > 1 else reports[0], indent=1) + "\n")
    return EXIT_DONE if len(written) == len(takes) else EXIT_FAILED


def parse_names(names: str) -> tuple[str, ...]:
    """-> the names in a list with commas."""
    return tuple(name.strip() for name in names.split(",") if name.strip())


def parse_frame_range(frames: str) -> tuple[int, int] | None:
    """-> the first and last frame that FIRST:LAST names; None for all of them."""
    first, colon, last = frames.partition(":")
    try:
        if not colon:
            raise ValueError
        return None if frames == ":" else (int(first) if first else -(2**62), int(last) if last else 2**62)
    except ValueError:
        raise SystemExit(print_usage_error(f"--frames must be FIRST:LAST, as in 100:250, not {frames!r}.")) from None
