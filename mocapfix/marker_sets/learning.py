"""Learning a studio's own marker set from a take: which segment each marker rides on, and where.

Something must be known to begin with: of a shipped set's labels most, else what labels say in words, else nothing but where the
markers are; then how they move decides.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mocapfix import marker_sets, multi_subject
from mocapfix.calibrate import marker_set_fit, unlabelled_markers
from mocapfix.calibrate.marker_set_fit import MarkerSetFit
from mocapfix.errors import TakeError
from mocapfix.marker_sets import MarkerSet, label_words
from mocapfix.pose_prior import mean_pose
from mocapfix.pose_prior.joint_limits import load_joint_limits
from mocapfix.read import capture
from mocapfix.report.stage_timer import ProgressCallback
from mocapfix.skeleton import load_cmu31_body
from mocapfix.take import Take

KNOWN_LABEL_LOG_ODDS, LABEL_WORD_LOG_ODDS, POSITION_LOG_ODDS = (
    10.0,
    4.0,
    3.0,
)  # log odds that a segment is right: by a known set, by words, by where the cloud lies
MIN_SEGMENT_PROBABILITY = 0.9  # a marker that is less likely to ride on its segment is named
LEARNED_MARKER_SPREAD_M = 0.02  # metres: of a place that was measured on one person, about another's


@dataclass(frozen=True)
class LearnedMarkerSet:
    """What was learnt from a take.

    marker_set  the new set
    how         a sentence: where its first guess came from
    left_out    label: the reason, for those that ride on no segment
    doubtful    label: the two segments between which it may ride
    residual    metres: how far the set's markers lie from the body on average
    """

    marker_set: MarkerSet
    guess_description: str
    excluded_markers: dict[str, str]
    ambiguous_markers: dict[str, str]
    mean_residual_m: float

    @property
    def file_comment(self) -> str:
        """What to write above the set."""
        said = [
            f"{self.marker_set.title}. Places are in metres on the average body, in the axes of the joint that carries them;",
            "spread is how far one person's marker lies from there (standard deviation per axis).",
            self.guess_description,
            f"The markers lie {self.mean_residual_m * 1e3:.1f} mm from the body on average.",
        ]
        said += [f"{label} may as well ride on {segment}." for label, segment in self.ambiguous_markers.items()]
        return "\n".join([*said, *(f"Left out: {label} {reason}." for label, reason in self.excluded_markers.items())])


def learn_marker_set(
    path: str | Path,
    name: str,
    like: str | Path | None = None,
    subject_prefix: str | None = None,
    up: str | None = None,
    progress: ProgressCallback | None = None,
) -> LearnedMarkerSet:
    """-> the marker set that a take wears, as `name`.

    like            a set, shipped or a file, that explains some of the take's labels; None: the one that fits, if any does
    subject_prefix  whose set it is ("Jim", whose labels are "Jim:LFHD"); None: of several people, that of the most markers
    up              the file's axis to the sky, as in `read.take`

    Raises ReadError, SceneError or TakeError with a sentence for a technician.
    """
    tell = progress or (lambda stage: None)
    tell("read")
    take = capture.read_take(path, up)
    if subject_prefix is not None:
        (take,) = multi_subject.split_subjects(take, None, subject_prefix)
    take, labels, strangers = select_subject_markers(take.masked(take.measured))
    tell("guess")
    guess, worth, how = guess_marker_set(take, labels, like)
    tell("learn")
    body = load_cmu31_body()
    found = marker_set_fit.fit_marker_set(
        take, labels, guess, worth, body, mean_pose.load_mean_pose_prior("mean-pose", body.skeleton)
    )
    worn = build_learned_set(found, guess, name, f"Learnt from {take.name}", keep_guess=worth == KNOWN_LABEL_LOG_ODDS)
    if lack := worn.describe_missing_body(worn.labels):
        raise TakeError(f"{take.name}: no marker set can be learnt: of a body {lack.partition(';')[0]}.")
    reasons = found.attachment.rejection_reasons
    left = {label: reason for label, reason in zip(labels, reasons, strict=True) if reason}
    return LearnedMarkerSet(worn, how, {**left, **strangers}, list_ambiguous_markers(found, labels), found.mean_residual_m)


def select_subject_markers(take: Take) -> tuple[Take, tuple[str, ...], dict[str, str]]:
    """-> the markers of the subject with the most of them and those of no subject, their labels without the prefix, and why
    others are left out."""
    owners = take.marker_subjects
    whose = max(dict.fromkeys(owners), key=lambda owner: (bool(owner), owners.count(owner)))
    chosen: dict[str, int] = {}
    others: dict[str, str] = {}
    for column, (owner, bare) in enumerate(zip(owners, take.bare_labels, strict=True)):
        if owner not in (whose, ""):
            others[take.labels[column]] = f"is {owner}'s, not {whose}'s"
        elif bare in chosen:
            others[take.labels[column]] = "bears the same label as another"
        else:
            chosen[bare] = column
    columns = np.array(list(chosen.values()), int)
    return take.select(columns, take.visible), tuple(chosen), others


def guess_marker_set(take: Take, labels: tuple[str, ...], like: str | Path | None) -> tuple[MarkerSet, float, str]:
    """-> a guess at some of the markers that shows a body, the log odds that it is right about one, and a sentence on it."""
    there = [label if take.visible[:, m].any() else "" for m, label in enumerate(labels)]
    known = marker_sets.load_marker_set(like) if like else marker_sets.choose_marker_set(there).marker_set
    if known:
        guess = relabel_marker_set(known, there)
        if lack := known.describe_missing_body(known.match_labels(there)):
            raise TakeError(f"{take.name}: {known.name} is no beginning: of its markers {len(guess.labels)} are there; {lack}.")
        others = " The others are by how they move." if len(guess.labels) < sum(map(bool, there)) else ""
        return guess, KNOWN_LABEL_LOG_ODDS, f"{marker_sets.describe_marker_set_match(known, there)}{others}"
    guess = label_words.guess_marker_set_from_words([label for label in there if label])
    if not guess.describe_missing_body(guess.labels):
        return (
            guess,
            LABEL_WORD_LOG_ODDS,
            f"The labels of {len(guess.labels)} markers told about where they are; the rest is by how they move.",
        )
    body = load_cmu31_body()
    limits = load_joint_limits(body.skeleton)
    guess = unlabelled_markers.guess_from_marker_cloud(
        take, labels, body, mean_pose.load_mean_pose_prior("mean-pose", body.skeleton), limits
    )
    return (
        guess,
        POSITION_LOG_ODDS,
        "The labels tell no body: all is by where the markers lie on one and how they move. Look at it once.",
    )


def relabel_marker_set(known: MarkerSet, labels: list[str]) -> MarkerSet:
    """-> the part of a set that a take shows, by the take's labels."""
    found = known.match_labels(labels)
    rows = [known.labels.index(label) for label in found]
    return replace(
        known, labels=tuple(labels[column] for column in found.values()), joints=known.joints[rows], marker_offsets=known.marker_offsets[rows],
        marker_spread=known.marker_spread[rows], aliases=((),) * len(rows), optional_labels=frozenset(),
    )  # fmt: skip


