"""The add-on's reader of BVH files: any unit, axis, order of channels, and translated joints."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.addon.addon_modules import load_addon_module

bvh_file, solved_take, process = (load_addon_module(name) for name in ("bvh_file", "solved_take", "process"))
HIERARCHY = """HIERARCHY
ROOT Hips
{{
  OFFSET 5 6 7
  CHANNELS 6 Xposition Yposition Zposition {order}
  JOINT Left Leg
  {{
    OFFSET 10 -40 0
    CHANNELS {leg} {order}
    End Site
    {{
      OFFSET 0 -30 5
    }}
  }}
  JOINT Chest
  {{
    OFFSET 0 50 3
    CHANNELS 3 {order}
    JOINT Head
    {{
      OFFSET 1 20 0
      CHANNELS 3 {order}
      End Site
      {{
        OFFSET 0 15 0
      }}
    }}
  }}
}}
MOTION
Frames: {count}
Frame Time: 0.025
"""
NAMES, PARENTS = ("Hips", "Left Leg", "Chest", "Head"), (-1, 0, 0, 2)
OFFSETS = np.array([[0, 0, 0], [10, -40, 0], [0, 50, 3], [1, 20, 0]], float)
FRAME_COUNT = 12


def compose_motion(order: str, leg_positions: np.ndarray | None = None) -> tuple[str, np.ndarray]:
    """Return the text of a BVH and the positions (T, 4, 3) of its joints in the file's axes and unit."""
    rng = np.random.default_rng(5)
    angles, root = rng.uniform(-60, 60, (FRAME_COUNT, 4, 3)), rng.normal(0, 30, (FRAME_COUNT, 3))
    turns = [Rotation.from_euler(order, angles[:, j], degrees=True).as_matrix() for j in range(4)]
    positions, rotations = np.zeros((FRAME_COUNT, 4, 3)), [turns[0]]
    positions[:, 0] = root
    for j in (1, 2, 3):
        offset = np.tile(OFFSETS[j], (FRAME_COUNT, 1)) if j != 1 or leg_positions is None else leg_positions
        positions[:, j] = positions[:, PARENTS[j]] + np.einsum("tab,tb->ta", rotations[PARENTS[j]], offset)
        rotations.append(rotations[PARENTS[j]] @ turns[j])
    leg = "6 Xposition Yposition Zposition" if leg_positions is not None else "3"
    head = HIERARCHY.format(order=" ".join(f"{axis}rotation" for axis in order), leg=leg, count=FRAME_COUNT)
    moved = np.zeros((FRAME_COUNT, 0)) if leg_positions is None else leg_positions
    values = np.concatenate([root, angles[:, 0], moved, angles[:, 1], angles[:, 2], angles[:, 3]], axis=1)
    return head + "\n".join(" ".join(f"{each:.9f}" for each in row) for row in values), positions


def build_take(positions: np.ndarray):
    """Return the take with which mocapfix describes the joints, in metres and in Blender's axes."""
    sd, report = np.full(positions.shape[:2], np.nan), {"take": {"animation": True}, "fill": {"unfilled": []}}
    return solved_take.SolvedTake("a", "", NAMES, positions, sd, 40.0, 1, None, np.zeros(0, int), (), report)


@pytest.mark.parametrize("order", ["ZXY", "XYZ", "YZX"])
@pytest.mark.parametrize(("unit", "up"), [(0.01, "x"), (0.0254, "z")])
def test_joints_are_where_mocapfix_has_found_them(tmp_path, order, unit, up):
    text, positions = compose_motion(order)
    expected = unit * positions @ Rotation.from_euler(up, 90, degrees=True).as_matrix().T + [0.1, 0.2, 0.3]
    (tmp_path / "a.bvh").write_text(text, encoding="utf-8")
    body = bvh_file.read_bvh_body(tmp_path / "a.bvh", build_take(expected))
    assert body.names == NAMES
    assert body.rate == pytest.approx(40)
    np.testing.assert_allclose(bvh_file.compute_joint_positions(body, np.arange(FRAME_COUNT)), expected, atol=1e-6)
    assert np.linalg.norm(body.ends[3]) == pytest.approx(15 * unit)
    assert np.isnan(body.ends[2]).all()


@pytest.mark.parametrize("is_displacement", [False, True])
def test_translated_joints_are_followed(tmp_path, is_displacement):
    shift = np.random.default_rng(1).normal(0, 2, (FRAME_COUNT, 3))
    text, positions = compose_motion("ZXY", OFFSETS[1] + shift)
    if is_displacement:
        head, _, body = text.partition("Frame Time: 0.025\n")
        values = np.array([line.split() for line in body.splitlines()], float)
        values[:, 6:9] -= OFFSETS[1]
        text = head + "Frame Time: 0.025\n" + "\n".join(" ".join(map(str, row)) for row in values)
    (tmp_path / "a.bvh").write_text(text, encoding="utf-8")
    body = bvh_file.read_bvh_body(tmp_path / "a.bvh", build_take(0.01 * positions))
    assert list(body.translations) == [1]
    np.testing.assert_allclose(bvh_file.compute_joint_positions(body, np.arange(FRAME_COUNT)), 0.01 * positions, atol=1e-6)


def test_constant_positions_replace_offsets(tmp_path):
    text, positions = compose_motion("ZXY", np.tile([11.0, -42.0, 1.0], (FRAME_COUNT, 1)))
    (tmp_path / "a.bvh").write_text(text, encoding="utf-8")
    body = bvh_file.read_bvh_body(tmp_path / "a.bvh", build_take(0.01 * positions))
    assert not body.translations
    np.testing.assert_allclose(np.linalg.norm(body.offsets[1]), 0.01 * np.linalg.norm([11, -42, 1]), atol=1e-7)


@pytest.mark.parametrize("keep", [0.3, 0.9])
def test_file_that_is_cut_off_is_one_sentence(tmp_path, keep):
    text, positions = compose_motion("ZXY")
    (tmp_path / "a.bvh").write_text(text[: int(keep * len(text))], encoding="utf-8")
    with pytest.raises(process.ProcessError, match="the cleaned BVH cannot be read; import it with"):
        bvh_file.read_bvh_body(tmp_path / "a.bvh", build_take(positions))
