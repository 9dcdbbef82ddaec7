"""HybrIK on the average body: exact, wrong and missing joints, and invalid arguments."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.errors import ConstraintError
from mocapfix.lab import sound_takes
from mocapfix.lab.sound_takes import build_known_motion
from mocapfix.model.motion import FrameStatus
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.solve import initial_motion, kinematics, mean_pose
from mocapfix.subject.library import load_marker_set

SKELETON, MARKER_SET = load_cmu31_body().skeleton, load_marker_set("cmu41")
SUBJECT = Subject(
    SKELETON, MARKER_SET.name, MARKER_SET.labels, MARKER_SET.joints, MARKER_SET.marker_offsets, np.zeros(len(MARKER_SET.labels))
)
NO_TWIST = np.tile([1.0, 0.0], (1, 31, 1))  # with little information
VARIANTS = ("naive", "adaptive", "x")


@pytest.fixture(scope="module")
def people():
    """Return 100 poses at random places in the world, their joints (100, J, 3) and markers (100, K, 3)."""
    rng = np.random.default_rng(0)
    rotations, places = sound_takes.load_unseen_poses()[::10].copy(), rng.normal(0, 1, (100, 3))
    rotations[:, 0] = Rotation.random(100, rng).as_matrix() @ rotations[:, 0]
    motion = build_known_motion(places, rotations)
    return motion, *kinematics.compute_joint_and_marker_positions(SUBJECT, motion)


def joints_of(motion, subject=SUBJECT):
    return kinematics.compute_world_poses(subject.skeleton, motion)[0]


def index(name):
    return SKELETON.find_joint(name)


@pytest.mark.parametrize("variant", VARIANTS)
def test_exact_joints_are_reproduced(people, variant):
    _, joints, _ = people
    found = initial_motion.solve_hybrik(joints, SUBJECT, variant=variant, twists=NO_TWIST)
    assert np.abs(joints_of(found) - joints).max() < 5e-5
    assert (found.status == FrameStatus.PLACED).all()


def test_exact_joints_and_twists_give_the_pose(people):
    motion, joints, _ = people
    found = initial_motion.solve_hybrik(joints, SUBJECT, twists=1e9 * true_twists(motion.local_rotations))
    boned = [index(name) for name in ("LowerBack", "Spine", "LeftArm", "LeftForeArm", "RightUpLeg", "RightLeg", "Neck")]
    assert np.abs(found.local_rotations[:, boned] - motion.local_rotations[:, boned]).max() < 1e-3


def true_twists(rotations):
    """Return (T, J, 2): each rotation about the bone to its joint's children, by scipy's quaternions."""
    twists = np.tile([1.0, 0.0], (*rotations.shape[:2], 1))
    for j in range(1, 31):
        bones = SKELETON.offsets[(SKELETON.parents == j) & (np.linalg.norm(SKELETON.offsets, axis=1) > 1e-3)]
        if len(bones):
            quaternion = Rotation.from_matrix(rotations[:, j]).as_quat()
            half = quaternion[:, :3] @ bones.mean(0) / np.linalg.norm(bones.mean(0))
            angle = 2 * np.arctan2(half, quaternion[:, 3])
            twists[:, j] = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return twists


def test_markers_determine_the_twist(people):
    _, joints, markers = people
    by_markers = initial_motion.solve_hybrik(joints, SUBJECT, twists=NO_TWIST, markers=markers)
    without = initial_motion.solve_hybrik(joints, SUBJECT, twists=NO_TWIST)
    assert np.abs(joints_of(by_markers) - joints).max() < 5e-5
    off = [
        np.linalg.norm(kinematics.compute_joint_and_marker_positions(SUBJECT, each)[1] - markers, axis=2).mean()
        for each in (by_markers, without)
    ]
    assert off[0] < 0.5e-3 < 10e-3 < off[1]


def add_noise(joints):
    return joints + np.random.default_rng(1).uniform(-0.02, 0.02, joints.shape)


def test_naive_accumulates_bone_length_errors(people):
    """Eq. 15: the error of a joint is the sum of its ancestors' errors, each along the given bone."""
    given_joints = add_noise(people[1])
    deviation = given_joints - joints_of(initial_motion.solve_hybrik(given_joints, SUBJECT, variant="naive", twists=NO_TWIST))
    for chain in (("LHipJoint", "LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase"), ("LeftArm", "LeftForeArm", "LeftHand")):
        for parent, child in pairwise(chain):
            bone = given_joints[:, index(child)] - given_joints[:, index(parent)]
            length = np.linalg.norm(bone, axis=1, keepdims=True)
            error = bone * (1 - np.linalg.norm(SKELETON.offsets[index(child)]) / length)
            assert np.allclose(deviation[:, index(child)], deviation[:, index(parent)] + error, atol=1e-9)


