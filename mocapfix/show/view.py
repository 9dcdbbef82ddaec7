"""The view saved in the recording: the body in the picture throughout, what became of its markers beside it."""

import numpy as np

from mocapfix.take import Take
from mocapfix.words import worded

FIELD = np.radians(55)  # rerun's field of view, from bottom to top
LOOKS = 1000  # frames that are looked at to find the eye's place, at most
ROOM = 1.12  # around the body at the picture's edges
CLIP = 3.0  # times the errors' 95th percentile is the top of their plot: a spike would hide the rest


def blueprint(before: Take, after: Take, joints: np.ndarray | None, error: np.ndarray | None):
    """-> rerun's blueprint for the recording of comparison.comparison, with joints (T, J, 3) and error (T, M) in metres."""
    import rerun.blueprint as rrb

    position, target = _eye(after.markers if joints is None else np.concatenate([after.markers, joints], axis=1))
    eye = rrb.EyeControls3D(position=position, look_target=target, eye_up=(0, 1, 0))
    body = rrb.Spatial3DView(origin="world", name=f"{before.name}: before and after", eye_controls=eye)
    legend = rrb.PlotLegend(rrb.Corner2D.RightTop)
    plots = [
        rrb.StateTimelineView(origin="state", name=worded("What became of the markers", before)),
        rrb.TimeSeriesView(origin="missing", name=worded("Markers missing", before), plot_legend=legend),
    ]
    if error is not None and np.isfinite(error).any():
        top = CLIP * 1e3 * float(np.nanpercentile(error, 95))
        axis = rrb.ScalarAxis(range=(0, top), zoom_lock=False)
        plots.append(rrb.TimeSeriesView(origin="error", name="Farthest from the body, mm", axis_y=axis, plot_legend=legend))
    beside = rrb.Vertical(*plots, row_shares=[3, 1, 2][: len(plots)])
    time = rrb.TimePanel(timeline="time", state="collapsed", play_state="paused")
    return rrb.Blueprint(rrb.Horizontal(body, beside, column_shares=[3, 2]), time, collapse_panels=True)


def _eye(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> eye and target (3,) metres from which all of the points (T, N, 3) are in a picture at least as wide as high.

    It looks across the way the body goes, a little from above.
    """
    points = points[:: -(-len(points) // LOOKS)]
    points = points[np.isfinite(points).all(axis=-1)]
    if not len(points):
        return np.array([0.0, 1.5, 4.0]), np.array([0.0, 1.0, 0.0])
    target = (points.min(axis=0) + points.max(axis=0)) / 2
    x, _, z = np.ptp(points, axis=0)
    towards = np.array([0.35, 0.3, 1.0]) if x >= z else np.array([1.0, 0.3, 0.35])
    towards /= np.linalg.norm(towards)
    across = np.cross([0.0, 1.0, 0.0], towards)
    across /= np.linalg.norm(across)
    seen = (points - target) @ np.stack([across, np.cross(towards, across), towards], axis=1)
    distance = (seen[:, 2] + ROOM * np.abs(seen[:, :2]).max(axis=1) / np.tan(FIELD / 2)).max()
    return target + distance * towards, target
