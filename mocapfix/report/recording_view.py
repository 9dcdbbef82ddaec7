"""The view saved in the recording: the body in the picture throughout, what became of its markers beside it."""

import numpy as np

from mocapfix.report.terms import use_joint_terms
from mocapfix.take import Take

FIELD_OF_VIEW_RAD = np.radians(55)  # rerun's field of view, from bottom to top
MAX_CAMERA_FRAMES = 1000  # frames that are looked at to find the eye's place, at most
CAMERA_MARGIN_FACTOR = 1.12  # around the body at the picture's edges
RESIDUAL_CLIP_FACTOR = 3.0  # times the errors' 95th percentile is the top of their plot: a spike would hide the rest


def build_blueprint(input_take: Take, cleaned_take: Take, joint_position_world: np.ndarray | None, residual_m: np.ndarray | None):
    """-> rerun's blueprint for the recording of comparison.comparison, with joints (T, J, 3) and error (T, M) in metres."""
    import rerun.blueprint as rrb

    position, target = _compute_eye_position(
        cleaned_take.markers
        if joint_position_world is None
        else np.concatenate([cleaned_take.markers, joint_position_world], axis=1)
    )
    eye = rrb.EyeControls3D(position=position, look_target=target, eye_up=(0, 1, 0))
    body = rrb.Spatial3DView(origin="world", name=f"{input_take.name}: before and after", eye_controls=eye)
    legend = rrb.PlotLegend(rrb.Corner2D.RightTop)
    plots = [
        rrb.StateTimelineView(origin="state", name=use_joint_terms("What became of the markers", input_take)),
        rrb.TimeSeriesView(origin="missing", name=use_joint_terms("Markers missing", input_take), plot_legend=legend),
    ]
    if residual_m is not None and np.isfinite(residual_m).any():
        top = RESIDUAL_CLIP_FACTOR * 1e3 * float(np.nanpercentile(residual_m, 95))
        axis = rrb.ScalarAxis(range=(0, top), zoom_lock=False)
        plots.append(rrb.TimeSeriesView(origin="error", name="Farthest from the body, mm", axis_y=axis, plot_legend=legend))
    beside = rrb.Vertical(*plots, row_shares=[3, 1, 2][: len(plots)])
    time = rrb.TimePanel(timeline="time", state="collapsed", play_state="paused")
    return rrb.Blueprint(rrb.Horizontal(body, beside, column_shares=[3, 2]), time, collapse_panels=True)


def _compute_eye_position(position_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> eye and target (3,) metres from which all of the points (T, N, 3) are in a picture at least as wide as high.

    It looks across the way the body goes, a little from above.
    """
    position_world = position_world[:: -(-len(position_world) // MAX_CAMERA_FRAMES)]
    position_world = position_world[np.isfinite(position_world).all(axis=-1)]
    if not len(position_world):
        return np.array([0.0, 1.5, 4.0]), np.array([0.0, 1.0, 0.0])
    target = (position_world.min(axis=0) + position_world.max(axis=0)) / 2
    x, _, z = np.ptp(position_world, axis=0)
    towards = np.array([0.35, 0.3, 1.0]) if x >= z else np.array([1.0, 0.3, 0.35])
    towards /= np.linalg.norm(towards)
    across = np.cross([0.0, 1.0, 0.0], towards)
    across /= np.linalg.norm(across)
    seen = (position_world - target) @ np.stack([across, np.cross(towards, across), towards], axis=1)
    distance = (seen[:, 2] + CAMERA_MARGIN_FACTOR * np.abs(seen[:, :2]).max(axis=1) / np.tan(FIELD_OF_VIEW_RAD / 2)).max()
    return target + distance * towards, target
