"""Stick figures of one frame, before and after, as SVG: seen from where the body faces, from one side and a little above."""

from dataclasses import dataclass
from html import escape

import numpy as np

from mocapfix.show.cleaning import Cleaning
from mocapfix.show.states import EMPTY, RELABELLED, STATES, former, mended
from mocapfix.skeleton import Skeleton
from mocapfix.words import worded

TURN, TILT = np.radians(25), np.radians(8)
MARGIN = 0.12  # metres around the body
STRAY = 0.4  # metres off the body up to which a faulty marker still widens the picture
TILE, TILES = 0.5, 2  # metres: the floor's tiles, and how many on each side of the body


def worst_frame(state: np.ndarray, joints: np.ndarray | None) -> int:
    """-> the index of the frame with most markers mended or relabelled, or else most empty, of those in which there is a body.

    state (T, M) as states.states gives it; joints (T, J, 3). Among equals it is the one in the middle.
    """
    score = (mended(state) | (state == RELABELLED)).sum(axis=1) * (state.shape[1] + 1) + (state == EMPTY).sum(axis=1)
    if joints is not None:
        score = np.where(np.isfinite(joints).all(axis=(1, 2)), score, -1)
    worst = np.flatnonzero(score == score.max())
    return int(worst[len(worst) // 2])


def stick_figures(cleaning: Cleaning, frame: int) -> tuple[str, str]:
    """-> two SVG pictures on one scale: the markers as they were, and the body with the markers as they are.

    Without skeleton and joints, and where no joint is known in this frame, there are markers only.
    """
    before, after, skeleton, joints = cleaning.before, cleaning.after, cleaning.skeleton, cleaning.joints
    state = cleaning.state[frame]
    was = former(before.seen[frame], state)
    body = joints[frame] if joints is not None else np.empty((0, 3))
    body = body if np.isfinite(body).all() else np.empty((0, 3))
    across = _left(skeleton, body) if skeleton is not None and len(body) else _widest(after.markers[frame])
    picture = _picture(before.markers[frame], after.markers[frame], body, across)
    floor = picture.floor()
    bones = picture.bones(skeleton, body) if skeleton is not None and len(body) else ""
    shown = worded("the markers", before)
    return (
        picture.svg(floor + picture.markers(before.markers[frame], was, before.labels), f"{shown} before"),
        picture.svg(floor + bones + picture.markers(after.markers[frame], state, after.labels), f"{shown} after"),
    )


@dataclass(frozen=True)
class _Picture:
    """How a frame is drawn: centimetres on paper, y down.

    axes    (3, 3) rows: right, up and towards the viewer, in the world
    ground  (3,) metres: a point on the floor under the body
    box     left, top, width and height in centimetres
    """

    axes: np.ndarray
    ground: np.ndarray
    box: tuple[float, float, float, float]

    def place(self, points: np.ndarray) -> np.ndarray:
        """(..., 3) metres -> (..., 3) centimetres right, down and towards the viewer."""
        return (points @ self.axes.T) * [100, -100, 100]

    def svg(self, content: str, name: str) -> str:
        box = " ".join(f"{side:.1f}" for side in self.box)
        return f'<svg class="figure" viewBox="{box}" role="img" aria-label="{name}">{content}</svg>'

    def floor(self) -> str:
        steps, far = np.arange(-TILES, TILES + 1) * TILE, TILES * TILE
        ends = [[(s, 0, -far), (s, 0, far)] for s in steps] + [[(-far, 0, s), (far, 0, s)] for s in steps]
        return _path("floor", self.place(self.ground + np.array(ends)))

    def bones(self, skeleton: Skeleton, joints: np.ndarray) -> str:
        child = np.flatnonzero(skeleton.parents >= 0)
        return _path("bones", self.place(np.stack([joints[skeleton.parents[child]], joints[child]], axis=1)))

    def markers(self, points: np.ndarray, state: np.ndarray, labels: tuple[str, ...]) -> str:
        """Circles, the farthest first, so that near ones cover them; markers that are not there are left out."""
        placed = self.place(points)
        return "".join(
            f'<circle class="{STATES[state[m]]}" cx="{placed[m, 0]:.1f}" cy="{placed[m, 1]:.1f}" r="2">'
            f"<title>{escape(labels[m])}: {STATES[state[m]]}</title></circle>"
            for m in np.argsort(placed[:, 2])
            if np.isfinite(placed[m]).all()
        )


def _path(name: str, lines: np.ndarray) -> str:
    """lines (N, 2, 3) centimetres -> one SVG path of that class."""
    return f'<path class="{name}" d="{"".join(f"M{a[0]:.1f} {a[1]:.1f}L{b[0]:.1f} {b[1]:.1f}" for a, b in lines)}"/>'


def _picture(before: np.ndarray, after: np.ndarray, body: np.ndarray, across: np.ndarray) -> _Picture:
    """-> the picture that holds markers (M, 3) and body (J, 3); `across` (3,) is level and shall lie left to right in it."""
    up = np.array([0.0, 1.0, 0.0])
    front = np.cross(across, up)
    right, towards = across * np.cos(TURN) - front * np.sin(TURN), front * np.cos(TURN) + across * np.sin(TURN)
    axes = np.stack([right, up * np.cos(TILT) - towards * np.sin(TILT), towards * np.cos(TILT) + up * np.sin(TILT)])
    points = np.concatenate([after, body])
    points = points[np.isfinite(points).all(axis=1)]
    points = points if len(points) else np.zeros((1, 3))
    low, high = points.min(axis=0), points.max(axis=0)
    ground = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    stray = np.clip(before[np.isfinite(before).all(axis=1)], low - STRAY, high + STRAY)
    picture = _Picture(axes, ground, (0, 0, 0, 0))
    flat = picture.place(np.concatenate([points, stray]))[:, :2]
    (left, top), (width, height) = flat.min(axis=0) - 100 * MARGIN, np.ptp(flat, axis=0) + 200 * MARGIN
    return _Picture(axes, ground, (left, top, width, height))


def _left(skeleton: Skeleton, joints: np.ndarray) -> np.ndarray:
    """-> (3,) the level direction to the body's left, which is +X in its rest pose."""
    across = skeleton.resting[:, 0]
    return _level((across - across.mean()) @ joints)


def _widest(points: np.ndarray) -> np.ndarray:
    """-> (3,) the level direction in which points (N, 3), some NaN, are spread most."""
    points = points[np.isfinite(points).all(axis=1)][:, [0, 2]]
    if len(points) < 2:
        return np.array([1.0, 0.0, 0.0])
    x, z = np.linalg.svd(points - points.mean(axis=0))[2][0]
    return _level(np.array([x, 0.0, z]))


def _level(direction: np.ndarray) -> np.ndarray:
    direction = direction * [1, 0, 1]
    length = np.linalg.norm(direction)
    return direction / length if length > 1e-9 else np.array([1.0, 0.0, 0.0])
