"""FBX without Blender, and with a Blender that fails. Files that Blender writes are opened in tests/blender."""

import os
import stat
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters import fbx
from mocapfix.characters.character_files import write_character_glb
from mocapfix.characters.fbx import BLENDER_VARIABLE, find_blender, write_fbx
from mocapfix.characters.fbx_export import find_difference, keep_rotations_exact, split_rate
from mocapfix.characters.load_character import read_character_skeletons
from mocapfix.errors import ReadError, WriteError
from tests.characters.character_files import build_figure_character, build_mixamo_glb, build_motion


@pytest.fixture
def glb(tmp_path):
    character = build_figure_character()
    write_character_glb(tmp_path / "walk.glb", character, build_motion(character), "walk")
    return tmp_path / "walk.glb"


def make_executable(path, text):
    path.write_text(f"#!{sys.executable}\n{text}\n", encoding="utf-8")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def test_without_blender_a_sentence_says_so(glb, monkeypatch):
    monkeypatch.delenv(BLENDER_VARIABLE, raising=False)
    monkeypatch.setenv("PATH", str(glb.parent))
    assert find_blender() is None
    sentence = write_fbx(glb.with_suffix(".fbx"), glb, 60.0)
    assert sentence is not None
    assert "needs Blender" in sentence
    assert BLENDER_VARIABLE in sentence
    assert not glb.with_suffix(".fbx").exists()


def test_blender_on_the_search_path_is_found(tmp_path, monkeypatch):
    monkeypatch.delenv(BLENDER_VARIABLE, raising=False)
    blender = make_executable(tmp_path / "blender", "")
    monkeypatch.setenv("PATH", str(tmp_path))
    command = find_blender()
    assert command is not None
    assert command[0] == str(blender)
    assert "--background" in command


def test_a_failure_of_blender_is_one_sentence(glb, monkeypatch):
    blender = make_executable(glb.parent / "blender", "import sys; sys.exit('Error: no GPU.')")
    monkeypatch.setenv(BLENDER_VARIABLE, str(blender))
    sentence = write_fbx(glb.with_suffix(".fbx"), glb, 60.0)
    assert sentence == "walk.fbx was not written: Blender failed (Error: no GPU)."
    assert sorted(path.name for path in glb.parent.iterdir()) == ["blender", "walk.glb"]


def test_a_blender_that_writes_nothing_is_noticed(glb, monkeypatch):
    monkeypatch.setenv(BLENDER_VARIABLE, str(make_executable(glb.parent / "blender", "")))
    assert write_fbx(glb.with_suffix(".fbx"), glb, 60.0) == "walk.fbx was not written: Blender wrote no file."


def test_a_blender_that_does_not_end_is_stopped(glb, monkeypatch):
    monkeypatch.setenv(BLENDER_VARIABLE, str(make_executable(glb.parent / "blender", "import time; time.sleep(60)")))
    monkeypatch.setattr(fbx, "BLENDER_TIMEOUT_S", 0.5)
    sentence = write_fbx(glb.with_suffix(".fbx"), glb, 60.0)
    assert sentence == "walk.fbx was not written: Blender did not end within 0.5 s."


def test_an_executable_that_is_missing_is_named(glb, monkeypatch):
    monkeypatch.setenv(BLENDER_VARIABLE, "/nowhere/blender")
    sentence = write_fbx(glb.with_suffix(".fbx"), glb, 60.0)
    assert sentence is not None
    assert "/nowhere/blender cannot be started" in sentence


def test_the_file_that_blender_wrote_is_the_output(glb, monkeypatch):
    """A program that copies its arguments shows what Blender is given: one animation, and the rate."""
    text = "import sys, pathlib; source, target, rate, name = sys.argv[-4:]; "
    text += "pathlib.Path(target).write_bytes(pathlib.Path(source).read_bytes() + f'{rate} {name}'.encode())"
    monkeypatch.setenv(BLENDER_VARIABLE, str(make_executable(glb.parent / "blender", text)))
    assert write_fbx(glb.with_suffix(".fbx"), glb, 59.94) is None
    assert glb.with_suffix(".fbx").read_bytes().endswith(b"59.94 walk")
    assert os.listdir(glb.parent).count("walk.fbx") == 1  # noqa: PTH208


