"""Legs among rigid groups of markers without informative labels."""

import numpy as np
import pytest

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.solve.kinematics import compute_world_poses
from mocapfix.subject.unlabelled_markers import guess_from_rigid_groups
from mocapfix.synthetic import compose_take

SKELETON = load_cmu31_body().skeleton
WALK = compose_take(seed=8, seconds=8.0, rate=25.0)
LEFT_LEG, RIGHT_LEG = (tuple(side + name for name in ("UpLeg", "Leg", "Foot")) for side in ("Left", "Right"))
BELOW_HIPS = {"UpLeg": [0.1, -0.2, 0.05], "Leg": [0.1, -0.2, 0.03], "Foot": [0.0, -0.04, 0.05]}
"""Middle of the markers on each segment of a left leg, in metres in the axes of its joint."""


def place_groups(names: tuple[str, ...], seed: int = 0) -> tuple[Take, dict[str, str]]:
    """Return a take of four markers on each of some segments, in no order, and the segment of each label."""
    rng = np.random.default_rng(seed)
    positions, rotations = compute_world_poses(WALK.subject.skeleton, WALK.motion)
    paths, segments = [], []
    for name in names:
        joint, side = SKELETON.find_joint(name), -1 if name.startswith("Right") else 1
        middle = BELOW_HIPS.get(name.removeprefix("Left").removeprefix("Right"), [0.0, 0.0, 0.0])
        spread = [0.1, 0.01, 0.1] if name == "Hips" else [0.02, 0.01, 0.07] if name.endswith("Foot") else [0.03, 0.05, 0.03]
        corners = np.array([[1, 1, 1], [-1, 1, 1], [1, -1, -1], [-1, 1, -1]]) * spread
        for offset in np.array(middle) * [side, 1, 1] + corners + rng.normal(0, 0.005, (4, 3)):
            paths.append(positions[:, joint] + rotations[:, joint] @ offset)
            segments.append(name)
    order = rng.permutation(len(paths))
    markers = np.stack([paths[k] for k in order], axis=1) + rng.normal(0, 0.0005, (len(positions), len(paths), 3))
    labels = tuple(f"M{k}" for k in range(len(paths)))
    return Take(markers, labels, 25.0), {label: segments[k] for label, k in zip(labels, order, strict=True)}


@pytest.mark.parametrize(
    "names",
    [("Hips", *LEFT_LEG, *RIGHT_LEG), ("Hips", *RIGHT_LEG), ("Hips", "Spine1", "Head", *LEFT_LEG, *RIGHT_LEG)],
    ids=["legs", "right leg", "legs and trunk"],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_every_marker_on_a_leg_gets_its_segment(names, seed):
    take, segments = place_groups(names, seed)
    guess = guess_from_rigid_groups(take, take.labels, SKELETON)
    assert guess is not None
    found = {label: SKELETON.names[joint] for label, joint in zip(guess.labels, guess.joints, strict=True)}
    assert found == {label: name for label, name in segments.items() if name in ("Hips", *LEFT_LEG, *RIGHT_LEG)}


def test_a_mirrored_person_has_the_sides_exchanged():
    take, segments = place_groups(("Hips", *LEFT_LEG, *RIGHT_LEG))
    guess = guess_from_rigid_groups(take.replace_markers(take.markers * [-1, 1, 1]), take.labels, SKELETON)
    assert guess is not None
    mirrored = {"Left": "Right", "Right": "Left", "Hips": "Hips"}
    for label, joint in zip(guess.labels, guess.joints, strict=True):
        side = next(word for word in mirrored if segments[label].startswith(word))
        assert SKELETON.names[joint].startswith(mirrored[side])


@pytest.mark.parametrize(
    "names",
    [(*LEFT_LEG, *RIGHT_LEG), ("Hips", "LeftUpLeg", "RightUpLeg"), ("Spine1", "LeftArm", "LeftForeArm", "LeftHand"), ("Hips",)],
    ids=["no pelvis", "thighs", "arm", "pelvis"],
)
def test_other_parts_of_a_body_are_no_legs(names):
    take, _ = place_groups(names)
    assert guess_from_rigid_groups(take, take.labels, SKELETON) is None


def test_a_person_at_rest_shows_no_joints():
    take, _ = place_groups(("Hips", *LEFT_LEG, *RIGHT_LEG))
    at_rest = take.replace_markers(np.tile(take.markers[:1], (take.frame_count, 1, 1)))
    assert guess_from_rigid_groups(at_rest, take.labels, SKELETON) is None
