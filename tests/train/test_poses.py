import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix import prior
from mocapfix.errors import ReadError
from mocapfix.prior.contract import from_middle
from mocapfix.skeleton import cmu31
from mocapfix.train.mirror import mirrored
from mocapfix.train.poses import gather
from tests.train.people import walked, write_bvh

NAMES = cmu31().skeleton.names
MIDDLE = prior.load("mean-pose", cmu31().skeleton).rotations


@pytest.fixture
def folder(tmp_path):
    for name in ("01_01", "02_01", "03_01"):
        write_bvh(tmp_path / f"{name}.bvh", walked(int(name[:2])))
    return tmp_path


def gathered(folder, test="02", unseen="03"):
    return gather(folder, MIDDLE, frozenset([test]), frozenset([unseen]), lambda what: None)


def test_subjects_are_kept_apart_and_each_pose_is_there_mirrored(folder):
    poses = gathered(folder)
    assert poses.frames == {"01": 24, "03": 24}
    expected = from_middle(walked(1), MIDDLE)
    np.testing.assert_allclose(poses.seen, np.concatenate([expected, mirrored(expected, NAMES)]), atol=1e-5)
    np.testing.assert_allclose(poses.unseen[:24], from_middle(walked(3), MIDDLE), atol=1e-5)


def test_frames_beyond_a_flip_are_dropped_but_a_thumbs_flip_does_no_harm(folder):
    flipped, flip = walked(1), Rotation.from_rotvec([3.0, 0, 0]).as_matrix()
    flipped[:5, NAMES.index("LeftUpLeg")] = flipped[:5, NAMES.index("LeftUpLeg")] @ flip
    flipped[12:, NAMES.index("LThumb")] = flipped[12:, NAMES.index("LThumb")] @ flip
    write_bvh(folder / "01_01.bvh", flipped)
    poses = gathered(folder)
    assert (poses.frames["01"], poses.dropped) == (19, 5)
    np.testing.assert_allclose(poses.seen[:19], from_middle(flipped[5:], MIDDLE), atol=1e-5)


def test_a_folder_without_those_who_are_needed_is_named(folder):
    with pytest.raises(ReadError, match="the unseen subjects 77"):
        gathered(folder, unseen="77")
    for name in ("01", "02"):
        (folder / f"{name}_01.bvh").unlink()
    with pytest.raises(ReadError, match="subjects to learn from"):
        gathered(folder)


def test_in_mnn_iks_split_three_frames_of_every_five_are_learned_from_and_the_others_kept_of_everybody(folder):
    poses = gather(folder, MIDDLE, frozenset(["02"]), frozenset(["03"]), lambda what: None, interleaved=True)
    learned = np.isin(np.arange(24) % 5, (0, 2, 4))
    people = [from_middle(walked(who), MIDDLE) for who in (1, 2, 3)]
    half = len(poses.seen) // 2
    np.testing.assert_allclose(poses.seen[:half], np.concatenate([each[learned] for each in people]), atol=1e-5)
    np.testing.assert_allclose(poses.unseen[: len(poses.unseen) // 2], np.concatenate([p[~learned] for p in people]), atol=1e-5)
    assert poses.frames == {"01": 14, "02": 14, "03": 14}
    assert poses.interleaved
    assert not gathered(folder).interleaved
