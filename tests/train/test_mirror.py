import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.skeleton import cmu31
from mocapfix.train.mirror import FLIP, mirrored, mirrored_name


@pytest.mark.parametrize(
    ("name", "other"),
    [("LeftArm", "RightArm"), ("LHipJoint", "RHipJoint"), ("RThumb", "LThumb"), ("LowerBack", "LowerBack"), ("Head", "Head")],
)
def test_mirrored_names(name, other):
    assert mirrored_name(name) == other


def test_mirroring_twice_gives_each_joint_back_and_stays_on_the_body():
    names = cmu31().skeleton.names
    assert {mirrored_name(name) for name in names} == set(names)
    assert all(mirrored_name(mirrored_name(name)) == name for name in names)


def test_a_mirrored_pose_turns_each_joint_as_the_mirror_shows_it():
    names = cmu31().skeleton.names
    vectors = np.random.default_rng(0).normal(0, 0.5, (4, len(names), 3))
    turned, seen = (Rotation.from_rotvec(v.reshape(-1, 3)).as_matrix() for v in (vectors, mirrored(vectors, names)))
    other = [names.index(mirrored_name(name)) for name in names]
    turned, seen = (m.reshape(4, len(names), 3, 3) for m in (turned, seen))
    np.testing.assert_allclose(seen, FLIP @ turned[:, other] @ FLIP, atol=1e-12)
