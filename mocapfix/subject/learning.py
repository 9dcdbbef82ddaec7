"""Learn a marker set from a take, where no known set fits: the segment of each marker and its offset.

Learning starts from a guess at some of the markers: those of a known set that are among the labels, else those whose labels have
known words, else those on legs that rigid groups form, or those that the cloud of markers locates on a body. How the markers
move then decides about all of them. `clean` uses the set, `mocapfix marker-set learn` writes it.

A body with many joints follows nearly any markers to a few millimetres, so a small residual is no proof. A wrong body shows in
other ways: it has an impossible size, knees that bend forwards, or segments far apart on it whose markers keep their distance.
Without a plausible body there is no set: no skeleton is better than a wrong one.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.errors import TakeError, format_name_list
from mocapfix.io.capture import read_take
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.skeleton import BODY_SECTIONS, find_common_joint, load_cmu31_body
from mocapfix.model.stage_timer import ProgressCallback
from mocapfix.model.take import Take
from mocapfix.options import DEFAULT_READ_OPTIONS, ReadOptions
from mocapfix.solve.mean_pose import JointLimits, load_joint_limits, load_mean_pose_prior
from mocapfix.stats.marker_distances import find_rigid_groups, measure_distance_spread
from mocapfix.stats.sequences import sample_evenly
from mocapfix.subject import library
from mocapfix.subject.label_words import guess_marker_set_from_words, names_object
from mocapfix.subject.marker_set_fit import MarkerSetFit, fit_marker_set
from mocapfix.subject.props import find_props
from mocapfix.subject.unlabelled_markers import guess_from_marker_cloud, guess_from_rigid_groups

MAX_LEARNED_MEAN_RESIDUAL_M = 0.009  # from the body of a correct set; with a wrong side or segment it is larger
MIN_LEARNED_SIZE_RATIO = 0.5  # to the average body: a child of three
MIN_POSITION_SIZE_RATIO = 0.75  # of a body that is located by positions alone; a part taken for a whole is smaller
MAX_LEARNED_SIZE_RATIO = 1.3  # largest size relative to the average body
STEADINESS_RATIO = 2.0  # of the variation to a distant segment and the least to a near one, that is a contradiction
MAX_STEADY_SPREAD_M = 0.006  # of a distance (sd), below which two markers seem to be on the same segment
MIN_TRAVEL_SPREAD_M = 0.05  # of a marker that moves; two markers at rest keep their distance on any segments
PASSED_JOINT_NAMES = ("LowerBack", "Spine", "Neck", "Neck1")  # not counted between segments: trunk and head are neighbours
MIN_DISTANT_SEGMENTS = 4  # between two: an upper arm hardly moves against the head in a short walk
MAX_CONTRADICTED_SHARE = 0.04  # share of the markers whose steadiest neighbours may be on distant segments
MIN_DISTANCE_MOTION_M = 0.008  # median, between markers on distant segments; less is too little to learn from
MAX_BEND_VIOLATION_RAD = 0.35  # angle beyond its limits at which a knee or an elbow bends the wrong way
MAX_TURN_VIOLATION_RAD = 0.05  # beyond its limits at which a foot or an upper arm is turned the wrong way round
MAX_VIOLATION_SHARE = 0.2  # share of the frames in which they may be
MIN_JUDGED_MARKERS = 2  # markers of a segment whose joint is judged: one marker leaves its rotation open
MAX_NAMED_MARKER_SD_M = 0.02  # per axis against its segment, above which a marker is left out though it is named
MAX_UNNAMED_MARKER_SD_M = 0.012  # the same for a marker that is attached for its motion alone
MIN_UNNAMED_PROBABILITY = 0.9  # of its segment below which such a marker is left out, but for a neighbouring one
MIN_LOCATED_SHARE = 0.8  # share of the visible markers that a body located by positions alone must explain
TRUNK_JOINT_NAMES = ("Hips", "Spine1", "Head")
LIMB_SEGMENT_NAMES = ("UpLeg", "Leg", "Foot", "Arm", "ForeArm")
MIN_TRUNK_SEGMENT_MARKERS = 3  # markers on pelvis, thorax and head each of such a body
MIN_PAIRED_LIMB_SEGMENTS = 8  # number of its ten limb segments that have two markers or more; each has at least one
HINGE_JOINT_NAMES = ("LeftLeg", "RightLeg", "LeftForeArm", "RightForeArm")  # knees and elbows, which bend in one direction only
TURNED_JOINT_NAMES = ("LeftFoot", "RightFoot", "LeftArm", "RightArm")  # of a body that faces backwards


@dataclass(frozen=True)
class LearnedBody:
    """What the checks compare: a learned set with the body on which it was learned."""

    marker_set: MarkerSet  # K markers
    mean_residual_m: float  # their mean distance from the body
    size_ratio: float  # size relative to the average body
    joint_rotations: Float[np.ndarray, "N J 3 3"]  # world rotations of the joints in N frames
    distance_spread: Float[np.ndarray, "K K"]  # m: variation of the distances between the markers
    position_spread: Float[np.ndarray, " K"]  # m: variation of their positions


def describe_implausible_body(learned: LearnedBody, limits: JointLimits, *, from_positions: bool) -> str:
    """Return why a learned body is not plausible as a predicate, "" if it is; of segments guessed `from_positions` or labels."""
    min_size = MIN_POSITION_SIZE_RATIO if from_positions else MIN_LEARNED_SIZE_RATIO
    segment_distance = count_segments_between(learned.marker_set.joints)
    spread = learned.distance_spread[(segment_distance >= MIN_DISTANT_SEGMENTS) & np.isfinite(learned.distance_spread)]
    if not len(spread):  # a single limb
        spread = learned.distance_spread[(segment_distance > 0) & np.isfinite(learned.distance_spread)]
    motion = float(np.median(spread)) if len(spread) else 0.0
    if not motion >= MIN_DISTANCE_MOTION_M:
        return "moves too little in this take to be verified"
    if not min_size <= learned.size_ratio <= MAX_LEARNED_SIZE_RATIO:
        return f"would have {learned.size_ratio:.0%} of the size of the average person"
    if learned.mean_residual_m > MAX_LEARNED_MEAN_RESIDUAL_M:
        return f"would be {learned.mean_residual_m * 1e3:.0f} mm from its markers on average"
    contradiction = _describe_contradiction(
        learned.marker_set, segment_distance, learned.distance_spread, learned.position_spread
    )
    if contradiction:
        return contradiction
    if name := find_impossible_joint(learned.marker_set.joints, learned.joint_rotations, limits):
        return f"would turn {name} in an impossible way"
    return ""


def describe_incomplete_location(joints: Int[np.ndarray, " K"], visible_count: int) -> str:
    """Return why markers located by positions alone, attached to K joints, are not enough of a whole body, "" if they are."""
    skeleton = load_cmu31_body().skeleton
    counts = {name: int((joints == j).sum()) for j, name in enumerate(skeleton.names)}
    limbs = {side + name: counts[side + name] for side in ("Left", "Right") for name in LIMB_SEGMENT_NAMES}
    sparse = [name for name in TRUNK_JOINT_NAMES if counts[name] < MIN_TRUNK_SEGMENT_MARKERS]
    sparse += [name for name, count in limbs.items() if not count]
    if len(joints) < MIN_LOCATED_SHARE * visible_count:
        return f"explains only {len(joints)} of {visible_count} markers"
    if sparse:
        return f"has too few markers on {format_name_list(sparse)}"
    if sum(count > 1 for count in limbs.values()) < MIN_PAIRED_LIMB_SEGMENTS:
        return f"has single markers on {format_name_list([name for name, count in limbs.items() if count == 1])}"
    return ""


def describe_contradicted_guess(take: Take, labels: Sequence[str], guess: MarkerSet) -> str:
    """Return why a guess from positions alone is not plausible, before a body is fitted to it; "" if it may be."""
    if problem := describe_incomplete_location(guess.joints, int(take.visible.any(0).sum())):
        return problem
    markers = take.markers[:, [labels.index(label) for label in guess.labels]]
    segment_distance = count_segments_between(guess.joints)
    return _describe_contradiction(guess, segment_distance, measure_distance_spread(markers), measure_position_spread(markers))


def _describe_contradiction(
    marker_set: MarkerSet, segment_distance: np.ndarray, distance_spread: np.ndarray, position_spread: np.ndarray
) -> str:
    is_contradicted = find_contradicted_markers(segment_distance, distance_spread, position_spread)
    if is_contradicted.mean() <= MAX_CONTRADICTED_SHARE:
        return ""
    names = [label for label, is_wrong in zip(marker_set.labels, is_contradicted, strict=True) if is_wrong]
    return f"would have {names[0]} on another segment than the markers with which it moves"


def count_segments_between(joints: Int[np.ndarray, " K"]) -> Int[np.ndarray, "K K"]:
    """Return for each pair of markers how many segments lie on the way from one to the other, the last included."""
    body = load_cmu31_body()
    passed = {body.skeleton.find_joint(name) for name in PASSED_JOINT_NAMES} | set(np.flatnonzero(~body.free_joints).tolist())
    count = {(a, b): _count_steps(a, b, passed) for a in set(joints.tolist()) for b in set(joints.tolist())}
    return np.array([[count[int(a), int(b)] for b in joints] for a in joints], int)


def _count_steps(start: int, end: int, passed: set[int]) -> int:
    parents = load_cmu31_body().skeleton.parents
    top = find_common_joint(parents, (start, end))
    path: set[int] = {top}
    for joint in (start, end):
        while joint != top:
            path.add(joint)
            joint = int(parents[joint])
    return len(path - passed - {start})


def find_contradicted_markers(
    segment_distance: Int[np.ndarray, "K K"], distance_spread: Float[np.ndarray, "K K"], position_spread: Float[np.ndarray, " K"]
) -> Bool[np.ndarray, " K"]:
    """Find the markers that keep their distance to a marker on a distant segment, though both move."""
    spread = np.where(position_spread > MIN_TRAVEL_SPREAD_M, distance_spread, np.inf)
    distant = np.where(segment_distance >= MIN_DISTANT_SEGMENTS, spread, np.inf).min(1)
    near = np.where(segment_distance < MIN_DISTANT_SEGMENTS, spread, np.inf).min(1)
    limit = np.minimum(MAX_STEADY_SPREAD_M, STEADINESS_RATIO * near)
    return (position_spread > MIN_TRAVEL_SPREAD_M) & (distant < limit)


def measure_position_spread(markers: Float[np.ndarray, "T M 3"]) -> Float[np.ndarray, " M"]:
    """Return the variation of each marker's position in metres: the norm of its standard deviations; 0 if never visible."""
    sampled = markers[sample_evenly(len(markers), 200)]
    is_visible = ~np.isnan(sampled[..., 0])
    count = np.maximum(is_visible.sum(0), 1)[:, None]
    centred = np.where(is_visible[..., None], sampled - np.nansum(sampled, axis=0) / count, 0.0)
    return np.sqrt((centred**2).sum((0, 2)) / count[:, 0])


