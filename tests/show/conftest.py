"""A take whose truth is known to the sample: a body in its T-pose walks along Z, and four things go wrong with its markers."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from mocapfix.faults import Fault, Faults
from mocapfix.skeleton import Skeleton, cmu31
from mocapfix.take import Take

FRAMES, RATE, FIRST = 240, 120.0, 101
LABELS = tuple(f"M{n:02d}" for n in range(29)) + ("<b>&\"'", "never")  # 31 markers, one on each joint


@dataclass(frozen=True)
class Scene:
    before: Take
    after: Take
    faults: Faults
    skeleton: Skeleton
    joints: np.ndarray
    error: np.ndarray
    record: dict

    @property
    def shown(self):
        return self.before, self.after, self.faults, self.skeleton, self.joints, self.error


@pytest.fixture
def scene() -> Scene:
    skeleton = cmu31().skeleton
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
    before = Take(markers, LABELS, RATE, FIRST, Path("walk <1>.c3d"))
    mended = markers.copy()
    mended[50:100, 3], mended[60:70, 29], mended[70, 5] = truth[50:100, 3], truth[60:70, 29], truth[70, 5]
    items = (
        Fault("gap", 3, 50, 99, 0.5, "M03 is not seen for 0.42 s."),
        Fault("spike", 5, 70, 70, 0.3, "M05 lies 300 mm off its path."),
        Fault("jitter", 7, 120, 139, 0.01, "M07 trembles."),
        Fault("gap", 29, 60, 79, 0.2, "<b> is not seen."),
        Fault("absent", 30, 0, FRAMES - 1, np.nan, "never is never seen in this take."),
    )
    error = np.linalg.norm(markers - truth, axis=-1) + 0.002
    after = before.with_markers(mended)
    return Scene(before, after, Faults(items), skeleton, joints, error, record(before, after, items))


def record(before: Take, after: Take, items: tuple[Fault, ...]) -> dict:
    """The JSON report of such a take."""
    by_marker: dict = {label: {"mean": 2.0 + m, "p95": 3.0 + m} for m, label in enumerate(LABELS[:-1])}
    by_marker["never"] = {"mean": None, "p95": None}
    return {
        "take": {
            "file": before.name,
            "frames": before.frames,
            "first_frame": before.first_frame,
            "rate_hz": before.rate,
            "markers": len(LABELS),
            "marker_set": "cmu41",
            "labels": list(LABELS),
        },
        "faults": [{"kind": item.kind, "marker": LABELS[item.marker]} for item in items],
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
            "missing_before": int((~before.seen).sum()),
            "filled": 60,
            "mended": 1,
            "left_empty": int((~after.seen).sum()),
            "left": [{"marker": LABELS[29], "first": 171, "last": 180, "reason": "The <hand> was hidden."}],
        },
        "seconds": {"read": 0.03, "total": 2.5},
        "notes": ["Look at M07 & its neighbours."],
    }