def test_a_missing_folder_is_refused(glb, monkeypatch):
    text = "import sys, pathlib; pathlib.Path(sys.argv[-3]).write_bytes(b'x')"
    monkeypatch.setenv(BLENDER_VARIABLE, str(make_executable(glb.parent / "blender", text)))
    with pytest.raises(WriteError, match="nowhere"):
        write_fbx(glb.parent / "nowhere" / "walk.fbx", glb, 60.0)


@pytest.mark.parametrize("rate", [24.0, 25.0, 30.0, 60.0, 120.0, 59.94, 60000 / 1001, 23.976, 12.5, 179.82])
def test_blender_can_store_every_rate(rate):
    fps, base = split_rate(rate)
    assert isinstance(fps, int)
    assert fps / base == pytest.approx(rate, rel=1e-6)


def test_the_bone_farthest_from_its_place_is_named():
    """Distances up to a tenth of a millimetre are rounding of the formats."""
    expected = {"hip": [(0.0, 1.0, 0.0), (0.0, 1.0, 0.1)], "finger": [(0.5, 1.0, 0.0), (0.5, 1.0, 0.1)]}
    near = {**expected, "finger": [(0.5, 1.00009, 0.0), (0.5, 1.0, 0.1)]}
    far = {**expected, "finger": [(0.5, 1.0, 0.0), (0.5, 1.003, 0.1)]}
    assert find_difference(expected, near) == ""
    assert find_difference(expected, far) == "its bone finger is 3.0 mm from that of the GLB in frame 2"
    assert find_difference(expected, {"hip": expected["hip"]}) == "it lacks the bone finger"


def test_an_fbx_is_read_as_the_glb_to_which_blender_converts_it(tmp_path, monkeypatch):
    (tmp_path / "figure.glb").write_bytes(build_mixamo_glb())
    (tmp_path / "hero.fbx").write_bytes(b"Kaydara FBX Binary  \x00")
    text = "import sys, shutil; source, target = sys.argv[-2:]; assert source.endswith('hero.fbx'); "
    text += f"shutil.copy({str(tmp_path / 'figure.glb')!r}, target)"
    monkeypatch.setenv(BLENDER_VARIABLE, str(make_executable(tmp_path / "blender", text)))
    character = read_character_skeletons(tmp_path / "hero.fbx")[0]
    assert character.name == "hero"
    assert character.source is not None
    assert character.source.data == build_mixamo_glb()

    monkeypatch.setenv(
        BLENDER_VARIABLE, str(make_executable(tmp_path / "blender", "import sys; sys.exit('Error: version 6100')"))
    )
    with pytest.raises(
        ReadError, match=r"hero\.fbx: cannot be read: Blender failed \(Error: version 6100\); export the character"
    ):
        read_character_skeletons(tmp_path / "hero.fbx")[0]
    monkeypatch.delenv(BLENDER_VARIABLE)
    monkeypatch.setenv("PATH", str(tmp_path / "nowhere"))
    with pytest.raises(
        ReadError, match=r"hero\.fbx: an FBX is read by Blender, and it was not found; install it, set MOCAPFIX_BL"
    ):
        read_character_skeletons(tmp_path / "hero.fbx")[0]


@pytest.mark.parametrize("pitch_deg", [89.99, -89.999, 30.0])
def test_euler_angles_give_the_rotation_near_gimbal_lock(pitch_deg):
    """The errors of Blender's angles, a milliradian there, no longer add up."""
    rotation = Rotation.from_euler("xyz", [70.0, pitch_deg, -160.0], degrees=True)
    x, y, z, w = rotation.as_quat()

    class Wrapper:
        def fbx_object_tx(self):
            roll, pitch, yaw = np.deg2rad([70.0, pitch_deg, 200.0])
            matrix = SimpleNamespace(decompose=lambda: (None, (w, x, y, z), None))
            return "location", SimpleNamespace(x=roll + 1e-3, y=pitch, z=yaw - 3e-4), "scale", matrix, "rotation"

    keep_rotations_exact(Wrapper)
    _, euler, *_ = Wrapper().fbx_object_tx()
    found = Rotation.from_euler("xyz", [euler.x, euler.y, euler.z])
    limit = 1e-6 if abs(pitch_deg) > 45 else 1e-3  # elsewhere Blender's first two angles are exact
    assert (found * rotation.inv()).magnitude() < limit
    assert np.rad2deg(euler.z) == pytest.approx(200.0, abs=0.1)  # without a jump by a turn
