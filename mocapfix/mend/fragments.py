"""Fragments, joined to the markers that they are pieces of."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from mocapfix.faults import Fault, Fragment
from mocapfix.take import Take

JOINED = ("continues", "replaces")


def fragments(take: Take, faults: Iterable[Fault]) -> Take:
    """-> the take with every piece that is a marker's joined to it; the trajectory it came from is not seen there any more.

    What continues a marker fills it where it is missing; what replaces one takes its place; what only doubles one stays.
    """
    found = [fault for fault in faults if isinstance(fault, Fragment) and fault.relation in JOINED]
    if not found:
        return take
    count, loose = len(take.labels), take.unlabelled
    markers, sources, computed = take.markers.copy(), take.sources.copy(), take.measured != take.seen
    blind = np.zeros(take.seen.shape, bool) if take.blind is None else take.blind.copy()
    unlabelled = None if loose is None else loose.markers.copy()
    for fault in found:
        frames = np.arange(fault.first, fault.last + 1)
        if fault.donor < count:
            path, point = markers[:, fault.donor], sources[:, fault.donor].copy()
        elif loose is not None and unlabelled is not None:
            path, point = unlabelled[:, fault.donor - count], loose.sources[:, fault.donor - count]
        else:
            continue
        given = frames[~np.isnan(path[frames, 0])]
        if fault.relation == "continues":
            given = given[np.isnan(markers[given, fault.marker, 0])]
        markers[given, fault.marker], sources[given, fault.marker] = path[given], point[given]
        computed[given, fault.marker] = blind[given, fault.marker] = False
        path[given] = np.nan
    if loose is not None and unlabelled is not None:
        loose = loose.with_markers(unlabelled)
    return replace(take, markers=markers, source=sources, computed=computed, blind=blind, unlabelled=loose)
