"""A marker set of the take's own, where no known set fits: `clean` uses it, `mocapfix marker-set learn` writes it.

It is used only if a plausible body explains the take. Otherwise the take is cleaned without one: no skeleton is better than a
wrong one.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from mocapfix.errors import TakeError, format_name_list
from mocapfix.io.capture import read_take
from mocapfix.model.skeleton import BODY_SECTIONS, load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.options import DEFAULT_READ_OPTIONS, ReadOptions
from mocapfix.report.stage_timer import ProgressCallback
from mocapfix.subject.learning import LearnedMarkerSet, learn_from_markers, select_subject_markers
from mocapfix.subject.library import UNASSIGNED_SUBJECT, SubjectChoice, find_subject_prefixes, select_subject
from mocapfix.subject.props import find_props

OWN_SET_NAME = "own"
MIN_OWN_SET_MARKERS = 5
"""Visible markers of the smallest part of a body, a single limb."""
MAX_OWN_SET_MARKERS = 400
"""Visible markers of one body; the densest published set has 350 (Park & Hodgins 2006). The joints of 1,300 took 75 s to find."""


def find_own_marker_set(take: Take, choice: SubjectChoice) -> SubjectChoice:
    """Return the choice for a take without a known set: with a set learned from the take, or without one and with the reason."""
    known_reason = choice.notes[:1]
    try:
        count = int(take.visible.any(0).sum())
        if take.subject_name == UNASSIGNED_SUBJECT or count < MIN_OWN_SET_MARKERS:
            return choice
        if count > MAX_OWN_SET_MARKERS:
            raise TakeError(f"{take.name}: {count:,} markers with unknown labels are more than those of one body")
        selected = select_subject_markers(take.masked(take.measured))
        learned = add_props(learn_from_markers(selected, OWN_SET_NAME), take)
    except TakeError as error:
        reason = str(error).removeprefix(f"{take.name}: ").partition("; name")[0].removesuffix(".")
        reason = f"{reason[:1].upper()}{reason[1:]}."
        return replace(choice, notes=(*known_reason, reason, *choice.notes[1:]))
    notes = (*known_reason, *describe_learned_set(learned))
    return replace(choice, marker_set=learned.marker_set, notes=notes, is_learned=True)


def learn_marker_set(
    path: str | Path,
    name: str,
    *,
    like: str | Path | None = None,
    subject_prefix: str | None = None,
    options: ReadOptions = DEFAULT_READ_OPTIONS,
    progress: ProgressCallback | None = None,
) -> LearnedMarkerSet:
    """Return the marker set of the take at `path` under a name.

    like            a marker set, as for `load_marker_set`, to which some of the labels belong; None for the set that fits, if any
    subject_prefix  the subject ("Jim" of Jim:LFHD); None for the one with the most markers
    options         what is known about the file, as for `read_take`
    progress        called with the name of each stage as it begins

    Raises ReadError, SceneError or TakeError.
    """
    report_stage = progress or (lambda stage: None)
    report_stage("read")
    take = read_take(path, options)
    take = replace(take, subject_prefixes=find_subject_prefixes(take.labels))
    if subject_prefix is not None:
        take = select_subject(take, subject_prefix)
    selected = select_subject_markers(take.masked(take.measured))
    report_stage("learn")
    return add_props(learn_from_markers(selected, name, like), take)


def add_props(learned: LearnedMarkerSet, take: Take) -> LearnedMarkerSet:
    """Return a learned set with the rigid groups of the take's other markers as props."""
    is_on_body = np.isin(take.bare_labels, learned.marker_set.labels)
    groups = find_props(take.masked(take.measured), is_on_body, {})
    props = {group.name: tuple(take.bare_labels[m] for m in group.markers) for group in groups}
    return replace(learned, marker_set=replace(learned.marker_set, props=props))


def describe_learned_set(learned: LearnedMarkerSet) -> tuple[str, ...]:
    """Return the notes on what a learned set assumes."""
    names, labels = load_cmu31_body().skeleton.names, learned.marker_set.labels
    marked = {names[joint] for joint in learned.marker_set.joints}
    sections = [section for section, joints in BODY_SECTIONS.items() if marked.intersection(joints)]
    notes = [
        f"A marker set was learned from this take: {learned.guess_description}",
        f"The {len(labels)} markers of the learned set are on {format_name_list(sections)}, "
        f"{learned.mean_residual_m * 1e3:.1f} mm from the body on average. `mocapfix marker-set learn` writes the set.",
    ]
    ambiguous = [f"{label} (or on {joint})" for label, joint in learned.ambiguous_markers.items() if label in labels]
    if ambiguous:
        notes.append(f"The segment of these markers is ambiguous: {format_name_list(ambiguous)}.")
    return tuple(notes)


def withdraw_marker_set(choice: SubjectChoice) -> SubjectChoice:
    """Return the choice without its learned marker set, and with the reason."""
    reason = "A marker set learned from this take would reject or relabel measured samples, so it is not used."
    no_body = "The take was cleaned without a skeleton: there is no BVH."
    return replace(choice, marker_set=None, is_learned=False, notes=(*choice.notes[:1], reason, no_body))
