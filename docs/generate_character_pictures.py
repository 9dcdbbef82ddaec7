"""Make the contact sheets in docs/characters.md and docs/robots.md, and the hands in docs/hands.md.

    python docs/generate_character_pictures.py CHARACTERS [CAPTURES [ROBOTS]]

CHARACTERS is a folder with the files that SHEETS and HAND_CHARACTERS name, CAPTURES one with takes of the CMU Graphics Lab Motion
Capture Database, ROBOTS one with the files that ROBOTS names. Without them only the hands are drawn, which are composed. None is
in the repository; docs/characters.md says where the characters come from.
"""

import sys
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial.transform import Rotation

import mocapfix
from mocapfix.characters.character import build_cmu31_character, convert_motion
from mocapfix.characters.character_files import convert_hand_motion, write_character_glb
from mocapfix.characters.load_character import load_character
from mocapfix.characters.retarget_motion import retarget_motion
from mocapfix.hands.hand_model import HAND_JOINTS
from mocapfix.hands.solve_hands import HandMotion, solve_hands
from mocapfix.io.gltf import parse_glb, read_gltf_nodes
from mocapfix.io.gltf_mesh import compute_node_matrices, read_gltf_mesh
from mocapfix.lab.hands import GESTURES, MARKER_COUNTS, TrueHand, compose_hands, fit_body, select_columns
from mocapfix.model.body_fit import BodyFit
from mocapfix.model.skeleton import is_below
from mocapfix.options import FEET_LOCK, FEET_SOFT, OutputOptions
from mocapfix.report.contact_sheet import INK, OVERSAMPLING, PAPER, ROWS, TITLE_HEIGHT_PX, SheetFigure, draw_figure

PICTURES = Path(__file__).parent / "gallery"
SHEETS = {
    "kaykit_knight.glb": "02_05",
    "quaternius.glb": "05_13",
    "RobotExpressive.glb": "02_01",
    "CesiumMan.glb": "05_13",
    "cryptovoxels.vrm": "85_02",
    "Xbot.glb": "85_02",
}
"""character to the take that moves it"""
ROBOTS = {
    "unitree_g1/g1.xml": "05_13",
    "unitree_h1/h1.xml": "02_01",
    "booster_t1/t1.xml": "85_02",
    "fourier_n1/n1.xml": "05_13",
    "engineai_pm01/pm01.xml": "85_02",
}
"""robot to the take that moves it"""
WIDTH_PX, COLOURS = 1200, 64

HAND_SEED = 5  # of a person of the benchmark
SHOWN_GESTURES = {"fist": "fist", "point": "point", "flat": "spread", "grip": "grip", "piano": "piano"}
"""gestures of the benchmark, and their titles"""
HAND_CHARACTERS = ("Xbot.glb", "geno_bl.glb")
CELL_PX, TITLE_PX, TEXT_PX = (200, 190), 26, 16
PX_PER_M, HAND_HEIGHT = 750.0, 0.16  # of the picture; where the wrist is above the lower edge of a cell, as a share of its height
TO_VIEWER = np.array([0.1, 0.75, 0.65])  # in the axes of a left palm: from the tips, the back of the hand and the thumb
SKIN, TRUE_SKIN, PALM_RADIUS_M = (0.9, 0.72, 0.56), (0.62, 0.69, 0.78), 0.0105
BONE_RADII_M = np.linspace(0.0095, 0.0065, 4)  # from the knuckle to the tip
SIDES, RINGS = 14, 7  # of a drawn bone


def draw_sheet(character: Path, take: Path, feet: str) -> Image.Image:
    """Return the contact sheet of a character that a take moves."""
    result = mocapfix.clean(take, feet=feet)
    with TemporaryDirectory() as folder:
        outputs = result.write(folder, options=OutputOptions(characters=(character,), extra_formats=("sheet",)))
        with Image.open(outputs[f"{character.stem}.sheet.png"]) as sheet:
            return sheet.convert("RGB")


def save_sheet(name: str, sheet: Image.Image) -> None:
    """Save a picture in the width and with the colours of all."""
    small = sheet.resize((WIDTH_PX, round(sheet.height * WIDTH_PX / sheet.width)), Image.Resampling.LANCZOS)
    small.quantize(COLOURS).save(PICTURES / f"{name}.png", optimize=True)


def draw_sheets(characters: Path, captures: Path) -> None:
    for name, take in SHEETS.items():
        path = characters / name
        save_sheet(f"character-{path.stem}", draw_sheet(path, captures / f"{take}.c3d", FEET_SOFT))


