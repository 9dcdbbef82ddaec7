"""Build the report of one subject's take, section by section, from what the stages of its cleaning returned.

`build_report` and `build_inspection_report` are the whole; `build_contact_section` is the section on contacts with the floor, and
`describe_contacts` its notes on what a technician must know.
"""

from collections import Counter
from collections.abc import Collection, Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from mocapfix.contacts.contacts import FOOT_JOINTS, BodyContacts, GaitEvent
from mocapfix.errors import join_words
from mocapfix.labels.label_summary import build_labelling_section
from mocapfix.model.changes import Decided, UnfilledRun, serialize_changes
from mocapfix.model.faults import Fault, Faults
from mocapfix.model.motion import FrameStatus, Motion
from mocapfix.model.stage_timer import StageTimer
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.options import FEET_OFF, NO_TRAINED_PRIOR, CleanOptions
from mocapfix.report import notes
from mocapfix.report import report as json_report
from mocapfix.report.terms import MARKER_TERMS, PointTerms
from mocapfix.solve.lost_in_sight import LostPart
from mocapfix.solve.motion_solver import PREVIEW_NOTE
from mocapfix.subject.library import SubjectChoice

STEP_TIME_RANGE_S = (0.2, 1.2)  # time between the strikes of the two feet that make a step; a longer one is a pause
MIN_CADENCE_STEPS = 4  # steps from which a cadence is computed
SOURCE_NAMES = {"force plate": "its force plate", "file": "the file", "markers": "the markers"}
MAX_FLOOR_ERROR_M = 0.03  # difference between the floor's height and the one that motion files assume above which a note names it


def build_contact_section(contacts: BodyContacts, take: Take) -> json_report.ContactSection:
    """Return the section on the contacts in a take, whose frame numbers it has."""
    floor = contacts.floor
    return {
        "floor": {
            "height_m": round(floor.height_m, 4),
            "tilt_deg": round(floor.tilt_deg, 2),
            "level_heights_m": [round(height, 4) for height in floor.level_heights_m],
        }
        if floor.level_heights_m
        else None,
        "joints": {joint: _build_joint_entry(contacts, joint) for joint in contacts.joints} if contacts.has_feet else {},
        "feet": {
            "mode": contacts.held_feet.mode,
            "largest_displacement_mm": round(contacts.held_feet.largest_displacement_m * 1e3, 2),
            "yielded_s": round(contacts.held_feet.yielded_s, 3),
        },
        "gait": build_gait_entry(contacts.events),
        "events": [_build_event_entry(event, contacts.rate, take) for event in contacts.events],
        "event_disagreements": [
            {
                **_build_event_entry(each.event, contacts.rate, take),
                "other_source": each.other.source,
                "delay_ms": round(1e3 * float(each.delay_s), 1),
            }
            for each in contacts.event_disagreements
        ],
    }


def _build_event_entry(event: GaitEvent, rate: float, take: Take) -> json_report.GaitEventEntry:
    return {
        "side": event.side,
        "event": event.kind,
        "time_s": round(float(event.time_s), 4),
        "frame": round(float(take.first_frame + event.time_s * rate), 2),
        "source": event.source,
    }


def _build_joint_entry(contacts: BodyContacts, joint: str) -> json_report.JointContactEntry:
    column = contacts.joints.index(joint)
    is_contact, is_known = contacts.is_contact[:, column], contacts.is_known[:, column]
    intervals, count = contacts.list_intervals(joint), int(is_contact.sum())
    return {
        "contacts": len(intervals),
        "seconds": round(count / contacts.rate, 3),
        "share": round(count / max(1, len(is_contact)), 4),
        "probability": round(float(contacts.probability[is_contact, column].mean()), 3) if count else None,
        "inferred": sum(not is_known[first : last + 1].all() for first, last in intervals),
        "inferred_s": round(int((is_contact & ~is_known).sum()) / contacts.rate, 3),
    }


def build_gait_entry(events: Sequence[GaitEvent]) -> json_report.GaitEntry:
    """Return the number of strikes and steps, and the cadence."""
    strikes = sorted((event for event in events if event.kind == "foot strike"), key=lambda event: event.time_s)
    shortest_s, longest_s = STEP_TIME_RANGE_S
    steps_s = [
        after.time_s - before.time_s
        for before, after in pairwise(strikes)
        if after.side != before.side and shortest_s <= after.time_s - before.time_s <= longest_s
    ]
    has_cadence = len(steps_s) >= MIN_CADENCE_STEPS
    return {
        "strikes": {side: sum(event.side == side for event in strikes) for side in FOOT_JOINTS},
        "steps": len(steps_s),
        "cadence_steps_per_min": round(60.0 / float(np.median(steps_s)), 1) if has_cadence else None,
    }


