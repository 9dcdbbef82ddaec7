"""Stick figures of one frame, before and after, as SVG: seen from where the body faces, from one side and a little above."""

from dataclasses import dataclass
from html import escape

import numpy as np

from mocapfix.report.comparison import CleaningComparison
from mocapfix.report.sample_states import (
    SAMPLE_EMPTY,
    SAMPLE_RELABELLED,
    SAMPLE_STATE_NAMES,
    classify_input_samples,
    find_estimated_samples,
)
from mocapfix.report.terms import use_joint_terms
from mocapfix.skeleton import Skeleton

VIEW_YAW_RAD, VIEW_PITCH_RAD = np.radians(25), np.radians(8)
STICK_FIGURE_MARGIN_M = 0.12  # metres around the body
MAX_DRAWN_STRAY_DISTANCE_M = 0.4  # metres off the body up to which a faulty marker still widens the picture
FLOOR_TILE_SIZE_M, FLOOR_TILES_PER_SIDE = 0.5, 2  # metres: the floor's tiles, and how many on each side of the body


def find_worst_frame(sample_states: np.ndarray, joint_position_world: np.ndarray | None) -> int:
    """-> the index of the frame with most markers mended or relabelled, or else most empty, of those in which there is a body.

    state (T, M) as states.states gives it; joints (T, J, 3). Among equals it is the one in the middle.
    """
    score = (find_estimated_samples(sample_states) | (sample_states == SAMPLE_RELABELLED)).sum(axis=1) * (
        sample_states.shape[1] + 1
    ) + (sample_states == SAMPLE_EMPTY).sum(axis=1)
    if joint_position_world is not None:
        score = np.where(np.isfinite(joint_position_world).all(axis=(1, 2)), score, -1)
    worst = np.flatnonzero(score == score.max())
    return int(worst[len(worst) // 2])


def draw_stick_figures(comparison: CleaningComparison, frame: int) -> tuple[str, str]:
    """-> two SVG pictures on one scale: the markers as they were, and the body with the markers as they are.

    Without skeleton and joints, and where no joint is known in this frame, there are markers only.
    """
    before, after, skeleton, joints = (
        comparison.input_take,
        comparison.cleaned_take,
        comparison.skeleton,
        comparison.joint_position_world,
    )
    state = comparison.sample_states[frame]
    was = classify_input_samples(before.visible[frame], state)
    body = joints[frame] if joints is not None else np.empty((0, 3))
    body = body if np.isfinite(body).all() else np.empty((0, 3))
    across = (
        _find_left_direction(skeleton, body)
        if skeleton is not None and len(body)
        else _find_widest_direction(after.markers[frame])
    )
    picture = _fit_view(before.markers[frame], after.markers[frame], body, across)
    floor = picture.draw_floor()
    bones = picture.draw_bones(skeleton, body) if skeleton is not None and len(body) else ""
    shown = use_joint_terms("the markers", before)
    return (
        picture.render_svg(floor + picture.draw_markers(before.markers[frame], was, before.labels), f"{shown} before"),
        picture.render_svg(floor + bones + picture.draw_markers(after.markers[frame], state, after.labels), f"{shown} after"),
    )


@dataclass(frozen=True)
class _FigureView:
    """How a frame is drawn: centimetres on paper, y down.

    axes    (3, 3) rows: right, up and towards the viewer, in the world
    ground  (3,) metres: a point on the floor under the body
    box     left, top, width and height in centimetres
    """

    axes: np.ndarray
    ground_position_world: np.ndarray
    box_cm: tuple[float, float, float, float]

    def project_points(self, points: np.ndarray) -> np.ndarray:
        """(..., 3) metres -> (..., 3) centimetres right, down and towards the viewer."""
        return (points @ self.axes.T) * [100, -100, 100]

    def render_svg(self, content: str, name: str) -> str:
        box = " ".join(f"{side:.1f}" for side in self.box_cm)
        return f'<svg class="figure" viewBox="{box}" role="img" aria-label="{name}">{content}</svg>'

    def draw_floor(self) -> str:
        steps, far = (
            np.arange(-FLOOR_TILES_PER_SIDE, FLOOR_TILES_PER_SIDE + 1) * FLOOR_TILE_SIZE_M,
            FLOOR_TILES_PER_SIDE * FLOOR_TILE_SIZE_M,
        )
        ends = [[(s, 0, -far), (s, 0, far)] for s in steps] + [[(-far, 0, s), (far, 0, s)] for s in steps]
        return _draw_lines("floor", self.project_points(self.ground_position_world + np.array(ends)))

    def draw_bones(self, skeleton: Skeleton, joint_position: np.ndarray) -> str:
        child = np.flatnonzero(skeleton.parents >= 0)
        return _draw_lines(
            "bones", self.project_points(np.stack([joint_position[skeleton.parents[child]], joint_position[child]], axis=1))
        )

    def draw_markers(self, marker_position: np.ndarray, sample_states: np.ndarray, labels: tuple[str, ...]) -> str:
        """Circles, the farthest first, so that near ones cover them; markers that are not there are left out."""
        placed = self.project_points(marker_position)
        return "".join(
            f'<circle class="{SAMPLE_STATE_NAMES[sample_states[m]]}" cx="{placed[m, 0]:.1f}" cy="{placed[m, 1]:.1f}" r="2">'
            f"<title>{escape(labels[m])}: {SAMPLE_STATE_NAMES[sample_states[m]]}</title></circle>"
            for m in np.argsort(placed[:, 2])
            if np.isfinite(placed[m]).all()
        )


def _draw_lines(name: str, lines: np.ndarray) -> str:
    """lines (N, 2, 3) centimetres -> one SVG path of that class."""
    return f'<path class="{name}" d="{"".join(f"M{a[0]:.1f} {a[1]:.1f}L{b[0]:.1f} {b[1]:.1f}" for a, b in lines)}"/>'


def _fit_view(
    input_position: np.ndarray, cleaned_position: np.ndarray, joint_position: np.ndarray, left_direction: np.ndarray
) -> _FigureView:
    """-> the picture that holds markers (M, 3) and body (J, 3); `across` (3,) is level and shall lie left to right in it."""
    up = np.array([0.0, 1.0, 0.0])
    front = np.cross(left_direction, up)
    right, towards = (
        left_direction * np.cos(VIEW_YAW_RAD) - front * np.sin(VIEW_YAW_RAD),
        front * np.cos(VIEW_YAW_RAD) + left_direction * np.sin(VIEW_YAW_RAD),
    )
    axes = np.stack(
        [
            right,
            up * np.cos(VIEW_PITCH_RAD) - towards * np.sin(VIEW_PITCH_RAD),
            towards * np.cos(VIEW_PITCH_RAD) + up * np.sin(VIEW_PITCH_RAD),
        ]
    )
    points = np.concatenate([cleaned_position, joint_position])
    points = points[np.isfinite(points).all(axis=1)]
    points = points if len(points) else np.zeros((1, 3))
    low, high = points.min(axis=0), points.max(axis=0)
    ground = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    stray = np.clip(
        input_position[np.isfinite(input_position).all(axis=1)],
        low - MAX_DRAWN_STRAY_DISTANCE_M,
        high + MAX_DRAWN_STRAY_DISTANCE_M,
    )
    picture = _FigureView(axes, ground, (0, 0, 0, 0))
    flat = picture.project_points(np.concatenate([points, stray]))[:, :2]
    (left, top), (width, height) = (
        flat.min(axis=0) - 100 * STICK_FIGURE_MARGIN_M,
        np.ptp(flat, axis=0) + 200 * STICK_FIGURE_MARGIN_M,
    )
    return _FigureView(axes, ground, (left, top, width, height))


def _find_left_direction(skeleton: Skeleton, joint_position: np.ndarray) -> np.ndarray:
    """-> (3,) the level direction to the body's left, which is +X in its rest pose."""
    across = skeleton.rest_positions[:, 0]
    return _project_to_floor((across - across.mean()) @ joint_position)


def _find_widest_direction(points: np.ndarray) -> np.ndarray:
    """-> (3,) the level direction in which points (N, 3), some NaN, are spread most."""
    points = points[np.isfinite(points).all(axis=1)][:, [0, 2]]
    if len(points) < 2:
        return np.array([1.0, 0.0, 0.0])
    x, z = np.linalg.svd(points - points.mean(axis=0))[2][0]
    return _project_to_floor(np.array([x, 0.0, z]))


def _project_to_floor(direction: np.ndarray) -> np.ndarray:
    direction = direction * [1, 0, 1]
    length = np.linalg.norm(direction)
    return direction / length if length > 1e-9 else np.array([1.0, 0.0, 0.0])
