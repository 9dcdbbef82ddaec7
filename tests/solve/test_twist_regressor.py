"""Twists: exact from rotations, and predicted from joint positions."""

import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import load_file, save_file
from scipy.spatial.transform import Rotation

from mocapfix.errors import SceneError
from mocapfix.kernels.hybrik import compute_swing, compute_twist
from mocapfix.lab import sound_takes
from mocapfix.lab.cards import write_twist_regressor
from mocapfix.lab.frame_pairs import compute_twists
from mocapfix.lab.training_poses import mirror_joint_name
from mocapfix.model.skeleton import Skeleton, load_cmu31_skeleton
from mocapfix.solve.hybrik import (
    TwistRegressor,
    build_twist_spans,
    compute_bone_vectors,
    compute_span_directions,
    load_shipped_regressor,
    read_twist_regressor,
)
from mocapfix.solve.kinematics import build_kinematic_tree, compute_tree_poses
from tests.kernels import random_terms

BODY = load_cmu31_skeleton()
BONES = compute_bone_vectors(BODY)
HAS = ~np.isnan(BONES[:, 0])
WITHOUT = {"Hips", "LeftToeBase", "RightToeBase", "Head", "LeftHandIndex1", "RightHandIndex1", "LThumb", "RThumb"}
SWAP = [BODY.find_joint(mirror_joint_name(name)) for name in BODY.names]


@pytest.fixture(scope="module")
def people():
    """Return local rotations of subjects that the network was not trained on, and their joint positions, the root at rest."""
    poses = sound_takes.load_unseen_poses()[::4]
    poses[:, 0] = np.eye(3)
    return poses, compute_tree_poses(build_kinematic_tree(BODY), np.zeros((len(poses), 3)), poses)[0]


def upright(frames):
    return np.tile(np.eye(3), (frames, 1, 1))


def random_network(rng: np.random.Generator, width: int = 8) -> TwistRegressor:
    sizes = (6 * len(build_twist_spans().start), width, width, 2 * int(HAS.sum()))
    weights, offsets = (
        tuple(rng.normal(0, 0.3, shape).astype(np.float16).astype(np.float32) for shape in shapes)
        for shapes in (pairwise(sizes), sizes[1:])
    )
    return TwistRegressor(weights, offsets, np.where(HAS, rng.uniform(0.1, 0.5, len(HAS)), np.inf))


def compute_angle_difference(one, other):
    """Return the differences in radians between angles given by cosines and sines (..., 2) of any length."""
    a, b = (np.arctan2(each[..., 1], each[..., 0]) for each in (one, other))
    return np.abs((a - b + np.pi) % (2 * np.pi) - np.pi)


# from rotations


@given(st.integers(0, 2**32 - 1), st.floats(-np.pi, np.pi))
def test_twist_of_twist_and_swing_is_exact(seed, angle):
    rng = np.random.default_rng(seed)
    bone, way = rng.normal(0, 0.3, 3), Rotation.from_rotvec(rng.uniform(-1.5, 1.5, 3)).as_matrix()
    swung = np.reshape(compute_swing(tuple(bone), tuple(way @ bone)), (3, 3))
    turned = np.reshape(compute_twist(tuple(bone), np.cos(angle), np.sin(angle)), (3, 3))
    np.testing.assert_allclose(compute_twists((swung @ turned)[None], bone[None])[0], [np.cos(angle), np.sin(angle)], atol=1e-9)


def test_rotation_about_the_bone_is_its_angle_and_across_it_zero():
    bone = np.array([[0.0, 0.3, 0.0]])
    about, across = (Rotation.from_rotvec(v).as_matrix()[None] for v in ([0, 0.7, 0], [0.7, 0, -1.1]))
    np.testing.assert_allclose(compute_twists(about, bone), [[np.cos(0.7), np.sin(0.7)]], atol=1e-12)
    np.testing.assert_allclose(compute_twists(across, bone), [[1, 0]], atol=1e-12)


