"""Fragments, joined to the markers that they are pieces of."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from mocapfix.faults import LABEL_KINDS, MIN_LABEL_CONFIDENCE, Fault, Fragment
from mocapfix.take import Take

# MERGED: mocapfix.mend.fragments
JOINED_RELATIONS = ("continues", "replaces")


def join_fragments(take: Take, faults: Iterable[Fault]) -> Take:
    """-> the take with every piece that is a marker's joined to it; the trajectory it came from is not seen there any more.

    What continues a marker fills it where it is missing; what replaces one takes its place; what only doubles one stays.
    """
    found = [fault for fault in faults if isinstance(fault, Fragment) and fault.relation in JOINED_RELATIONS]
    if not found:
        return take
    count, loose = len(take.labels), take.unlabelled
    markers, sources, computed = take.markers.copy(), take.source_points.copy(), take.measured != take.visible
    blind = np.zeros(take.visible.shape, bool) if take.uncaptured is None else take.uncaptured.copy()
    unlabelled = None if loose is None else loose.markers.copy()
    for fault in found:
        frames = np.arange(fault.first, fault.last + 1)
        if fault.donor < count:
            path, point = markers[:, fault.donor], sources[:, fault.donor].copy()
        elif loose is not None and unlabelled is not None:
            path, point = unlabelled[:, fault.donor - count], loose.source_points[:, fault.donor - count]
        else:
            continue
        given = frames[~np.isnan(path[frames, 0])]
        if fault.relation == "continues":
            given = given[np.isnan(markers[given, fault.marker, 0])]
        markers[given, fault.marker], sources[given, fault.marker] = path[given], point[given]
        computed[given, fault.marker] = blind[given, fault.marker] = False
        path[given] = np.nan
    if loose is not None and unlabelled is not None:
        loose = loose.replace_markers(unlabelled)
    return replace(take, markers=markers, relabelled_points=sources, computed=computed, uncaptured=blind, unlabelled=loose)


# MERGED: mocapfix.mend.labels
# Exchanged labels, put right.
def undo_label_exchanges(take: Take, faults: Iterable[Fault]) -> Take:
    """-> the take with every exchange of labels that is sure put right, in the order given; other faults are no matter."""
    for fault in faults:
        if fault.kind in LABEL_KINDS and fault.confidence >= MIN_LABEL_CONFIDENCE:
            take = take.exchange_labels(fault.markers, fault.first, fault.last)
    return take


def relabel_samples(take: Take, faults: Iterable[Fault]) -> Take:
    """-> the take with exchanges put right and fragments joined, one after the other in the order given."""
    for fault in faults:
        take = undo_label_exchanges(join_fragments(take, [fault]), [fault])
    return take
