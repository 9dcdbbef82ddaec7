"""Contact sheets: which frames are shown, how triangles and figures are drawn, and the pictures of a take."""

from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from mocapfix.characters.character_files import CharacterFiles
from mocapfix.characters.load_character import load_character
from mocapfix.io.bvh import write_bvh
from mocapfix.io.gltf_mesh import compute_node_matrices, read_gltf_mesh
from mocapfix.options import OutputOptions
from mocapfix.output_formats import build_exported_motion
from mocapfix.report.contact_sheet import (
    BODY,
    COLUMNS,
    INK,
    MARKER,
    PAPER,
    ROWS,
    Performer,
    SheetFigure,
    build_views,
    choose_frames,
    draw_contact_sheet,
    draw_figure,
)
from tests.io.test_gltf_mesh import build_cube, read_back

RED, BLUE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)


def draw_triangles(corners, colours) -> np.ndarray:
    """Return the pixels of a picture of 40 x 40 with triangles."""
    picture = Image.new("RGB", (40, 40), PAPER)
    draw_figure(picture, SheetFigure(np.asarray(corners, float), np.empty((0, 2, 3)), np.empty((0, 3))), np.array(colours), INK)
    return np.array(picture, int)


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_the_nearer_of_two_triangles_is_shown(order):
    """The red one is nearer, and covers the blue one on the left; the order in which they are given does not matter."""
    blue, red = [[0, 0, 0], [39, 0, 0], [0, 39, 0]], [[0, 0, 5], [10, 0, 5], [0, 39, 5]]
    pixels = draw_triangles(np.array([blue, red])[order], np.array([BLUE, RED])[order])
    assert pixels[5, 4, 0] > 100 > pixels[5, 4, 2]
    assert pixels[5, 25, 2] > 100 > pixels[5, 25, 0]
    assert tuple(pixels[35, 35]) == PAPER


def test_a_surface_is_brightest_towards_the_light_on_either_side():
    facing, edge = [[5, 5, 0], [35, 5, 0], [5, 35, 0]], [[5, 5, 0], [35, 5, 60], [5, 35, 0]]
    bright, turned, dark = (draw_triangles([each], [RED])[10, 10, 0] for each in (facing, facing[::-1], edge))
    assert bright == turned > dark


def test_a_cube_that_a_bone_carries_is_drawn_where_it_is():
    content, nodes = read_back(*build_cube(bone_at=(1.0, 3.0, 0.0)))
    mesh = read_gltf_mesh(content, nodes)
    corners = mesh.pose(compute_node_matrices(content, nodes)[0])[mesh.triangles] * [10.0, 10.0, 1.0]
    rows, columns = np.nonzero((draw_triangles(corners, mesh.colours) != PAPER).any(-1))
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (10, 20, 10, 20)


def test_the_left_of_a_figure_is_right_in_its_view():
    right, up, towards = build_views(np.array([2.0, 0.5, 0.0]))  # its left is +X, so its front is +Z
    assert right[0] > 0.9
    np.testing.assert_allclose(up, [0, 1, 0])
    assert towards[2] > 0.9
    np.testing.assert_allclose(build_views(np.array([0.0, 1.0, 0.0])) @ build_views(np.zeros(3)).T, np.eye(3), atol=1e-12)


def test_the_frames_shown_are_the_extremes():
    """Of a figure that stands, frame 30 is a squat, 61 has an arm raised, and 85 the other."""
    poses = np.tile([[0.0, 1.0, 0.0], [0.3, 1.3, 0.0], [-0.3, 1.3, 0.0]], (100, 1, 1))
    poses[30, 0, 1] = 0.4
    poses[61, 1] += [0.5, 0.5, 0.0]
    poses[85, 2] += [-0.5, 0.5, 0.0]
    frames = choose_frames(poses)
    assert {30, 61, 85} <= set(frames.tolist())
    assert len(frames) == COLUMNS * ROWS - 1
    assert (np.diff(frames) > 0).all()
    np.testing.assert_array_equal(choose_frames(poses[:3]), [0, 1, 2])


