import numpy as np
import pytest

from mocapfix.io import bvh
from mocapfix.model.animation import Animation, build_joint_take, build_tip_take, compute_joint_point_sd
from tests.bvh_files import TEXT


@pytest.fixture
def figure(tmp_path) -> Animation:
    (tmp_path / "figure.bvh").write_text(TEXT, encoding="utf-8")
    return bvh.read_bvh(tmp_path / "figure.bvh")


def test_joint_take_holds_world_positions_of_joints(figure: Animation):
    take = build_joint_take(figure)
    np.testing.assert_array_equal(take.markers, figure.compute_world_poses()[0])
    assert take.labels == figure.names
    assert (take.first_frame, take.rate, take.layout, take.path) == (1, figure.rate, None, figure.path)
    assert take.point_kind == "joint"


def test_tip_is_mean_of_children_and_end_sites(figure: Animation):
    take, (positions, rotations) = build_tip_take(figure), figure.compute_world_poses()
    assert take.labels == (*figure.names, "Hips position")
    np.testing.assert_allclose(take.markers[:, 0], (positions[:, 1] + positions[:, 3]) / 2)
    np.testing.assert_allclose(take.markers[:, 1], positions[:, 2])
    mean_end_offset = figure.end_sites[2].mean(0) * figure.unit_m
    np.testing.assert_allclose(take.markers[:, 2], positions[:, 2] + rotations[:, 2] @ mean_end_offset)
    end_position = positions[:, 3] + rotations[:, 3] @ figure.end_sites[3][0] * figure.unit_m
    np.testing.assert_allclose(take.markers[:, 3], (positions[:, 4] + end_position) / 2)
    np.testing.assert_array_equal(take.markers[:, -1], positions[:, 0])


def test_sd_of_points_equals_that_of_sampled_rotations(figure: Animation):
    rng, sd, draws = np.random.default_rng(0), 0.01, 4000
    variance = np.zeros((figure.frame_count, len(figure.names) + 1))
    variance[1, 3] = sd**2
    tips = build_tip_take(figure)
    predicted = compute_joint_point_sd(figure, tips, variance)
    assert not predicted[[0, 2]].any()
    assert (predicted[1] > 0).tolist() == [False, False, False, True, True, False]
    positions = figure.compute_world_poses()[0][1]
    for point in (3, 4):
        lever_arm = tips.markers[1, point] - positions[3]
        displacements = np.cross(rng.normal(scale=sd, size=(draws, 3)), lever_arm)
        assert predicted[1, point] == pytest.approx(np.sqrt((displacements**2).mean()), rel=0.03)


def test_sd_of_root_position_applies_to_all_points(figure: Animation):
    variance = np.zeros((figure.frame_count, len(figure.names) + 1))
    variance[:, -1] = 0.02**2
    take = build_joint_take(figure)
    np.testing.assert_allclose(compute_joint_point_sd(figure, take, variance), 0.02)


def test_joint_skeleton_is_in_metres(figure: Animation):
    skeleton, positions = figure.skeleton, figure.compute_world_poses()[0]
    np.testing.assert_allclose(skeleton.offsets, figure.bone_offsets * figure.unit_m)
    np.testing.assert_allclose(skeleton.offsets[3], [0, 0.605, 0])  # the median of its position channels
    np.testing.assert_array_equal(positions, figure.compute_world_poses()[0])
    assert skeleton.names == figure.names


REFERENCE = TEXT.replace(
    "HIERARCHY\n", "HIERARCHY\nROOT Reference\n{\n  OFFSET 0 0 0\n  CHANNELS 3 Xposition Yposition Zposition\n"
)
REFERENCE = REFERENCE.replace("ROOT Hips", "JOINT Hips").replace("MOTION", "}\nMOTION")


def test_the_position_track_is_that_of_the_hips_below_a_reference_that_does_not_move(tmp_path):
    head, rows = REFERENCE.split(".0083333\n")
    (tmp_path / "a.bvh").write_text(
        f"{head}.0083333\n" + "".join(f"0 0 0 {row}\n" for row in rows.splitlines()), encoding="utf-8"
    )
    figure = bvh.read_bvh(tmp_path / "a.bvh")
    tips = build_tip_take(figure)
    assert tips.labels[-1] == "Hips position"
    np.testing.assert_allclose(tips.markers[:, -1], [[0.105, 0.9, -0.0325], [0.106, 0.901, -0.0315], [0.107, 0.902, -0.0305]])
    values = np.tile(figure.values, (40, 1))
    values[60:62, :3] = 1e6  # a fault of the reference
    assert build_tip_take(figure.replace_values(values)).labels[-1] == "Hips position"
