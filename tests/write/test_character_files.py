"""The files of a character beside the other outputs of a take."""

import json
from dataclasses import replace

import numpy as np
import pytest

from mocapfix.animation import Animation
from mocapfix.characters.character_choice import load_character
from mocapfix.errors import WriteError
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.options import OutputOptions
from mocapfix.read.capture import read_capture
from mocapfix.write.character_files import CharacterFiles
from mocapfix.write.output_formats import list_output_formats


@pytest.fixture(autouse=True)
def without_report_files(monkeypatch):
    """Replace the recording and the HTML report, which take most of the time and are not tested here."""
    monkeypatch.setattr("mocapfix.report.recording.write_recording", lambda target, comparison: target.write_bytes(b"rrd"))
    monkeypatch.setattr("mocapfix.report.html_report.write_html_report", lambda target, *_: target.write_text("page"))
    monkeypatch.setattr("mocapfix.write.fbx.find_blender", lambda: None)


@pytest.fixture
def solved(cleaned):
    """Return the cleaned take with half a second of its motion."""
    return replace(cleaned.result, motion=cleaned.result.motion.select_frames(np.arange(61)))


def test_all_files_of_each_character_are_written(solved, tmp_path):
    options = OutputOptions(characters=("mixamo", "smpl"), key_error_deg=0.5)
    outputs = solved.write(tmp_path, options=options)
    for name in ("mixamo", "smpl"):
        assert {f"{name}.{suffix}" for suffix in ("glb", "bvh", "npz", "map.yaml")} <= set(outputs)
    notes = json.loads(outputs["report.json"].read_text())["notes"]
    assert any("walk.mixamo.glb" in note and "ratio of the legs' lengths" in note for note in notes)
    assert any("walk.smpl.glb" in note and "keys are kept" in note for note in notes)


def test_bvh_of_a_character_moves_like_its_arrays(solved, tmp_path):
    outputs = solved.write(tmp_path, options=OutputOptions(characters=("mixamo",), output_rate_hz=30.0))
    animation = read_capture(outputs["mixamo.bvh"])
    assert isinstance(animation, Animation)
    arrays = np.load(outputs["mixamo.npz"])
    assert animation.rate == pytest.approx(30.0)
    position, _ = animation.compute_world_poses()
    hips = position[:, animation.names.index("mixamorig:Hips")]
    assert arrays["rate"] == 30.0
    assert len(arrays["pelvis_position"]) == len(hips) == 16
    np.testing.assert_allclose(hips, arrays["pelvis_position"], atol=1e-4)


def test_fbx_that_cannot_be_written_is_no_failure(solved, tmp_path):
    outputs = solved.write(tmp_path, options=OutputOptions(characters=("mixamo",), extra_formats=("fbx",)))
    assert "mixamo.fbx" not in outputs
    notes = json.loads(outputs["report.json"].read_text())["notes"]
    assert sum("FBX needs Blender" in note for note in notes) == 2  # of the solved skeleton, and of the character


def test_file_names_are_checked_before_anything_is_cleaned():
    files = CharacterFiles(load_character("mixamo"), has_fbx=True)
    assert files.suffixes == ("mixamo.glb", "mixamo.bvh", "mixamo.npz", "mixamo.map.yaml", "mixamo.fbx")
    list_output_formats(OutputOptions(characters=("mixamo", "mixamo")))  # the same twice is written once
    with pytest.raises(WriteError, match=r"both have the suffix \.mixamo\.glb"):
        list_output_formats(OutputOptions(characters=("mixamo", find_preset_path("mixamo"))))


def find_preset_path(name: str) -> str:
    """Return the path of a preset's file, which has the preset's name."""
    return str(find_shipped_folder("scenes") / "rigs" / f"{name}.yaml")
