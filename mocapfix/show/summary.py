"""What a technician reads first: what was wrong with the take, what was done about it, and what was left."""

import numpy as np

from mocapfix.faults import MISSING, Faults
from mocapfix.take import Take

PLURALS = {"gap": "gaps", "spike": "spikes", "jitter": "bursts of jitter"}
SINGULARS = {"gap": "gap", "spike": "spike", "jitter": "burst of jitter"}


def wrong(take: Take, faults: Faults) -> str:
    """-> a few sentences on the faults: how many, of which kinds, and the longest gap."""
    count = len(take.labels)
    if not faults.items:
        return "Nothing: every marker is there in every frame, and none strays."
    kinds = {"gap": sum(fault.kind in MISSING for fault in faults.items)}
    kinds |= {kind: faults.counts().get(kind, 0) for kind in ("spike", "jitter")}
    found = [f"{n:,} {(SINGULARS if n == 1 else PLURALS)[kind]}" for kind, n in kinds.items() if n]
    marked = len({fault.marker for fault in faults.items})
    text = f"{marked} of {count} markers {'has' if marked == 1 else 'have'} faults: {_and(found)}."
    missing = int((~take.seen).sum())
    if missing:
        text += f" {missing:,} of {take.seen.size:,} samples ({missing / take.seen.size:.1%}) were missing."
        text += _longest_gap(take, faults)
    return text


def _longest_gap(take: Take, faults: Faults) -> str:
    gaps = [fault for fault in faults.items if fault.kind in MISSING]
    if not gaps:
        return ""
    longest = max(gaps, key=lambda fault: fault.last - fault.first)
    label, seconds = take.labels[longest.marker], (longest.last - longest.first + 1) / take.rate
    if longest.kind == "absent":
        return f" {label} is never seen."
    first, last = take.frame_number(longest.first), take.frame_number(longest.last)
    return f" The longest gap is {label}’s, frames {first} to {last} ({seconds:.2f} s)."


def done(record: dict) -> str:
    """-> sentences on what was filled and replaced, and from what."""
    fill, solve, subject = record["fill"], record["solve"], record["subject"]
    if not fill["filled"] and not fill["mended"]:
        return "Nothing was changed: the samples are as they were measured."
    parts = []
    if fill["filled"]:
        parts.append(f"{fill['filled']:,} of the missing samples {'was' if fill['filled'] == 1 else 'were'} filled")
    if fill["mended"]:
        parts.append(f"{fill['mended']:,} faulty {'one was' if fill['mended'] == 1 else 'ones were'} replaced")
    text = f"{_and(parts)}; every other sample is as it was measured."
    if subject is None or solve is None:
        return f"{text} No body was used: the samples come from the other markers and from the markers’ own paths."
    residual = solve["marker_residual_mm"]
    return (
        f"{text} A body with this person’s bones places them; the seen markers lie "
        f"{number(residual['mean'])} mm from it on average, 95% of them within {number(residual['p95'])} mm."
    )


def left(record: dict) -> str:
    """-> a sentence on the samples that are still missing."""
    fill = record["fill"]
    if not fill["left_empty"]:
        return "Nothing: no sample is missing any more."
    markers = list(dict.fromkeys(item["marker"] for item in fill["left"]))
    text = f"{fill['left_empty']:,} {'sample is' if fill['left_empty'] == 1 else 'samples are'} still missing"
    return f"{text}, on {_and(markers)}: see the reasons below." if markers else f"{text}."


def number(value: float | None, digits: int = 1) -> str:
    """-> a number as the page shows it, a dash where it is not known."""
    return "–" if value is None or not np.isfinite(value) else f"{value:,.{digits}f}"


def _and(words: list[str]) -> str:
    """-> "a, b and c"."""
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))
