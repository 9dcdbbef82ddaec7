"""Learn a studio's marker set from a take: the segment of each marker and its offset.

Learning starts from a guess at some of the markers: those of a known set that are among the labels, else those whose labels have
known words, else those on legs that rigid groups form, or those that the cloud of markers locates on a body. How the markers
move then decides about all of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mocapfix.calibrate.grouped_markers import guess_from_rigid_groups
from mocapfix.calibrate.marker_set_checks import (
    describe_contradicted_guess,
    describe_contradicted_words,
    describe_implausible_body,
    describe_incomplete_location,
    find_doubtful_markers,
    is_contradicted_by_words,
    measure_learned_body,
)
from mocapfix.calibrate.marker_set_fit import MarkerSetFit, fit_marker_set
from mocapfix.calibrate.unlabelled_markers import guess_from_marker_cloud
from mocapfix.errors import TakeError, format_name_list
from mocapfix.marker_set import MarkerSet
from mocapfix.marker_sets.label_words import guess_marker_set_from_words, names_object
from mocapfix.marker_sets.library import choose_marker_set, describe_marker_set_match, load_marker_set
from mocapfix.pose_prior.mean_pose import load_joint_limits, load_mean_pose_prior
from mocapfix.skeleton import load_cmu31_body
from mocapfix.take import Take

KNOWN_LABEL_LOG_ODDS = 10.0
"""log odds that the segment of a marker is correct if its label is one of a known set"""
LABEL_WORD_LOG_ODDS = 4.0
"""the same if the label has a known word"""
GROUP_LOG_ODDS = 6.0
"""the same if the marker is in a rigid group whose joints show its segment"""
POSITION_LOG_ODDS = 3.0
"""the same if the segment is guessed from the cloud of markers"""
MIN_GROUPED_SHARE = 0.6
"""share of the visible markers on legs that rigid groups form, from which no whole body is searched for"""
MAX_LOCATED_SHARE = 0.2
"""share of the labels whose words locate a marker, above which a body is not located by positions"""
MIN_SEGMENT_PROBABILITY = 0.9
"""probability of a segment below which the marker is reported as ambiguous"""
LEARNED_MARKER_SPREAD_M = 0.02
"""standard deviation per axis of other people's markers about an offset that was measured on one person"""
MEAN_POSE_PRIOR_NAME = "mean-pose"


@dataclass(frozen=True)
class LearnedMarkerSet:
    """A marker set that was learned from a take.

    marker_set         the set
    guess_description  a sentence on the guess from which it was learned
    excluded_markers   why a marker is not in the set, by label
    ambiguous_markers  the name of another joint to which a marker may be attached, by label
    mean_residual_m    mean distance of the markers from the body
    """

    marker_set: MarkerSet
    guess_description: str
    excluded_markers: dict[str, str]
    ambiguous_markers: dict[str, str]
    mean_residual_m: float

    @property
    def file_comment(self) -> str:
        """The comment for the file of the set."""
        lines = [
            f"{self.marker_set.title}. Offsets are in metres on the average body, in the axes of the joint;",
            "spread is the standard deviation per axis, over people, of the marker about its offset.",
            self.guess_description,
            f"Mean distance of the markers from the body: {self.mean_residual_m * 1e3:.1f} mm.",
        ]
        lines += [f"{label} may be attached to {joint_name} instead." for label, joint_name in self.ambiguous_markers.items()]
        lines += [f"Not included: {label} {reason}." for label, reason in self.excluded_markers.items()]
        return "\n".join(lines)


@dataclass(frozen=True)
class SubjectMarkers:
    """The markers of one subject in a take.

    take              its markers and those without a subject prefix
    labels            their labels without prefix
    excluded_markers  why a marker was left out, by label
    """

    take: Take
    labels: tuple[str, ...]
    excluded_markers: dict[str, str]


@dataclass(frozen=True)
class InitialGuess:
    """A guess at some of the markers of a take, enough to determine a body.

    marker_set      the guessed markers by the labels of the take
    label_log_odds  log odds that the segment of a marker is correct
    description     a sentence on where the guess comes from
    """

    marker_set: MarkerSet
    label_log_odds: float
    description: str


def learn_from_markers(selected: SubjectMarkers, name: str, like: str | Path | None = None) -> LearnedMarkerSet:
    """Return the set that is learned from a subject's markers, from the most certain guess or from their rigid groups.

    Raises TakeError as `guess_marker_set` and `fit_guessed_set`.
    """
    try:
        return fit_guessed_set(selected, guess_marker_set(selected.take, selected.labels, like), name)
    except TakeError:
        guess = None if like else guess_from_groups(selected.take, selected.labels)
        if guess is None:
            raise
    return fit_guessed_set(selected, guess, name)


