import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.skeleton import load_cmu31_body
from mocapfix.train.training_poses import MIRROR_X_MATRIX, mirror_joint_name, mirror_pose_vectors


@pytest.mark.parametrize(
    ("name", "other"),
    [("LeftArm", "RightArm"), ("LHipJoint", "RHipJoint"), ("RThumb", "LThumb"), ("LowerBack", "LowerBack"), ("Head", "Head")],
)
def test_mirrored_names(name, other):
    assert mirror_joint_name(name) == other


def test_mirroring_twice_gives_each_joint_back_and_stays_on_the_body():
    names = load_cmu31_body().skeleton.names
    assert {mirror_joint_name(name) for name in names} == set(names)
    assert all(mirror_joint_name(mirror_joint_name(name)) == name for name in names)


def test_a_mirrored_pose_turns_each_joint_as_the_mirror_shows_it():
    names = load_cmu31_body().skeleton.names
    vectors = np.random.default_rng(0).normal(0, 0.5, (4, len(names), 3))
    turned, seen = (Rotation.from_rotvec(v.reshape(-1, 3)).as_matrix() for v in (vectors, mirror_pose_vectors(vectors, names)))
    other = [names.index(mirror_joint_name(name)) for name in names]
    turned, seen = (m.reshape(4, len(names), 3, 3) for m in (turned, seen))
    np.testing.assert_allclose(seen, MIRROR_X_MATRIX @ turned[:, other] @ MIRROR_X_MATRIX, atol=1e-12)
