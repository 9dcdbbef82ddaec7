"""What labelling did, for reports: the confidence of each marker's labels, and the trajectories that stay without a label."""

from typing import TypedDict

import numpy as np
from jaxtyping import Bool

from mocapfix.errors import format_name_list
from mocapfix.model.take import Take
from mocapfix.stats.sequences import find_runs
from mocapfix.subject.library import choose_marker_set

CERTAIN_LABEL_CONFIDENCE = 0.95  # confidence from which a label is certain


class LabelledMarkerEntry(TypedDict):
    """A marker that was labelled: its samples, their mean confidence, and the frames in which its label is uncertain."""

    samples: int
    confidence: float
    uncertain: list[tuple[int, int, float]]


class UnlabelledEntry(TypedDict):
    """A trajectory without a label: its name in the file, its frames and its samples."""

    label: str
    first: int
    last: int
    samples: int


class LabellingSection(TypedDict):
    """The labels that mocapfix gave to the trajectories of a take without labels."""

    markers: dict[str, LabelledMarkerEntry]
    unlabelled: list[UnlabelledEntry]


def build_labelling_section(take: Take) -> LabellingSection | None:
    """Return the section on the labels of a take, None if the file has its labels itself."""
    confidence = take.label_confidence
    if confidence is None:
        return None
    markers: dict[str, LabelledMarkerEntry] = {}
    for m in np.flatnonzero(_find_labelled_markers(take)):
        visible = take.visible[:, m]
        uncertain = [
            (take.get_frame_number(first), take.get_frame_number(last), round(float(confidence[first : last + 1, m].min()), 3))
            for first, last in find_runs(visible & (confidence[:, m] < CERTAIN_LABEL_CONFIDENCE))
        ]
        mean = round(float(confidence[visible, m].mean()), 4)
        markers[take.labels[m]] = {"samples": int(visible.sum()), "confidence": mean, "uncertain": uncertain}
    return {"markers": markers, "unlabelled": _list_unlabelled(take)}


def describe_labelling(take: Take, expected_labels: tuple[str, ...] = ()) -> list[str]:
    """Return sentences on the labels that mocapfix gave, and on `expected_labels` that no trajectory got."""
    section = build_labelling_section(take)
    if section is None:
        return []
    samples = sum(entry["samples"] for entry in section["markers"].values())
    notes = [f"Labelled by mocapfix: {samples} samples of {len(section['markers'])} markers."]
    found = {label.rpartition(":")[2] for label in section["markers"]}
    if absent := [label for label in expected_labels if label not in found]:
        notes.append(f"Not found: {format_name_list(absent)}.")
    if uncertain := [label for label, entry in section["markers"].items() if entry["uncertain"]]:
        notes.append(f"Uncertain in a part of the frames, which the report lists: {format_name_list(uncertain)}.")
    if section["unlabelled"]:
        listed = [f"{each['label']} (frames {each['first']}-{each['last']})" for each in section["unlabelled"]]
        notes.append(f"Left without a label: {format_name_list(listed)}.")
    return notes


def _list_unlabelled(take: Take) -> list[UnlabelledEntry]:
    """Return the trajectories without a label, and those that keep a label without a meaning: in no set that fits the take."""
    entries, is_kept = list[UnlabelledEntry](), take.visible.any(0) & ~_find_labelled_markers(take)
    has_meaning = choose_marker_set([take.labels[m] for m in np.flatnonzero(is_kept)]).marker_set is not None
    parts = [] if has_meaning else [(take, is_kept)]
    parts += [(take.unlabelled, take.unlabelled.visible.any(0))] if take.unlabelled else []
    for part, is_listed in parts:
        for u in np.flatnonzero(is_listed):
            frames = np.flatnonzero(part.visible[:, u])
            first, last = take.get_frame_number(frames[0]), take.get_frame_number(frames[-1])
            entries.append({"label": part.labels[u], "first": first, "last": last, "samples": len(frames)})
    return sorted(entries, key=lambda entry: -entry["samples"])


def _find_labelled_markers(take: Take) -> Bool[np.ndarray, " M"]:
    """Return which markers of a take have labels that mocapfix gave."""
    assert take.label_confidence is not None
    return np.any(take.visible & ~np.isnan(take.label_confidence), axis=0)
