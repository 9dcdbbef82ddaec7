"""Segments lost: the stretches in which nothing of a segment, a limb or the whole body is seen.

Their markers' gaps are all there besides; this says what the gaps do not, that no neighbour on the same bone can help.
"""

import numpy as np

from mocapfix.faults import Fault
from mocapfix.marker_set import LIMBS, MarkerSet
from mocapfix.skeleton import cmu31
from mocapfix.take import Take, runs

LEAST = 0.1  # seconds: what is lost for less, its markers' own paths carry over
FEWEST = 2  # markers of a segment; of a single one its gap says it all


def found(take: Take, marker_set: MarkerSet) -> list[Fault]:
    """-> where all markers of a part of the body are missing that the take has at all, by first frame.

    What is lost with a greater part is not named besides.
    """
    faults: list[Fault] = []
    for name, markers in parts(take, marker_set):
        for first, last in runs(~np.any(take.seen[:, markers], axis=1)):
            inside = any(whole.first <= first and last <= whole.last and set(markers) <= set(whole.markers) for whole in faults)
            if last - first + 1 >= LEAST * take.rate and not inside:
                faults.append(_fault(take, name, markers, first, last))
    return sorted(faults, key=lambda fault: (fault.first, -len(fault.others)))


def parts(take: Take, marker_set: MarkerSet) -> list[tuple[str, list[int]]]:
    """-> the body, its limbs and its segments, greater ones first: what each is called, and its markers in the take."""
    columns, names = marker_set.columns(take.labels), np.array(cmu31().skeleton.names)[marker_set.joints]
    bones = {"the body": set(names)} | {f"the {limb}": set(joints) for limb, joints in LIMBS.items()}
    bones |= {name: {name} for name in dict.fromkeys(names.tolist())}
    found = [(part, [int(c) for c in columns[np.isin(names, list(on))] if c >= 0]) for part, on in bones.items()]
    return [(part, markers) for part, markers in found if len(markers) >= FEWEST]


def _fault(take: Take, name: str, markers: list[int], first: int, last: int) -> Fault:
    seconds, whole = (last - first + 1) / take.rate, last - first + 1 == take.frames
    time = "in the whole take" if whole else f"for {seconds:.2f} s"
    labels = ", ".join(take.bare_labels[m] for m in markers)
    known = "only its neighbours and people's usual poses tell where it is"
    reason = f"Nothing of {name} is seen {time} ({labels}): {known}."
    if name == "the body":
        reason = f"Nothing of the body is seen {time}: where it is can only be guessed from before and after."
    return Fault("segment lost", markers[0], first, last, _moved(take, markers, first, last), reason, 1.0, tuple(markers[1:]))


def _moved(take: Take, markers: list[int], first: int, last: int) -> float:
    """-> metres: how far the part's markers that are seen on both sides move meanwhile, the median; NaN where none is."""
    if first == 0 or last == take.frames - 1:
        return float("nan")
    way = np.linalg.norm(take.markers[last + 1, markers] - take.markers[first - 1, markers], axis=-1)
    return float(np.nanmedian(way)) if np.isfinite(way).any() else float("nan")
