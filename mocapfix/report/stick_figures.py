"""SVG stick figures of a moment, before and after cleaning, in front of the body, from one side and slightly above."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from markupsafe import Markup

from mocapfix.hands.finger_markers import SIDES
from mocapfix.hands.hand_model import HAND_JOINTS, JOINTS_PER_RAY, RAYS, TIP_JOINTS
from mocapfix.hands.solve_hands import HandMotion
from mocapfix.model.skeleton import Skeleton
from mocapfix.model.windows import join_columns
from mocapfix.report.sample_states import CleaningComparison, SampleOutcome, classify_input_samples

VIEW_YAW_RAD = np.radians(25)
VIEW_PITCH_RAD = np.radians(8)
STICK_FIGURE_MARGIN_M, HAND_MARGIN_M = 0.12, 0.02  # around the body and an enlarged hand
HAND_POINTS = "Wrist of the hand"  # name of the first of a hand's points, after its side
MAX_DRAWN_STRAY_DISTANCE_M = 0.4  # distance from the body up to which faulty markers enlarge the picture
FLOOR_TILE_SIZE_M = 0.5
FLOOR_TILES_PER_SIDE = 2  # on each side of the body
CM_PER_M = 100
MAX_DRAWN_MARKERS = 200  # of one state, in pictures of the session page and in a moving figure
MOVING_REACH_S = 1.0  # played before and after the worst moment
MAX_MOVING_RATE_HZ = 30.0  # of the frames that are played
MIN_DIRECTION_LENGTH = 1e-9  # shorter level directions are replaced by the world's X axis


def build_moving_figures(
    comparison: CleaningComparison, frame: int, chosen: Sequence[str]
) -> tuple[Markup, Markup, dict[str, Any]]:
    """Return pictures of a frame before and after cleaning, with rings around the chosen markers, and what is played in them.

    That is the frames up to MOVING_REACH_S before and after: their rate, their numbers in the file, for each the SVG paths of
    both pictures by CSS class, and the index of the one that is shown first.
    """
    before, after, joints = comparison.input_take, comparison.cleaned_take, comparison.joint_position_world
    step, reach = max(1, round(after.rate / MAX_MOVING_RATE_HZ)), round(MOVING_REACH_S * after.rate)
    frames = list(range(frame - min(frame, reach) // step * step, min(after.frame_count, frame + reach + 1), step))
    view, ring = fit_figure_view(comparison, frame, select_shown_body(comparison, frame)), np.isin(after.labels, chosen)
    shown = np.concatenate([after.markers[frames], *([] if joints is None else [joints[frames]])], axis=1).reshape(-1, 3)
    view = view.fit_points(shown) if np.isfinite(shown).any() else view
    paths: list[list[dict[str, str]]] = []
    for t in frames:
        states, rings = (
            comparison.sample_states[t],
            (_join_dots(view.project_known(x.markers[t, ring]), 1) for x in (before, after)),
        )
        marks = trace_markers(view, before.markers[t], classify_input_samples(before.visible[t], states))
        bones = {"bones": trace_bones(view, comparison, t)}
        traces = ({"bones": ""} | marks, bones | trace_markers(view, after.markers[t], states))
        paths.append([{"ring": each} | trace for each, trace in zip(rings, traces, strict=True)])
    contents = ("".join(f'<path class="{k}" d="{path}"/>' for k, path in each.items()) for each in paths[frames.index(frame)])
    one, other = (view.render_svg(view.draw_floor() + each, comparison.terms.points) for each in contents)
    numbers = [after.get_frame_number(t) for t in frames]
    return one, other, {"rate": after.rate / step, "numbers": numbers, "paths": paths, "index": frames.index(frame)}


def add_hand_points(
    skeleton: Skeleton, joints: Float[np.ndarray, "T J 3"], hands: Sequence[HandMotion]
) -> tuple[Skeleton, Float[np.ndarray, "T N 3"]]:
    """Return a body with the wrists, joints and tips of its hands as joints, and their positions in metres in the world."""
    names, parents, places, bones = list(skeleton.names), skeleton.parents.tolist(), [joints], np.arange(len(HAND_JOINTS))
    for model, hand in ((hand.hand.model, hand) for hand in hands):
        first, carrier = len(names) + 1, skeleton.find_joint(f"{model.side}Hand")
        inner = np.where(bones % JOINTS_PER_RAY, first + bones - 1, first - 1)
        parents += [carrier, *inner.tolist(), *(first + bones[JOINTS_PER_RAY - 1 :: JOINTS_PER_RAY]).tolist()]
        names += [f"{model.side}{HAND_POINTS}", *(f"{name} of the hand" for name in (*model.joint_names, *model.tip_names))]
        places += [hand.palm_position[:, None], hand.point_positions]
    more = np.zeros((len(names) - len(skeleton.names), 3))
    offsets, ends = (np.concatenate([each, more + fill]) for each, fill in ((skeleton.offsets, 0.0), (skeleton.ends, np.nan)))
    return Skeleton(tuple(names), np.array(parents), offsets, ends), join_columns(places)


def build_hand_figures(comparison: CleaningComparison, frame: int) -> list[tuple[Markup, str, str]]:
    """Return enlarged pictures of the hands in a frame, from the back of each, with the bends at the joints of the fingers."""
    found, skeleton, joints = list[tuple[Markup, str, str]](), comparison.skeleton, comparison.joint_position_world
    if skeleton is None or joints is None or not len(joints):
        return []
    for side in (each for each in SIDES if f"{each}{HAND_POINTS}" in skeleton.names):
        first = skeleton.find_joint(f"{side}{HAND_POINTS}")
        wrist, *points = joints[frame, first : first + 1 + len(HAND_JOINTS) + len(TIP_JOINTS)]
        rays = np.array([[wrist, *points[3 * k : 3 * k + 3], points[len(HAND_JOINTS) + k]] for k in range(len(RAYS))])
        vectors = np.diff(rays, axis=1)
        vectors /= np.linalg.norm(vectors, axis=2, keepdims=True)
        bends = np.degrees(np.arccos(np.clip((vectors[:, 1:] * vectors[:, :-1]).sum(2), -1, 1)))
        up, right = vectors[2, 0], (rays[1, 1] - rays[4, 1]) * (1 if side == "Left" else -1)
        right = right - up * (right @ up)
        right /= np.linalg.norm(right)
        view = FigureView(np.stack([right, up, np.cross(right, up)]), wrist, (0.0, 0.0, 0.0, 0.0))
        view = view.fit_points(rays.reshape(-1, 3), HAND_MARGIN_M)
        lines = view.project_points(np.stack([rays[:, :-1], rays[:, 1:]], axis=2)).reshape(-1, 2, 3)
        path = f'<path class="bones" style="stroke-width: .8" d="{_join_lines(lines, 2)}"/>'
        text = "; ".join(f"{ray} {', '.join(f'{x:.0f}' for x in each)}" for ray, each in zip(RAYS, bends, strict=True))
        found.append((view.render_svg(path, f"{side} hand"), f"{side} hand:", text))
    return found


def trace_markers(
    view: "FigureView", position_world: Float[np.ndarray, "M 3"], sample_states: Int[np.ndarray, " M"], digits: int = 1
) -> dict[str, str]:
    """Return the SVG paths of the visible markers by the label of their state."""
    points = {each.label: view.project_known(position_world[sample_states == each]) for each in SampleOutcome}
    return {label: _join_dots(each, digits) for label, each in points.items()}


def trace_bones(view: "FigureView", comparison: CleaningComparison, frame: int, digits: int = 1) -> str:
    """Return the SVG path of the known bones of the body that a picture of a frame shows."""
    body, skeleton = select_shown_body(comparison, frame), comparison.skeleton
    if skeleton is None or not len(body):
        return ""
    child = np.flatnonzero(skeleton.parents >= 0)
    ends = np.stack([body[skeleton.parents[child]], body[child]], axis=1)
    return _join_lines(view.project_points(ends[np.isfinite(ends).all(axis=(1, 2))]), digits)


def select_shown_body(comparison: CleaningComparison, frame: int) -> Float[np.ndarray, "J 3"]:
    """Return the joint positions in metres of the body that a picture of a frame shows, (0, 3) if a solved joint is unknown."""
    joints = comparison.joint_position_world
    is_known = joints is not None and np.isnan(joints[:, np.isnan(joints[frame, :, 0]), 0]).all()
    return joints[frame] if joints is not None and is_known else np.empty((0, 3))


@dataclass(frozen=True)
class FigureView:
    """Orthographic view of one frame, in centimetres with y down."""

    rotation_view_world: Float[np.ndarray, "3 3"]  # rows: right, up and towards the viewer
    ground_position_world: Float[np.ndarray, " 3"]  # m: point on the floor below the body
    box_cm: tuple[float, float, float, float]  # left, top, width and height

    def project_points(self, position_world: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Project points in metres to centimetres: right, down and towards the viewer."""
        return (position_world @ self.rotation_view_world.T) * [CM_PER_M, -CM_PER_M, CM_PER_M]

    def project_known(self, position_world: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "n 3"]:
        """Project those points that are known."""
        return self.project_points(position_world[np.isfinite(position_world).all(axis=1)])

    def fit_points(self, position_world: Float[np.ndarray, "N 3"], margin_m: float = STICK_FIGURE_MARGIN_M) -> "FigureView":
        """Return the view whose picture contains those points that are known."""
        points, margin_cm = self.project_known(position_world)[:, :2], CM_PER_M * margin_m
        (left, top), (width, height) = points.min(axis=0) - margin_cm, np.ptp(points, axis=0) + 2 * margin_cm
        return replace(self, box_cm=(float(left), float(top), float(width), float(height)))

    def render_svg(self, content: str, name: str) -> Markup:
        box = " ".join(f"{side:.1f}" for side in self.box_cm)
        return Markup(f'<svg class="figure" viewBox="{box}" role="img" aria-label="{name}">{content}</svg>')

    def draw_floor(self) -> str:
        steps = np.arange(-FLOOR_TILES_PER_SIDE, FLOOR_TILES_PER_SIDE + 1) * FLOOR_TILE_SIZE_M
        end = FLOOR_TILES_PER_SIDE * FLOOR_TILE_SIZE_M
        lines = [[(s, 0, -end), (s, 0, end)] for s in steps] + [[(-end, 0, s), (end, 0, s)] for s in steps]
        path = _join_lines(self.project_points(self.ground_position_world + np.array(lines)), 1)
        return f'<path class="floor" d="{path}"/>'


