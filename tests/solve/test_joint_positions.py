"""Joint positions from markers: exact for exact markers, otherwise with errors that agree with their standard deviations."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.solve import kinematics, mean_pose
from mocapfix.solve.initial_motion import estimate_joint_positions
from mocapfix.subject.library import load_marker_set
from mocapfix.synthetic import compose_take
from tests.kernels import random_terms

BODY, MARKER_SET = load_cmu31_body(), load_marker_set("cmu41")
NAMES = BODY.skeleton.names
MEAN = mean_pose.load_mean_pose_prior("mean-pose", BODY.skeleton)
NOMINAL = Subject(
    BODY.skeleton,
    MARKER_SET.name,
    MARKER_SET.labels,
    MARKER_SET.joints,
    MARKER_SET.marker_offsets,
    np.full(len(MARKER_SET.labels), 0.005),
)
EXACT = replace(NOMINAL, marker_spread=np.full(len(MARKER_SET.labels), 1e-7))
UNDETERMINED_NAMES = (
    "Spine",
    "Neck1",
    "FingerBase",
    "HandIndex1",
    "Thumb",
    "ToeBase",
)  # joints whose bend the markers do not determine
DETERMINED = np.array([not name.endswith(UNDETERMINED_NAMES) for name in NAMES])
CARRYING = [NAMES[j] for j in np.unique(MARKER_SET.joints)]
seeds = st.integers(0, 2**32 - 1)


def index(*names):
    return [NAMES.index(name) for name in names]


def take_of(markers):
    return Take(markers, MARKER_SET.labels, 100.0)


def draw_poses(rng, frames):
    """Return joints (T, J, 3) and markers (T, K, 3) of NOMINAL in poses drawn from the prior."""
    local = np.tile(MEAN.mean_rotations, (frames, 1, 1, 1))
    for j in range(1, len(NAMES)):
        if BODY.free_joints[j]:
            turn = rng.multivariate_normal(np.zeros(3), np.linalg.inv(MEAN.information[j]), frames)
            local[:, j] = Rotation.from_rotvec(turn).as_matrix() @ local[:, j]
    local[:, 0] = random_terms.draw_rotations(rng, frames)
    zeros, none = np.zeros(frames, int), np.zeros((frames, 0))
    return kinematics.compute_joint_and_marker_positions(
        NOMINAL, Motion(rng.normal(0, 2, (frames, 3)), local, zeros, zeros, none, none)
    )


def test_exact_markers_give_exact_joints():
    truth = compose_take(seed=2, seconds=6.0, rate=30.0)
    exact = replace(truth.subject, marker_spread=EXACT.marker_spread)
    joints, markers = kinematics.compute_joint_and_marker_positions(exact, truth.motion)
    found, deviation, _ = estimate_joint_positions(take_of(markers), exact, BODY)
    np.testing.assert_allclose(found[:, DETERMINED], joints[:, DETERMINED], atol=1e-9)
    assert deviation[:, DETERMINED].max() < 1e-5
    assert np.linalg.norm(found - joints, axis=-1)[:, ~DETERMINED].max() < 0.1


@given(seeds)
def test_estimate_is_equivariant_to_rigid_motion(seed):
    rng = np.random.default_rng(seed)
    _, markers = draw_poses(rng, 3)
    markers += rng.normal(0, 0.01, markers.shape)
    markers[rng.random(markers.shape[:2]) < 0.2] = np.nan
    turn, way = random_terms.draw_rotations(rng, 1)[0], rng.normal(0, 2, 3)
    here, sd, _ = estimate_joint_positions(take_of(markers), NOMINAL, BODY)
    there, moved_sd, _ = estimate_joint_positions(take_of(markers @ turn.T + way), NOMINAL, BODY)
    np.testing.assert_allclose(there, here @ turn.T + way, atol=1e-6)
    np.testing.assert_allclose(moved_sd, sd, atol=1e-6)


@pytest.mark.parametrize("complete", [True, False])
def test_errors_agree_with_the_sd(complete):
    rng = np.random.default_rng(1)
    joints, markers = draw_poses(rng, 3000)
    markers += rng.normal(0, 0.005, markers.shape)
    if not complete:
        markers[rng.random(markers.shape[:2]) < 0.3] = np.nan
    found, deviation, _ = estimate_joint_positions(take_of(markers), NOMINAL, BODY)
    known = ~np.isnan(deviation)
    assert known.mean() > 0.99
    ratio = np.abs(found - joints) / deviation[..., None]
    each = np.array([np.median(ratio[:, j][known[:, j]]) for j in range(len(NAMES))]) / 0.6745
    assert each.max() < 1.3
    assert each.min() > 0.5
    assert (ratio[known] < 1).mean() == pytest.approx(0.68, abs=0.08)
    assert (ratio[known] < 2).mean() == pytest.approx(0.95, abs=0.03)


@pytest.mark.parametrize("name", CARRYING)
def test_unmarked_segment_follows_its_neighbours_with_larger_sd(name):
    rng, is_missing = np.random.default_rng(3), MARKER_SET.joints == NAMES.index(name)
    joints, markers = draw_poses(rng, 200)
    before, sd, _ = estimate_joint_positions(take_of(markers), NOMINAL, BODY)
    markers[:, is_missing] = np.nan
    found, deviation, _ = estimate_joint_positions(take_of(markers), NOMINAL, BODY)
    assert np.isfinite(found).all()
    ratio = np.abs(found - joints) / deviation[..., None]
    assert (ratio < 2).mean() > 0.93
    assert (deviation > 0.999 * sd).mean() > 0.95
    other = "Right" if name.startswith("Left") else "Left"
    far = index(f"{other}Foot", f"{other}Hand")
    np.testing.assert_allclose(found[:, far], before[:, far], atol=0.005)


def test_knee_without_thigh_markers_is_one_thigh_from_the_hip():
    joints, markers = draw_poses(np.random.default_rng(4), 300)
    markers[:, MARKER_SET.joints == NAMES.index("LeftUpLeg")] = np.nan
    found, _, _ = estimate_joint_positions(take_of(markers), NOMINAL, BODY)
    hip, knee = index("LeftUpLeg", "LeftLeg")
    length = np.linalg.norm(NOMINAL.skeleton.offsets[knee])
    np.testing.assert_allclose(np.linalg.norm(found[:, knee] - found[:, hip], axis=-1), length, atol=0.02)
    assert np.median(np.linalg.norm(found - joints, axis=-1)[:, knee]) < 0.02


@pytest.mark.parametrize("label", ["STRN", "LFWT", "LBHD", "RHEE"])
def test_outlying_marker_is_rejected(label):
    rng = np.random.default_rng(5)
    joints, markers = draw_poses(rng, 100)
    complete, _, _ = estimate_joint_positions(take_of(markers), NOMINAL, BODY)
    markers[:, MARKER_SET.labels.index(label)] += 0.2 * random_terms.draw_units(rng, 100)
    found, _, _ = estimate_joint_positions(take_of(markers), NOMINAL, BODY)
    moved = np.linalg.norm(found - complete, axis=-1)
    assert np.quantile(moved, 0.95) < 0.03
    assert np.linalg.norm(found - joints, axis=-1).mean() < 0.03


def test_coincident_joints_get_one_position():
    _, markers = draw_poses(np.random.default_rng(6), 20)
    markers += np.random.default_rng(7).normal(0, 0.01, markers.shape)
    found, deviation, _ = estimate_joint_positions(take_of(markers), NOMINAL, BODY)
    for names in (("Hips", "LHipJoint", "RHipJoint", "LowerBack"), ("Neck", "LeftShoulder", "RightShoulder")):
        together = index(*names)
        np.testing.assert_array_equal(found[:, together], found[:, together[:1]].repeat(len(names), 1))
        np.testing.assert_array_equal(deviation[:, together], deviation[:, together[:1]].repeat(len(names), 1))


def test_frames_are_independent():
    _, markers = draw_poses(np.random.default_rng(8), 40)
    alone = [estimate_joint_positions(take_of(markers[t : t + 1]), NOMINAL, BODY)[0][0] for t in range(0, 40, 13)]
    np.testing.assert_array_equal(estimate_joint_positions(take_of(markers), NOMINAL, BODY)[0][::13], alone)


def test_frames_without_markers_have_no_joints():
    joints, markers = draw_poses(np.random.default_rng(9), 5)
    markers[[0, 3]] = np.nan
    found, deviation, _ = estimate_joint_positions(take_of(markers), EXACT, BODY)
    assert np.isnan(found[[0, 3]]).all()
    assert np.isnan(deviation[[0, 3]]).all()
    np.testing.assert_allclose(found[[1, 2, 4]][:, DETERMINED], joints[[1, 2, 4]][:, DETERMINED], atol=1e-8)
    assert estimate_joint_positions(take_of(markers[:0]), NOMINAL, BODY)[0].shape == (0, len(NAMES), 3)


@given(seeds, st.integers(0, 3))
def test_few_markers_determine_nearby_joints_only(seed, count):
    rng = np.random.default_rng(seed)
    _, markers = draw_poses(rng, 1)
    kept = rng.choice(markers.shape[1], count, replace=False)
    markers[:, np.setdiff1d(np.arange(markers.shape[1]), kept)] = np.nan
    found, deviation, _ = estimate_joint_positions(take_of(markers), NOMINAL, BODY)
    np.testing.assert_array_equal(np.isnan(found).all(-1), np.isnan(deviation))
    assert (deviation[~np.isnan(deviation)] > 0).all()
    if count:
        assert not np.isnan(deviation[0, MARKER_SET.joints[kept]]).any()  # its own segment's joint is within reach


@pytest.mark.parametrize("at", [0.0, 5.0])
def test_coincident_markers_give_finite_values(at):
    found, deviation, _ = estimate_joint_positions(take_of(np.full((2, len(MARKER_SET.labels), 3), at)), NOMINAL, BODY)
    known = ~np.isnan(deviation)
    assert np.isfinite(found[known]).all()


def test_calibration_error_increases_the_sd():
    _, markers = draw_poses(np.random.default_rng(10), 2)
    uncertain_subject = replace(NOMINAL, joint_sd=np.full(len(NAMES), 0.02))
    at, sd, _ = estimate_joint_positions(take_of(markers), NOMINAL, BODY)
    same, larger_sd, _ = estimate_joint_positions(take_of(markers), uncertain_subject, BODY)
    np.testing.assert_array_equal(same, at)
    np.testing.assert_allclose(larger_sd**2, sd**2 + 0.02**2)
