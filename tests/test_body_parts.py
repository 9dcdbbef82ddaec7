"""Takes that show a part of the body: what is solved is as accurate as in the whole take, the rest is not presented as known."""

import json

import numpy as np
import pytest

from mocapfix import pipeline
from mocapfix.io.capture import read_capture
from mocapfix.model.animation import Animation
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.options import OutputOptions
from mocapfix.synthetic import compose_take
from tests.conftest import build_c3d

NAMES = load_cmu31_body().skeleton.names
PELVIS = {"LFWT", "RFWT", "LBWT", "RBWT"}
LEFT_LEG = {"LTHI", "LKNE", "LSHN", "LANK", "LHEE", "LTOE", "LMT5"}
LEGS = LEFT_LEG | {f"R{label[1:]}" for label in LEFT_LEG}
LEFT_ARM = {"LSHO", "LUPA", "LELB", "LFRM", "LWRA", "LWRB", "LFIN"}
TRUNK = {"C7", "T10", "CLAV", "STRN", "RBAC"}
PARTS = {
    "pelvis and legs": PELVIS | LEGS,
    "pelvis and left leg": PELVIS | LEFT_LEG,
    "left leg": LEFT_LEG,
    "trunk and left arm": TRUNK | LEFT_ARM,
}
SOLVED_JOINTS = {
    "pelvis and legs": ("Hips", "LeftUpLeg", "RightUpLeg", "LeftLeg", "RightLeg", "LeftFoot", "RightFoot"),
    "pelvis and left leg": ("Hips", "LeftUpLeg", "LeftLeg", "LeftFoot"),
    "left leg": ("LeftLeg", "LeftFoot"),
    "trunk and left arm": ("Spine1", "LeftArm", "LeftForeArm", "LeftHand"),
}
UNSOLVED_JOINTS = {
    "pelvis and legs": ("Spine1", "Head", "LeftArm", "RightHand"),
    "pelvis and left leg": ("Spine1", "RightLeg", "RightFoot", "Head"),
    "left leg": ("Hips", "RightUpLeg", "Spine1"),
    "trunk and left arm": ("Hips", "LeftUpLeg", "Head", "RightForeArm"),
}
MAX_ADDED_ERROR_MM = 4.0
"""compared with the joint error of the part beyond that of the whole body; the ends of a part lack the evidence beyond it"""


@pytest.fixture(scope="module")
def truth():
    return compose_take(seed=3, seconds=6.0)


def write_part(path, truth, labels, *, keep_empty_labels=False):
    kept = [m for m, label in enumerate(truth.labels) if label in labels or keep_empty_labels]
    markers = truth.damaged_positions[:, kept].copy()
    markers[:, [truth.labels[m] not in labels for m in kept]] = np.nan
    path.write_bytes(build_c3d(markers, [truth.labels[m] for m in kept]))
    return path


def find_frames_with_arms(truth):
    """Return the frames (T,) in which no arm is lost as a whole: an arm cannot be estimated from the trunk alone."""
    arms = [[truth.labels.index(f"{side}{label[1:]}") for label in LEFT_ARM - {"LSHO"}] for side in "LR"]
    return ~np.any([truth.missing_mask[:, arm].all(1) for arm in arms], axis=0)


def compute_joint_errors_mm(truth, result, joints):
    columns = [NAMES.index(name) for name in joints]
    frames = find_frames_with_arms(truth)
    difference = result.joint_position_world[frames][:, columns] - truth.joint_positions[frames][:, columns]
    return 1e3 * np.linalg.norm(difference, axis=-1).mean(0)


@pytest.fixture(scope="module")
def whole(truth, tmp_path_factory):
    return pipeline.clean(write_part(tmp_path_factory.mktemp("whole") / "whole.c3d", truth, set(truth.labels)))


@pytest.fixture(scope="module", params=PARTS)
def part(request, truth, tmp_path_factory):
    path = write_part(tmp_path_factory.mktemp("part") / "part.c3d", truth, PARTS[request.param])
    return request.param, pipeline.clean(path)


def test_solved_joints_are_nearly_as_accurate_as_those_of_the_whole_body(part, whole, truth):
    name, result = part
    joints = SOLVED_JOINTS[name]
    added_mm = compute_joint_errors_mm(truth, result, joints) - compute_joint_errors_mm(truth, whole, joints)
    assert added_mm.mean() < MAX_ADDED_ERROR_MM, dict(zip(joints, added_mm, strict=True))
    residuals = [each.report["solve"]["marker_residual_mm"]["mean"] for each in (result, whole)]
    assert residuals[0] < residuals[1] + 1.0


