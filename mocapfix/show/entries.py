"""The lists of the report page: every change with pictures of the worst ones, what was left as it was, what is empty."""

import shlex
from html import escape

from mocapfix.animation import Animation
from mocapfix.changes import Change
from mocapfix.faults import MISSING, Fault
from mocapfix.show import curves
from mocapfix.show.cleaning import Cleaning
from mocapfix.show.markup import LISTED, fold, frames, legend, more, table
from mocapfix.show.pictures import picture
from mocapfix.show.summary import number, size
from mocapfix.show.worst import worst
from mocapfix.words import worded

# Classes of the page's style sheet, and what they mean.
COLOURS = (
    ("was", "as it was"),
    ("now", "as it is now"),
    ("kept", "not changed"),
    ("band", "where 95 in 100 are predicted to lie"),
    ("when", "the change"),
)
OF_MARKERS = (
    "Paths are seen from the markers nearest by, x, y (up) and z on one scale; dashed is the other marker concerned. "
    "Of a marker that moved on its segment there are the distances from its neighbours."
)
OF_TIPS = (
    "Paths are those of the joints’ tips, the middle of what hangs on them, seen from the tip of the joint above, x, y (up) and "
    "z on one scale; dashed are other joints concerned."
)
HEAD = ("Change", "Markers", "Frames", "Why, and what was done", "Missing", "From body, mm", "Predicted, mm", "Decision")


def pictures(cleaning: Cleaning) -> str:
    """The worst changes, each with its picture."""
    figures = "".join(_figure(cleaning, *pair) for pair in worst(cleaning))
    if not figures:
        return ""
    words = OF_TIPS if isinstance(cleaning.before.layout, Animation) else OF_MARKERS
    return f'<h2>The worst changes</h2><p class="soft">{words}</p>{legend(COLOURS)}<div class="changes">{figures}</div>'


def _figure(cleaning: Cleaning, change: Change, fault: Fault) -> str:
    shown = curves.of(cleaning, fault)
    drawn = picture(shown, fault.first, fault.last, cleaning.before.first_frame)
    name = f"{change.kind}: {', '.join(change.markers)}, {_frames(change)}."
    surely = "" if change.predicted_mm is None else f" Predicted error {number(change.predicted_mm)} mm."
    seen_from = f" Seen from {', '.join(shown.seen_from)}." if shown.seen_from else ""
    cut = " Only its beginning is shown." if shown.frames[-1] < fault.last else ""
    text = escape(f"{_told(change)}{surely}{seen_from}{cut}")
    return f"<figure>{drawn}<figcaption><b>{escape(name)}</b> {text}</figcaption></figure>"


def _frames(change: Change) -> str:
    return f"frame{'s' if change.last > change.first else ''} {frames(change.first, change.last)}"


def _told(change: Change) -> str:
    """-> why it was made, and how."""
    method = f"{change.method[:1].upper()}{change.method[1:]}" if change.decision == "accept" else "Not made"
    return f"{change.why} {method}."


def change_list(cleaning: Cleaning) -> str:
    """Every change, and how somebody takes one back."""
    if not cleaning.changes:
        return ""
    rows = [
        (
            change.id,
            ", ".join(change.markers),
            frames(change.first, change.last),
            _told(change),
            _turned(change.before.missing, change.after.missing, 0),
            _turned(change.before.off_body_mm, change.after.off_body_mm, 1),
            number(change.predicted_mm) if change.predicted_mm is not None else "",
            change.decision,
        )
        for change in cleaning.changes[:LISTED]
    ]
    head = [worded(name, cleaning.before) for name in HEAD]
    listed = fold("change", len(cleaning.changes), table(head, rows) + more(len(cleaning.changes)))
    return f'<h2>All changes</h2><div class="entries">{listed}</div>{_taking_back(cleaning)}'


def _turned(before: float | None, after: float | None, digits: int) -> str:
    """-> a number before and after; nothing where there is none."""
    return f"{number(before, digits)} → {number(after, digits)}" if (before, after) not in ((0, 0), (None, None)) else ""


def _taking_back(cleaning: Cleaning) -> str:
    name = cleaning.before.path.name if cleaning.before.path else "TAKE"
    file = f"{cleaning.before.stem}.changes.yaml"
    believed = worded("what was measured there is believed", cleaning.before)
    command = shlex.join(["mocapfix", "clean", name, "--changes", file, "--overwrite"])
    return (
        f'<p class="soft">To take a change back, set its decision in {escape(file)} to “reject” (or to “keep”: {believed}) '
        f"and clean again: <code>{escape(command)}</code></p>"
    )


def unchanged(cleaning: Cleaning) -> str:
    """What was found and kept as it was measured."""
    take, found = cleaning.before, [fault for fault in cleaning.unchanged if fault.kind not in MISSING]
    if not found:
        return ""
    rows = [
        (
            fault.kind,
            take.label(fault.marker),
            frames(take.frame_number(fault.first), take.frame_number(fault.last)),
            size(fault),
            fault.reason,
        )
        for fault in found[:LISTED]
    ]
    listed = table(("Kind", worded("Marker", take), "Frames", "How far", "What was found"), rows)
    return f"<h2>Found, and kept as it was</h2>{fold('fault', len(found), listed + more(len(found)))}"


def left_empty(record: dict, cleaning: Cleaning) -> str:
    """What is still missing, and why."""
    rows = [(item["marker"], frames(item["first"], item["last"]), item["reason"]) for item in record["fill"]["left"]]
    if not rows:
        return ""
    head = (worded("Marker", cleaning.before), "Frames", "Why")
    return f"<h2>Left empty</h2>{fold('stretch', len(rows), table(head, rows[:LISTED]) + more(len(rows)))}"
