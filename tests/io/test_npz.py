import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.character import compute_character_poses
from mocapfix.characters.character_files import list_moving_bones
from mocapfix.errors import WriteError
from mocapfix.io.npz import write_character_npz, write_npz
from mocapfix.model.motion import FrameStatus
from mocapfix.model.take import Take
from mocapfix.solve import kinematics
from tests.characters.character_files import FIGURE, build_figure_character, build_motion
from tests.io.read_back import SKELETON, motion_of, smooth_rotations

MARKERS = np.random.default_rng(0).normal(size=(50, 3, 3))
MARKERS[7, 1] = np.nan
SAMPLE_SD = np.full((50, 3), np.nan)
SAMPLE_SD[9, 2] = 0.004
TAKE = Take(MARKERS, ("LFHD", "Jim:RFHD", "ß"), 120.0, first_frame=301, sample_sd=SAMPLE_SD)


def test_arrays_load_without_pickle_and_have_the_solution(tmp_path):
    motion = motion_of(smooth_rotations(0, 25, 31, swing=4), np.random.default_rng(1).normal(size=(25, 3)))
    write_npz(tmp_path / "walk.npz", TAKE, SKELETON, motion, 60.0)
    with np.load(tmp_path / "walk.npz", allow_pickle=False) as file:
        found = {name: file[name] for name in file.files}
    assert str(found["format"]) == "mocapfix 1"
    assert (float(found["rate"]), float(found["marker_rate"]), int(found["first_frame"])) == (60, 120, 301)
    assert (tuple(found["names"]), tuple(found["labels"]), list(found["status_texts"])) == (
        SKELETON.names,
        TAKE.labels,
        [status.description for status in FrameStatus],
    )
    for name, array in (
        ("markers", MARKERS),
        ("marker_sd", SAMPLE_SD),
        ("root", motion.root_position),
        ("status", motion.status),
    ):
        np.testing.assert_array_equal(found[name], array)
    for name in ("parents", "offsets", "ends"):
        np.testing.assert_array_equal(found[name], getattr(SKELETON, name))
    rotations = Rotation.from_quat(found["rotations"].reshape(-1, 4)).as_matrix().reshape(25, 31, 3, 3)
    np.testing.assert_allclose(rotations, motion.local_rotations, atol=1e-12)
    assert ((found["rotations"][1:] * found["rotations"][:-1]).sum(-1) > 0).all()  # no flips
    np.testing.assert_allclose(found["joints"], kinematics.compute_world_poses(SKELETON, motion)[0])


def test_a_take_without_a_body_has_only_markers(tmp_path):
    write_npz(tmp_path / "walk.npz", TAKE)
    with np.load(tmp_path / "walk.npz", allow_pickle=False) as file:
        assert set(file.files) == {
            "format",
            "units",
            "rate",
            "first_frame",
            "labels",
            "markers",
            "marker_sd",
            "marker_rate",
        }
        assert float(file["rate"]) == 120
        assert np.isnan(file["markers"][7, 1]).all()


def test_the_pose_follows_from_the_arrays(tmp_path):
    character = build_figure_character()
    motion = build_motion(character)
    write_character_npz(tmp_path / "walk.npz", character, motion, list_moving_bones(character, motion))
    with np.load(tmp_path / "walk.npz", allow_pickle=False) as file:
        arrays = dict(file)
    assert str(arrays["format"]) == "mocapfix character 1"
    assert tuple(arrays["names"]) == FIGURE.names
    assert float(arrays["rate"]) == 60
    pelvis = arrays["names"].tolist().index(str(arrays["pelvis"]))
    positions, rotations = [], []
    for bone, parent in enumerate(arrays["parents"]):
        own = np.tile(arrays["rest_positions"][bone], (40, 1)) if bone != pelvis else arrays["pelvis_position"]
        axes = Rotation.from_quat(arrays["rotations"][:, bone]).as_matrix()
        if parent >= 0:
            own, axes = positions[parent] + (rotations[parent] @ own[..., None])[..., 0], rotations[parent] @ axes
        positions.append(own)
        rotations.append(axes)
    np.testing.assert_allclose(np.stack(positions, axis=1), compute_character_poses(character, motion)[0], atol=1e-9)
    np.testing.assert_allclose(
        Rotation.from_quat(arrays["rest_rotations"]).as_matrix(), character.skeleton.rest_rotations, atol=1e-12
    )
    assert ((arrays["rotations"][1:] * arrays["rotations"][:-1]).sum(-1) > 0).all()
    segments = dict(zip(arrays["segments"].tolist(), arrays["segment_bones"].tolist(), strict=True))
    assert segments["spine"].split("\n") == ["Spine", "Spine1", "Spine2"]
    assert not arrays["is_moved"][FIGURE.names.index("LeftHandIndex1")]
    assert arrays["is_moved"][FIGURE.names.index("LeftHand")]


def test_a_missing_folder_is_refused(tmp_path):
    character = build_figure_character()
    with pytest.raises(WriteError, match="nowhere"):
        write_character_npz(tmp_path / "nowhere" / "walk.npz", character, build_motion(character), ())
