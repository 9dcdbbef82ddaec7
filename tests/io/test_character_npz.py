import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.character import compute_character_poses
from mocapfix.errors import WriteError
from mocapfix.io.character_files import list_moving_bones
from mocapfix.io.npz import write_character_npz
from tests.characters.character_files import FIGURE, build_figure_character, build_motion


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
    np.testing.assert_allclose(Rotation.from_quat(arrays["rest_rotations"]).as_matrix(), character.rest_rotations, atol=1e-12)
    assert ((arrays["rotations"][1:] * arrays["rotations"][:-1]).sum(-1) > 0).all()
    segments = dict(zip(arrays["segments"].tolist(), arrays["segment_bones"].tolist(), strict=True))
    assert segments["spine"].split("\n") == ["Spine", "Spine1", "Spine2"]
    assert not arrays["is_moved"][FIGURE.names.index("LeftHandIndex1")]
    assert arrays["is_moved"][FIGURE.names.index("LeftHand")]


def test_a_missing_folder_is_refused(tmp_path):
    character = build_figure_character()
    with pytest.raises(WriteError, match="nowhere"):
        write_character_npz(tmp_path / "nowhere" / "walk.npz", character, build_motion(character), ())
