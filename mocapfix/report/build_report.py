"""The report of one subject's take, built from the state at the end of its cleaning."""

from mocapfix.options import CleanOptions
from mocapfix.report import notes, report_data, review_file
from mocapfix.report.report import Report
from mocapfix.state import CleaningState


def build_report(state: CleaningState, options: CleanOptions, stage_seconds: dict[str, float]) -> Report:
    """Return the report: what was wrong, what was changed, what stays empty, and notes for the technician."""
    assert state.cleaned_take is not None
    take, detection, body, residual_m = state.original_take, state.detection, state.body, state.residual_m
    solve, body_notes = None, list[str]()
    if body and residual_m is not None:
        solve = report_data.build_solve_section(
            take,
            body.subject,
            body.motion,
            residual_m,
            options.prior.prior,
            options.solve.prior_scale,
            options.initialise.method,
        )
        body_notes = notes.build_body_notes(detection, detection.epochs, body, residual_m)
    return {
        "take": report_data.build_take_section(take, state.marker_set.name if state.marker_set else None),
        "faults": report_data.build_fault_entries(take, detection.faults),
        "changes": review_file.serialize_changes(state.changes),
        "subject": report_data.build_subject_section(body.subject) if body else None,
        "solve": solve,
        "fill": report_data.build_fill_section(
            take, detection.take, state.cleaned_take, state.unfilled_runs, detection.donor_markers
        ),
        "seconds": stage_seconds,
        "notes": [*take.notes, *state.notes, *body_notes, *notes.describe_uncertain_fills(state.cleaned_take)],
    }