def describe_contacts(contacts: BodyContacts, requested_mode: str, floor_height_m: float, terms: PointTerms) -> list[str]:
    """Return notes on a floor that is not where it is assumed, is tilted or has levels, and on feet that are not seen."""
    if not contacts.has_feet:
        held = "" if requested_mode == FEET_OFF else f", and --feet {requested_mode} has no effect"
        return [f"The {terms.points} do not show both feet, so no contacts with the floor are detected{held}."]
    floor = contacts.floor
    if not floor.level_heights_m:
        return ["No foot stands still in this take, so no floor is detected."]
    notes: list[str] = []
    offset_m = floor.height_m - floor_height_m
    if abs(offset_m) > MAX_FLOOR_ERROR_M:
        place = f"{abs(offset_m) * 1e3:.0f} mm {'above' if offset_m > 0 else 'below'} height {floor_height_m:g} m"
        notes.append(f"The feet stand {place}; --floor {floor.height_m:.3f} writes motion files with the floor at height 0.")
    if floor.tilt_deg > 0:
        notes.append(f"The floor is tilted by {floor.tilt_deg:.1f} degrees; motion files have the same tilt.")
    if len(floor.level_heights_m) > 1:
        heights = join_words([f"{height:.2f}" for height in floor.level_heights_m])
        notes.append(f"The feet stand on {len(floor.level_heights_m)} levels, at heights of {heights} m, such as steps or boxes.")
    return notes + _describe_inferred_contacts(contacts, terms) + _describe_event_disagreements(contacts)


def _describe_inferred_contacts(contacts: BodyContacts, terms: PointTerms) -> list[str]:
    """Return a note on the contacts of feet that are inferred; no note without any."""
    joints = [joint for names in FOOT_JOINTS.values() for joint in names]
    entries = [_build_joint_entry(contacts, joint) for joint in joints]
    count, seconds = sum(entry["inferred"] for entry in entries), sum(entry["inferred_s"] for entry in entries)
    if not count:
        return []
    what = "1 contact of a heel or a ball of a foot is" if count == 1 else f"{count} contacts of heels and balls of feet are"
    return [f"{what} partly inferred: for {max(seconds, 0.01):.2f} s in all, too few {terms.points} show the foot."]


def _describe_event_disagreements(contacts: BodyContacts) -> list[str]:
    """Return a note on the events of which two sources give different times; no note without any."""
    if not contacts.event_disagreements:
        return []
    (side, kind, time_s, source), other = max(contacts.event_disagreements, key=lambda each: abs(each.delay_s))
    delay_ms, count = 1e3 * (other.time_s - time_s), len(contacts.event_disagreements)
    more = f" (and {count - 1} more in the report)" if count > 1 else ""
    when = f"{abs(delay_ms):.0f} ms {'later' if delay_ms > 0 else 'earlier'} by {SOURCE_NAMES.get(other.source, other.source)}"
    return [
        f"The {side} {kind} at {time_s:.3f} s by {SOURCE_NAMES.get(source, source)} is {when}{more}; "
        "force plates count before the file, and the file before markers."
    ]


def build_take_section(take: Take, marker_set: str | None, cleaned_take: Take | None = None) -> json_report.TakeSection:
    """Return the section on the input; `marker_set` is None if none matches, `cleaned_take` before a take is cleaned."""
    section: json_report.TakeSection = {
        "file": take.path.name if take.path else take.name,
        "frames": take.frame_count,
        "first_frame": take.first_frame,
        "rate_hz": take.rate,
        "markers": len(take.labels),
        "marker_set": marker_set,
        "labels": list(take.labels),
    }
    if take.up_axis:
        section["up_axis"] = {"axis": take.up_axis.letter, "basis": take.up_axis.basis, "certain": take.up_axis.is_certain}
    if labelling := build_labelling_section(take):
        section["labelling"] = labelling
    if take.computed_points and (computed := (cleaned_take or take).computed_points):
        section["computed_points"] = [
            {
                "label": label,
                "recognised_by": computed.evidence[c],
                "computed_from": list(computed.list_parent_labels(c, take)),
                "updated": int(computed.updated_counts[c]),
            }
            for c, label in enumerate(computed.take.labels)
        ]
    if take.subject_name:
        section["person"] = take.subject_name
    if take.point_kind == "joint":
        section["animation"] = True
    return section


