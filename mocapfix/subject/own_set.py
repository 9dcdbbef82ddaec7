"""A marker set of the take's own, where no known set fits: `clean` uses it, `mocapfix marker-set learn` writes it.

It is used only if a plausible body explains the take. Otherwise the take is cleaned without one: no skeleton is better than a
wrong one.

The trial of a learned marker set: what it changes in the very take from which it was learned.

Labels and samples that are consistent without a skeleton should stay as they are with it. A wrong skeleton contradicts them.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Int

from mocapfix.detect.loop import detect_on_trajectories
from mocapfix.errors import TakeError, format_name_list
from mocapfix.io.capture import read_take
from mocapfix.labels import multi_subject
from mocapfix.model.skeleton import BODY_SECTIONS, load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.options import DEFAULT_READ_OPTIONS, CleanOptions, ReadOptions
from mocapfix.report.stage_timer import ProgressCallback, StageTimer
from mocapfix.state import CleaningState, DetectionState
from mocapfix.subject.learning import LearnedMarkerSet, learn_from_markers, select_subject_markers
from mocapfix.subject.library import UNASSIGNED_SUBJECT, SubjectChoice, find_subject_prefixes
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
        (take,) = multi_subject.split_subjects(take, None, subject_prefix)
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


FitStage = Callable[[CleaningState, CleanOptions, StageTimer], CleaningState]

MAX_CONTRADICTED_SAMPLE_SHARE = 2e-4
"""Share of the samples of the set's markers that a body with a correct set may reject or relabel."""
MIN_CONTRADICTED_SAMPLES = 6
"""Number of samples that it may reject or relabel in a take of any length."""
MAX_LEFT_OUT_SHARE = 0.1
"""Share of the set's markers that are left out after the trial because most contradictions concern them."""


@dataclass(frozen=True)
class SetTrial:
    """What a body contradicts in a take that is consistent without it.

    contradicted_counts  (K,) samples of each marker that are rejected or relabelled
    sample_count         visible samples of the markers
    """

    contradicted_counts: Int[np.ndarray, " K"]
    sample_count: int

    @property
    def is_passed(self) -> bool:
        """Whether the contradicted samples are few."""
        return int(self.contradicted_counts.sum()) <= self._max_count

    @property
    def _max_count(self) -> float:
        return max(MIN_CONTRADICTED_SAMPLES, MAX_CONTRADICTED_SAMPLE_SHARE * self.sample_count)

    def select_kept_markers(self) -> Int[np.ndarray, " kept"]:
        """Return the markers that remain without those that cause most contradictions; none if these are too many."""
        order = np.argsort(-self.contradicted_counts, kind="stable")
        remaining = self.contradicted_counts.sum() - np.cumsum(self.contradicted_counts[order])
        left_out_count = int(np.argmax(remaining <= self._max_count)) + 1
        if left_out_count > MAX_LEFT_OUT_SHARE * len(order):
            return order[:0]
        return np.sort(order[left_out_count:])


def try_learned_set(
    first: CleaningState, fitted: CleaningState, options: CleanOptions, timer: StageTimer, detect_and_fit: FitStage
) -> CleaningState:
    """Return the fitted state if its learned set contradicts hardly any sample, else one with a part of the set or without.

    first           the state before any detection
    detect_and_fit  fits a body with a part of the set
    """
    assert first.marker_set is not None
    with timer("detect"):
        without_set = detect_on_trajectories(withdraw_marker_set(first), options)
    columns = first.marker_set.find_columns(first.original_take.labels)
    trial = compare_detections(without_set.detection, fitted.detection, columns)
    if trial.is_passed:
        return fitted
    kept, labels = trial.select_kept_markers(), first.marker_set.labels
    narrowed = first.marker_set.select_markers([labels[k] for k in kept])
    if not len(kept) or narrowed.describe_missing_body(narrowed.labels):
        return without_set
    return detect_and_fit(replace(first, marker_set=narrowed), options, timer)


def compare_detections(without_set: DetectionState, with_set: DetectionState, columns: Int[np.ndarray, " K"]) -> SetTrial:
    """Return what the detection with a learned set contradicts in the take as detected without it.

    columns  the take's columns of the K markers of the set, -1 for one that it does not have
    """
    before, after = without_set.take.markers, with_set.take.markers
    is_relabelled = ((before != after) & ~(np.isnan(before) & np.isnan(after))).any(-1) & without_set.take.visible
    is_rejected = without_set.inlier_mask & ~with_set.inlier_mask
    is_contradicted = (is_relabelled | is_rejected)[:, columns] & (columns >= 0)
    return SetTrial(is_contradicted.sum(0), int(without_set.take.visible[:, columns[columns >= 0]].sum()))


def withdraw_marker_set(state: CleaningState) -> CleaningState:
    """Return the state without its learned marker set, and with the reason."""
    notes = (*state.notes[:1], "A marker set learned from this take would reject or relabel measured samples, so it is not used.")
    notes = (*notes, "The take was cleaned without a skeleton: there is no BVH.")
    return replace(state, marker_set=None, has_learned_set=False, notes=notes)
