"""The kinds of fault in a technician's words, and in the few groups that the page tells apart."""

from collections import Counter
from collections.abc import Iterable

from mocapfix.faults import LABELS, MISSING, PLACES, Kind

# Classes of the page's style sheet, and what they mean.
GROUPS = (
    ("missing", "missing, filled"),
    ("faulty", "measured wrongly, replaced"),
    ("label", "under another label, put right"),
    ("place", "marker at another place from then on"),
    ("missing left", "outlined: left as it was"),
)
WORDS = {
    "mislabelled": ("exchange of labels throughout", "exchanges of labels throughout"),
    "swap": ("exchange of labels", "exchanges of labels"),
    "fragment": ("piece under another label", "pieces under another label"),
    "moved": ("marker knocked to another place", "markers knocked to another place"),
    "drift": ("marker that slid", "markers that slid"),
    "segment lost": ("segment lost", "segments lost"),
    "gap": ("gap", "gaps"),
    "spike": ("spike", "spikes"),
    "pop": ("pop", "pops"),
    "flip": ("flip", "flips"),
    "jitter": ("burst of jitter", "bursts of jitter"),
    "stuck": ("stretch held at one value", "stretches held at one value"),
    "straight": ("straight-line fill", "straight-line fills"),
    "computed": ("fill of another program", "fills of another program"),
    "ghost": ("jump to a ghost", "jumps to a ghost"),
    "noise": ("noisy marker", "noisy markers"),
}


def group(kind: Kind) -> str:
    """-> the group of a kind of fault, a class of the page's style sheet."""
    if kind in (*MISSING, "segment lost"):
        return "missing"
    return "label" if kind in (*LABELS, "fragment") else "place" if kind in PLACES else "faulty"


def counted(kinds: Iterable[str]) -> str:
    """-> "3 gaps, 1 spike and 2 bursts of jitter"; all that is missing is a gap."""
    counts = Counter("gap" if kind in MISSING else kind for kind in kinds)
    return listed([f"{counts[kind]:,} {words[counts[kind] > 1]}" for kind, words in WORDS.items() if counts[kind]])


def listed(words: list[str]) -> str:
    """-> "a, b and c"."""
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))
