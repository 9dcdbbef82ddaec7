"""Notes of a report: sentences on unobserved joints, unassigned markers, large residuals, lost limbs and uncertain fills."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.contacts.contacts import PLATE_SOURCE, BodyContacts, StandingBody
from mocapfix.errors import format_name_list, join_names, join_words
from mocapfix.hands.finger_markers import find_finger_markers, select_carried
from mocapfix.hands.solve_hands import HandMotion
from mocapfix.model.body_fit import BodyFit, RememberedGap
from mocapfix.model.changes import compute_distance_error_mm
from mocapfix.model.detected import Detected
from mocapfix.model.faults import (
    EXTERNAL_FILL_KINDS,
    LABEL_KINDS,
    MIN_LABEL_CONFIDENCE,
    REPLACED_SAMPLE_KINDS,
    Fault,
    build_fault_mask,
)
from mocapfix.model.marker_set import ARMS, MarkerSet
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import BODY_SECTIONS
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.report.report import RigidGroupEntry
from mocapfix.report.terms import MARKER_TERMS, PointTerms, format_frame_range, get_point_terms
from mocapfix.solve.lost_in_sight import BODY_PARTS, LostPart, find_lost_parts
from mocapfix.stats.sequences import find_runs, sample_evenly

MAX_RELIABLE_FILL_SD_M = 0.06  # per axis; fills with a larger predicted standard deviation are listed
MIN_STRAY_DISTANCE_M = 0.1  # from the body; a marker this far for MIN_STRAY_DURATION_S is reported with its frames
MIN_STRAY_DURATION_S = 0.05
MAX_IMPORTED_FILL_DISTANCE_M = 0.02  # from the body; compared with the median over the fill of another program
MISLABELLED_MARKER_DISTANCE_M = 0.06  # from the body; a marker farther away in most of its frames probably has a wrong label
MISLABELLED_MARKER_SHARE = 0.5  # share of a marker's frames that counts as most
MAX_LISTED_RANGES = 2  # frame ranges in one sentence
MAX_GROUPS_LENGTH = 110  # characters of a list of rigid groups
MAX_LISTED_GROUP_LABELS = 2  # labels of each of them
MAX_LISTED_PART_LABELS = 2  # labels of a part of the body in one sentence
MAX_LISTED_REMEMBERED = 3  # limbs that are inferred from the memory of the person, those lost longest
# Median distance of the samples from the body of a given subject that shows another person, or markers attached again: other
# people have 10.9 mm and more, the same person in other takes 4.6 mm; markers attached 5 mm off 6.9 mm, and 12 mm off 12 mm.
MIN_OTHER_BODY_DISTANCE_M = 0.01
MAX_STRAY_NOTES = 4  # notes on single markers that are far from the body; more are one sentence
NO_PREVIEW_NOTE = "Preview without a skeleton: gaps are filled as in a full clean, and faults are detected in one round."


@dataclass(frozen=True)
class SolvedBody:
    """What results, reports and files need of the body of a take."""

    subject: Subject
    motion: Motion
    joint_positions: Float[np.ndarray, "T J 3"]  # metres; NaN for joints that the markers do not show
    contacts: BodyContacts
    residual_m: Float[np.ndarray, "T M"]  # metres, the distance of each inlier from its place on the body; NaN elsewhere
    lost_parts: tuple[LostPart, ...]  # parts that the solve lost in sight, with the samples of the M markers of the take
    is_observed: Bool[np.ndarray, " J"]  # whether an inlier of any marker on a joint is visible
    carried_markers: tuple[int, ...]  # the markers of the take that the body carries
    remembered: tuple[RememberedGap, ...]  # limbs that are inferred from the memory of the person
    left_hand: HandMotion | None = None  # None if no marker shows its fingers
    right_hand: HandMotion | None = None

    @property
    def hands(self) -> tuple[HandMotion, ...]:
        """The hands whose fingers markers show."""
        return tuple(hand for hand in (self.left_hand, self.right_hand) if hand)


def build_solved_body(detected: Detected, standing: StandingBody, hands: tuple[HandMotion, ...] = ()) -> SolvedBody:
    """Return what outputs need of a body whose standing feet are held, and of its hands."""
    body, columns, epochs = standing.fit, standing.fit.marker_columns, detected.epochs
    by_side = {hand.hand.model.side: hand for hand in hands}
    carried, seen = columns[columns >= 0], np.any(epochs.split_mask(detected.inlier_mask), axis=0)
    joints = body.extended_subject.joints[columns >= 0][seen[carried]]
    residual_m = np.linalg.norm(detected.take.markers - detected.place_on_body(body), axis=-1)
    return SolvedBody(
        subject=body.subject,
        motion=body.motion,
        joint_positions=body.solved_joint_positions,
        contacts=standing.contacts,
        residual_m=np.where(detected.inlier_mask, residual_m, np.nan),
        lost_parts=find_lost_body_parts(detected, body) if body.evidence else (),  # a preview loses too many
        is_observed=np.isin(np.arange(len(body.subject.skeleton.names)), joints),
        carried_markers=tuple(epochs.column_marker[carried].tolist()),
        remembered=body.remembered,
        left_hand=by_side.get("Left"),
        right_hand=by_side.get("Right"),
    )


def build_body_notes(
    detected: Detected, body: SolvedBody, *, is_preview: bool = False, has_given_subject: bool = False
) -> list[str]:
    """Return the notes on where the body fits poorly or is unknown."""
    names, is_solved = body.subject.skeleton.names, body.subject.solved_joints
    lost_samples = np.zeros(body.residual_m.shape, bool)
    for part in body.lost_parts:
        lost_samples |= part.markers
    unsolved = format_name_list([name for name, is_shown in zip(names, is_solved, strict=True) if not is_shown])
    hands = find_finger_markers(body.subject.marker_set, detected.take.labels)
    fingers = [column for hand in hands for column in hand.columns.tolist()]  # which `describe_hands` names
    return [
        *[f"Not shown by any marker, so not solved and kept at rest: {unsolved}."] * (not is_solved.all()),
        *describe_unobserved_joints(body.subject, body.is_observed),
        *describe_unassigned_markers(detected.take, body.carried_markers, {*detected.donor_markers, *fingers}),
        *(describe_lost_part(detected.take, part, detected.inlier_mask) for part in body.lost_parts),
        *describe_stray_markers(detected.take, body.residual_m, detected.faults.items, lost_samples, has_given_subject),
        *describe_imported_fills(detected, body.residual_m),
        *describe_remembered_gaps(detected.take, body.remembered, names),
        *describe_hands(detected, body.subject, body.hands, is_preview=is_preview),
    ]


def describe_hands(detected: Detected, subject: Subject, hands: Sequence[HandMotion], *, is_preview: bool) -> list[str]:
    """Return notes on the hands that are solved, and on those with finger markers that are not; none without such markers."""
    solved = {hand.hand.model.side: f"{hand.hand.length_m * 1e3:.0f} mm long" for hand in hands}
    left = [each for each in find_finger_markers(subject.marker_set, detected.take.labels) if each.side not in solved]
    found, missed = ([f"{side.lower()} hand" for side in sides] for sides in (solved, [each.side for each in left]))
    reason = "no piece that the body of the windows is calibrated from shows them; cut the take to solve them"
    if is_preview:
        reason = "hands are not solved in a preview; clean the take without --fast"
    elif left and not any(detected.solver_mask[:, each.columns].any() for each in left):
        reason = "none of their samples can be used"
    elif not select_carried(left, subject.joints):
        reason = "no marker shows the forearm"
    lengths = [f"{name} ({length})" for name, length in zip(found, solved.values(), strict=True)]
    return [
        *[f"The fingers of the {join_words(lengths)} are solved from their markers; files of motion have them."] * bool(solved),
        *[f"The finger markers of the {join_words(missed)} are filled and not solved: {reason}."] * bool(left),
    ]


def describe_remembered_gaps(take: Take, gaps: Sequence[RememberedGap], names: Sequence[str]) -> list[str]:
    """Return a note on the limbs that are inferred from the memory of the person; no note without any."""
    listed: list[str] = []
    for gap in sorted(gaps, key=lambda gap: gap.first - gap.last)[:MAX_LISTED_REMEMBERED]:
        joints = {names[joint] for joint in gap.joints}
        parts = [part for part, of_part in BODY_PARTS.items() if joints <= set(of_part)]
        what = min(parts, key=lambda part: len(BODY_PARTS[part])) if parts else format_name_list(sorted(joints))
        frames = format_frame_range(*map(take.get_frame_number, (gap.first, gap.last)))
        listed.append(f"{what} in frames {frames} from {gap.source}")
    more = f"; and {len(gaps) - len(listed):,} more" if len(gaps) > len(listed) else ""
    return [f"Inferred from the memory of the person: {'; '.join(listed)}{more}."] if listed else []


def describe_unobserved_joints(subject: Subject, is_observed: Bool[np.ndarray, " J"]) -> list[str]:
    """Return a note on the joints whose markers are never visible."""
    names = [subject.skeleton.names[j] for j in dict.fromkeys(subject.joints.tolist()) if not is_observed[j]]
    return [f"No visible marker on {format_name_list(names)}: the mean pose is used there."] if names else []


def describe_unassigned_markers(take: Take, columns: Sequence[int], described: Collection[int] = ()) -> list[str]:
    """Return a note on the visible markers that are not in the marker set, without those that other notes describe."""
    is_other = take.visible.any(0) & ~np.isin(np.arange(len(take.labels)), [*columns, *described])
    unassigned = [take.labels[m] for m in np.flatnonzero(is_other)]
    if not unassigned:
        return []
    prefixes = {take.marker_subjects[m] for m in columns} - {""}
    solved = f"The solved subject is {format_name_list(sorted(prefixes))}. " if prefixes else ""
    return [f"{solved}Not in its marker set, filled without the skeleton: {format_name_list(unassigned)}."]


def describe_stray_markers(
    take: Take,
    residual_m: Float[np.ndarray, "T M"],
    faults: Iterable[Fault] = (),
    described_mask: Bool[np.ndarray, "T M"] | None = None,
    has_given_subject: bool = False,
) -> list[str]:
    """Return notes on markers far from the body: in most frames, or in intervals; or that a given subject's body does not fit.

    Args:
        residual_m: Distance of each inlier marker from the body in metres, NaN for other samples.
        faults: The detected faults: an exchange of labels that was too uncertain to be corrected is mentioned.
        described_mask: Samples that another note describes.
    """
    known = residual_m[~np.isnan(residual_m)]
    if has_given_subject and len(known) and np.median(known) > MIN_OTHER_BODY_DISTANCE_M:
        far = _format_mm(float(np.median(known)))
        where = f"Half of the samples are more than {far} from where the given subject has their markers"
        return [f"{where}: it is another person, or they were attached again. Leave out --subject or --like, or calibrate again."]
    suspected = [fault for fault in faults if fault.kind in LABEL_KINDS and fault.confidence < MIN_LABEL_CONFIDENCE]
    suspected_mask = build_fault_mask(suspected, residual_m.shape)
    residual_m = residual_m if described_mask is None else np.where(described_mask, np.nan, residual_m)
    misplaced: list[str] = []
    strays: list[str] = []
    stray_labels: list[str] = []
    for m in np.flatnonzero((residual_m > MISLABELLED_MARKER_DISTANCE_M).any(0)):
        compared = ~np.isnan(residual_m[:, m])
        if (residual_m[:, m] > MISLABELLED_MARKER_DISTANCE_M).sum() > MISLABELLED_MARKER_SHARE * compared.sum():
            misplaced.append(take.labels[m])
            continue
        for first, last in find_runs(residual_m[:, m] > MIN_STRAY_DISTANCE_M):
            if (last - first + 1) / take.rate >= MIN_STRAY_DURATION_S:
                frames = f"frames {take.get_frame_number(first)} to {take.get_frame_number(last)}"
                distance = _format_mm(float(np.median(residual_m[first : last + 1, m])))
                is_suspected = suspected_mask[first : last + 1, m].any()
                assumption = "check the suspected label swap" if is_suspected else "its label was assumed to be right"
                strays.append(f"{take.labels[m]}, {frames}: {distance} from the body, left unchanged; {assumption}.")
                stray_labels.append(take.labels[m])
    far, names = _format_mm(MISLABELLED_MARKER_DISTANCE_M), format_name_list(misplaced)
    notes = [f"{label} is more than {far} from the body in most of its frames; check its label." for label in misplaced]
    if len(misplaced) > MAX_STRAY_NOTES:
        what = f"{len(misplaced)} of {residual_m.shape[1]} markers ({names}) are more than {far} from the body"
        notes = [f"{what} in most of their frames: the subject file or the marker set is not that of this person."]
    if len(strays) > MAX_STRAY_NOTES:
        names, far = format_name_list(list(dict.fromkeys(stray_labels))), _format_mm(MIN_STRAY_DISTANCE_M)
        what = f"In {len(strays):,} intervals a marker is more than {far} from the body and left unchanged ({names})"
        strays = [f"{what}; check the labels, and the subject file or the marker set if you named one."]
    return notes + strays


def list_frame_ranges(runs: Sequence[tuple[int, int]], first_frame: int) -> str:
    """Return the first intervals, (first, last) from 0, as frame numbers in a sentence, and the number of the others."""
    ranges = [format_frame_range(first + first_frame, last + first_frame) for first, last in runs]
    more = f" and {len(ranges) - MAX_LISTED_RANGES:,} more intervals" if len(ranges) > MAX_LISTED_RANGES else ""
    return ", ".join(ranges[:MAX_LISTED_RANGES]) + more if more else join_words(ranges)


def describe_lost_part(take: Take, part: LostPart, inlier_mask: Bool[np.ndarray, "T M"]) -> str:
    """Return a note on a part of the body that the solve lost in sight: frames, distance, and what was assumed of its markers."""
    listed = list_frame_ranges(find_runs(part.frames), take.get_frame_number(0))
    frames = "1 frame" if part.frame_count == 1 else f"{part.frame_count:,} frames"
    labels = format_name_list([take.labels[m] for m in np.flatnonzero(part.markers.any(0))], MAX_LISTED_PART_LABELS)
    distance = _format_mm(float(np.nanmean(part.distance_m)))
    replaced_count = int((part.markers & ~inlier_mask).sum())
    replaced = f"{replaced_count:,} {'sample was' if replaced_count == 1 else 'samples were'} taken for faults"
    outcome = f"They are plausible and {replaced if replaced_count else 'left unchanged'}; do not use it there."
    return f"The solved {part.name} is {distance} from its markers ({labels}) in {frames} ({listed}). {outcome}"


def find_lost_body_parts(detected: Detected, body: BodyFit) -> tuple[LostPart, ...]:
    """Return the parts of the body that the solve lost in sight, with the samples of the take's markers.

    They are judged by everything that was measured under correct labels.
    """
    columns, epochs = body.marker_columns, detected.epochs
    measured = detected.select_columns(columns, detected.take.measured)
    is_inlier = np.take(epochs.split_mask(detected.inlier_mask), columns, axis=1) & (columns >= 0)
    lost: list[LostPart] = []
    for part in find_lost_parts(measured.markers, is_inlier, body.extended_subject, body.marker_positions):
        mask = np.zeros(epochs.take.visible.shape, bool)
        mask[:, columns[columns >= 0]] = part.markers[:, columns >= 0]
        lost.append(replace(part, markers=epochs.merge_columns(mask)))
    return tuple(lost)


def describe_imported_fills(detected: Detected, residual_m: Float[np.ndarray, "T M"]) -> list[str]:
    """Return a note on fills of other programs that are far from the body and were left unchanged."""
    fills = detected.sample_faults.select_kinds(*EXTERNAL_FILL_KINDS)
    distances = [(float(np.median(residual_m[fill.frame_slice, fill.marker])), fill) for fill in fills]
    far = [(distance, fault) for distance, fault in distances if distance > MAX_IMPORTED_FILL_DISTANCE_M]
    if detected.replaced_kinds != REPLACED_SAMPLE_KINDS or not far:
        return []
    distance, worst = max(far, key=lambda pair: pair[0])
    first, last = (detected.take.get_frame_number(frame) for frame in (worst.first, worst.last))
    farthest = f"{detected.take.labels[worst.marker]}, frames {first} to {last}, {_format_mm(distance)}"
    return [
        f"{len(far)} of {len(fills)} fills by another program are more than {_format_mm(MAX_IMPORTED_FILL_DISTANCE_M)} "
        f"from the body (the farthest: {farthest}) and are left unchanged; --refill replaces them."
    ]


def find_laboratory_evidence(marker_set: MarkerSet, body: SolvedBody) -> str:
    """Return in a few words what suggests that a take is that of a laboratory; "" if nothing does.

    It is force plates, a marker set of laboratories, or a body of which only legs are shown.
    """
    if any(event.source == PLATE_SOURCE for event in body.contacts.events):
        return "force plates"
    if marker_set.is_laboratory:
        return f"the marker set {marker_set.name}"
    subject = body.subject
    names = {name for name, is_solved in zip(subject.skeleton.names, subject.solved_joints, strict=True) if is_solved}
    upper = {joint for section in ("head", *ARMS) for joint in BODY_SECTIONS[section]}
    return "legs only" if "Hips" in names and not names & upper else ""


def describe_up_axis(take: Take) -> list[str]:
    """Return a note on an up axis that is uncertain; no note if the file gives it or its evidence is clear."""
    if take.up_axis is None or take.up_axis.is_certain:
        return []
    return [f"{take.up_axis.letter} is assumed to be the up axis ({take.up_axis.basis}); this is uncertain: --up sets it."]


MAX_COMPARED_FRAMES = 100  # in which labels are compared
MIN_STEP_MARKERS = 6  # that neighbouring frames show; no step is found in 393 recordings of training people
MIN_JUMP_M, MIN_JUMP_M_S2 = 0.03, 300.0  # by which, and with what acceleration, markers leave their paths at once
MIN_JUMPING_SHARE = 0.75  # of the markers, which no impact moves so
MIN_MOVING_STEP_M = 0.001  # of half of the markers beside frames that repeat, which do not repeat because the body is at rest
MIN_ABSENT_S = 0.5


def describe_frame_steps(take: Take) -> list[str]:
    """Return notes on frames that no camera recorded so: all markers jump at once, repeat a frame, or are missing."""
    counts, terms = np.zeros(take.frame_count, int), get_point_terms(take)
    is_far, is_same, is_moving = (np.zeros(take.frame_count, bool) for _ in range(3))  # the step to each frame
    for start in range(0, take.frame_count, 4096):  # a long take lies on disk
        markers = np.array(take.markers[max(start - 2, 0) : start + 4096])
        end = max(start - 2, 0) + len(markers)
        counts[end - len(markers) : end] = (~np.isnan(markers[..., 0])).sum(1)
        steps = np.diff(markers, axis=0)
        bends = np.linalg.norm(np.diff(steps, axis=0), axis=-1)
        lengths, shown = np.linalg.norm(steps, axis=-1), (~np.isnan(steps[..., 0])).sum(1)
        is_same[end - len(steps) : end] = (shown >= MIN_STEP_MARKERS) & ((lengths == 0).sum(1) == shown)
        is_moving[end - len(steps) : end] = (lengths > MIN_MOVING_STEP_M).sum(1) > shown / 2
        shown = (~np.isnan(bends)).sum(1)
        far = (bends > max(MIN_JUMP_M, MIN_JUMP_M_S2 / take.rate**2)).sum(1)
        is_far[end - len(bends) : end] = (shown >= MIN_STEP_MARKERS) & (far >= MIN_JUMPING_SHARE * shown)
    jumps = np.flatnonzero(is_far[:-1] & is_far[1:] & ~(is_same | np.roll(is_same, 1))[:-1])  # not of a body that was held
    held = [run for run in find_runs(is_same) if is_moving[max(run[0] - 1, 0)] or is_moving[min(run[1] + 1, len(counts) - 1)]]
    absent = [run for run in find_runs(counts == 0) if run[1] + 1 - run[0] >= MIN_ABSENT_S * take.rate]
    frames = [list_frame_ranges(each, take.get_frame_number(0)) for each in (held, absent)]
    count = sum(last + 1 - first for first, last in held)
    at = join_words([f"{take.get_frame_number(int(jump))}" for jump in jumps[:MAX_LISTED_RANGES]])
    more = f" and {len(jumps) - MAX_LISTED_RANGES:,} more" if len(jumps) > MAX_LISTED_RANGES else ""
    where = f"All {terms.points} jump at frame{'s' * (len(jumps) > 1)} {at}{more}: frames are missing before, or takes are joined"
    what = f"{count:,} {'frame repeats' if count == 1 else 'frames repeat'} the frame before ({frames[0]}) while the body moves"
    return [
        *[f"{where}. Cut the take there: fills and motion beside it are not reliable."] * bool(len(jumps)),
        *[f"{what}: the recording was held, or its rate was raised (--rate)."] * bool(count),
        *[f"No {terms.point} is visible in frames {frames[1]}: any motion there is a guess."] * bool(absent),
    ]


def describe_copies(take: Take) -> list[str]:
    """Return a note on labels that have the samples of another one, by frames spread evenly; no note without any."""
    same: dict[bytes, list[str]] = {}
    markers = np.array(take.markers[sample_evenly(take.frame_count, MAX_COMPARED_FRAMES)])
    for m in np.flatnonzero(~np.isnan(markers[..., 0]).all(0)).tolist():
        same.setdefault(markers[:, m].tobytes(), []).append(take.labels[m])
    copies = [join_names(labels) for labels in same.values() if len(labels) > 1]
    return [f"These labels have the same samples, so all but one of them are copies: {'; '.join(copies)}."] * bool(copies)


def describe_computed_points(take: Take) -> list[str]:
    """Return a note on the points that a program computed from markers; no note without any."""
    computed = take.computed_points
    if computed is None:
        return []
    count, listed = len(computed.take.labels), join_names(computed.take.labels)
    what = "1 point of the file is" if count == 1 else f"{count} points of the file are"
    updated = int(computed.updated_counts.sum())
    outcome = f"{updated:,} of their samples were computed from the cleaned markers" if updated else "they are unchanged"
    return [f"{what} computed from markers and no evidence of where markers are ({listed}): {outcome}."]


def describe_rigid_groups(groups: Sequence[RigidGroupEntry], *, has_body: bool) -> list[str]:
    """Return a note on the rigid groups of markers that are not on the body; no note without any."""
    if not groups:
        return []
    listed = [f"{group['name']} ({format_name_list(group['markers'], MAX_LISTED_GROUP_LABELS)})" for group in groups]
    while len(listed) > 1 and len("; ".join(listed)) > MAX_GROUPS_LENGTH:
        listed.pop()
    more = f" and {len(groups) - len(listed):,} more" if len(groups) > len(listed) else ""
    what = "Rigid groups outside the skeleton, such as props" if has_body else "Rigid groups, such as props or the head"
    return [f"{what}, whose gaps are filled from their shape: {'; '.join(listed)}{more}."]


def describe_uncertain_fills(cleaned_take: Take, terms: PointTerms = MARKER_TERMS) -> list[str]:
    """Return a note on fills with a large predicted standard deviation; no note without any."""
    if cleaned_take.sample_sd is None or not (uncertain := cleaned_take.sample_sd > MAX_RELIABLE_FILL_SD_M).any():
        return []
    order = [m for m in np.argsort(-uncertain.sum(0), kind="stable") if uncertain[:, m].any()]
    labels = format_name_list([cleaned_take.labels[m] for m in order])
    limit = f"a predicted error above {compute_distance_error_mm(np.array([MAX_RELIABLE_FILL_SD_M])):.0f} mm"
    return [f"{uncertain.sum()} filled {terms.samples} are unreliable, with {limit}: {labels}."]


def _format_mm(distance_m: float) -> str:
    return f"{distance_m * 1e3:.0f} mm"
