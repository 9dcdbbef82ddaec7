"""What a cleaning is said to have done, in a few lines, out of its record."""

import shlex
from pathlib import Path

from rich.markup import escape

from mocapfix.console import out


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