def _join_lines(lines_cm: Float[np.ndarray, "N 2 3"], digits: int) -> str:
    return "".join(f"M{a[0]:.{digits}f} {a[1]:.{digits}f}L{b[0]:.{digits}f} {b[1]:.{digits}f}" for a, b in lines_cm)


def _join_dots(points_cm: Float[np.ndarray, "N 3"], digits: int) -> str:
    """Return the SVG path of dots: lines without length, which have round ends."""
    return "".join(f"M{x:.{digits}f} {y:.{digits}f}h0" for x, y, _ in points_cm[:MAX_DRAWN_MARKERS])


def fit_figure_view(comparison: CleaningComparison, frame: int, joint_position: Float[np.ndarray, "J 3"]) -> FigureView:
    """Return the view that contains all markers of a frame, before and after cleaning, and the joints of the body."""
    input_position, cleaned_position = comparison.input_take.markers[frame], comparison.cleaned_take.markers[frame]
    left_direction = _find_widest_direction(cleaned_position)  # to the right side of the picture
    if comparison.skeleton is not None and len(joint_position):  # +X in the rest pose, by the regression of the joints on it
        known = np.isfinite(joint_position).all(axis=1)
        lateral = comparison.skeleton.rest_positions[known, 0]
        left_direction = _project_to_floor((lateral - lateral.mean()) @ joint_position[known])
    up = np.array([0.0, 1.0, 0.0])
    front = np.cross(left_direction, up)
    right = left_direction * np.cos(VIEW_YAW_RAD) - front * np.sin(VIEW_YAW_RAD)
    towards = front * np.cos(VIEW_YAW_RAD) + left_direction * np.sin(VIEW_YAW_RAD)
    tilted_up = up * np.cos(VIEW_PITCH_RAD) - towards * np.sin(VIEW_PITCH_RAD)
    tilted_towards = towards * np.cos(VIEW_PITCH_RAD) + up * np.sin(VIEW_PITCH_RAD)
    axes = np.stack([right, tilted_up, tilted_towards])
    points = np.concatenate([cleaned_position, joint_position])
    points = points[np.isfinite(points).all(axis=1)]
    points = points if len(points) else np.zeros((1, 3))
    low, high = points.min(axis=0), points.max(axis=0)
    ground = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    stray = input_position[np.isfinite(input_position).all(axis=1)]
    stray = np.clip(stray, low - MAX_DRAWN_STRAY_DISTANCE_M, high + MAX_DRAWN_STRAY_DISTANCE_M)
    return FigureView(axes, ground, (0.0, 0.0, 0.0, 0.0)).fit_points(np.concatenate([points, stray]))


def _find_widest_direction(position: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " 3"]:
    """Return the level direction of the largest spread of points; NaN points are ignored."""
    level = position[np.isfinite(position).all(axis=1)][:, [0, 2]]
    if len(level) < 2:
        return np.array([1.0, 0.0, 0.0])
    x, z = np.linalg.svd(level - level.mean(axis=0))[2][0]
    return _project_to_floor(np.array([x, 0.0, z]))


def _project_to_floor(direction: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """Return the level unit vector of a direction, the world's X axis for vertical ones."""
    direction = direction * [1, 0, 1]
    length = np.linalg.norm(direction)
    return direction / length if length > MIN_DIRECTION_LENGTH else np.array([1.0, 0.0, 0.0])
