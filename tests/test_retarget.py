from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.animation import Animation, compose_transforms
from mocapfix.animations import joint_mapping
from mocapfix.animations.retarget import SkeletonAlignment, align_skeleton, convert_to_cmu31, from_cmu31
from mocapfix.read import amc, bvh
from mocapfix.skeleton import load_cmu31_body

CAPTURES = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "captures"
FILES = sorted(CAPTURES.glob("*/*.bvh")) + sorted(CAPTURES.glob("*/*.amc"))
OURS = load_cmu31_body().skeleton
ROTATIONS = ("Zrotation", "Xrotation", "Yrotation")
POSITIONS = ("Xposition", "Yposition", "Zposition")

# A figure with hanging arms that faces +X, with a spine of one joint, a joint before the hips, and a roll joint in an arm.
FIGURE = {
    "Reference": (None, (0, 0, 0)),
    "Hips": ("Reference", (0, 95, 0)),
    "Chest": ("Hips", (0, 30, 0)),
    "Neck": ("Chest", (0, 25, 0)),
    "Head": ("Neck", (0, 10, 0)),
    "LeftCollar": ("Chest", (0, 20, -3)),
    "LeftShoulder": ("LeftCollar", (0, 0, -15)),
    "LeftElbow": ("LeftShoulder", (0, -28, 0)),
    "LeftRoll": ("LeftElbow", (0, -12, 0)),
    "LeftWrist": ("LeftRoll", (0, -12, 0)),
    "RightCollar": ("Chest", (0, 20, 3)),
    "RightShoulder": ("RightCollar", (0, 0, 15)),
    "RightElbow": ("RightShoulder", (0, -28, 0)),
    "RightWrist": ("RightElbow", (0, -24, 0)),
    "LeftHip": ("Hips", (0, 0, -10)),
    "LeftKnee": ("LeftHip", (0, -42, 0)),
    "LeftAnkle": ("LeftKnee", (0, -43, 0)),
    "RightHip": ("Hips", (0, 0, 10)),
    "RightKnee": ("RightHip", (0, -42, 0)),
    "RightAnkle": ("RightKnee", (0, -43, 0)),
}


def figure(seed: int, frames: int = 5, bend: float = 1.0) -> Animation:
    """-> the figure, turned everywhere as chance has it, but in its roll joint, which stays."""
    names = tuple(FIGURE)
    channels = tuple((*POSITIONS, *ROTATIONS) if name in ("Reference", "Hips") else ROTATIONS for name in names)
    values = np.random.default_rng(seed).uniform(-60, 60, (frames, sum(len(each) for each in channels))) * bend
    here = Animation(
        names=names,
        parents=np.array([names.index(above) if above else -1 for above, _ in FIGURE.values()]),
        offsets=np.array([offset for _, offset in FIGURE.values()], float),
        end_sites=tuple(np.array([[15.0, -8, 0]]) if "Ankle" in name else np.empty((0, 3)) for name in names),
        channels=channels,
        values=values,
        rate=120.0,
    )
    values[:, here.get_rotation_channels(names.index("LeftRoll"))[0]] = 0.0
    return here


def fit_of(animation: Animation) -> SkeletonAlignment:
    choice = joint_mapping.map_joints(animation.names, animation.parents)
    assert choice.mapping is not None, choice.reason
    fit = align_skeleton(animation, choice.mapping)
    assert fit is not None
    return fit