def guess_from_groups(take: Take, labels: Sequence[str]) -> InitialGuess | None:
    """Return the guess from rigid groups and their joints; None if they form no leg, or words in the labels contradict them."""
    guess = guess_from_rigid_groups(take, tuple(labels), load_cmu31_body().skeleton)
    if guess is None or is_contradicted_by_words(guess, guess_marker_set_from_words(guess.labels)):
        return None
    count = len(guess.labels)
    description = f"{count} markers were located by the joints between their rigid groups, others by motion. Check the result."
    return InitialGuess(guess, GROUP_LOG_ODDS, description)


def fit_guessed_set(selected: SubjectMarkers, guess: InitialGuess, name: str) -> LearnedMarkerSet:
    """Return the set that is learned from an initial guess. Raises TakeError if it is not that of a plausible body."""
    take, labels = selected.take, selected.labels
    body = load_cmu31_body()
    prior = load_mean_pose_prior(MEAN_POSE_PRIOR_NAME, body.skeleton)
    is_from_positions = guess.label_log_odds == POSITION_LOG_ODDS
    if is_from_positions and (problem := describe_contradicted_guess(take, labels, guess.marker_set)):
        raise TakeError(f"{take.name}: no marker set can be learned: the body located by the positions of the markers {problem}.")
    fit = fit_marker_set(take, labels, guess.marker_set, guess.label_log_odds, body, prior)
    keep_guess = guess.label_log_odds == KNOWN_LABEL_LOG_ODDS
    marker_set = build_learned_set(fit, guess.marker_set, name, f"Learned from {take.name}", keep_guess=keep_guess)
    reasons = dict(zip(labels, fit.attachment.rejection_reasons, strict=True))
    if not keep_guess:
        reasons |= find_doubtful_markers(take, labels, fit, guess.marker_set.labels)
        marker_set = marker_set.select_markers([label for label in marker_set.labels if not reasons[label]])
    if problem := marker_set.describe_missing_body(marker_set.labels):
        raise TakeError(f"{take.name}: no marker set can be learned: {problem.partition(';')[0]}.")
    marker_set = marker_set.select_shown_part(marker_set.labels)
    if not keep_guess:
        learned_body = measure_learned_body(take, labels, marker_set, fit, body.skeleton.total_length_m)
        limits = load_joint_limits(body.skeleton)
        problem = (
            describe_incomplete_location(marker_set.joints, int(take.visible.any(0).sum()))
            if is_from_positions
            else describe_contradicted_words(labels, fit, guess.marker_set)
        )
        if problem := problem or describe_implausible_body(learned_body, limits, from_positions=is_from_positions):
            raise TakeError(f"{take.name}: no marker set can be learned: the body {problem}.")
    excluded = {label: reason for label, reason in reasons.items() if reason}
    return LearnedMarkerSet(
        marker_set,
        guess.description,
        {**excluded, **selected.excluded_markers},
        find_ambiguous_markers(fit, labels),
        fit.mean_residual_m,
    )


def select_subject_markers(take: Take) -> SubjectMarkers:
    """Return the markers of the subject with the most of them and those without a prefix; none whose label names an object."""
    subject_names = take.marker_subjects
    chosen_subject = max(dict.fromkeys(subject_names), key=lambda name: (bool(name), subject_names.count(name)))
    column_of_label: dict[str, int] = {}
    excluded: dict[str, str] = {}
    for column, (subject_name, label) in enumerate(zip(subject_names, take.bare_labels, strict=True)):
        if subject_name not in (chosen_subject, ""):
            excluded[take.labels[column]] = f"belongs to {subject_name}, not to {chosen_subject}"
        elif names_object(take.labels[column]):
            excluded[take.labels[column]] = "names an object"
        elif label in column_of_label:
            excluded[take.labels[column]] = "has the same label as another marker"
        else:
            column_of_label[label] = column
    columns = np.array(list(column_of_label.values()), int)
    return SubjectMarkers(take.select(columns, take.visible), tuple(column_of_label), excluded)