def build_learned_set(learned: MarkerSetFit, guess: MarkerSet, name: str, title: str, keep_guess: bool) -> MarkerSet:
    """-> the learnt set under its name, every place measured on this person but for those that are to be kept, a known set's."""
    worn, size = learned.marker_set, learned.subject.skeleton.total_length_m / load_cmu31_body().skeleton.total_length_m
    person = {label: k for k, label in enumerate(learned.subject.labels)}
    places, spread = worn.marker_offsets.copy(), worn.marker_spread.copy()
    for n, label in enumerate(worn.labels):
        k = person.get(label, -1)
        if k >= 0 and not (keep_guess and label in guess.labels) and learned.subject.joints[k] == worn.joints[n]:
            places[n], spread[n] = learned.subject.marker_offsets[k] / size, LEARNED_MARKER_SPREAD_M
    return replace(worn, name=name, title=title, marker_offsets=places, marker_spread=spread, optional_labels=frozenset())


def list_ambiguous_markers(learned: MarkerSetFit, labels: tuple[str, ...]) -> dict[str, str]:
    """-> the markers that may ride on another segment than they were put on, and that one."""
    names, at = load_cmu31_body().skeleton.names, learned.attachment
    unsure = np.flatnonzero((at.joints >= 0) & (at.probability < MIN_SEGMENT_PROBABILITY))
    return {labels[m]: names[at.second_joints[m]] for m in unsure}