def places(fit: SkeletonAlignment, root: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """-> (T, 31, 3) metres where a pose puts the joints of the fitted skeleton."""
    apart = np.tile(fit.skeleton.offsets, (len(root), 1, 1))
    apart[:, 0] = root
    return compose_transforms(fit.skeleton.parents, apart, rotations)[0]


def check(animation: Animation) -> None:
    """The known joints lie where the file's do, and what went over comes back."""
    fit = fit_of(animation)
    root, rotations = convert_to_cmu31(animation, fit)
    known = fit.file_joints >= 0
    position, _ = animation.compute_world_poses()
    np.testing.assert_allclose(places(fit, root, rotations)[:, known], position[:, fit.file_joints[known]], atol=1e-6)
    values = from_cmu31(animation, fit, range(31), np.arange(animation.frame_count), rotations)
    np.testing.assert_allclose(
        animation.replace_values(values).compute_local_rotations(), animation.compute_local_rotations(), atol=1e-8
    )


@given(st.integers(0, 10**6))
def test_joints_lie_where_the_files_do_and_come_back(seed):
    check(figure(seed))


@pytest.mark.skipif(not FILES, reason="the real captures are not here")
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_of_every_capture_joints_lie_where_the_files_do_and_come_back(path):
    found = (bvh if path.suffix == ".bvh" else amc).animation(path)
    check(found.replace_values(found.values[:: max(1, found.frame_count // 50)]))


def test_the_rest_pose_is_told_in_our_axes():
    resting = figure(0, frames=1, bend=0.0)
    fit = fit_of(resting)
    _, rotations = convert_to_cmu31(resting, fit)
    position = places(fit, np.zeros((1, 3)), np.tile(np.eye(3), (1, 31, 1, 1)))[0]
    at = dict(zip(OURS.names, position, strict=True))
    for joint, (side, way) in {"LeftForeArm": ("LeftArm", 1), "RightForeArm": ("RightArm", -1)}.items():
        bone = at[joint] - at[side]
        np.testing.assert_allclose(bone / np.linalg.norm(bone), [way, 0, 0], atol=1e-6)  # a T-pose that faces +Z
    facing = rotations[0, 0] @ [0, 0, 1]
    np.testing.assert_allclose(facing, [1, 0, 0], atol=1e-9)
    lowered = rotations[0, OURS.find_joint("LeftArm")]
    np.testing.assert_allclose(lowered, Rotation.from_euler("Z", -90, degrees=True).as_matrix(), atol=1e-6)
    np.testing.assert_allclose(rotations[0, OURS.find_joint("LeftForeArm")], np.eye(3), atol=1e-6)
    assert np.linalg.norm(fit.skeleton.offsets[OURS.find_joint("LeftLeg")]) == pytest.approx(0.42)
    assert np.linalg.norm(fit.skeleton.ends[OURS.find_joint("LThumb")]) > 0


def test_of_a_bend_of_the_trunk_each_joint_takes_its_part():
    bent = figure(0, frames=1, bend=0.0)
    values = bent.values.copy()
    values[:, bent.get_rotation_channels(bent.index("Chest"))[0]] = [30, 0, 0]
    _, rotations = convert_to_cmu31(bent.replace_values(values), fit_of(bent))
    degrees = np.degrees(Rotation.from_matrix(rotations[0]).magnitude())
    np.testing.assert_allclose([degrees[OURS.find_joint(name)] for name in ("LowerBack", "Spine", "Spine1")], 10, atol=1e-9)


def test_what_is_not_there_is_not_there_in_ours_either():
    whole = figure(4)
    values = whole.values.copy()
    values[2, whole.get_rotation_channels(whole.index("Chest"))[0][1]] = np.nan
    torn, fit = whole.replace_values(values), fit_of(whole)
    (root, rotations), (_, expected) = convert_to_cmu31(torn, fit), convert_to_cmu31(whole, fit)
    assert np.isfinite(root).all()
    missing = np.asarray(np.isnan(rotations).any((2, 3)))
    assert set(np.argwhere(missing)[:, 0]) == {2}
    there = {OURS.names[joint] for joint in np.flatnonzero(~missing[2])}
    assert "Spine1" not in there
    assert {"Hips", "LeftUpLeg", "RightFoot"} <= there
    np.testing.assert_array_equal(rotations[~missing], expected[~missing])


@pytest.mark.parametrize("ours", ["LeftArm", "LeftHand", "Spine1", "LowerBack", "Hips", "Head"])
def test_one_joint_alone_turns_and_is_exact(ours):
    """Ours is given other turns: the file's joint is turned so in the world, its children keep their own."""
    before, turn = figure(1), Rotation.from_euler("XYZ", [20, 30, -40], degrees=True).as_matrix()
    before = before.replace_values(
        np.where(np.arange(before.values.shape[1]) == before.get_rotation_channels(8)[0][0], 25.0, before.values)
    )
    fit = fit_of(before)
    _, rotations = convert_to_cmu31(before, fit)
    rotations[:, OURS.find_joint(ours)] = rotations[:, OURS.find_joint(ours)] @ turn
    frames = np.array([1, 3])
    values = from_cmu31(before, fit, [OURS.find_joint(ours)], frames, rotations[frames])
    after = before.replace_values(values)
    changed = {before.names[j] for j in range(len(before.names)) if (values != before.values)[:, before.joint_columns[j]].any()}
    theirs = {"LeftArm": "LeftShoulder", "LeftHand": "LeftWrist", "Spine1": "Chest", "LowerBack": "Chest", "Hips": "Hips"}
    assert changed == {theirs.get(ours, "Head")}
    assert not (values != before.values)[[0, 2, 4]].any()
    _, again = convert_to_cmu31(after, fit)
    apart, back = np.eye(3), np.eye(3)
    chain = ("LowerBack", "Spine", "Spine1") if theirs.get(ours) == "Chest" else ("Neck1", "Head") if ours == "Head" else (ours,)
    for name in chain:
        apart, back = apart @ rotations[1, OURS.find_joint(name)], back @ again[1, OURS.find_joint(name)]
    np.testing.assert_allclose(back, apart, atol=1e-9)


def test_a_figure_that_never_stands_is_not_fitted():
    lying = replace(figure(2, bend=0.0), rotation_y_up_file=np.eye(3)[[0, 2, 1]] * [[1], [1], [-1]])
    choice = joint_mapping.map_joints(lying.names, lying.parents)
    assert choice.mapping is not None
    assert align_skeleton(lying, choice.mapping) is None


def test_a_rest_pose_that_is_none_is_made_up_for_by_a_frame_that_stands():
    """Every joint's axes are turned as chance has it: the numbers change, and with them the rest pose, the motion does not."""
    plain, rng = figure(3, bend=0.3), np.random.default_rng(3)
    values = plain.values.copy()
    for joint in range(len(plain.names)):
        values[0, plain.get_rotation_channels(joint)[0]] = 0.0
    plain = plain.replace_values(values)
    axes = Rotation.random(len(plain.names), rng=rng).as_matrix()
    above = np.concatenate([np.eye(3)[None], axes[plain.parents[1:]]])
    turned = np.swapaxes(above, 1, 2) @ plain.compute_local_rotations() @ axes
    other = replace(
        plain,
        offsets=np.einsum("jba,jb->ja", above, plain.offsets),
        end_sites=tuple(ends @ own for ends, own in zip(plain.end_sites, axes, strict=True)),
    )
    hips = other.index("Hips")
    other = other.replace_values(other.replace_rotations(np.arange(len(other.names)), np.arange(5), turned))
    other = other.replace_values(
        other.replace_positions(np.array([hips]), np.arange(5), plain.compute_local_positions()[:, [hips]] @ above[hips])
    )
    np.testing.assert_allclose(other.compute_world_poses()[0], plain.compute_world_poses()[0], atol=1e-9)
    expected, found = convert_to_cmu31(plain, fit_of(plain)), convert_to_cmu31(other, fit_of(other))
    np.testing.assert_allclose(found[0], expected[0], atol=1e-9)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-6)
