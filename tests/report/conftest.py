"""A comparison whose every sample is known: a body in its T-pose moves along Z, and its markers have faults of many kinds."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mocapfix.labels.fragments import join_fragments
from mocapfix.labels.label_swaps import undo_label_exchanges
from mocapfix.model import changes
from mocapfix.model.changes import serialize_changes
from mocapfix.model.faults import Fault, Faults, Fragment, MarkerShift
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.report.report import ErrorSummary, Report
from mocapfix.report.sample_states import CleaningComparison

FRAMES, RATE, FIRST_FRAME = 240, 120.0, 101
LABELS = tuple(f"M{n:02d}" for n in range(29)) + ("<b>&\"'", "never")  # 31 markers, one on each joint


@dataclass(frozen=True)
class Scene:
    """A comparison and its JSON report."""

    comparison: CleaningComparison
    report: Report

    def replace_comparison(self, **fields: Any) -> "Scene":
        """Return the scene with other fields of the comparison."""
        return replace(self, comparison=replace(self.comparison, **fields))


@pytest.fixture
def scene() -> Scene:
    skeleton = load_cmu31_body().skeleton
    rest = np.zeros((31, 3))
    for j in range(1, 31):
        rest[j] = rest[skeleton.parents[j]] + skeleton.offsets[j]
    root = np.stack([np.zeros(FRAMES), np.full(FRAMES, 0.95), 1.2 * np.arange(FRAMES) / RATE], axis=1)
    joint_position_world = rest + root[:, None]
    true_markers = joint_position_world + [0.0, 0.0, 0.05]
    markers = true_markers.copy()
    markers[50:100, 3] = np.nan  # a filled gap
    markers[60:80, 29] = np.nan  # a gap of which the second half stays empty
    markers[70, 5] += [0.3, 0.0, 0.0]  # a replaced spike
    markers[120:140, 7] += 0.01  # an unchanged burst of jitter
    markers[:, 30] = np.nan  # a marker that is never visible
    markers[200] = np.nan  # a frame without markers, which stays empty
    markers[150:170, [10, 11]] = markers[150:170, [11, 10]]  # a label swap
    markers[210:, 20] += [0.0, 0.03, 0.0]  # a marker shift
    fragment = np.full((FRAMES, 1, 3), np.nan)
    fragment[20:40, 0], markers[20:40, 12] = true_markers[20:40, 12], np.nan  # a fragment of M12 in an unlabelled trajectory
    unlabelled = Take(fragment, ("*1<i>",), RATE, FIRST_FRAME, point_columns=np.array([31]))
    input_take = Take(
        markers, LABELS, RATE, FIRST_FRAME, Path("walk <1>.c3d"), point_columns=np.arange(31), unlabelled=unlabelled
    )
    items = (
        Fault("gap", 3, 50, 99, 0.5, "M03 is missing for 0.42 s."),
        Fault("spike", 5, 70, 70, 0.3, "M05 is 300 mm off its trajectory."),
        Fault("jitter", 7, 120, 139, 0.01, "M07 jitters."),
        Fault("gap", 29, 60, 79, 0.2, "<b> is missing."),
        Fault("swap", 10, 150, 169, 0.3, "The labels of M10 and M11 are swapped.", other_markers=(11,)),
        Fragment("fragment", 12, 20, 39, 0.0, "*1<i> continues M12.", donor=31, relation="continues"),
        MarkerShift("moved", 20, 210, FRAMES - 1, 0.03, "M20 shifts by 30 mm.", settled_frame=210),
        Fault("absent", 30, 0, FRAMES - 1, np.nan, "never is not visible in this take."),
    )
    relabelled_take = undo_label_exchanges(join_fragments(input_take, items), items)
    cleaned_markers, sample_sd = relabelled_take.markers.copy(), np.full((FRAMES, 31), np.nan)
    for samples in ((slice(50, 100), 3), (slice(60, 70), 29), (70, 5)):
        cleaned_markers[samples], sample_sd[samples] = true_markers[samples], 0.01
    cleaned_take = relabelled_take.replace_markers(cleaned_markers, sample_sd)
    faults = Faults().add_faults(items)
    methods = np.where(np.isnan(sample_sd), "", "the body").astype(object)
    made = changes.build_changes(input_take, relabelled_take, cleaned_take, faults.items, true_markers, methods)
    residual_m = np.linalg.norm(cleaned_take.markers - true_markers, axis=-1) + 0.002
    comparison = CleaningComparison(
        input_take,
        relabelled_take,
        cleaned_take,
        faults,
        tuple(change for change, _ in made),
        skeleton,
        joint_position_world,
        residual_m,
    )
    return Scene(comparison, build_scene_report(comparison))


def build_scene_report(comparison: CleaningComparison) -> Report:
    """Return the JSON report of such a take."""
    before, after = comparison.input_take, comparison.cleaned_take
    by_marker: dict[str, ErrorSummary] = {label: {"mean": 2.0 + m, "p95": 3.0 + m} for m, label in enumerate(LABELS[:-1])}
    by_marker["never"] = {"mean": None, "p95": None}
    return {
        "take": {
            "file": before.name,
            "frames": before.frame_count,
            "first_frame": before.first_frame,
            "rate_hz": before.rate,
            "markers": len(LABELS),
            "marker_set": "cmu41",
            "labels": list(LABELS),
        },
        "faults": [],
        "changes": serialize_changes(comparison.changes),
        "subject": {"marker_set": "cmu41", "frames": 120, "bones_m": {"LeftLeg": 0.418, "LHipJoint": 0.0}, "spread_m": {}},
        "solve": {
            "prior": {"name": "gaussian", "scale": 1.0},
            "marker_residual_mm": {"mean": 3.2, "p95": 7.4, "by_marker": by_marker},
            "joint_deviation_mm": {"LeftFoot": {"mean": 6.0, "p95": 9.0}, "LeftHand": {"mean": 12.0, "p95": 21.0}},
            "start": "hybrik-x",
            "iterations_mean": 4.25,
            "solved_joints": ["Hips", "LeftFoot", "LeftHand"],
            "lost_in_sight": {"left arm": 3},
            "status": {"solved: well": 200, "guessed: too few": 40},
        },
        "fill": {
            "missing_before": int((~before.visible).sum()),
            "filled": 60,
            "replaced": 1,
            "relabelled": 60,
            "left_empty": int((~after.visible).sum()),
            "unfilled": [{"marker": LABELS[29], "first": 171, "last": 180, "reason": "The <hand> was hidden."}],
            "left_by_marker": [{"marker": LABELS[29], "samples": 10, "reasons": {"The <hand> was hidden.": 10}}],
        },
        "seconds": {"read": 0.03, "total": 2.5},
        "times": {"read": {"seconds": 0.03, "processor_seconds": 0.02}},
        "notes": ["Look at M07 & its neighbours."],
    }
