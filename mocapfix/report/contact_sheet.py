"""The contact sheet: the rest pose and frames of the take in one picture, the solved body beside a character that it moves.

The meshes are drawn as they stand in the written GLB, posed by linear blend skinning; without a mesh that can be read, the bones
are drawn as sticks. The body is as tall as the character, in the same view: from the front of its pelvis and from one side,
level, so that the floor is a line.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from PIL import Image, ImageDraw, ImageFont

from mocapfix.characters.character import Character, build_bone_matrices
from mocapfix.io.gltf import GlbContent, GltfNodes, parse_glb, read_gltf_nodes
from mocapfix.io.gltf_mesh import compute_node_matrices, move_nodes, read_gltf_mesh
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton, list_path
from mocapfix.model.take import Take
from mocapfix.solve.kinematics import compute_world_poses
from mocapfix.stats.sequences import select_farthest_rows

COLUMNS, ROWS = 4, 2
MAX_FRAME_S = 0.05  # before the first frame and after the last one, a figure stays as there
TAKE_LENGTH_M = 0.5  # the whole take counts as so much difference between two poses, so that the frames are spread over it
CELL_WIDTH_PX, CELL_HEIGHT_PX, MARGIN_PX = 420, 320, 14  # the most that the figures of a cell may fill, and the space around them
TITLE_HEIGHT_PX, LABEL_HEIGHT_PX, TITLE_PX, LABEL_PX = 58, 22, 20, 14
OVERSAMPLING = 2  # the figures are drawn larger by this factor, for smooth edges
STICK_PX, DOT_PX = 3, 2  # width, and radius
MAX_COLOURS = 128  # of the picture
YAW_RAD = np.radians(25)
GAP_M = 0.15  # between the two figures of a cell
PAPER, INK, FLOOR, BODY, MARKER = (248, 249, 250), (40, 46, 54), (150, 158, 168), (47, 111, 184), (224, 140, 20)
LIGHT = np.array([-0.35, 0.55, 0.76])  # direction to the light: right, up and towards the viewer
AMBIENT, DIFFUSE, DARKEST = 0.45, 0.6, 0.16  # of the shading; a black surface is drawn with the lightness DARKEST
UP, LEVEL = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 1.0])


@dataclass(frozen=True)
class Performer:
    """The solved body as it is written, and the cleaned take."""

    skeleton: Skeleton
    motion: Motion
    rate: float  # frames per second of the motion
    start_s: float  # time of its first frame in the take
    floor_height_m: float  # height of the floor in the take; in the motion it is 0
    take: Take


class ShownFigure(NamedTuple):
    """A character that a take moves, as its written file has it."""

    character: Character
    glb: Path
    scale: float  # metres of the performer in one of the character
    start_s: float  # start_s, end_s: times of its first and last frame in the take
    end_s: float
    floor_height_m: float  # height of the floor in the take; in the file it is 0

    def locate_bones(self, times_s: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T L 2 3"]:
        """Return the ends of its bones at times of the take, as large as the performer, in metres; NaN where it has no frame."""
        content, nodes, bones = _read_figure(self.character, self.glb)
        sticks = _list_sticks(nodes, bones, bones[self.character.mapping.bones["pelvis"][0]])
        times, animation = (times_s - self.start_s).tolist(), content.document["animations"][0]
        places = compute_node_matrices(content, nodes, animation, times)[..., :3, 3][:, sticks]
        places[(times_s < self.start_s - MAX_FRAME_S) | (times_s > self.end_s + MAX_FRAME_S)] = np.nan
        return self.scale * places + self.floor_height_m * UP


class ContactSheet(NamedTuple):
    """A contact sheet as the report shows it."""

    name: str  # of the file that it shows
    png: bytes
    figure: ShownFigure


class SheetFigure(NamedTuple):
    """What is drawn of one figure: right of its pelvis, above the floor, and towards the viewer, in metres."""

    triangles: Float[np.ndarray, "F 3 3"]
    sticks: Float[np.ndarray, "L 2 3"]
    dots: Float[np.ndarray, "M 3"]

    def view(self, place: Float[np.ndarray, " 3"], axes: Float[np.ndarray, "3 3"], scale: float = 1.0) -> "SheetFigure":
        """Return the figure as seen in a view, given in the world with the place of its pelvis."""
        return SheetFigure(*(scale * (each - place * LEVEL) @ axes.T for each in self))

    @property
    def points(self) -> Float[np.ndarray, "N 3"]:
        points = np.concatenate([np.zeros((1, 3)), *(each.reshape(-1, 3) for each in self)])
        return points[np.isfinite(points).all(1)]


def draw_contact_sheet(
    performer: Performer, character: Character | None = None, glb: Path | None = None, *, turns: bool = True
) -> bytes:
    """Draw the sheet of a take as PNG.

    Args:
        character: A character that it moves; None for the body alone.
        glb: The written file of the character, whose first animation is drawn.
        turns: Whether the character turns with the body; otherwise it is seen from its own front.
    """
    skeleton, take = performer.skeleton, performer.take
    hips, left, right, ankle = map(skeleton.find_joint, ("Hips", "LeftUpLeg", "RightUpLeg", "LeftFoot"))
    joints, rotations = compute_world_poses(skeleton, performer.motion)
    turned = np.einsum("tab,tjb->tja", build_views(joints[:, left] - joints[:, right]), joints - joints[:, [hips]] * LEVEL)
    frames = choose_frames(turned)
    take_frames = np.rint((performer.start_s + frames / performer.rate) * take.rate).astype(int).clip(0, take.frame_count - 1)
    labels = ["rest pose", *(f"frame {take.get_frame_number(frame)}" for frame in take_frames.tolist())]
    markers = take.markers[take_frames] - performer.floor_height_m * UP
    markers = np.concatenate([np.full_like(markers[:1], np.nan), markers])[:, : None if take.point_kind == "marker" else 0]
    rest, leaves = skeleton.rest_positions, np.flatnonzero(skeleton.is_leaf)
    poses = np.concatenate([rest[None] - rest[:, 1].min() * UP, joints[frames]])
    rotations = np.concatenate([np.tile(np.eye(3), (1, len(rest), 1, 1)), rotations[frames]])
    tips = poses[:, leaves] + np.einsum("tjab,jb->tja", rotations[:, leaves], skeleton.ends[leaves])
    bones = [(parent, joint) for joint, parent in enumerate([*skeleton.parents, *leaves]) if parent >= 0]
    views = build_views(poses[:, left] - poses[:, right])
    legend = "blue: solved body, orange: markers" if markers.size else "blue: solved body"
    title, reason, scale, characters, colours = f"The body ({legend})", "", 1.0, [], np.empty((0, 3))
    if character and glb:
        characters, colours = _show_character(
            character, glb, views[1:] if turns else views[:0], (frames / performer.rate).tolist()
        )
        leg_m = np.linalg.norm(skeleton.offsets[list_path(ankle, left, skeleton.parents)], axis=1).sum()  # apart in the rest pose
        height_m = np.nanmax(np.concatenate([poses[0], tips[0]])[:, 1]) - poses[0, left, 1] + leg_m + poses[0, ankle, 1]
        scale = float(characters[0].points[:, 1].max() / height_m) or 1.0
        title = f"{character.name}, beside the performer scaled by {scale:.2f} ({legend})"
        reason = character.mapping.reason
    bodies = [
        SheetFigure(np.empty((0, 3, 3)), np.concatenate([pose, tip])[np.array(bones)], dots).view(pose[hips], axes, scale)
        for pose, tip, dots, axes in zip(poses, tips, markers, views, strict=True)
    ]
    return _draw_cells([bodies, characters] if characters else [bodies], colours, labels, (title, reason))


def _show_character(
    character: Character, glb: Path, views: Float[np.ndarray, "F 3 3"], times_s: Sequence[float]
) -> tuple[list[SheetFigure], Float[np.ndarray, "N 3"]]:
    """Return the character in the rest pose and at some times, and the colours of triangles; in the views given for the last."""
    content, nodes, bones = _read_figure(character, glb)
    animation = content.document["animations"][0]
    rest_bones = dict(zip(bones, build_bone_matrices(character), strict=True))
    rest = move_nodes(nodes, compute_node_matrices(content, nodes)[0], rest_bones)
    if character.source is not None and character.source.kind == "bvh":  # in its rest pose the hips may be at height 0
        rest[:, 1, 3] -= rest[bones, 1, 3].min()
    matrices = np.concatenate([rest[None], compute_node_matrices(content, nodes, animation, times_s)])
    pelvis, left, right = (bones[character.mapping.bones[name][0]] for name in ("pelvis", "left_thigh", "right_thigh"))
    mesh, has_own_mesh = read_gltf_mesh(content, nodes), character.source is not None and character.source.kind == "gltf"
    triangles = mesh.triangles if has_own_mesh else mesh.triangles[:0]
    sticks = _list_sticks(nodes, bones, pelvis)[: 0 if len(triangles) else None]
    own_count = len(matrices) - len(views)
    views = np.concatenate([build_views((matrices[:, left] - matrices[:, right])[:own_count, :3, 3]), views])
    figures = [
        SheetFigure(mesh.pose(each)[triangles], each[:, :3, 3][sticks], np.empty((0, 3))).view(each[pelvis, :3, 3], axes)
        for each, axes in zip(matrices, views, strict=True)
    ]
    return figures, mesh.colours


def _read_figure(character: Character, glb: Path) -> tuple[GlbContent, GltfNodes, list[int]]:
    """Return the content of a character's file, its nodes, and the node of each bone."""
    content = parse_glb(glb, glb.read_bytes())
    nodes = read_gltf_nodes(glb, content.document)
    numbers = {name: node for node, name in enumerate(nodes.names)}
    return content, nodes, [numbers.get(name, bone) for bone, name in enumerate(character.skeleton.names)]