def test_adaptive_has_only_the_last_bone_error(people):
    """Eq. 17: the error of a joint lies along its own bone."""
    given_joints = add_noise(people[1])
    found = joints_of(initial_motion.solve_hybrik(given_joints, SUBJECT, variant="adaptive", twists=NO_TWIST))
    for parent, child in (("LeftUpLeg", "LeftLeg"), ("RightForeArm", "RightHand"), ("Neck1", "Head"), ("LowerBack", "Spine")):
        bone = given_joints[:, index(child)] - found[:, index(parent)]
        length = np.linalg.norm(bone, axis=1)
        deviation = np.linalg.norm(given_joints[:, index(child)] - found[:, index(child)], axis=1)
        assert np.allclose(deviation, np.abs(length - np.linalg.norm(SKELETON.offsets[index(child)])), atol=1e-9)


def test_x_reaches_hands_and_head_despite_wrong_bone_lengths(people):
    _, joints, _ = people
    other = SKELETON.offsets * np.where(np.arange(31) % 2, 1.04, 0.97)[:, None]
    other_subject = Subject(
        Skeleton(SKELETON.names, SKELETON.parents, other, SKELETON.ends),
        MARKER_SET.name, MARKER_SET.labels, MARKER_SET.joints, MARKER_SET.marker_offsets, SUBJECT.marker_spread,
    )  # fmt: skip
    ends = [index("Head"), index("LeftHand"), index("RightHand")]
    off, status = {}, {}
    for variant in ("adaptive", "x"):
        found = initial_motion.solve_hybrik(joints, other_subject, variant=variant, twists=NO_TWIST)
        off[variant] = np.linalg.norm(joints_of(found, other_subject) - joints, axis=2)[:, ends]
        status[variant] = found.status
    reached = status["x"] == FrameStatus.PLACED
    assert reached.sum() > 80
    head, hands = off["x"][reached, 0], off["x"][reached, 1:]
    assert np.median(head) < 0.1 * np.median(off["adaptive"][:, 0])
    assert np.mean(hands) < 0.6 * np.mean(off["adaptive"][:, 1:])


def test_unreachable_hands_have_a_status_and_are_pointed_at(people):
    _, joints, _ = people
    far, near = joints[:2].copy(), joints[:2].copy()
    hand = [index(name) for name in ("LeftHand", "LeftFingerBase", "LThumb", "LeftHandIndex1")]
    shoulder = joints[:2, index("LeftArm")]
    direction = joints[:2, hand[0]] - shoulder
    far[:, hand] += direction[:, None]  # twice as far, farther than any arm
    far[:, hand] += 0.5 * (direction / np.linalg.norm(direction, axis=1, keepdims=True))[:, None]
    near[:, hand] -= joints[:2, hand[:1]] - shoulder[:, None]
    stretched, folded = (initial_motion.solve_hybrik(each, SUBJECT, twists=NO_TWIST) for each in (far, near))
    assert (stretched.status == FrameStatus.OUT_OF_REACH).all()
    assert (folded.status == FrameStatus.TOO_NEAR).all()
    wrist = joints_of(stretched)[:, hand[0]] - joints_of(stretched)[:, index("LeftArm")]
    reach = np.linalg.norm(SKELETON.offsets[[index("LeftForeArm"), index("LeftHand")]], axis=1).sum()
    assert np.allclose(np.linalg.norm(wrist, axis=1), reach, atol=1e-6)


@pytest.mark.parametrize("variant", VARIANTS)
def test_pose_is_equivariant_to_world_motion(people, variant):
    _, joints, _ = people
    turn, shift = Rotation.from_rotvec([0.3, -2.0, 1.1]).as_matrix(), np.array([5.0, -1.0, 2.0])
    here = initial_motion.solve_hybrik(joints, SUBJECT, variant=variant, twists=NO_TWIST)
    there = initial_motion.solve_hybrik(joints @ turn.T + shift, SUBJECT, variant=variant, twists=NO_TWIST)
    assert np.allclose(there.root_position, here.root_position @ turn.T + shift, atol=1e-9)
    assert np.allclose(there.local_rotations[:, 0], turn @ here.local_rotations[:, 0], atol=1e-9)
    assert np.allclose(there.local_rotations[:, 1:], here.local_rotations[:, 1:], atol=1e-7)


def test_root_of_a_mirrored_body_is_no_reflection(people):
    _, joints, _ = people
    found = initial_motion.solve_hybrik(joints * [-1, 1, 1], SUBJECT, twists=NO_TWIST)
    assert np.allclose(np.linalg.det(found.local_rotations[:, 0]), 1)


