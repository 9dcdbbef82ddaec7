"""Cleaning takes from the command line, and saying what came of it."""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.markup import escape

from mocapfix.cli_arguments import Hierarchy, MarkerSetName, PrefixName, SubjectFile, Takes, Up, shown
from mocapfix.cli_tell import tell
from mocapfix.console import DONE, FAILED, Flag, err, staged, usage
from mocapfix.errors import MocapfixError, WriteError
from mocapfix.scenes import PRIOR, RIGS, START, STARTS

if TYPE_CHECKING:
    from mocapfix.outputs import OutputOptions


def clean(
    takes: Takes,
    folder: Annotated[Path | None, shown("DIR", "where outputs go", "TAKE.mocapfix/ by the take", name="out")] = None,
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
        str, shown("MARKER,...", "markers, or joints of an animation, left exactly as they are", "none")
    ] = "",
    frames: Annotated[
        str, shown("FIRST:LAST", "the only frames that may be touched (the file's numbers)", "all")
    ] = ":",
    refill: Annotated[
        Flag, tyro.conf.arg(help="replace what another program filled, where what was measured contradicts it")
    ] = False,
    only: Annotated[
        str, shown("KIND,...", "the only kinds of fault that are mended: gap, spike, swap, ...", "all")
    ] = "",
    changes: Annotated[
        tyro.conf.UseAppendAction[tuple[Path, ...]],
        tyro.conf.arg(metavar="FILE", help="an earlier changes file of the take, with your decisions; once for each person"),
    ] = (),
    bvh_for: Annotated[
        str, shown("PROGRAM,...", f"a BVH more for each: {', '.join(RIGS)}, or a rig's .yaml", "none")
    ] = "",
    also: Annotated[
        str, shown("KIND,...", "files of other kinds beside the usual: gltf, amc, npz, c3d, trc, csv", "none")
    ] = "",
    fps: Annotated[float | None, shown("N", "frames a second of what moves (BVH, glTF, ...)", "the take's")] = None,
    floor: Annotated[
        float, tyro.conf.arg(metavar="METRES", help="how high the floor lies in the file; what moves is written standing at 0")
    ] = 0.0,
) -> int:
    """Clean takes: labels put right, spikes mended, gaps filled; the file mended, a BVH, the changes, a report, a recording."""
    from mocapfix.faults import MENDED
    from mocapfix.fill import FillOptions
    from mocapfix.outputs import OutputOptions

    if not takes:
        raise SystemExit(usage("clean: name at least one take."))
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