def _list_sticks(nodes: GltfNodes, bones: Sequence[int], pelvis: int) -> Int[np.ndarray, "L 2"]:
    """Return the nodes at both ends of each bone below the pelvis."""
    below = {pelvis}
    for bone in bones:
        if nodes.parents[bone] in below:
            below.add(bone)
    return np.array([(nodes.parents[bone], bone) for bone in sorted(below - {pelvis})], int).reshape(-1, 2)


def choose_frames(poses: Float[np.ndarray, "T J 3"]) -> Int[np.ndarray, " F"]:
    """Return the frames that are shown, rising: that of the lowest root, and those that differ most from the ones before.

    Two frames differ by the distances of their joints and by the time between them. Neighbours are not shown: where a body rolls,
    the direction that it faces flips within a frame.

    Args:
        poses: Positions in metres relative to the place of the root on the floor, in axes that turn with the body.
    """
    joints = poses.reshape(len(poses), -1) / np.sqrt(poses.shape[1])
    features = np.concatenate([joints, np.linspace(0.0, TAKE_LENGTH_M, len(poses))[:, None]], axis=1)
    first, apart = int(poses[:, 0, 1].argmin()), max(len(poses) // (4 * COLUMNS * ROWS), 1)
    return np.unique(select_farthest_rows(features, min(COLUMNS * ROWS - 1, len(poses)), first, apart))


def build_views(left: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Return the axes of the views of figures whose left is in some directions: right, up and towards the viewer, as rows."""
    level = left * LEVEL
    length = np.linalg.norm(level, axis=-1, keepdims=True)
    side = np.where(length > 0, level / np.where(length > 0, length, 1.0), [1.0, 0.0, 0.0])
    right = side * np.cos(YAW_RAD) - np.cross(side, UP) * np.sin(YAW_RAD)
    return np.stack([right, np.broadcast_to(UP, right.shape), np.cross(right, UP)], axis=-2)


def _draw_cells(
    series: Sequence[Sequence[SheetFigure]], colours: Float[np.ndarray, "F 3"], labels: Sequence[str], title: tuple[str, str]
) -> bytes:
    """Return the picture with a cell for each frame, in which the figures of each series stand side by side, the first left."""
    points = [np.concatenate([figure.points for figure in each]) for each in series]
    half_widths = np.array([np.abs(each[:, 0]).max() for each in points])
    bottom, top = (float(bound([bound(each[:, 1]) for each in points])) for bound in (min, max))
    centres = np.cumsum(2 * half_widths + GAP_M) - half_widths - GAP_M
    total = float(centres[-1] + half_widths[-1])
    px_per_m = min(CELL_WIDTH_PX / total, CELL_HEIGHT_PX / (top - bottom))
    width, height = (int(length * px_per_m) + 2 * MARGIN_PX for length in (total, top - bottom))
    sheet = Image.new("RGB", (COLUMNS * width, TITLE_HEIGHT_PX + ROWS * (height + LABEL_HEIGHT_PX)), PAPER)
    pen = ImageDraw.Draw(sheet)
    for k, figures in enumerate(zip(*series, strict=True)):
        cell = Image.new("RGB", (OVERSAMPLING * width, OVERSAMPLING * height), PAPER)
        for figure, centre, colour in zip(figures, centres, (BODY, INK), strict=False):
            origin, scale = [MARGIN_PX + centre * px_per_m, MARGIN_PX + top * px_per_m, 0.0], [px_per_m, -px_per_m, px_per_m]
            draw_figure(cell, SheetFigure(*(OVERSAMPLING * (origin + each * scale) for each in figure)), colours, colour)
        left, upper = k % COLUMNS * width, TITLE_HEIGHT_PX + k // COLUMNS * (height + LABEL_HEIGHT_PX)
        sheet.paste(cell.reduce(OVERSAMPLING), (left, upper))
        floor = upper + MARGIN_PX + top * px_per_m
        pen.line([(left, floor), (left + width, floor)], FLOOR)
        pen.text((left + width / 2, upper + height), labels[k], INK, ImageFont.load_default(LABEL_PX), anchor="ma")
    pen.text((MARGIN_PX, MARGIN_PX / 2), title[0], INK, ImageFont.load_default(TITLE_PX))
    pen.text((MARGIN_PX, MARGIN_PX + TITLE_PX), title[1], INK, ImageFont.load_default(LABEL_PX))
    encoded = BytesIO()
    sheet.quantize(MAX_COLOURS, Image.Quantize.FASTOCTREE).save(encoded, "PNG", optimize=True)
    return encoded.getvalue()


def draw_figure(picture: Image.Image, figure: SheetFigure, colours: Float[np.ndarray, "F 3"], ink: tuple[int, int, int]) -> None:
    """Draw a figure, given in pixels and without NaN in its triangles, the nearest triangles last. They are lit on both sides."""
    pen, corners, radius = ImageDraw.Draw(picture), figure.triangles, DOT_PX * OVERSAMPLING
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) * [1.0, -1.0, 1.0]  # y is down
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals *= np.where(normals[:, 2:] < 0, -1.0, 1.0) / np.where(lengths > 0, lengths, 1.0)
    light = AMBIENT + DIFFUSE * np.maximum(normals @ LIGHT, 0.0)
    shaded = (255 * (DARKEST + (1 - DARKEST) * colours[: len(light)]) * light[:, None]).clip(0, 255).astype(int)
    order = np.argsort(corners[..., 2].mean(1))
    coordinates, channels = (each[order].T.tolist() for each in (corners[..., :2].reshape(-1, 6), shaded))
    # tuples: a list for each triangle takes five times as long, in the collection of garbage
    for triangle, colour in zip(zip(*coordinates, strict=True), zip(*channels, strict=True), strict=True):
        pen.polygon(triangle, colour)
    for start, end in figure.sticks[np.isfinite(figure.sticks).all((1, 2)), :, :2]:
        pen.line([tuple(start), tuple(end)], ink, STICK_PX * OVERSAMPLING)
    for x, y, _ in figure.dots[np.isfinite(figure.dots).all(1)]:
        pen.ellipse([x - radius, y - radius, x + radius, y + radius], MARKER)
