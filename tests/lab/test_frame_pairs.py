"""Training pairs: starts and targets of one trial, with noise of the given deviation and missing joints."""

import numpy as np
import pytest

from mocapfix.errors import ReadError
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.io.yaml_files import read_yaml_model
from mocapfix.lab import frame_pairs
from mocapfix.lab.frame_pairs import PairSampler, gather_sequences
from mocapfix.lab.settings import LearnedIkSettings
from tests.lab.motion_files import draw_motion, write_bvh_motion
from tests.solve.ik_cases import SKELETON


@pytest.fixture(scope="module")
def sequences(tmp_path_factory):
    folder = tmp_path_factory.mktemp("motion")
    for seed, name in enumerate(("01_01", "01_02", "14_01")):
        write_bvh_motion(folder / f"{name}.bvh", draw_motion(seed, 40, spread=0.2))
    return gather_sequences([folder], lambda subject: subject != "02", lambda text: None)


def build_settings(**changes):
    settings = read_yaml_model(LearnedIkSettings, find_shipped_folder("priors") / "ik.yaml")
    return settings.model_copy(update={"batch_poses": 64} | changes)


def test_sequences_know_their_trials_and_subjects(sequences):
    assert sequences.frame_counts == {"01": 80, "14": 40}
    assert sequences.first[[0, 39, 40, 119]].tolist() == [0, 0, 40, 80]
    assert sequences.last[[0, 39, 40, 119]].tolist() == [39, 39, 79, 119]


def test_no_motion_of_the_subjects_is_an_error(tmp_path):
    write_bvh_motion(tmp_path / "01_01.bvh", draw_motion(0))
    with pytest.raises(ReadError, match="no motion of the required subjects"):
        gather_sequences([tmp_path], lambda subject: subject == "02", lambda text: None)


def test_batches_repeat(sequences):
    first, second = (PairSampler(sequences, build_settings()).draw_batch(3) for _ in range(2))
    np.testing.assert_array_equal(first.positions, second.positions)
    np.testing.assert_array_equal(first.start[1], second.start[1])
    other = PairSampler(sequences, build_settings()).draw_batch(4)
    assert not np.array_equal(other.target[1], first.target[1])


def test_clean_pairs_are_frames_of_one_trial_apart(sequences):
    settings = build_settings(has_corruption=False, frame_offsets=(5,), batch_poses=32)
    batch = PairSampler(sequences, settings).draw_batch(1)  # of the mirrored and the others, this one is not mirrored or is
    candidates = sequences.rotations.astype(float)
    sampler = PairSampler(sequences, settings)
    mirrored = frame_pairs.MIRROR_X_MATRIX @ candidates[:, sampler.mirrored_joints] @ frame_pairs.MIRROR_X_MATRIX
    for start, target in zip(batch.start[1], batch.target[1], strict=True):
        for frames in (candidates, mirrored):
            near = [np.abs(frames - each).max((1, 2, 3)) for each in (start, target)]
            if max(each.min() for each in near) < 1e-5:
                assert abs(int(near[0].argmin()) - int(near[1].argmin())) == 5
                break
        else:
            pytest.fail("a pair is not of the motion")
    assert not np.isnan(batch.positions).any()


def test_noise_has_the_given_deviation_and_limbs_are_missing(sequences):
    batch = PairSampler(sequences, build_settings(batch_poses=2000)).draw_batch(0)
    true, _ = frame_pairs.compute_tree_poses(frame_pairs.build_kinematic_tree(batch.body), *batch.target)
    is_given = ~np.isnan(batch.positions[..., 0])
    ratio = ((batch.positions - true) / batch.joint_sd[..., None])[is_given]
    np.testing.assert_allclose(ratio.std(), 1, atol=0.05)
    assert 0.05 < 1 - is_given.mean() < 0.3
    arm = [SKELETON.find_joint(f"Left{name}") for name in ("ForeArm", "Hand", "FingerBase")]
    assert (~is_given[:, arm].any(1)).mean() > 0.02


def test_coincident_joints_are_found():
    names = {(SKELETON.names[a], SKELETON.names[b]) for a, b in frame_pairs.find_coincident_joints()}
    assert {("LHipJoint", "Hips"), ("LowerBack", "Hips"), ("LeftShoulder", "Neck"), ("LThumb", "LeftFingerBase")} <= names