def test_neighbours_are_not_shown_where_the_view_flips():
    poses = np.tile([[0.0, 1.0, 0.0], [0.3, 1.3, 0.0], [-0.3, 1.3, 0.5]], (100, 1, 1))
    poses[50:, 1:] *= [-1.0, 1.0, -1.0]
    assert np.diff(choose_frames(poses)).min() >= 100 // (4 * COLUMNS * ROWS)


def count_pixels(picture: Image.Image, colour: tuple[int, int, int]) -> int:
    """Return how many pixels have nearly a colour."""
    return int((np.abs(np.array(picture.convert("RGB"), int) - colour).max(-1) <= 12).sum())


def test_a_sheet_shows_the_body_left_of_the_character(cleaned, tmp_path, monkeypatch):
    monkeypatch.setattr("mocapfix.report.recording.write_recording", lambda target, *_: target.write_bytes(b"rrd"))
    result = replace(cleaned.result, motion=cleaned.result.motion.select_frames(np.arange(61)))
    outputs = result.write(tmp_path, options=OutputOptions(characters=("mixamo",), extra_formats=("sheet",), output_rate_hz=30.0))
    with Image.open(outputs["mixamo.sheet.png"]) as picture:
        half = picture.crop((0, 80, picture.width // COLUMNS // 2, picture.height // 2))
        other = picture.crop((picture.width // COLUMNS // 2, 80, picture.width // COLUMNS, picture.height // 2))
        assert count_pixels(half, BODY) > 100 > count_pixels(half, INK)
        assert count_pixels(other, INK) > 100 > count_pixels(other, BODY)
        assert count_pixels(picture, MARKER) > 100
    with Image.open(outputs["sheet.png"]) as picture:
        assert count_pixels(picture, BODY) > 800
    page = outputs["report.html"].read_text(encoding="utf-8")
    assert page.count('src="data:image/png;base64,') == 1
    assert "walk.mixamo.glb</h2>" in page


def test_the_mesh_of_a_character_of_ones_own_is_drawn(cleaned, tmp_path):
    """The test skin of a preset, as the mesh of a file: it is drawn in place of sticks."""
    result, glb = cleaned.result, tmp_path / "walk.hero.glb"
    exported = build_exported_motion(OutputOptions(), result.subject, result.motion.select_frames(np.arange(20)), 120.0)
    assert exported is not None
    CharacterFiles(load_character("mixamo"), OutputOptions()).write(tmp_path / "hero.glb", *exported.parts)
    hero = load_character(tmp_path / "hero.glb")
    CharacterFiles(hero, OutputOptions()).write(glb, *exported.parts)
    sheet = draw_contact_sheet(Performer(*exported.parts, 0.0, 0.0, result.take), hero, glb)
    with Image.open(BytesIO(sheet)) as picture:
        assert count_pixels(picture, BODY) > 800
        cells = picture.crop((0, 80, picture.width, picture.height // 2))
        assert count_pixels(cells, INK) < 1500  # the labels
        assert count_pixels(cells, (160, 160, 160)) > 100


def test_a_bvh_with_hips_at_height_0_is_drawn_standing(cleaned, tmp_path):
    result, glb = cleaned.result, tmp_path / "walk.hero.glb"
    exported = build_exported_motion(OutputOptions(), result.subject, result.motion.select_frames(np.arange(20)), 120.0)
    assert exported is not None
    write_bvh(tmp_path / "hero.bvh", exported.subject.skeleton, exported.motion, 120.0)
    hero = load_character(tmp_path / "hero.bvh")
    assert hero.skeleton.rest_positions[:, 1].min() < -0.8
    CharacterFiles(hero, OutputOptions()).write(glb, *exported.parts)
    with Image.open(BytesIO(draw_contact_sheet(Performer(*exported.parts, 0.0, 0.0, result.take), hero, glb))) as picture:
        assert count_pixels(picture, BODY) == pytest.approx(count_pixels(picture, INK), rel=0.4)