def test_joints_that_no_marker_shows_have_no_position(part):
    name, result = part
    assert result.subject is not None
    is_solved = result.subject.solved_joints
    assert is_solved[[NAMES.index(joint) for joint in SOLVED_JOINTS[name]]].all()
    assert not is_solved[[NAMES.index(joint) for joint in UNSOLVED_JOINTS[name]]].any()
    for values in (result.joint_position_world[..., 0], result.motion.joint_sd):
        np.testing.assert_array_equal(np.isnan(values), np.broadcast_to(~is_solved, values.shape))
    report = result.report
    assert report["solve"]["solved_joints"] == [joint for joint, solved in zip(NAMES, is_solved, strict=True) if solved]
    assert all((report["solve"]["joint_deviation_mm"][joint]["mean"] is None) == (not solved)
               for joint, solved in zip(NAMES, is_solved, strict=True))  # fmt: skip
    assert any(note.startswith("Not shown by any marker, so not solved and kept at rest:") for note in report["notes"])


def test_gaps_of_a_part_are_filled_from_its_body(part, truth):
    _, result = part
    fill = result.report["fill"]
    assert fill["left_empty"] == 0
    columns = [truth.labels.index(label) for label in result.take.labels]
    is_filled = truth.missing_mask[:, columns] & find_frames_with_arms(truth)[:, None]
    error_mm = 1e3 * np.linalg.norm(result.take.markers - truth.marker_positions[:, columns], axis=-1)
    assert np.median(error_mm[is_filled]) < 10
    untouched = ~truth.missing_mask[:, columns] & ~truth.spike_mask[:, columns]
    changed = (result.take.markers != result.input_take.markers).any(-1) & untouched
    assert changed.mean() < 1e-3


def test_outputs_hold_31_joints_and_say_which_are_real(truth, tmp_path):
    result = pipeline.clean(write_part(tmp_path / "legs.c3d", truth, PELVIS | LEGS))
    paths = result.write(tmp_path / "out", options=OutputOptions(extra_formats=("npz",)))
    assert result.subject is not None
    is_solved = result.subject.solved_joints
    with np.load(paths["npz"]) as arrays:
        np.testing.assert_array_equal(arrays["solved_joints"], is_solved)
        np.testing.assert_array_equal(np.isnan(arrays["joints"]).all(axis=(0, 2)), ~is_solved)
        rotations = arrays["rotations"]
    held = [NAMES.index(name) for name in UNSOLVED_JOINTS["pelvis and legs"]]
    np.testing.assert_allclose(rotations[:, held], np.broadcast_to(rotations[:1, held], rotations[:, held].shape), atol=1e-12)
    assert np.ptp(rotations[:, NAMES.index("LeftLeg")], axis=0).max() > 0.1
    animation = read_capture(paths["bvh"])
    assert isinstance(animation, Animation)
    assert len(animation.names) >= len(NAMES)
    assert json.loads(paths["report.json"].read_text(encoding="utf-8"))["solve"]["solved_joints"][0] == "Hips"


def test_labels_without_samples_are_no_part_of_the_body(truth, tmp_path):
    sparse = pipeline.clean(write_part(tmp_path / "empty.c3d", truth, PELVIS | LEGS, keep_empty_labels=True))
    cut = pipeline.clean(write_part(tmp_path / "cut.c3d", truth, PELVIS | LEGS))
    assert sparse.subject is not None
    assert cut.subject is not None
    assert sparse.joint_position_world is not None
    assert cut.joint_position_world is not None
    assert sparse.subject.labels == cut.subject.labels
    np.testing.assert_array_equal(sparse.subject.solved_joints, cut.subject.solved_joints)
    np.testing.assert_allclose(sparse.joint_position_world, cut.joint_position_world, atol=1e-3, equal_nan=True)


def test_subject_of_a_whole_body_serves_for_a_part(truth, whole, tmp_path):
    path = write_part(tmp_path / "legs.c3d", truth, PELVIS | LEGS)
    result = pipeline.clean(path, subject=whole.subject)
    assert result.subject is not None
    assert set(result.subject.labels) == PELVIS | LEGS
    np.testing.assert_array_equal(result.subject.skeleton.offsets, whole.subject.skeleton.offsets)
    errors_mm = compute_joint_errors_mm(truth, result, SOLVED_JOINTS["pelvis and legs"])
    assert (errors_mm < compute_joint_errors_mm(truth, whole, SOLVED_JOINTS["pelvis and legs"]) + 3.0).all()