def test_frames_are_independent(people):
    _, joints, _ = people
    whole = initial_motion.solve_hybrik(joints, SUBJECT, twists=NO_TWIST)
    damaged = joints.copy()
    damaged[50] = np.random.default_rng(0).normal(size=(31, 3))
    again = initial_motion.solve_hybrik(damaged, SUBJECT, twists=NO_TWIST)
    others = np.arange(100) != 50
    assert np.array_equal(again.local_rotations[others], whole.local_rotations[others])


def test_unknown_joints_do_not_affect_others(people):
    _, joints, _ = people
    lost = joints.copy()
    lost[:, [index("LeftForeArm"), index("LThumb"), index("RightFoot"), index("RightToeBase")], 1] = np.nan
    found = joints_of(initial_motion.solve_hybrik(lost, SUBJECT, twists=NO_TWIST))
    assert np.isfinite(found).all()
    known = ~np.isnan(lost[0, :, 1])
    assert np.abs(found - joints)[:, known].max() < 5e-5  # the hand, too, which x reaches across the lost elbow


def test_frame_without_hips_uses_its_trunk_or_its_neighbours(people):
    motion, joints, _ = people
    take = np.repeat(joints[:1], 5, axis=0)
    hips = [index(name) for name in ("Hips", "LHipJoint", "RHipJoint", "LowerBack", "LeftUpLeg", "RightUpLeg")]
    take[1, hips] = np.nan
    take[3] = np.nan
    found = initial_motion.solve_hybrik(take, SUBJECT, twists=NO_TWIST)
    assert found.status.tolist() == [
        FrameStatus.PLACED,
        FrameStatus.PLACED,
        FrameStatus.PLACED,
        FrameStatus.GUESSED,
        FrameStatus.PLACED,
    ]
    turned = Rotation.from_matrix(motion.local_rotations[0, 0].T @ found.local_rotations[:, 0]).magnitude()
    assert turned[1] < 0.7  # people bend
    assert turned[3] < 1e-3
    assert np.linalg.norm(found.root_position[3] - motion.root_position[0]) < 1e-4


def test_empty_and_unknown_input_give_poses():
    assert len(initial_motion.solve_hybrik(np.zeros((0, 31, 3)), SUBJECT, twists=NO_TWIST).root_position) == 0
    nothing = initial_motion.solve_hybrik(np.full((3, 31, 3), np.nan), SUBJECT, twists=NO_TWIST)
    assert (nothing.status == FrameStatus.GUESSED).all()
    assert np.isfinite(nothing.local_rotations).all()


def test_other_skeletons_are_rejected():
    fewer = Skeleton(("Hips", "Spine"), np.array([-1, 0]), np.zeros((2, 3)), np.zeros((2, 3)))
    other_subject = Subject(fewer, "none", (), np.zeros(0, int), np.zeros((0, 3)), np.zeros(0))
    with pytest.raises(ConstraintError, match="31 joints of the CMU skeleton"):
        initial_motion.solve_hybrik(np.zeros((5, 2, 3)), other_subject)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"positions": np.zeros((5, 30, 3))}, r"positions must be of shape \(any, 31, 3\), not \(5, 30, 3\)"),
        ({"positions": np.full((5, 31, 3), np.inf)}, "positions holds a number that is not finite"),
        ({"positions": "walk.c3d"}, "positions must be an array of numbers"),
        ({"positions": np.zeros((5, 31, 3), complex)}, "positions must be an array of numbers"),
        ({"markers": np.zeros((5, 3, 3))}, r"markers must be of shape \(5, 41, 3\)"),
        ({"markers": np.full((5, 41, 3), np.inf)}, "markers holds a number"),
        ({"twists": np.zeros((5, 31))}, r"twists must be of shape \(any, 31, 2\)"),
        ({"twists": np.zeros((4, 31, 2))}, "twists must have 1 or 5 frames, not 4"),
        ({"twists": np.full((5, 31, 2), np.nan)}, "twists holds a number that is not finite"),
        ({"joint_sd": np.zeros((4, 31))}, r"joint_sd must be of shape \(5, 31\)"),
        ({"joint_sd": 0.0}, "1e-06 metres or more"),
        ({"joint_sd": np.inf}, "joint_sd holds a number"),
        ({"joint_sd": "small"}, "joint_sd must be an array of numbers"),
        ({"held_joints": np.zeros(5, bool)}, r"held_joints must be of shape \(31\)"),
        ({"variant": "best"}, "naive, adaptive, x"),
    ],
)
def test_invalid_arguments_are_rejected(wrong, message):
    arguments = {"positions": np.zeros((5, 31, 3)), "twists": NO_TWIST} | wrong
    with pytest.raises(ConstraintError, match=message):
        initial_motion.solve_hybrik(arguments.pop("positions"), SUBJECT, **arguments)


