"""Wording of reports: names of fault kinds, groups of kinds, and terms for the points of a take or an animation."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from mocapfix.errors import join_words
from mocapfix.model.faults import LABEL_KINDS, MISSING_KINDS, SHIFT_KINDS, FaultKind
from mocapfix.model.take import Take

# CSS classes of the HTML report with their legend.
FAULT_GROUPS = (
    ("missing", "missing, filled"),
    ("faulty", "measurement error, replaced"),
    ("label", "wrong label, corrected"),
    ("place", "marker shifted on its segment from here on"),
    ("missing left", "outlined: left unchanged"),
)
# Singular and plural of each fault kind, in the order in which they are listed. All kinds of missing samples count as gaps.
FAULT_KIND_NAMES = {
    "mislabelled": ("label exchange over the whole take", "label exchanges over the whole take"),
    "swap": ("label swap", "label swaps"),
    "fragment": ("fragment under another label", "fragments under another label"),
    "moved": ("marker shift", "marker shifts"),
    "drift": ("sliding marker", "sliding markers"),
    "segment lost": ("segment without enough markers", "segments without enough markers"),
    "gap": ("gap", "gaps"),
    "spike": ("spike", "spikes"),
    "pop": ("pop", "pops"),
    "flip": ("flip", "flips"),
    "jitter": ("burst of jitter", "bursts of jitter"),
    "stuck": ("frozen interval", "frozen intervals"),
    "straight": ("straight-line fill", "straight-line fills"),
    "computed": ("fill by another program", "fills by another program"),
    "ghost": ("ghost marker", "ghost markers"),
    "marked": ("stretch marked in review", "stretches marked in review"),
    "noise": ("noisy marker", "noisy markers"),
    "foot slide": ("sliding foot", "sliding feet"),
    "root shift": ("root that moves for the feet", "roots that move for the feet"),
}


@dataclass(frozen=True)
class PointTerms:
    """Words for the points of a capture and for their samples."""

    point: str
    points: str
    sample: str
    samples: str
    measured: str
    left: str  # what samples without an estimate are left


MARKER_TERMS = PointTerms("marker", "markers", "sample", "samples", "measured", "empty")
JOINT_TERMS = PointTerms("joint", "joints", "value", "values", "read from the file", "unchanged")


def get_point_terms(take: Take) -> PointTerms:
    """Return the words for the points of a take, which are joints if it was made from an animation."""
    return JOINT_TERMS if take.point_kind == "joint" else MARKER_TERMS


def get_fault_group(kind: FaultKind) -> str:
    """Return the group of a fault kind: a CSS class of the HTML report."""
    if kind in (*MISSING_KINDS, "segment lost"):
        return "missing"
    if kind in (*LABEL_KINDS, "fragment"):
        return "label"
    return "place" if kind in SHIFT_KINDS else "faulty"


def format_fault_counts(kinds: Iterable[str] | Mapping[str, int]) -> str:
    """Return a list such as "3 gaps, 1 spike and 2 bursts of jitter" of the kinds of faults, or of their numbers by kind."""
    counts: Counter[str] = Counter()
    for kind, count in Counter(kinds).items():
        counts["gap" if kind in MISSING_KINDS else kind] += count
    return join_words([f"{counts[kind]:,} {names[counts[kind] > 1]}" for kind, names in FAULT_KIND_NAMES.items() if counts[kind]])


def format_frame_range(first: int, last: int) -> str:
    """Return a range of frame numbers, inclusive at both ends, such as "101–150"."""
    return f"{first}–{last}" if last > first else f"{first}"


def format_number(value: int | float | None, digits: int = 1) -> str:
    """Return a number with thousands separators, or a dash if it is unknown (None, NaN or infinite)."""
    return "–" if value is None or value != value or abs(value) == float("inf") else f"{value:,.{digits}f}"