def build_fault_entries(take: Take, faults: Faults) -> list[json_report.FaultEntry]:
    """Return the entries of all faults, with the labels and frame numbers of `take`."""
    return [_build_fault_entry(take, fault) for fault in faults.items]


def _build_fault_entry(take: Take, fault: Fault) -> json_report.FaultEntry:
    entry: json_report.FaultEntry = {
        "kind": fault.kind,
        "marker": take.get_label(fault.marker),
        "first": take.get_frame_number(fault.first),
        "last": take.get_frame_number(fault.last),
        "severity_m": _round_or_none(fault.severity, 5) if fault.severity_unit == "m" else None,
        "confidence": round(fault.confidence, 3),
        "reason": fault.reason,
    }
    if fault.severity_unit == "rad":
        entry["severity_deg"] = _round_or_none(float(np.degrees(fault.severity)), 2)
    return entry


def _round_or_none(value: float, digits: int) -> float | None:
    return None if np.isnan(value) else round(float(value), digits)


def build_inspection_report(
    take: Take, marker_set: str | None, fault_take: Take, faults: Faults, notes: list[str]
) -> json_report.InspectionReport:
    """Return the report of a take that was inspected only."""
    return {"take": build_take_section(take, marker_set), "faults": build_fault_entries(fault_take, faults), "notes": notes}


def build_subject_section(subject: Subject) -> json_report.SubjectSection:
    lengths, is_solved = np.linalg.norm(subject.skeleton.offsets, axis=1), subject.solved_joints
    has_length = (lengths > 0) & is_solved & is_solved[subject.skeleton.parents]
    return {
        "marker_set": subject.marker_set,
        "frames": subject.frame_count,
        "bones_m": {subject.skeleton.names[j]: round(float(lengths[j]), 4) for j in np.flatnonzero(has_length)},
        "spread_m": {label: round(float(x), 4) for label, x in zip(subject.labels, subject.marker_spread, strict=True)},
    }


def build_solve_section(
    take: Take,
    subject: Subject,
    motion: Motion,
    residual_m: Float[np.ndarray, "T M"],
    prior_name: str,
    prior_scale: float,
    start_name: str,
    *,
    lost_parts: Sequence[LostPart] = (),
) -> json_report.SolveSection:
    """Return the section on the solve."""
    compared = np.flatnonzero(~np.isnan(residual_m).all(0))
    repeated = {label for label, count in Counter(take.labels).items() if count > 1}
    names = [f"{label} #{m + 1}" if label in repeated else label for m, label in enumerate(take.labels)]
    overall = _summarise_errors(residual_m)
    joint_sd = zip(subject.skeleton.names, motion.joint_sd.T, strict=True)
    return {
        "marker_residual_mm": {
            "mean": overall["mean"],
            "p95": overall["p95"],
            "by_marker": {names[m]: _summarise_errors(residual_m[:, m]) for m in compared},
        },
        "solved_joints": [
            name for name, is_solved in zip(subject.skeleton.names, subject.solved_joints, strict=True) if is_solved
        ],
        "joint_deviation_mm": {name: _summarise_errors(sd) for name, sd in joint_sd},
        "start": start_name,
        "prior": None if prior_name == NO_TRAINED_PRIOR else {"name": prior_name, "scale": prior_scale},
        "iterations_mean": round(float(motion.iterations.mean()), 2),
        "lost_in_sight": {part.name: part.frame_count for part in lost_parts},
        "status": {FrameStatus(code).description: count for code, count in sorted(Counter(motion.status.tolist()).items())},
    }


def _summarise_errors(error_m: Float[np.ndarray, "*shape"]) -> json_report.ErrorSummary:
    """Return the mean and the 95th percentile in millimetres; NaN samples are ignored."""
    known = error_m[~np.isnan(error_m)] * 1e3
    if len(known) == 0:
        return {"mean": None, "p95": None}
    return {"mean": round(float(known.mean()), 3), "p95": round(float(np.percentile(known, 95)), 3)}