def find_impossible_joint(
    joints: Int[np.ndarray, " K"], joint_rotations: Float[np.ndarray, "N J 3 3"], limits: JointLimits
) -> str:
    """Return the name of a joint that is beyond its limits in many frames, "" if none is.

    Knees and elbows are judged about the axis about which they bend. Of a body that faces backwards, or has its sides exchanged,
    the feet and the upper arms are turned about any axis. Only joints with two markers or more are judged.
    """
    skeleton = load_cmu31_body().skeleton
    for joint, name in enumerate(skeleton.names):
        is_hinge = name in HINGE_JOINT_NAMES
        if not (is_hinge or name in TURNED_JOINT_NAMES) or (joints == joint).sum() < MIN_JUDGED_MARKERS:
            continue
        parent = int(skeleton.parents[joint])
        local = np.einsum("nba,nbc->nac", joint_rotations[:, parent], joint_rotations[:, joint])
        turn = Rotation.from_matrix(local @ limits.mean_rotations[joint].T).as_rotvec()
        beyond = np.maximum(limits.lower_rad[joint] - turn, turn - limits.upper_rad[joint])
        axis = int((limits.upper_rad[joint] - limits.lower_rad[joint]).argmax())  # about which it bends
        excess, max_excess = (beyond[:, axis], MAX_BEND_VIOLATION_RAD) if is_hinge else (beyond.max(1), MAX_TURN_VIOLATION_RAD)
        if (excess > max_excess).mean() > MAX_VIOLATION_SHARE:
            return name
    return ""


