import numpy as np
import pytest

from mocapfix.animations import joint_points
from mocapfix.read import bvh
from tests.bvh_files import TEXT


@pytest.fixture
def figure(tmp_path):
    (tmp_path / "figure.bvh").write_text(TEXT)
    return bvh.read_bvh(tmp_path / "figure.bvh")


def test_places_are_where_the_joints_are(figure):
    take = joint_points.build_joint_take(figure)
    np.testing.assert_array_equal(take.markers, figure.world()[0])
    assert take.labels == figure.names
    assert (take.first_frame, take.rate, take.layout, take.path) == (1, figure.rate, figure, figure.path)


def test_tips_are_the_middle_of_what_hangs_on_a_joint_and_last_the_root(figure):
    take, (places, turns) = joint_points.build_tip_take(figure), figure.world()
    assert take.labels == (*figure.names, "Hips's place")
    np.testing.assert_allclose(take.markers[:, 0], (places[:, 1] + places[:, 3]) / 2)
    np.testing.assert_allclose(take.markers[:, 1], places[:, 2])
    ends = figure.ends[2].mean(0) * figure.unit
    np.testing.assert_allclose(take.markers[:, 2], places[:, 2] + turns[:, 2] @ ends)
    end = places[:, 3] + turns[:, 3] @ figure.ends[3][0] * figure.unit
    np.testing.assert_allclose(take.markers[:, 3], (places[:, 4] + end) / 2)
    np.testing.assert_array_equal(take.markers[:, -1], places[:, 0])


def test_reach_is_what_turning_a_joint_a_little_does_to_the_points(figure):
    """Root mean square over many small turns, drawn."""
    rng, sd, draws = np.random.default_rng(0), 0.01, 4000
    variance = np.zeros((figure.frame_count, len(figure.names) + 1))
    variance[1, 3] = sd**2
    tips = joint_points.build_tip_take(figure)
    predicted = joint_points.compute_point_deviation(tips, variance)
    assert not predicted[[0, 2]].any()
    assert (predicted[1] > 0).tolist() == [False, False, False, True, True, False]
    places = figure.world()[0][1]
    for point in (3, 4):
        arm = tips.markers[1, point] - places[3]
        moved = np.cross(rng.normal(scale=sd, size=(draws, 3)), arm)
        assert predicted[1, point] == pytest.approx(np.sqrt((moved**2).mean()), rel=0.03)


def test_an_unsure_root_moves_everything_alike(figure):
    variance = np.zeros((figure.frame_count, len(figure.names) + 1))
    variance[:, -1] = 0.02**2
    np.testing.assert_allclose(joint_points.compute_point_deviation(joint_points.build_joint_take(figure), variance), 0.02)


def test_the_tree_is_in_metres(figure):
    skeleton, joints = joint_points.build_joint_skeleton(figure)
    np.testing.assert_allclose(skeleton.offsets, figure.offsets * figure.unit)
    np.testing.assert_array_equal(joints, figure.world()[0])
    assert skeleton.names == figure.names
