"""The kinds of fault in a technician's words, and in the few groups that the page tells apart."""

from collections import Counter
from collections.abc import Iterable

from mocapfix.animation import Animation
from mocapfix.faults import LABEL_KINDS, MISSING_KINDS, SHIFT_KINDS, FaultKind
from mocapfix.take import Take

# MERGED: mocapfix.show.kinds
# Classes of the page's style sheet, and what they mean.
FAULT_GROUPS = (
    ("missing", "missing, filled"),
    ("faulty", "measured wrongly, replaced"),
    ("label", "under another label, put right"),
    ("place", "marker at another place from then on"),
    ("missing left", "outlined: left as it was"),
)
FAULT_KIND_NAMES = {
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


def get_fault_group(kind: FaultKind) -> str:
    """-> the group of a kind of fault, a class of the page's style sheet."""
    if kind in (*MISSING_KINDS, "segment lost"):
        return "missing"
    return "label" if kind in (*LABEL_KINDS, "fragment") else "place" if kind in SHIFT_KINDS else "faulty"


def format_fault_counts(kinds: Iterable[str]) -> str:
    """-> "3 gaps, 1 spike and 2 bursts of jitter"; all that is missing is a gap."""
    counts = Counter("gap" if kind in MISSING_KINDS else kind for kind in kinds)
    return join_words([f"{counts[kind]:,} {words[counts[kind] > 1]}" for kind, words in FAULT_KIND_NAMES.items() if counts[kind]])


def join_words(words: list[str]) -> str:
    """-> "a, b and c"."""
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


# MERGED: mocapfix.words
# Sentences that are said of markers, said of what a take has: an animation has joints.
def use_joint_terms(text: str, take: Take) -> str:
    """-> a sentence about markers as one about the take's points. It must hold no names out of files, which stay as they are."""
    if not isinstance(take.layout, Animation):
        return text
    return text.replace("marker", "joint").replace("Marker", "Joint").replace("measured", "read").replace("sample", "value")
