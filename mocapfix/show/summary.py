"""What a technician reads first: what was wrong with the take, what was done about it, and what was left."""

from collections import Counter

import numpy as np

from mocapfix.animation import Animation
from mocapfix.faults import MISSING, Fault, Fragment
from mocapfix.show.cleaning import Cleaning
from mocapfix.show.kinds import counted, listed
from mocapfix.words import worded

NAMED = 12  # markers in one sentence at most


def wrong(record: dict, cleaning: Cleaning) -> str:
    """-> a few sentences on the faults: how many, of which kinds, the longest gap, and what belongs to no marker."""
    take, count = cleaning.before, record["take"]["markers"]
    none = [fault for fault in cleaning.faults.items if isinstance(fault, Fragment) and fault.relation in ("other", "doubles")]
    faults = [fault for fault in cleaning.faults.items if fault not in none]
    text = worded("Nothing: every marker is there in every frame, and none strays.", take)
    if faults:
        marked = len({m if m < count else 0 for fault in faults for m in fault.markers})  # a root's place is the root's
        kinds = counted(fault.kind for fault in faults)
        text = f"{marked} of {count} {worded('markers', take)} {'has' if marked == 1 else 'have'} faults: {kinds}."
    if missing := record["fill"]["missing_before"]:
        text += f" {missing:,} of {take.seen.size:,} {worded('samples', take)} ({missing / take.seen.size:.1%}) were missing."
        text += _longest_gap(cleaning, faults)
    if none:
        donors = len({fault.donor for fault in none})
        text += (
            f" {donors:,} trajector{'y' if donors == 1 else 'ies'} without a marker’s name continue{'s' * (donors == 1)} none."
        )
    return text


def _longest_gap(cleaning: Cleaning, faults: list[Fault]) -> str:
    gaps, take = [fault for fault in faults if fault.kind in MISSING], cleaning.before
    if not gaps:
        return ""
    longest = max(gaps, key=lambda fault: fault.last - fault.first)
    label, seconds = take.label(longest.marker), (longest.last - longest.first + 1) / take.rate
    if longest.kind == "absent":
        return f" {label} is never seen."
    first, last = take.frame_number(longest.first), take.frame_number(longest.last)
    return f" The longest gap is {label}’s, frames {first} to {last} ({seconds:.2f} s)."


def done(record: dict, cleaning: Cleaning) -> str:
    """-> sentences on what was relabelled, replaced and filled, from what, and what somebody decided against."""
    fill, solve, subject = record["fill"], record["solve"], record["subject"]
    parts = [
        f"{fill[key]:,} {worded(one if fill[key] == 1 else many, cleaning.before)}"
        for key, one, many in (
            ("relabelled", "sample was put under its own label", "samples were put under their own labels"),
            ("mended", "faulty one was replaced", "faulty ones were replaced"),
            ("filled", "of the missing samples was filled", "of the missing samples were filled"),
        )
        if fill[key]
    ]
    if not parts:
        nothing = worded("Nothing was changed: the samples are as they were measured.", cleaning.before)
        return f"{nothing}{_against(record)}"
    text = f"{listed(parts)}; {worded('every other sample is as it was measured', cleaning.before)}.{_against(record)}"
    if not fill["filled"] and not fill["mended"]:
        return text
    if isinstance(cleaning.before.layout, Animation):
        return f"{text} Each change below says how."
    if subject is None or solve is None:
        return f"{text} No body was used: the samples come from the other markers and from the markers’ own paths."
    residual = solve["marker_residual_mm"]
    return (
        f"{text} A body with this person’s bones places them; the seen markers lie "
        f"{number(residual['mean'])} mm from it on average, 95% of them within {number(residual['p95'])} mm."
    )


def _against(record: dict) -> str:
    """What was not made since somebody decided so."""
    against = Counter(change["decision"] for change in record["changes"])
    said = {"reject": "rejected", "keep": "kept as measured"}
    words = [f"{against[decision]:,} {word}" for decision, word in said.items() if against[decision]]
    return f" Not made, by decision: {listed(words)}." if words else ""


def left(record: dict, cleaning: Cleaning) -> str:
    """-> sentences on the samples that are still missing, and on the faults that were kept."""
    fill, take = record["fill"], cleaning.before
    text = worded("No sample is missing any more.", take)
    if fill["left_empty"]:
        markers = list(dict.fromkeys(item["marker"] for item in fill["left"]))
        text = f"{fill['left_empty']:,} {worded('sample is' if fill['left_empty'] == 1 else 'samples are', take)} still missing"
        names = [*markers[:NAMED], *([f"{len(markers) - NAMED} more"] if len(markers) > NAMED else [])]
        text = f"{text}, on {listed(names)}: see the reasons below." if markers else f"{text}."
    kept = counted(fault.kind for fault in cleaning.unchanged if fault.kind not in (*MISSING, "fragment"))
    return f"{text} Found and kept: {kept}." if kept else text if fill["left_empty"] else f"Nothing: {text[0].lower()}{text[1:]}"


def size(fault: Fault) -> str:
    """-> how severe a fault is, with its unit; a dash where it is not known."""
    value, unit = (np.degrees(fault.severity), "degrees") if fault.unit == "rad" else (1e3 * fault.severity, "mm")
    return f"{number(value, 0)} {unit}" if np.isfinite(value) else number(None)


def number(value: float | None, digits: int = 1) -> str:
    """-> a number as the page shows it, a dash where it is not known."""
    return "–" if value is None or not np.isfinite(value) else f"{value:,.{digits}f}"
