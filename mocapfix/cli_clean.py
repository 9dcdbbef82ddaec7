"""Cleaning takes from the command line, and saying what came of it."""

import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.markup import escape

from mocapfix.console import DONE, FAILED, Flag, err, out, staged, usage
from mocapfix.errors import MocapfixError, WriteError
from mocapfix.scenes import PRIOR, RIGS, START, STARTS

if TYPE_CHECKING:
    from mocapfix.outputs import OutputOptions

Takes = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="TAKE...", help="files of captured motion")]
MarkerSetName = Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE", help="which markers; by default chosen by the labels")]
SubjectFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE", help="a calibrated subject; by default from the take itself")]
PrefixName = Annotated[
    str | None, tyro.conf.arg(metavar="NAME", help='the one person of several: "Jim" of Jim:LFHD; by default everybody, in turn')
]
Up = Annotated[
    Literal["X", "Y", "Z"] | None, tyro.conf.arg(metavar="X|Y|Z", help="the file's axis to the sky; by default what it tells")
]

Hierarchy = Annotated[
    str | None,
    tyro.conf.arg(metavar="STYLE|FILE", help="how an animation's joints are called; by default as they tell by themselves"),
]


def clean(
    takes: Takes,
    folder: Annotated[
        Path | None, tyro.conf.arg(name="out", metavar="DIR", help="where outputs go; TAKE.mocapfix/ by the take")
    ] = None,
    marker_set: MarkerSetName = None,
    subject: SubjectFile = None,
    subject_prefix: PrefixName = None,
    up: Up = None,
    hierarchy: Hierarchy = None,
    prior: Annotated[str, tyro.conf.arg(metavar="NAME|none", help="a trained prior, to tell of limbs that are lost")] = PRIOR,
    prior_scale: Annotated[
        float, tyro.conf.arg(metavar="X", help="times the prior's standard deviations: 2 believes it half as much")
    ] = 1.0,
    init: Annotated[str, tyro.conf.arg(metavar="START", help=f"the way to each frame's first pose: {', '.join(STARTS)}")] = START,
    overwrite: Annotated[Flag, tyro.conf.arg(help="replace outputs that are there")] = False,
    as_json: Annotated[
        Flag, tyro.conf.arg(name="json", help="print the report as JSON (an array for several takes or people), nothing else")
    ] = False,
    max_gap: Annotated[float, tyro.conf.arg(metavar="SECONDS", help="longer gaps are left empty")] = 600.0,
    limit: Annotated[
        float, tyro.conf.arg(metavar="MM", help="what could be placed no better than this, per axis, is left empty")
    ] = 250.0,
    keep: Annotated[
        str, tyro.conf.arg(metavar="MARKER,...", help="markers, or joints of an animation, left exactly as they are")
    ] = "",
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
        tyro.conf.UseAppendAction[tuple[Path, ...]],
        tyro.conf.arg(metavar="FILE", help="an earlier changes file of the take, with your decisions; once for each person"),
    ] = (),
    bvh_for: Annotated[
        str, tyro.conf.arg(metavar="PROGRAM,...", help=f"a BVH more for each: {', '.join(RIGS)}, or a rig's .yaml")
    ] = "",
    also: Annotated[
        str, tyro.conf.arg(metavar="KIND,...", help="files of other kinds beside the usual: gltf, amc, npz, c3d, trc, csv")
    ] = "",
    fps: Annotated[
        float | None, tyro.conf.arg(metavar="N", help="frames a second of what moves (BVH, glTF, ...); by default the take's")
    ] = None,
    floor: Annotated[
        float, tyro.conf.arg(metavar="METRES", help="how high the floor lies in the file; what moves is written standing at 0")
    ] = 0.0,
) -> int:
    """Clean takes: labels put right, spikes mended, gaps filled; a C3D, a BVH, the changes, a report, a recording."""
    from mocapfix.faults import MENDED
    from mocapfix.fill import FillOptions
    from mocapfix.outputs import OutputOptions

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
    try:
        wanted = OutputOptions(also=listed(also), bvh_for=listed(bvh_for), fps=fps, floor=floor)
    except MocapfixError as error:
        raise SystemExit(usage(str(error))) from None
    options = FillOptions(max_gap=max_gap, keep=listed(keep), frames=between(frames), limit=limit / 1e3, refill=refill)
    given = {"marker_set": marker_set, "subject": subject, "prior": prior, "prior_scale": prior_scale, "init": init, "up": up}
    given |= {"options": options, "only": listed(only), "changes": changes, "subject_prefix": subject_prefix}
    given |= {"hierarchy": hierarchy}
    return cleaned(takes, folder, given, wanted, overwrite, as_json)


def cleaned(
    takes: Sequence[Path],
    folder: Path | None,
    given: dict[str, Any],
    wanted: "OutputOptions",
    overwrite: bool = False,
    as_json: bool = False,
) -> int:
    """Clean takes one after the other and tell of each; -> the exit status. What cannot be cleaned stops none of the others.

    folder  where outputs go; None: TAKE.mocapfix/ beside each take
    given   what `pipeline.clean` is told besides the take
    """
    from mocapfix import pipeline
    from mocapfix.result import check_free

    reports, written = [], set()
    for take in takes:
        where = folder or take.with_name(f"{take.stem}.mocapfix")
        try:
            if where / take.stem in written:
                raise WriteError(f"{take}: another take of this name was written into {where}; clean it into another folder.")
            check_free(where, take.stem, overwrite, take, wanted)
            with staged(take.name) as progress:
                result = pipeline.clean(take, **given, progress=progress)
                result.write(where, overwrite, progress, wanted)
        except MocapfixError as error:
            err.print(escape(str(error)), style="red", soft_wrap=True)
            continue
        written.add(where / take.stem)
        for each in result.people or (result,):
            outputs = each.outputs(where, wanted)
            reports.append(json.loads(outputs["report.json"].read_text(encoding="utf-8")))
            if not as_json:
                tell(reports[-1], outputs, given.get("subject_prefix"))
    if as_json and reports:
        sys.stdout.write(json.dumps(reports if len(takes) > 1 or len(reports) > 1 else reports[0], indent=1) + "\n")
    return DONE if len(written) == len(takes) else FAILED


def tell(report: dict, outputs: dict[str, Path], subject_prefix: str | None = None) -> None:
    """Print what a cleaning did, in a few lines; `subject_prefix` is what was given to it."""
    from mocapfix.show.kinds import counted

    fill, take = report["fill"], report["take"]
    relabelled = f", {fill['relabelled']} put under their own labels" if fill["relabelled"] else ""
    out.print(
        f"[bold]{escape(named(take))}[/]: {fill['missing_before']} samples were missing, {fill['filled']} are filled; "
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
    folder = outputs["changes.yaml"].parent
    out.print(f"  {escape(str(folder))}/: {', '.join(escape(path.name) for path in outputs.values())}", soft_wrap=True)
    if report["changes"]:
        whose = ["--subject-prefix", subject_prefix] if subject_prefix else []
        again = escape(shlex.join([*whose, "--changes", str(outputs["changes.yaml"]), "--overwrite"]))
        out.print(f"  To take a change back, decide so in the changes file and clean again: {again}", soft_wrap=True)


def named(take: dict) -> str:
    """-> what a record's take is called."""
    return f"{take['file']} ({take['person']})" if "person" in take else take["file"]


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