def measure_learned_body(take: Take, labels: Sequence[str], marker_set: MarkerSet, fit: MarkerSetFit) -> LearnedBody:
    """Return what the checks compare of a set that was fitted to a take, whose markers have `labels` in the set."""
    columns = [labels.index(label) for label in marker_set.labels]
    markers = take.markers[:, columns]
    residual_m = float(np.sqrt(3 * np.mean(fit.attachment.residual_sd[columns] ** 2)))
    spreads = measure_distance_spread(markers), measure_position_spread(markers)
    return LearnedBody(marker_set, residual_m, fit.subject.skeleton.size_ratio, fit.joint_rotations, *spreads)


def describe_contradicted_words(labels: Sequence[str], fit: "MarkerSetFit", guess: MarkerSet) -> str:
    """Return why the motion contradicts the labels' words, "" if not; words may name a neighbouring segment."""
    attached = np.array([fit.attachment.joints[labels.index(label)] for label in guess.labels])
    is_attached = attached >= 0
    pairs = zip(guess.joints[is_attached].tolist(), attached[is_attached].tolist(), strict=True)
    is_moved = np.array([count_segments_between(np.array(pair))[0, 1] > 1 for pair in pairs], bool)
    if not len(is_moved) or is_moved.mean() <= MAX_CONTRADICTED_SHARE:
        return ""
    names = [label for label, is_kept in zip(guess.labels, is_attached, strict=True) if is_kept]
    return f"would have {names[int(is_moved.argmax())]} on another segment than its label says"


