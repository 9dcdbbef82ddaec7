"""The motion prior: its network in numpy, and its predictions in gaps."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from mocapfix.errors import SceneError
from mocapfix.lab.cards import write_weights
from mocapfix.solve import motion_prior
from mocapfix.solve.motion_prior import INNER_COUNT, TOKEN_COUNT, build_motion_tree, count_features, count_outputs

torch = pytest.importorskip("torch")
motion_training = pytest.importorskip("mocapfix.lab.motion_training")
JOINTS = build_motion_tree().joints
RATE_HZ = 60.0


def draw_network(seed=0):
    features = torch.from_numpy(np.random.default_rng(seed).normal(size=(4, TOKEN_COUNT, count_features())).astype(np.float32))
    return motion_training.draw_initial_network(16, 2, seed, features), features


def draw_motion(frame_count=200):
    """Return the root position and local rotations of a motion that turns steadily."""
    times_s = np.arange(frame_count) / RATE_HZ
    speeds = np.random.default_rng(0).uniform(-0.3, 0.3, (31, 3))
    rotations = Rotation.from_rotvec((times_s[:, None, None] * speeds).reshape(-1, 3)).as_matrix()
    return np.stack([times_s, 1 + 0 * times_s, 0.5 * times_s], -1), rotations.reshape(frame_count, 31, 3, 3)


def hide(first, last, joints: list[int] | slice = slice(None), frame_count=200):
    is_known = np.ones((frame_count, len(JOINTS)), bool)
    is_known[first : last + 1, joints] = False
    return is_known


@pytest.fixture
def prior():
    return motion_training.extract_motion_weights(draw_network()[0])


@pytest.fixture
def interpolating_prior(prior):
    """Return a network whose outputs are zero."""
    changed = {name: 0 * values for name, values in prior.tensors.items() if name.startswith("output")}
    return motion_prior.MotionPrior(prior.tensors | changed)


def test_numpy_evaluates_the_network_as_torch_does(prior):
    network, features = draw_network()
    with torch.inference_mode():
        expected = network(features).numpy()
    assert expected.shape == (4, INNER_COUNT, count_outputs())
    np.testing.assert_allclose(prior.evaluate(features.numpy()), expected, atol=5e-3)


def test_outputs_of_zero_give_the_interpolation(interpolating_prior):
    position, rotations = draw_motion()
    damaged, hidden = rotations.copy(), position.copy()
    damaged[80:131], hidden[80:131] = np.eye(3), 0
    gap = interpolating_prior.predict_gap(hidden, damaged, hide(80, 130), 80, 130, RATE_HZ)
    np.testing.assert_allclose(gap.root_position, position[80:131], atol=1e-4)
    np.testing.assert_allclose(gap.local_rotations, rotations[80:131][:, JOINTS], atol=1e-3)
    assert gap.rotation_sd_rad[25].min() > 2 * gap.rotation_sd_rad[0].max() > 0


def test_even_values_are_interpolated_as_by_scipy():
    values, at = np.random.default_rng(0).normal(size=(18, 5)), np.linspace(-0.5, 17.5, 100)
    np.testing.assert_allclose(motion_prior.interpolate_evenly(values, at), CubicSpline(np.arange(18), values)(at), atol=1e-12)


def test_known_joints_keep_their_rotations(prior):
    position, rotations = draw_motion()
    lost = [7, 8]
    gap = prior.predict_gap(position, rotations, hide(80, 130, lost), 80, 130, RATE_HZ)
    known = np.delete(np.arange(len(JOINTS)), lost)
    np.testing.assert_allclose(gap.local_rotations[:, known], rotations[80:131][:, JOINTS[known]], atol=1e-3)
    np.testing.assert_allclose(gap.root_position, position[80:131], atol=1e-4)
    assert (gap.rotation_sd_rad[:, known] == 0).all()


def test_prediction_turns_and_moves_with_the_body(prior):
    position, rotations = draw_motion()
    turn = Rotation.from_rotvec([0, 2.0, 0]).as_matrix()
    turned = rotations.copy()
    turned[:, 0] = turn @ rotations[:, 0]
    gap = prior.predict_gap(position, rotations, hide(80, 130), 80, 130, RATE_HZ)
    other = prior.predict_gap(position @ turn.T + [1, 0, 3], turned, hide(80, 130), 80, 130, RATE_HZ)
    np.testing.assert_allclose(other.root_position, gap.root_position @ turn.T + [1, 0, 3], atol=1e-3)
    np.testing.assert_allclose(other.local_rotations[:, 0], turn @ gap.local_rotations[:, 0], atol=1e-3)
    np.testing.assert_allclose(other.local_rotations[:, 1:], gap.local_rotations[:, 1:], atol=1e-3)


@pytest.mark.parametrize(("first", "last"), [(0, 40), (150, 199), (20, 180), (50, 52)])
def test_gaps_at_an_end_or_of_other_durations_are_not_predicted(prior, first, last):
    position, rotations = draw_motion()
    assert prior.predict_gap(position, rotations, hide(first, last), first, last, RATE_HZ) is None


def test_joint_that_is_never_known_is_not_predicted(prior):
    position, rotations = draw_motion()
    assert prior.predict_gap(position, rotations, hide(0, 199, [3]), 80, 130, RATE_HZ) is None


def test_file_has_the_same_weights(prior, tmp_path):
    write_weights(tmp_path / "mine.safetensors", prior.tensors)
    (tmp_path / "other").touch()
    assert (tmp_path / "mine.safetensors").stat().st_mode == (tmp_path / "other").stat().st_mode  # others may read it, too
    again = motion_prior.read_motion_prior(tmp_path / "mine.safetensors")
    for name, values in prior.tensors.items():
        np.testing.assert_array_equal(again.tensors[name], values)


def test_other_files_raise(tmp_path):
    write_weights(tmp_path / "part.safetensors", {"input.weight": np.ones(3)})
    (tmp_path / "text.safetensors").write_text("weights", encoding="utf-8")
    for name in ("part", "text", "absent"):
        with pytest.raises(SceneError, match=f"{name}.safetensors: is not a motion prior"):
            motion_prior.read_motion_prior(tmp_path / f"{name}.safetensors")
