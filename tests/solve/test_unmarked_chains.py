"""The neck between chest and head: bent in equal parts between unchanged ends."""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.lab import sound_takes
from mocapfix.lab.sound_takes import build_known_motion
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.solve import initial_motion, kinematics, mean_pose
from mocapfix.subject.library import load_marker_set

SKELETON, MARKER_SET = load_cmu31_body().skeleton, load_marker_set("cmu41")
SUBJECT = Subject(
    SKELETON, MARKER_SET.name, MARKER_SET.labels, MARKER_SET.joints, MARKER_SET.marker_offsets, np.zeros(len(MARKER_SET.labels))
)
PRIOR = mean_pose.load_mean_pose_prior("mean-pose", SKELETON)
NECK = [SKELETON.find_joint(name) for name in ("Neck", "Neck1", "Head")]


def test_neck_is_the_only_unmarked_chain():
    assert initial_motion.find_unmarked_chains(SUBJECT) == [NECK]


def test_ends_keep_their_rotation_and_joints_between_share_it():
    rotations = sound_takes.load_unseen_poses()[::50]
    before = build_known_motion(np.zeros((len(rotations), 3)), rotations)
    after = initial_motion.bend_unmarked_chains(before, SUBJECT, PRIOR)
    worlds = [kinematics.compute_world_poses(SKELETON, motion)[1] for motion in (before, after)]
    others = [j for j in range(31) if j not in NECK[:2]]
    np.testing.assert_allclose(worlds[1][:, others], worlds[0][:, others], atol=1e-12)
    away = np.swapaxes(PRIOR.mean_rotations[NECK[:2]], 1, 2) @ after.local_rotations[:, NECK[:2]]
    angles = Rotation.from_matrix(away.reshape(-1, 3, 3)).magnitude().reshape(-1, 2)
    np.testing.assert_allclose(angles[:, 0], angles[:, 1], atol=1e-9)
    assert angles.max() > 0.1


def test_mean_pose_is_a_fixed_point_and_input_is_not_modified():
    standing = build_known_motion(np.zeros((1, 3)), PRIOR.mean_rotations[None].copy())
    np.testing.assert_allclose(
        initial_motion.bend_unmarked_chains(standing, SUBJECT, PRIOR).local_rotations, standing.local_rotations, atol=1e-12
    )
    folded = build_known_motion(np.zeros((1, 3)), standing.local_rotations.copy())
    folded.local_rotations[0, NECK[0]] = Rotation.from_euler("x", 1.0).as_matrix()
    kept = folded.local_rotations.copy()
    initial_motion.bend_unmarked_chains(folded, SUBJECT, PRIOR)
    np.testing.assert_array_equal(folded.local_rotations, kept)