def draw_robots(robots: Path, captures: Path) -> None:
    """Draw the title and the last row of the sheet of each robot below each other."""
    rows: list[Image.Image] = []
    for name, take in ROBOTS.items():
        sheet = draw_sheet(robots / name, captures / f"{take}.c3d", FEET_LOCK)
        height = (sheet.height - TITLE_HEIGHT_PX) // ROWS
        row = Image.new("RGB", (sheet.width, TITLE_HEIGHT_PX + height))
        row.paste(sheet)
        row.paste(sheet.crop((0, sheet.height - height, *sheet.size)), (0, TITLE_HEIGHT_PX))
        rows.append(row.resize((WIDTH_PX, round(row.height * WIDTH_PX / row.width)), Image.Resampling.LANCZOS))
    picture = Image.new("RGB", (WIDTH_PX, sum(row.height for row in rows)))
    for k, row in enumerate(rows):
        picture.paste(row, (0, sum(each.height for each in rows[:k])))
    save_sheet("robots", picture)


def find_frame(truth: TrueHand, gesture: str) -> int:
    """Return the frame whose bends are the nearest to those of a gesture; end joints are not compared."""
    thumb, knuckles, middles, *_ = GESTURES[gesture]
    wanted = np.concatenate([thumb, np.stack(np.broadcast_arrays(knuckles, middles, [0.0] * 4)[:2], axis=1).ravel()])
    compared = [0, 1, 2, *(joint for joint in range(3, 15) if joint % 3 < 2)]
    return int(np.linalg.norm(np.degrees(truth.flexions[:, compared]) - wanted, axis=1).argmin())


def build_bone(start: Float[np.ndarray, " 3"], end: Float[np.ndarray, " 3"], radii: tuple[float, float]) -> np.ndarray:
    """Return the triangles (F, 3, 3) of a bone with round ends."""
    length = float(np.linalg.norm(end - start))
    polar = np.linspace(0, np.pi, 2 * RINGS)
    along = np.where(polar < np.pi / 2, -radii[0] * np.cos(polar), length - radii[1] * np.cos(polar))
    radius = np.sin(polar) * np.where(polar < np.pi / 2, *radii)
    middle = np.linspace(0, 1, 5)[1:-1]  # short triangles are drawn in the right order
    along, radius = np.insert(along, RINGS, length * middle), np.insert(radius, RINGS, np.interp(middle, [0, 1], radii))
    around = np.linspace(0, 2 * np.pi, SIDES + 1)
    ring = np.stack([np.cos(around), np.sin(around), np.zeros(SIDES + 1)], axis=-1)
    grid = radius[:, None, None] * ring + along[:, None, None] * [0.0, 0.0, 1.0]
    turn = Rotation.align_vectors([(end - start) / length], [[0.0, 0.0, 1.0]])[0].as_matrix()
    grid = start + grid @ turn.T
    corners = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    return np.concatenate([np.stack([corners[k] for k in each], axis=2).reshape(-1, 3, 3) for each in ((0, 1, 2), (0, 2, 3))])


def build_hand(wrist: Float[np.ndarray, " 3"], points: Float[np.ndarray, "20 3"]) -> Float[np.ndarray, "F 3 3"]:
    """Return the triangles of a hand from its joints and tips."""
    bones = list[np.ndarray]()
    for ray in range(5):
        chain = np.concatenate([points[3 * ray : 3 * ray + 3], points[[len(HAND_JOINTS) + ray]]])
        bones.append(build_bone(wrist, chain[0], (PALM_RADIUS_M, PALM_RADIUS_M)))
        for (start, end), radii in zip(pairwise(chain), pairwise(BONE_RADII_M.tolist()), strict=True):
            bones.append(build_bone(start, end, radii))
    return np.concatenate(bones)


def draw_cell(
    triangles: Float[np.ndarray, "F 3 3"],
    colours: Float[np.ndarray, "F 3"],
    dots: Float[np.ndarray, "M 3"],
    place: tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]],
    scale: float = 1.0,
) -> Image.Image:
    """Return the picture of a hand as seen from the thumb's side of its palm, which has a place and axes in the world."""
    origin, palm = place
    across = np.cross([1.0, 0.0, 0.0], TO_VIEWER)
    across /= np.linalg.norm(across)
    towards = TO_VIEWER / np.linalg.norm(TO_VIEWER)
    axes = np.stack([across, np.cross(towards, across), towards]) @ palm.T
    seen = (scale * (each - origin) @ axes.T for each in (triangles, dots))
    shift = OVERSAMPLING * np.array([CELL_PX[0] / 2, (1 - HAND_HEIGHT) * CELL_PX[1], 0.0])
    pixels = [shift + OVERSAMPLING * PX_PER_M * each * [1.0, -1.0, 1.0] for each in seen]
    cell = Image.new("RGB", (OVERSAMPLING * CELL_PX[0], OVERSAMPLING * CELL_PX[1]), PAPER)
    draw_figure(cell, SheetFigure(pixels[0], np.empty((0, 2, 3)), pixels[1]), colours, INK)
    return cell.reduce(OVERSAMPLING)