def test_array_type_and_memory_order_are_irrelevant(people):
    _, joints, markers = people
    plain = initial_motion.solve_hybrik(joints, SUBJECT, markers=markers, twists=NO_TWIST)
    for kind in (lambda a: np.asfortranarray(a), lambda a: a.tolist(), lambda a: a[::-1][::-1]):
        again = initial_motion.solve_hybrik(
            kind(joints), SUBJECT, markers=kind(markers), twists=NO_TWIST, held_joints=[j in (1, 6) for j in range(31)]
        )
        assert np.array_equal(again.local_rotations, plain.local_rotations)


def test_partly_unknown_marker_is_unknown(people):
    _, joints, markers = people
    part, none = markers.copy(), markers.copy()
    part[:, 3, 1] = none[:, 3] = np.nan
    one, other = (
        initial_motion.solve_hybrik(joints, SUBJECT, markers=each, twists=NO_TWIST).local_rotations for each in (part, none)
    )
    assert np.array_equal(one, other)
    assert np.isfinite(one).all()


def test_head_with_one_central_marker_keeps_the_mean_pose(people):
    _, joints, markers = people
    places, head = MARKER_SET.marker_offsets.copy(), MARKER_SET.joints == index("Head")
    places[head] = 0.0
    one = Subject(SKELETON, MARKER_SET.name, MARKER_SET.labels, MARKER_SET.joints, places, np.zeros(len(MARKER_SET.labels)))
    markers = np.where(head[:, None], joints[:, [index("Head")]], markers)
    found = initial_motion.solve_hybrik(joints, one, markers=markers, twists=NO_TWIST)
    assert np.allclose(
        found.local_rotations[:, index("Head")],
        mean_pose.load_mean_pose_prior("mean-pose", SKELETON).mean_rotations[index("Head")],
    )


def test_hips_alone_keep_their_position(people):
    _, joints, _ = people
    take = np.repeat(joints[:1], 9, axis=0) + np.linspace(0, 1, 9)[:, None, None]
    take[4:, 1:] = np.nan
    for variant in ("adaptive", "x"):
        found = initial_motion.solve_hybrik(take, SUBJECT, variant=variant, twists=NO_TWIST)
        assert np.allclose(found.root_position, take[:, 0], atol=1e-4)
        assert np.allclose(found.local_rotations[4:, 0], found.local_rotations[3, 0])


def test_subject_without_marker_spread_can_be_posed(people):
    _, joints, markers = people
    found = initial_motion.initialise_motion(
        Take(markers, MARKER_SET.labels, 30.0),
        SUBJECT,
        load_cmu31_body(),
        mean_pose.load_mean_pose_prior("mean-pose", SKELETON),
        "hybrik-x",
    )
    determined = [index(name) for name in ("Hips", "LeftLeg", "RightFoot", "Spine1", "LeftForeArm", "RightHand")]
    assert np.median(np.linalg.norm(joints_of(found) - joints, axis=2)[:, determined]) < 0.002


def test_outlying_marker_has_no_influence():
    """An outlier that is excluded from the joint positions must not rotate the head, the hips or a forearm either."""
    rotations = sound_takes.load_unseen_poses()[::20]
    true = build_known_motion(np.zeros((len(rotations), 3)), rotations)
    markers = kinematics.compute_joint_and_marker_positions(SUBJECT, true)[1] + np.random.default_rng(0).normal(
        0, 0.002, (len(rotations), 41, 3)
    )
    body, prior = load_cmu31_body(), mean_pose.load_mean_pose_prior("mean-pose", SKELETON)
    subject = Subject(
        SKELETON, MARKER_SET.name, MARKER_SET.labels, MARKER_SET.joints, MARKER_SET.marker_offsets, np.full(41, 0.005)
    )

    def turned(markers):
        found = initial_motion.initialise_motion(Take(markers, MARKER_SET.labels, 30.0), subject, body, prior, "hybrik-x")
        world = [kinematics.compute_world_poses(SKELETON, motion)[1] for motion in (found, true)]
        off = np.swapaxes(world[0], 2, 3) @ world[1]
        return np.degrees(Rotation.from_matrix(off.reshape(-1, 3, 3)).magnitude()).reshape(off.shape[:2])

    sound = turned(markers)
    for label, joint in (("LBWT", "Hips"), ("LFHD", "Head"), ("STRN", "Spine1"), ("LWRB", "LeftForeArm")):
        damaged = markers.copy()
        damaged[:, MARKER_SET.labels.index(label)] += [0.3, -0.3, 0.4]
        assert np.median(turned(damaged)[:, index(joint)]) < np.median(sound[:, index(joint)]) + 6
