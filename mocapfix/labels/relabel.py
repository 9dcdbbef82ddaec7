"""Relabelling: fragments are joined to their markers, and exchanges of labels are undone."""

from collections.abc import Iterable
from dataclasses import replace
from itertools import groupby

import numpy as np

from mocapfix.model.faults import JOINED_RELATIONS, LABEL_KINDS, MIN_LABEL_CONFIDENCE, Fault, Fragment
from mocapfix.model.take import Take


def join_fragments(take: Take, faults: Iterable[Fault]) -> Take:
    """Join the fragments that belong to a marker to it, and remove their samples from the trajectories they came from.

    A fragment that continues a marker fills it where it is missing. One that replaces a marker takes its place. One that only
    doubles a marker stays where it is.
    """
    fragments = [fault for fault in faults if isinstance(fault, Fragment) and fault.relation in JOINED_RELATIONS]
    if not fragments:
        return take
    count, loose = len(take.labels), take.unlabelled
    markers, sources, computed = take.markers.copy(), take.source_points.copy(), take.measured != take.visible
    uncaptured = np.zeros(take.visible.shape, bool) if take.uncaptured is None else take.uncaptured.copy()
    unlabelled = None if loose is None else loose.markers.copy()
    for fragment in fragments:
        frames = np.arange(fragment.first, fragment.last + 1)
        if fragment.donor < count:
            path, point = markers[:, fragment.donor], sources[:, fragment.donor].copy()
        elif loose is not None and unlabelled is not None:
            path, point = unlabelled[:, fragment.donor - count], loose.source_points[:, fragment.donor - count]
        else:
            continue
        joined = frames[~np.isnan(path[frames, 0])]
        if fragment.relation == "continues":
            joined = joined[np.isnan(markers[joined, fragment.marker, 0])]
        markers[joined, fragment.marker], sources[joined, fragment.marker] = path[joined], point[joined]
        computed[joined, fragment.marker] = uncaptured[joined, fragment.marker] = False
        path[joined] = np.nan
    if loose is not None and unlabelled is not None:
        loose = loose.replace_markers(unlabelled)
    return replace(take, markers=markers, relabelled_points=sources, computed=computed, uncaptured=uncaptured, unlabelled=loose)


def undo_label_exchanges(take: Take, faults: Iterable[Fault]) -> Take:
    """Undo the exchanges of labels with a sufficient confidence, in the given order. Other faults are ignored."""
    exchanges = [
        (fault.markers, fault.first, fault.last)
        for fault in faults
        if fault.kind in LABEL_KINDS and fault.confidence >= MIN_LABEL_CONFIDENCE
    ]
    return take.exchange_labels_in_turn(exchanges) if exchanges else take


def relabel_samples(take: Take, faults: Iterable[Fault]) -> Take:
    """Join fragments and undo exchanges of labels, one after the other in the given order."""
    for are_fragments, group in groupby(faults, key=lambda fault: isinstance(fault, Fragment)):
        repair = join_fragments if are_fragments else undo_label_exchanges
        take = repair(take, group)
    return take