def find_doubtful_markers(
    take: Take, labels: Sequence[str], fit: "MarkerSetFit", named_labels: Collection[str]
) -> dict[str, str]:
    """Return why a marker is left out of the learned set though it was attached to a segment, by label."""
    skeleton, attachment = load_cmu31_body().skeleton, fit.attachment
    is_named = np.array([label in named_labels for label in labels])
    max_sd = np.where(is_named, MAX_NAMED_MARKER_SD_M, MAX_UNNAMED_MARKER_SD_M)
    reasons: dict[str, str] = {}
    for m in np.flatnonzero(attachment.joints >= 0).tolist():
        joint, second = int(attachment.joints[m]), int(attachment.second_joints[m])
        is_unclear = attachment.probability[m] < MIN_UNNAMED_PROBABILITY and not is_named[m]
        if attachment.residual_sd[m] > max_sd[m]:
            reasons[labels[m]] = f"moves by {attachment.residual_sd[m] * 1e3:.0f} mm against {skeleton.names[joint]}"
        elif is_unclear and joint not in (skeleton.parents[second], second) and second != skeleton.parents[joint]:
            reasons[labels[m]] = f"may be on {skeleton.names[joint]} or on {skeleton.names[second]}"
    is_left_out = (attachment.joints < 0) | np.array([label in reasons for label in labels])
    for group in find_rigid_groups(measure_distance_spread(take.markers)):
        members = np.array(group.markers)
        if is_left_out[members].any() and not is_named[members].any():
            reasons |= {labels[m]: "belongs to a prop" for m in group.markers if not is_left_out[m]}
    return reasons


KNOWN_LABEL_LOG_ODDS = 10.0  # log odds that the segment of a marker is correct if its label is one of a known set
LABEL_WORD_LOG_ODDS = 4.0  # the same if the label has a known word
GROUP_LOG_ODDS = 6.0  # the same if the marker is in a rigid group whose joints show its segment
POSITION_LOG_ODDS = 3.0  # the same if the segment is guessed from the cloud of markers
MIN_GROUPED_SHARE = 0.6  # share of the visible markers on legs that rigid groups form, from which no whole body is searched for
MAX_LOCATED_SHARE = 0.2  # share of the labels whose words locate a marker, above which a body is not located by positions
MIN_SEGMENT_PROBABILITY = 0.9  # probability of a segment below which the marker is reported as ambiguous
# Standard deviation per axis of other people's markers about an offset that was measured on one person.
LEARNED_MARKER_SPREAD_M = 0.02
MEAN_POSE_PRIOR_NAME = "mean-pose"


@dataclass(frozen=True)
class LearnedMarkerSet:
    """A marker set that was learned from a take."""

    marker_set: MarkerSet  # the set
    guess_description: str  # a sentence on the guess from which it was learned
    excluded_markers: dict[str, str]  # why a marker is not in the set, by label
    ambiguous_markers: dict[str, str]  # the name of another joint to which a marker may be attached, by label
    mean_residual_m: float  # mean distance of the markers from the body

    @property
    def file_comment(self) -> str:
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
    """The markers of one subject in a take."""

    take: Take  # its markers and those without a subject prefix
    labels: tuple[str, ...]  # their labels without prefix
    excluded_markers: dict[str, str]  # why a marker was left out, by label


