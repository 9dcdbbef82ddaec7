"""The neck between chest and head: bent by equal parts, its ends as they were."""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix import marker_set, prior
from mocapfix.bench import unseen
from mocapfix.bench.common_task import posed
from mocapfix.initialise import necks
from mocapfix.kernels import kinematics
from mocapfix.skeleton import cmu31
from mocapfix.subject import Subject

SKELETON, WORN = cmu31().skeleton, marker_set.load("cmu41")
SUBJECT = Subject(SKELETON, WORN.name, WORN.labels, WORN.joints, WORN.places, np.zeros(len(WORN.labels)))
HABITS = prior.load("mean-pose", SKELETON)
NECK = [SKELETON.index(name) for name in ("Neck", "Neck1", "Head")]


def test_only_the_neck_is_such_a_chain():
    assert necks.chains(SUBJECT) == [NECK]


def test_head_and_chest_are_turned_as_before_and_each_joint_between_by_the_same_angle():
    rotations = unseen.shipped()[::50]
    before = posed(np.zeros((len(rotations), 3)), rotations)
    after = necks.bent(before, SUBJECT, HABITS)
    worlds = [kinematics.world(SKELETON, motion)[1] for motion in (before, after)]
    others = [j for j in range(31) if j not in NECK[:2]]
    np.testing.assert_allclose(worlds[1][:, others], worlds[0][:, others], atol=1e-12)
    away = np.swapaxes(HABITS.rotations[NECK[:2]], 1, 2) @ after.rotations[:, NECK[:2]]
    angles = Rotation.from_matrix(away.reshape(-1, 3, 3)).magnitude().reshape(-1, 2)
    np.testing.assert_allclose(angles[:, 0], angles[:, 1], atol=1e-9)
    assert angles.max() > 0.1


def test_the_mean_pose_stays_as_it_is_and_its_motion_is_not_touched():
    standing = posed(np.zeros((1, 3)), HABITS.rotations[None].copy())
    np.testing.assert_allclose(necks.bent(standing, SUBJECT, HABITS).rotations, standing.rotations, atol=1e-12)
    folded = posed(np.zeros((1, 3)), standing.rotations.copy())
    folded.rotations[0, NECK[0]] = Rotation.from_euler("x", 1.0).as_matrix()
    kept = folded.rotations.copy()
    necks.bent(folded, SUBJECT, HABITS)
    np.testing.assert_array_equal(folded.rotations, kept)