def save_cells(name: str, rows: list[list[Image.Image]], titles: list[str], labels: list[str]) -> None:
    """Save rows of pictures with a title above each column and a label beside each row."""
    margin, font = 90, ImageFont.load_default(TEXT_PX)
    sheet = Image.new("RGB", (margin + CELL_PX[0] * len(titles), TITLE_PX + CELL_PX[1] * len(rows)), PAPER)
    pen = ImageDraw.Draw(sheet)
    for column, title in enumerate(titles):
        pen.text((margin + (column + 0.5) * CELL_PX[0], TITLE_PX / 2), title, INK, font, anchor="mm")
    for row, (label, cells) in enumerate(zip(labels, rows, strict=True)):
        pen.text((10, TITLE_PX + (row + 0.5) * CELL_PX[1]), label, INK, font, anchor="lm")
        for column, cell in enumerate(cells):
            sheet.paste(cell, (margin + column * CELL_PX[0], TITLE_PX + row * CELL_PX[1]))
    sheet.quantize(COLOURS, Image.Quantize.MEDIANCUT).save(PICTURES / f"{name}.png", optimize=True)


def draw_on_character(
    path: Path, body: BodyFit, hands: tuple[HandMotion, ...], rate: float, frames: list[int]
) -> list[Image.Image]:
    """Return pictures of the left hand of a character that is posed like a body with hands."""
    character, skeleton = load_character(path), body.subject.skeleton
    poses = {hand.hand.model.side.lower(): convert_hand_motion(hand, rate, rate) for hand in hands}
    motion = retarget_motion(build_cmu31_character(skeleton), convert_motion(body.motion, rate), character, hands=poses)
    with TemporaryDirectory() as folder:
        glb = Path(folder) / "hand.glb"
        write_character_glb(glb, character, motion, "hand")
        content = parse_glb(glb, glb.read_bytes())
    nodes, mapping = read_gltf_nodes(path, content.document), character.mapping
    mesh = read_gltf_mesh(content, nodes)
    bones = mapping.bones["left_hand"][0], mapping.fingers["left_middle"][0]
    wrist, finger = (nodes.names.index(character.skeleton.names[bone]) for bone in bones)
    is_hand = np.array([node == wrist or is_below(node, wrist, nodes.parents) for node in range(len(nodes.names))])
    shown = is_hand[mesh.nodes[mesh.strongest]][mesh.triangles].all(1)
    cells = list[Image.Image]()
    for frame in frames:
        [matrices] = compute_node_matrices(content, nodes, content.document["animations"][0], [frame / rate])
        place, knuckle = matrices[[wrist, finger], :3, 3]
        own = np.linalg.norm(hands[0].hand.model.ray_offsets[6])
        scale = float(own / np.linalg.norm(knuckle - place))
        triangles = mesh.pose(matrices)[mesh.triangles[shown]]
        cells.append(draw_cell(triangles, mesh.colours[shown], np.empty((0, 3)), (place, hands[0].palm_rotation[frame]), scale))
    return cells


def draw_hands(characters: Path) -> None:
    """Draw a composed person's left hand beside the solved one, and the solved one on characters."""
    truth = compose_hands(HAND_SEED)
    true, rate = truth.hands["Left"], truth.take.rate
    frames = [find_frame(true, gesture) for gesture in SHOWN_GESTURES]
    detected, body = fit_body(truth.take)
    none, few = np.empty((0, 3)), dict[int, tuple[HandMotion, ...]]()
    for count, left in MARKER_COUNTS.items():
        kept, is_used = select_columns(truth, detected.take.labels, left), detected.solver_mask
        few[count] = solve_hands(detected.take.select(kept, is_used), is_used[:, kept], body.subject, body.motion)
    rows = list[list[Image.Image]]()
    for frame in frames:
        place = true.palm[0][frame], true.palm[1][frame]
        triangles = build_hand(place[0], true.points[frame])
        cells = [draw_cell(triangles, np.tile(TRUE_SKIN, (len(triangles), 1)), none, place)]
        for solved, _ in few.values():
            triangles = build_hand(solved.palm_position[frame], solved.point_positions[frame])
            cells.append(draw_cell(triangles, np.tile(SKIN, (len(triangles), 1)), true.points[frame], place))
        rows.append(cells)
    save_cells("hands", rows, ["truth", *(f"{count} markers" for count in few)], list(SHOWN_GESTURES.values()))
    solved = few[20][0]
    hand = [build_hand(solved.palm_position[frame], solved.point_positions[frame]) for frame in frames]
    places = [(solved.palm_position[frame], solved.palm_rotation[frame]) for frame in frames]
    rows = [[draw_cell(each, np.tile(SKIN, (len(each), 1)), none, place) for each, place in zip(hand, places, strict=True)]]
    rows += [draw_on_character(characters / name, body, few[20], rate, frames) for name in HAND_CHARACTERS]
    labels = ["solved", *(Path(name).stem for name in HAND_CHARACTERS)]
    save_cells("hands-characters", rows, list(SHOWN_GESTURES.values()), labels)


def main(characters: Path, captures: Path | None = None, robots: Path | None = None) -> None:
    draw_hands(characters)
    if captures:
        draw_sheets(characters, captures)
    if captures and robots:
        draw_robots(robots, captures)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