@dataclass(frozen=True)
class InitialGuess:
    """A guess at some of the markers of a take, enough to determine a body."""

    marker_set: MarkerSet  # the guessed markers by the labels of the take
    label_log_odds: float  # log odds that the segment of a marker is correct
    description: str  # a sentence on where the guess comes from


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
    if guess is None:
        return None
    by_words, guessed = guess_marker_set_from_words(guess.labels), dict(zip(guess.labels, guess.joints.tolist(), strict=True))
    pairs = [(guessed[label], joint) for label, joint in zip(by_words.labels, by_words.joints.tolist(), strict=True)]
    if any(count_segments_between(np.array(pair))[0, 1] > 1 for pair in pairs):
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
        learned_body = measure_learned_body(take, labels, marker_set, fit)
        limits = load_joint_limits(body.skeleton)
        problem = (
            describe_incomplete_location(marker_set.joints, int(take.visible.any(0).sum()))
            if is_from_positions
            else describe_contradicted_words(labels, fit, guess.marker_set)
        )
        if problem := problem or describe_implausible_body(learned_body, limits, from_positions=is_from_positions):
            raise TakeError(f"{take.name}: no marker set can be learned: the body {problem}.")
    excluded = {label: reason for label, reason in reasons.items() if reason} | selected.excluded_markers
    is_ambiguous = (fit.attachment.joints >= 0) & (fit.attachment.probability < MIN_SEGMENT_PROBABILITY)
    others = {labels[m]: body.skeleton.names[fit.attachment.second_joints[m]] for m in np.flatnonzero(is_ambiguous).tolist()}
    return LearnedMarkerSet(marker_set, guess.description, excluded, others, fit.mean_residual_m)


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

    Raises:
        TakeError: If the set `like` has too few of the take's markers, or if no guess shows a body.
    """
    visible_labels = [label if take.visible[:, m].any() else "" for m, label in enumerate(labels)]
    known = library.load_marker_set(like) if like else library.choose_marker_set(visible_labels).marker_set
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
        return InitialGuess(guess, KNOWN_LABEL_LOG_ODDS, f"{library.describe_marker_set_match(known, visible_labels)}{others}")
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
    return InitialGuess(
        guess_from_marker_cloud(take, tuple(labels)),
        POSITION_LOG_ODDS,
        "The labels do not locate a body: all markers were located by their positions and motion. Check the result.",
    )


def relabel_marker_set(known: MarkerSet, labels: Sequence[str]) -> MarkerSet:
    """Return those markers of a set that are among a take's labels, under the take's labels."""
    found = known.match_labels(labels)
    names = tuple(labels[column] for column in found.values())
    return replace(known.select_markers(found), labels=names, aliases=((),) * len(names), optional_labels=frozenset())


def build_learned_set(learned: MarkerSetFit, guess: MarkerSet, name: str, title: str, *, keep_guess: bool) -> MarkerSet:
    """Return the learned set under its name, with the offsets that were measured on this person.

    Args:
        keep_guess: Whether the offsets of the guessed markers stay as they are, because they are of a known set.
    """
    marker_set = learned.marker_set
    size = learned.subject.skeleton.size_ratio
    index_of_label = {label: k for k, label in enumerate(learned.subject.labels)}
    offsets, spread = marker_set.marker_offsets.copy(), marker_set.marker_spread.copy()
    for n, label in enumerate(marker_set.labels):
        k = index_of_label.get(label, -1)
        is_kept = keep_guess and label in guess.labels
        if k >= 0 and not is_kept and learned.subject.joints[k] == marker_set.joints[n]:
            offsets[n], spread[n] = learned.subject.marker_offsets[k] / size, LEARNED_MARKER_SPREAD_M
    return replace(marker_set, name=name, title=title, marker_offsets=offsets, marker_spread=spread, optional_labels=frozenset())


OWN_SET_NAME = "own"
MIN_OWN_SET_MARKERS = 5  # visible markers of the smallest part of a body, a single limb
MAX_OWN_SET_MARKERS = 400  # of one body; the densest published set has 350 (Park & Hodgins 2006)


def find_own_marker_set(take: Take, choice: library.SubjectChoice) -> library.SubjectChoice:
    """Return the choice for a take without a known set: with a set learned from the take, or without one and with the reason."""
    known_reason = choice.notes[:1]
    try:
        count = int(take.visible.any(0).sum())
        if take.subject_name == library.UNASSIGNED_SUBJECT or count < MIN_OWN_SET_MARKERS:
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

    Raises ReadError, SceneError or TakeError.

    Args:
        like: A marker set, as for `load_marker_set`, to which some of the labels belong; None for the set that fits, if any.
        subject_prefix: The subject ("Jim" of Jim:LFHD); None for the one with the most markers.
        options: What is known about the file, as for `read_take`.
        progress: Called with the name of each stage as it begins.
    """
    report_stage = progress or (lambda stage: None)
    report_stage("read")
    take = read_take(path, options)
    take = replace(take, subject_prefixes=library.find_subject_prefixes(take.labels))
    if subject_prefix is not None:
        take = library.select_subject(take, subject_prefix)
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