def guess_marker_set(take: Take, labels: Sequence[str], like: str | Path | None = None) -> InitialGuess:
    """Return the most certain guess at the markers of a take from its labels or the cloud of its markers.

    labels  of the take's markers, without subject prefixes
    like    as for `learn_marker_set`

    Raises TakeError if the set `like` has too few of the take's markers, or if no guess shows a body.
    """
    visible_labels = [label if take.visible[:, m].any() else "" for m, label in enumerate(labels)]
    known = load_marker_set(like) if like else choose_marker_set(visible_labels).marker_set
    from_words = guess_marker_set_from_words([label for label in visible_labels if label])
    is_part = known is not None and bool(known.describe_incomplete_body(known.match_labels(visible_labels)))
    if is_part and not like and not from_words.describe_incomplete_body(from_words.labels):
        known = None  # the words of the labels show more: a whole body
    if known:
        found = known.match_labels(visible_labels)
        problem = known.describe_missing_body(found)
        guess = relabel_marker_set(known if problem else known.select_shown_part(found), visible_labels)
        if problem:
            raise TakeError(
                f"{take.name}: {known.name} cannot be used to learn a marker set: only {len(guess.labels)} of its markers are "
                f"present; {problem}."
            )
        has_others = len(guess.labels) < sum(map(bool, visible_labels))
        others = " The segments of the others are learned from their motion." if has_others else ""
        return InitialGuess(guess, KNOWN_LABEL_LOG_ODDS, f"{describe_marker_set_match(known, visible_labels)}{others}")
    guess = from_words.select_shown_part(from_words.labels)
    if guess.labels:
        description = f"{len(guess.labels)} markers were located by words in their labels, the others by their motion."
        return InitialGuess(guess, LABEL_WORD_LOG_ODDS, description)
    if len(from_words.labels) >= MAX_LOCATED_SHARE * sum(map(bool, visible_labels)):
        raise TakeError(
            f"{take.name}: no marker set can be learned: the words in the labels locate {format_name_list(from_words.labels)}, "
            "which show neither a body nor a part of one."
        )
    grouped = None if like else guess_from_groups(take, labels)
    if grouped and len(grouped.marker_set.labels) >= MIN_GROUPED_SHARE * sum(map(bool, visible_labels)):
        return grouped
    body = load_cmu31_body()
    prior, limits = load_mean_pose_prior(MEAN_POSE_PRIOR_NAME, body.skeleton), load_joint_limits(body.skeleton)
    guess = guess_from_marker_cloud(take, tuple(labels), body, prior, limits)
    return InitialGuess(
        guess,
        POSITION_LOG_ODDS,
        "The labels do not locate a body: all markers were located by their positions and motion. Check the result.",
    )


def relabel_marker_set(known: MarkerSet, labels: Sequence[str]) -> MarkerSet:
    """Return those markers of a set that are among a take's labels, under the take's labels."""
    found = known.match_labels(labels)
    rows = [known.labels.index(label) for label in found]
    return replace(
        known,
        labels=tuple(labels[column] for column in found.values()),
        joints=known.joints[rows],
        marker_offsets=known.marker_offsets[rows],
        marker_spread=known.marker_spread[rows],
        aliases=((),) * len(rows),
        optional_labels=frozenset(),
    )


def build_learned_set(learned: MarkerSetFit, guess: MarkerSet, name: str, title: str, *, keep_guess: bool) -> MarkerSet:
    """Return the learned set under its name, with the offsets that were measured on this person.

    keep_guess  whether the offsets of the guessed markers stay as they are, because they are of a known set
    """
    marker_set = learned.marker_set
    size = learned.subject.skeleton.total_length_m / load_cmu31_body().skeleton.total_length_m
    index_of_label = {label: k for k, label in enumerate(learned.subject.labels)}
    offsets, spread = marker_set.marker_offsets.copy(), marker_set.marker_spread.copy()
    for n, label in enumerate(marker_set.labels):
        k = index_of_label.get(label, -1)
        is_kept = keep_guess and label in guess.labels
        if k >= 0 and not is_kept and learned.subject.joints[k] == marker_set.joints[n]:
            offsets[n], spread[n] = learned.subject.marker_offsets[k] / size, LEARNED_MARKER_SPREAD_M
    return replace(marker_set, name=name, title=title, marker_offsets=offsets, marker_spread=spread, optional_labels=frozenset())


def find_ambiguous_markers(learned: MarkerSetFit, labels: Sequence[str]) -> dict[str, str]:
    """Return the markers that may be attached to another joint, with its name, by label."""
    joint_names, attachment = load_cmu31_body().skeleton.names, learned.attachment
    is_ambiguous = (attachment.joints >= 0) & (attachment.probability < MIN_SEGMENT_PROBABILITY)
    return {labels[int(m)]: joint_names[attachment.second_joints[m]] for m in np.flatnonzero(is_ambiguous)}