def test_batches_and_joints_without_a_bone():
    twists = compute_twists(np.tile(np.eye(3), (2, 5, 31, 1, 1)), BONES)
    assert twists.shape == (2, 5, 31, 2)
    assert np.isnan(twists[:, :, ~HAS]).all()
    np.testing.assert_allclose(twists[:, :, HAS], np.broadcast_to([1.0, 0.0], (2, 5, HAS.sum(), 2)), atol=1e-12)


def test_bones_point_to_the_mean_of_separate_children():
    assert {name for name, has in zip(BODY.names, HAS, strict=True) if not has} == WITHOUT
    np.testing.assert_allclose(BONES[BODY.find_joint("Spine1")], BODY.offsets[BODY.find_joint("Neck")])
    offsets = np.array([[9, 9, 9], [0, 1, 0], [0, 0, 0], [2.0, 0, 0]])
    fork = Skeleton(("a", "b", "c", "d"), np.array([-1, 0, 0, 0]), offsets, np.full((4, 3), np.nan))
    np.testing.assert_array_equal(compute_bone_vectors(fork), [[1, 0.5, 0], *np.full((3, 3), np.nan)])


# from positions


def test_prediction_length_is_at_most_the_information():
    network, rng = random_network(np.random.default_rng(0)), np.random.default_rng(1)
    positions = rng.normal(size=(400, 31, 3))
    raw = network.evaluate(compute_span_directions(positions, upright(400)))
    lengths = np.linalg.norm(raw, axis=2)
    assert (lengths < 0.7).any()
    assert (lengths > 1.4).any()
    twists = network.predict_twists(positions, upright(400))
    assert not twists[:, ~HAS].any()
    np.testing.assert_allclose(
        np.linalg.norm(twists[:, HAS], axis=2) * network.sd_rad[HAS] ** 2, np.minimum(lengths, 1), rtol=1e-5
    )
    np.testing.assert_allclose(compute_angle_difference(twists[:, HAS], raw), 0, atol=1e-5)


def test_frames_are_independent():
    network, positions = random_network(np.random.default_rng(0)), np.random.default_rng(1).normal(size=(30, 31, 3))
    together = network.predict_twists(positions, upright(len(positions)))
    for part in (slice(0, 3), slice(20, 21)):
        np.testing.assert_array_equal(network.predict_twists(positions[part], upright(len(positions[part]))), together[part])
    assert network.predict_twists(positions[:0], upright(0)).shape == (0, 31, 2)


@given(st.integers(0, 2**32 - 1))
def test_position_and_heading_are_irrelevant(seed):
    rng = np.random.default_rng(seed)
    positions, turn, way = rng.normal(size=(3, 31, 3)), random_terms.draw_rotations(rng, 1)[0], rng.normal(0, 5, 3)
    still = load_shipped_regressor().predict_twists(positions, upright(3))
    np.testing.assert_allclose(
        load_shipped_regressor().predict_twists(positions @ turn.T + way, np.tile(turn, (3, 1, 1))), still, atol=1e-2
    )


def test_unknown_frames_get_the_typical_twist(people):
    nothing = load_shipped_regressor().predict_twists(np.full((1, 31, 3), np.nan), upright(1))
    assert np.isfinite(nothing).all()
    np.testing.assert_array_equal(load_shipped_regressor().predict_twists(people[1][:1], np.full((1, 3, 3), np.nan)), nothing)
    arm = BODY.find_joint("LeftArm")
    usual = load_shipped_regressor().predict_twists(people[1], upright(len(people[1])))[:, arm]
    assert np.linalg.norm(nothing[0, arm]) < 0.9 * np.linalg.norm(usual, axis=1).mean()  # with less information


def test_shipped_regressor_predicts_held_out_twists(people):
    poses, places = people
    true = compute_twists(poses, BONES)[:, HAS]
    predicted = load_shipped_regressor().predict_twists(places, upright(len(places)))[:, HAS]
    none, error = compute_angle_difference(np.array([1.0, 0.0]), true), compute_angle_difference(predicted, true)
    assert error.mean() < 0.7 * none.mean()  # including the hands, whose twist the joints do not determine
    arms = [j in (BODY.find_joint("LeftArm"), BODY.find_joint("RightArm")) for j in np.flatnonzero(HAS)]
    assert error[:, arms].mean() < 0.35 * none[:, arms].mean()