def build_fill_section(
    input_take: Take,
    relabelled_take: Take,
    cleaned_take: Take,
    unfilled_runs: Sequence[UnfilledRun],
    fragment_donors: Collection[int] = (),
) -> json_report.FillSection:
    """Return the numbers of filled, replaced, relabelled and empty samples.

    Args:
        input_take, relabelled_take, cleaned_take: The take as read, with corrected labels, and cleaned.
        fragment_donors: Markers whose samples are fragments of other markers; they are not counted.
    """
    counts = np.ones(len(input_take.labels), bool)
    counts[list(fragment_donors)] = False
    estimated = ~np.isnan(cleaned_take.estimated_sd)
    visible = relabelled_take.visible
    relabelled = cleaned_take.visible & ~estimated & (cleaned_take.source_points != input_take.source_points)
    unfilled: list[json_report.UnfilledEntry] = [
        {
            "marker": input_take.labels[run.marker],
            "first": input_take.get_frame_number(run.first),
            "last": input_take.get_frame_number(run.last),
            "reason": run.reason,
        }
        for run in unfilled_runs
        if counts[run.marker]
    ]
    reasons: dict[str, Counter[str]] = {}
    for run in unfilled:
        reasons.setdefault(run["marker"], Counter())[run["reason"]] += run["last"] - run["first"] + 1
    left: list[json_report.LeftEmptyEntry] = [
        {"marker": marker, "samples": each.total(), "reasons": dict(each.most_common())} for marker, each in reasons.items()
    ]
    return {
        "missing_before": int((~input_take.visible & counts).sum()),
        "filled": int((estimated & ~visible & counts).sum()),
        "replaced": int((estimated & visible & counts).sum()),
        "relabelled": int((relabelled & counts).sum()),
        "left_empty": sum(entry["samples"] for entry in left),
        "unfilled": unfilled,
        "left_by_marker": sorted(left, key=lambda entry: -entry["samples"]),
    }


def build_report(
    take: Take, subject: SubjectChoice, body: notes.SolvedBody | None, decided: Decided, options: CleanOptions, timer: StageTimer
) -> json_report.Report:
    """Return the report on a take as it was read: what was wrong, was changed and stays empty, and notes for the technician."""
    detected, solve, body_notes = decided.detected, None, list[str]()
    if body:
        prior, start = options.prior.name_used, options.initialise.method_used
        prior = NO_TRAINED_PRIOR if options.initialise.is_fast else prior, options.solve.prior_scale
        solve = build_solve_section(take, body.subject, body.motion, body.residual_m, *prior, start, lost_parts=body.lost_parts)
        body_notes += [PREVIEW_NOTE] * options.initialise.is_fast
        is_given = subject.subject is not None and not (subject.marker_set and subject.marker_set.point_sd)  # keypoints are noisy
        body_notes += notes.build_body_notes(detected, body, is_preview=options.initialise.is_fast, has_given_subject=is_given)
        floor_m = options.output.floor_height_m
        body_notes += describe_contacts(body.contacts, options.contacts.feet, floor_m, MARKER_TERMS)
    elif options.initialise.is_fast:
        body_notes.append(notes.NO_PREVIEW_NOTE)
    rigid_groups: list[json_report.RigidGroupEntry] = []
    for group in decided.rigid_groups:
        labels = [take.labels[m] for m in group.markers]
        rigid_groups.append({"name": group.name, "markers": labels, "spread_mm": round(group.spread_m * 1e3, 2)})
    marker_set = subject.marker_set
    report: json_report.Report = {
        "take": build_take_section(take, marker_set.name if marker_set else None, decided.take),
        "faults": build_fault_entries(take, detected.faults),
        "changes": serialize_changes(decided.changes),
        "subject": build_subject_section(body.subject) if body else None,
        "solve": solve,
        "fill": build_fill_section(take, detected.take, decided.take, decided.unfilled_runs, detected.donor_markers),
        "seconds": timer.stage_seconds,
        "times": timer.part_times,
        "notes": [
            *take.notes,
            *notes.describe_up_axis(take),
            *notes.describe_computed_points(decided.take),
            *notes.describe_frame_steps(detected.take),
            *notes.describe_copies(take),
            *subject.notes,
            *detected.notes,
            *body_notes,
            *notes.describe_rigid_groups(rigid_groups, has_body=body is not None),
            *notes.describe_uncertain_fills(decided.take),
        ],
    }
    if body and marker_set:
        if evidence := notes.find_laboratory_evidence(marker_set, body):
            report["take"]["laboratory"] = evidence
        report["contacts"] = build_contact_section(body.contacts, take)
    if rigid_groups:
        report["rigid_groups"] = rigid_groups
    return report
