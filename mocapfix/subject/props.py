"""Props: rigid groups of markers that are not on the body, such as a racket, a box or a wheelchair.

A take shows them by itself: their markers keep their distances while they move against all others. A marker set may name them.
Without a body the segments that move like one, such as the head, are rigid groups too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import takewhile

import numpy as np
from jaxtyping import Bool

from mocapfix.model.marker_set import fold_label
from mocapfix.model.take import Take
from mocapfix.stats.marker_distances import (
    MAX_RIGID_SPREAD_M,
    MIN_GROUP_MARKERS,
    MIN_GROUP_MOTION_M,
    RigidGroup,
    find_prop_groups,
    measure_distance_spread,
    measure_group,
)

MIN_PREFIX_LETTERS = 3  # letters that the labels of a group must have in common at their beginning to name it
# Characters at the end of this common beginning that are no part of the name.
LABEL_ENDING_CHARACTERS = "0123456789 _.-:#"
MAX_KNOWN_PROP_SPREAD_M = 2 * MAX_RIGID_SPREAD_M  # of a prop that a marker set names; with more it is not rigid here


def find_props(
    take: Take, is_on_body: Bool[np.ndarray, " M"], known_props: Mapping[str, Sequence[str]]
) -> tuple[RigidGroup, ...]:
    """Return the rigid groups of a take's markers outside the body, the largest first, with names.

    Args:
        is_on_body: The markers of the solved body; none of them where there is no body.
        known_props: The labels of the markers on each prop, as a marker set names them.
    """
    is_free = ~is_on_body & take.visible.any(0)
    if is_free.sum() < MIN_GROUP_MARKERS:
        return ()
    spread = measure_distance_spread(take.markers)
    known = _find_known_props(take, is_free, spread, known_props)

    def is_at_rest(group: RigidGroup) -> bool:  # without other markers, against which it would move, everything is rigid
        return not (np.nanstd(take.markers[:, list(group.markers)], axis=0) > MIN_GROUP_MOTION_M).any()

    is_taken = is_on_body.copy()
    is_taken[[m for group in known for m in group.markers]] = True
    found = [group for group in find_prop_groups(spread, is_taken) if not (np.isnan(group.motion_m) and is_at_rest(group))]
    names = _name_groups([[take.labels[m] for m in group.markers] for group in found], [group.name for group in known])
    return (*known, *(replace(group, name=name) for group, name in zip(found, names, strict=True)))


def _find_known_props(
    take: Take, is_free: np.ndarray, spread: np.ndarray, known_props: Mapping[str, Sequence[str]]
) -> tuple[RigidGroup, ...]:
    """Return those props of a marker set that are rigid in this take; they need not move against the other markers."""
    column_of_label = {fold_label(label): m for m, label in enumerate(take.bare_labels) if is_free[m]}
    groups: list[RigidGroup] = []
    for name, labels in known_props.items():
        columns = sorted(column_of_label[folded] for folded in map(fold_label, labels) if folded in column_of_label)
        if len(columns) >= MIN_GROUP_MARKERS:
            group = measure_group(columns, spread, name)
            groups += [group] if group.spread_m <= MAX_KNOWN_PROP_SPREAD_M else []
    return tuple(groups)


def _name_groups(labels_of_group: Sequence[Sequence[str]], taken_names: Sequence[str]) -> list[str]:
    """Return names of groups: the common beginning of the labels, else a number."""
    names: list[str] = []
    for labels in labels_of_group:
        letters = zip(*(label.rpartition(":")[2] for label in labels), strict=False)
        name = "".join(each[0] for each in takewhile(lambda each: len(set(each)) == 1, letters)).rstrip(LABEL_ENDING_CHARACTERS)
        is_name = sum(letter.isalpha() for letter in name) >= MIN_PREFIX_LETTERS and name not in (*taken_names, *names)
        names.append(name if is_name else f"group {len(names) + 1}")
    return names