def test_displaced_or_missing_joints_have_little_effect(people):
    poses, places = people
    rng, true = np.random.default_rng(0), compute_twists(poses, BONES)[:, HAS]
    displaced = places + rng.uniform(-0.02, 0.02, places.shape)
    displaced[rng.random(places.shape[:2]) < 0.1] = np.nan
    error = compute_angle_difference(load_shipped_regressor().predict_twists(displaced, upright(len(places)))[:, HAS], true)
    assert error.mean() < 0.85 * compute_angle_difference(np.array([1.0, 0.0]), true).mean()


def test_sd_covers_held_out_twists(people):
    poses, places = people
    error = compute_angle_difference(
        load_shipped_regressor().predict_twists(places, upright(len(places))), compute_twists(poses, BONES)
    )[:, HAS]
    assert ((error < 2 * load_shipped_regressor().sd_rad[HAS]).mean(axis=0) > 0.9).all()


def test_mirrored_joints_give_nearly_mirrored_twists(people):
    _, places = people
    predicted = load_shipped_regressor().predict_twists(places, upright(len(places)))
    mirrored = load_shipped_regressor().predict_twists(places[:, SWAP] * [-1, 1, 1], upright(len(places)))[:, SWAP] * [1, -1]
    assert np.degrees(compute_angle_difference(predicted, mirrored)[:, HAS].mean()) < 2


# files


def test_network_round_trips(tmp_path):
    network, positions = random_network(np.random.default_rng(0)), np.random.default_rng(1).normal(size=(5, 31, 3))
    write_twist_regressor(tmp_path / "mine.safetensors", network)
    loaded = read_twist_regressor(tmp_path / "mine.safetensors")
    np.testing.assert_allclose(
        loaded.predict_twists(positions, upright(5)), network.predict_twists(positions, upright(5)), rtol=1e-5
    )
    np.testing.assert_allclose(loaded.sd_rad, network.sd_rad, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda tensors: tensors.pop("sigma"), "sigma"),
        (lambda tensors: tensors.pop("weights.0"), r"weights\.0"),
        (lambda tensors: tensors.update({"weights.2": np.ones((9, 46), np.float16)}), "its layers are not 174 by 8 by 8 by 46"),
        (lambda tensors: tensors.update({"offsets.2": np.ones(44, np.float16)}), "a cosine and a sine for the 23 of 31 joints"),
        (lambda tensors: tensors["offsets.0"].__setitem__(3, np.nan), "not finite"),
        (lambda tensors: tensors["sigma"].__setitem__(0, 1.0), "a sigma for a joint without a bone"),
        (lambda tensors: tensors["sigma"].__setitem__(2, 0.0), "sigma"),
        (lambda tensors: tensors.update(more=np.ones(3, np.float16)), "unexpected tensors: more"),
    ],
)
def test_invalid_tensors_are_rejected(tmp_path, change, message):
    path = tmp_path / "mine.safetensors"
    write_twist_regressor(path, random_network(np.random.default_rng(0)))
    tensors = load_file(path)
    change(tensors)
    save_file(tensors, path)
    with pytest.raises(SceneError, match=rf"mine\.safetensors: is not a twist regressor .*({message})"):
        read_twist_regressor(path)


def test_invalid_and_missing_files_are_rejected(tmp_path):
    (tmp_path / "text.safetensors").write_text("not that", encoding="utf-8")
    for name in ("text", "none"):
        with pytest.raises(SceneError, match=rf"{name}\.safetensors: is not a twist regressor"):
            read_twist_regressor(tmp_path / f"{name}.safetensors")


def test_prediction_does_not_import_torch():
    code = "import sys, numpy as np; from mocapfix.solve.hybrik import load_shipped_regressor; "
    code += "load_shipped_regressor().predict_twists(np.zeros((1, 31, 3)), np.eye(3)[None]); print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "False"
