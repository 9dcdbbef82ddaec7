import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.pose_prior import mean_pose
from mocapfix.pose_prior.model import compute_pose_vectors
from mocapfix.skeleton import load_cmu31_body
from mocapfix.train.training_poses import gather_training_poses, mirror_pose_vectors
from tests.train.people import walked, write_bvh

NAMES = load_cmu31_body().skeleton.names
MIDDLE = mean_pose.load_mean_pose_prior("mean-pose", load_cmu31_body().skeleton).rotations


@pytest.fixture
def folder(tmp_path):
    for name in ("01_01", "02_01", "03_01"):
        write_bvh(tmp_path / f"{name}.bvh", walked(int(name[:2])))
    return tmp_path


def gathered(folder, test="02", unseen="03"):
    return gather_training_poses(folder, MIDDLE, frozenset([test]), frozenset([unseen]), lambda what: None)


def test_subjects_are_kept_apart_and_each_pose_is_there_mirrored(folder):
    poses = gathered(folder)
    assert poses.frames == {"01": 24, "03": 24}
    expected = compute_pose_vectors(walked(1), MIDDLE)
    np.testing.assert_allclose(
        poses.training_vectors, np.concatenate([expected, mirror_pose_vectors(expected, NAMES)]), atol=1e-5
    )
    np.testing.assert_allclose(poses.unseen[:24], compute_pose_vectors(walked(3), MIDDLE), atol=1e-5)


def test_frames_beyond_a_flip_are_dropped_but_a_thumbs_flip_does_no_harm(folder):
    flipped, flip = walked(1), Rotation.from_rotvec([3.0, 0, 0]).as_matrix()
    flipped[:5, NAMES.index("LeftUpLeg")] = flipped[:5, NAMES.index("LeftUpLeg")] @ flip
    flipped[12:, NAMES.index("LThumb")] = flipped[12:, NAMES.index("LThumb")] @ flip
    write_bvh(folder / "01_01.bvh", flipped)
    poses = gathered(folder)
    assert (poses.frames["01"], poses.dropped_frames) == (19, 5)
    np.testing.assert_allclose(poses.training_vectors[:19], compute_pose_vectors(flipped[5:], MIDDLE), atol=1e-5)


def test_a_folder_without_those_who_are_needed_is_named(folder):
    with pytest.raises(ReadError, match="the unseen subjects 77"):
        gathered(folder, unseen="77")
    for name in ("01", "02"):
        (folder / f"{name}_01.bvh").unlink()
    with pytest.raises(ReadError, match="subjects to learn from"):
        gathered(folder)


def test_in_mnn_iks_split_three_frames_of_every_five_are_learned_from_and_the_others_kept_of_everybody(folder):
    poses = gather_training_poses(folder, MIDDLE, frozenset(["02"]), frozenset(["03"]), lambda what: None, is_interleaved=True)
    learned = np.isin(np.arange(24) % 5, (0, 2, 4))
    people = [compute_pose_vectors(walked(who), MIDDLE) for who in (1, 2, 3)]
    half = len(poses.training_vectors) // 2
    np.testing.assert_allclose(poses.training_vectors[:half], np.concatenate([each[learned] for each in people]), atol=1e-5)
    np.testing.assert_allclose(poses.unseen[: len(poses.unseen) // 2], np.concatenate([p[~learned] for p in people]), atol=1e-5)
    assert poses.frames == {"01": 14, "02": 14, "03": 14}
    assert poses.is_interleaved
    assert not gathered(folder).is_interleaved
