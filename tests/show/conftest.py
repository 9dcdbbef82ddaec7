"""A take whose truth is known to the sample: a body in its T-pose walks along Z, and all sorts go wrong with its markers."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from mocapfix import changes, repair
from mocapfix.faults import Fault, Faults, Fragment, MarkerShift
from mocapfix.report import CleaningComparison, review_file
from mocapfix.skeleton import load_cmu31_body
from mocapfix.take import Take

FRAMES, RATE, FIRST = 240, 120.0, 101
LABELS = tuple(f"M{n:02d}" for n in range(29)) + ("<b>&\"'", "never")  # 31 markers, one on each joint


@dataclass(frozen=True)
class Scene:
    cleaning: CleaningComparison
    record: dict

    def with_(self, **other) -> "Scene":
        """The scene with another take, other faults, and so on."""
        return replace(self, comparison=replace(self.cleaning, **other))


@pytest.fixture
def scene() -> Scene:
    skeleton = load_cmu31_body().skeleton
    rest = np.zeros((31, 3))
    for j in range(1, 31):
        rest[j] = rest[skeleton.parents[j]] + skeleton.offsets[j]
    walk = np.stack([np.zeros(FRAMES), np.full(FRAMES, 0.95), 1.2 * np.arange(FRAMES) / RATE], axis=1)
    joints = rest + walk[:, None]
    truth = joints + [0.0, 0.0, 0.05]
    markers = truth.copy()
    markers[50:100, 3] = np.nan  # a gap that is filled
    markers[60:80, 29] = np.nan  # a gap of which the second half is left
    markers[70, 5] += [0.3, 0.0, 0.0]  # a spike that is replaced
    markers[120:140, 7] += 0.01  # a burst of jitter that is kept
    markers[:, 30] = np.nan  # a marker that is never seen
    markers[200] = np.nan  # a frame without any marker, left so
    markers[150:170, [10, 11]] = markers[150:170, [11, 10]]  # two labels exchanged
    markers[210:, 20] += [0.0, 0.03, 0.0]  # a marker knocked to another place
    loose = np.full((FRAMES, 1, 3), np.nan)
    loose[20:40, 0], markers[20:40, 12] = truth[20:40, 12], np.nan  # a marker that goes on under another name
    unlabelled = Take(loose, ("*1<i>",), RATE, FIRST, point_columns=np.array([31]))
    place = {"columns": np.arange(31), "unlabelled": unlabelled}
    before = Take(markers, LABELS, RATE, FIRST, Path("walk <1>.c3d"), **place)
    items = (
        Fault("gap", 3, 50, 99, 0.5, "M03 is not seen for 0.42 s."),
        Fault("spike", 5, 70, 70, 0.3, "M05 lies 300 mm off its path."),
        Fault("jitter", 7, 120, 139, 0.01, "M07 trembles."),
        Fault("gap", 29, 60, 79, 0.2, "<b> is not seen."),
        Fault("swap", 10, 150, 169, 0.3, "M10 and M11 have exchanged their labels.", other_markers=(11,)),
        Fragment("fragment", 12, 20, 39, 0.0, "*1<i> goes on as M12.", donor=31, relation="continues"),
        MarkerShift("moved", 20, 210, FRAMES - 1, 0.03, "M20 is knocked by 30 mm.", settled_frame=210),
        Fault("absent", 30, 0, FRAMES - 1, np.nan, "never is never seen in this take."),
    )
    labelled = repair.undo_label_exchanges(repair.join_fragments(before, items), items)
    mended, sure = labelled.markers.copy(), np.full((FRAMES, 31), np.nan)
    for where in ((slice(50, 100), 3), (slice(60, 70), 29), (70, 5)):
        mended[where], sure[where] = truth[where], 0.01
    after = labelled.replace_markers(mended, sure)
    faults = Faults().add_faults(items)
    ways = np.where(np.isnan(sure), "", "the body").astype(object)
    made = tuple(change for change, _ in changes.build_changes(before, labelled, after, faults.items, truth, ways))
    error = np.linalg.norm(after.markers - truth, axis=-1) + 0.002
    shown = CleaningComparison(before, labelled, after, faults, made, skeleton, joints, error)
    return Scene(shown, record(shown))


def record(cleaning: CleaningComparison) -> dict:
    """The JSON report of such a take."""
    before, after = cleaning.input_take, cleaning.cleaned_take
    by_marker: dict = {label: {"mean": 2.0 + m, "p95": 3.0 + m} for m, label in enumerate(LABELS[:-1])}
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
        "faults": [{"kind": item.kind, "marker": before.get_label(item.marker)} for item in cleaning.faults.items],
        "changes": review_file.serialize_changes(cleaning.changes),
        "subject": {"marker_set": "cmu41", "frames": 120, "bones_m": {"LeftLeg": 0.418, "LHipJoint": 0.0}, "spread_m": {}},
        "solve": {
            "prior": {"name": "gaussian", "scale": 1.0},
            "marker_residual_mm": {"mean": 3.2, "p95": 7.4, "by_marker": by_marker},
            "joint_deviation_mm": {"LeftFoot": {"mean": 6.0, "p95": 9.0}, "LeftHand": {"mean": 12.0, "p95": 21.0}},
            "start": "hybrik-x",
            "iterations_mean": 4.25,
            "status": {"solved: well": 200, "guessed: too few": 40},
        },
        "fill": {
            "missing_before": int((~before.visible).sum()),
            "filled": 60,
            "mended": 1,
            "relabelled": 60,
            "left_empty": int((~after.visible).sum()),
            "left": [{"marker": LABELS[29], "first": 171, "last": 180, "reason": "The <hand> was hidden."}],
        },
        "seconds": {"read": 0.03, "total": 2.5},
        "notes": ["Look at M07 & its neighbours."],
    }
