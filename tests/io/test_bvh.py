import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mocapfix.errors import ReadError
from mocapfix.io import bvh, capture
from mocapfix.io.conventions import estimate_height, infer_up_axis
from mocapfix.io.coordinates import ROTATIONS_TO_Y_UP
from mocapfix.model import windows
from mocapfix.model.animation import Animation
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.options import ReadOptions
from mocapfix.synthetic import compose_motion, draw_subject
from tests.bvh_files import HIERARCHY, ROWS, TEXT
from tests.captures import CAPTURES, needs_captures

VALUES = np.array([row.split() for row in ROWS], float)


def read(folder: Path, text: str | bytes):
    path = folder / "a.bvh"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return bvh.read_bvh(path)


def test_joints_channels_and_values_are_read(tmp_path):
    found = read(tmp_path, TEXT)
    assert found.names == ("Hips", "Left Knee", "Ns:Foot", "Chest", "Head")
    assert found.parents.tolist() == [-1, 0, 1, 0, 3]
    assert found.offsets.tolist() == [[1, 2, 3], [0, -60, 0], [0, -50, 5], [0, 60, 0], [0, 40, 0]]
    assert [each.tolist() for each in found.end_sites] == [[], [], [[0, 0, 20], [5, 0, 18]], [[0, 5, 0]], [[0, 20, 0]]]
    assert found.channels[2] == ("Yrotation", "Zrotation", "Xrotation")
    assert (found.channels[4], found.rate, found.unit_m, found.frame_count) == ((), 120.0, 0.01, 3)
    np.testing.assert_array_equal(found.values, VALUES)
    assert found.notes == ()
    data = (tmp_path / "a.bvh").read_bytes()
    assert found.value_byte_offsets is not None
    assert [data[start:].split()[0].decode() for start in found.value_byte_offsets.ravel()] == " ".join(ROWS).split()


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("\n", "\r"),
        lambda text: text.replace("  ", "\t"),
        lambda text: text.replace("Xposition", "XPOSITION").replace("Zrotation", "zRotation").replace("JOINT", "Joint"),
        lambda text: text.replace("MOTION", "Motion").replace("HIERARCHY", "hierarchy").replace("End Site", "end site"),
        lambda text: text.replace("\n{", " {").replace("Frames: 3", "Frames:\t3").replace("Frame Time:", "FRAME TIME :"),
        lambda text: text.replace(" 15.0000", "\n15.0000").replace(" 16.0000", "\n16.0000").replace(" 17.0000", "\n\n17.0000"),
        lambda text: text.replace("10.5000", "1.05e1").replace("20.0000", "+2E+1") + "\n\n",
        lambda text: text.replace("\n  OFFSET", " OFFSET").replace("\n    CHANNELS", " CHANNELS").replace("\n}", " }"),
        lambda text: "\ufeff" + text.replace("End Site", "End Site of the foot"),
    ],
)
def test_spelling_variants_are_equivalent(tmp_path, change):
    found, plain = read(tmp_path, change(TEXT)), read(tmp_path, TEXT)
    assert (found.names, found.channels, found.rate) == (plain.names, plain.channels, plain.rate)
    np.testing.assert_array_equal(found.values, VALUES)
    np.testing.assert_array_equal(found.offsets, plain.offsets)


def test_not_a_number_is_missing(tmp_path):
    found = read(tmp_path, TEXT.replace("16.0000", "-1.#IND").replace("17.0000", "nan"))
    assert np.argwhere(np.isnan(found.values)).tolist() == [[1, 6], [2, 6]]
    assert np.isnan(found.compute_world_poses()[0][1:, 2]).all()
    assert not np.isnan(found.compute_world_poses()[0][:, 3]).any()


def test_a_wrong_frame_count_is_noted(tmp_path):
    found = read(tmp_path, TEXT.replace("Frames: 3", "Frames: 500"))
    assert found.frame_count == 3
    assert found.notes == ("It declares 500 frames and has 3; all of these are read.",)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("MOTION", "NOTION", "has no line MOTION"),
        ("ROOT Hips\n{", "ROOT Hips\n", r"a\.bvh, line 4: an OFFSET is outside"),
        ("}\nMOTION", "MOTION", "1 braces not closed"),
        ("}\nMOTION", "}\n}\nMOTION", r"line 43: a brace closes that was not opened"),
        ("}\nMOTION", "}\nROOT Foot\n{\nOFFSET 0 0 0\n}\nMOTION", "line 46: Hips, Foot are the roots of two figures"),
        ("}\nMOTION", "ROOT Other\n{\nOFFSET 0 0 0\n}\n}\nMOTION", "line 42: ROOT Other is inside of another joint"),
        ("CHANNELS 1 Xrotation", "CHANNELS 2 Xrotation", "line 9: 2 channels are declared and 1 named"),
        ("CHANNELS 1 Xrotation", "CHANNELS 1 Wrotation", "line 9: channel Wrotation is neither"),
        ("CHANNELS 1 Xrotation", "CHANNELS", "line 9: no number of channels"),
        ("OFFSET 0 -60 0", "OFFSET 0 -60", "line 8: OFFSET 0 -60 is not three numbers"),
        ("OFFSET 0 -60 0", "OFFSET 0 x 0", "line 8: OFFSET 0 x 0 is not three numbers"),
        ("OFFSET 0 -60 0", "", "joint Left Knee has no OFFSET"),
        ("OFFSET 0 -60 0", "GARBAGE 1", "line 8: 'GARBAGE 1' is not one of ROOT"),
        ("Frame Time: .0083333", "", "line 44: there is no Frames: and Frame Time:"),
        ("Frame Time: .0083333", "Frame Time: 0", "line 45: a frame time of 0 s"),
        ("Frame Time: .0083333", "Frame Time: x", "the number of frames 3 or the frame time x is not a number"),
        ("10.6000", "ten", "line 47: 'ten' is not a number"),
        ("10.6000", "10,6", "line 47: '10,6' is not a number"),
        (" 7.1000", "", "line 47: has 15 numbers for 16 channels"),
        (" 7.2000", "", "line 48: has 15 numbers for 16 channels"),
        (" 7.0000", " 7.0000 8.0000", "line 46: has 17 numbers for 16 channels"),
        ("\n".join(ROWS), "", "has no motion: 16 channels and 0 numbers"),
    ],
)
def test_invalid_files_are_refused_with_the_line(tmp_path, old, new, message):
    assert TEXT.count(old) == 1
    with pytest.raises(ReadError, match=message):
        read(tmp_path, TEXT.replace(old, new))


def test_a_short_and_a_long_line_do_not_compensate_each_other(tmp_path):
    moved = TEXT.replace(" 7.0000\n10.6000", "\n7.0000 10.6000")
    with pytest.raises(ReadError, match="line 46: has 15 numbers"):
        read(tmp_path, moved)


def test_frames_may_span_several_lines(tmp_path):
    wrapped = HIERARCHY + "MOTION\nFrames: 3\nFrame Time: .01\n" + "\n".join(" ".join(ROWS).split()) + "\n"
    np.testing.assert_array_equal(read(tmp_path, wrapped).values, VALUES)
    with pytest.raises(ReadError, match=r"line \d+: has 1 numbers for 16 channels"):
        read(tmp_path, wrapped.removesuffix("7.2000\n"))


def test_missing_and_empty_files_are_refused(tmp_path):
    with pytest.raises(ReadError, match="there is no such file"):
        bvh.read_bvh(tmp_path / "b.bvh")
    with pytest.raises(ReadError, match="is a folder"):
        bvh.read_bvh(tmp_path)
    (tmp_path / "b.bvh").write_bytes(b"")
    with pytest.raises(ReadError, match="is empty"):
        bvh.read_bvh(tmp_path / "b.bvh")


def scale_lengths(text: str, factor: float) -> str:
    """Return a BVH of the figure with its offsets and positions multiplied."""
    header, rows = text.split(".0083333\n")
    lines = [
        " ".join(["OFFSET", *(repr(float(x) * factor) for x in line.split()[1:])]) if "OFFSET" in line else line
        for line in header.splitlines()
    ]
    values = np.array([row.split() for row in rows.splitlines()], float)
    values[:, [0, 1, 2, 10, 11, 12]] *= factor
    return "\n".join(lines) + ".0083333\n" + "\n".join(" ".join(map(repr, row)) for row in values.tolist()) + "\n"


@pytest.mark.parametrize(
    ("factor", "unit"),
    [(1, 0.01), (0.01, 1.0), (10, 0.001), (1 / 5.6444444, 0.0254 / 0.45), (1 / 2.54, 0.0254), (1 / 30.48, 0.3048)],
)
def test_the_unit_is_inferred_from_the_height_of_the_figure(tmp_path, factor, unit):
    scaled = scale_lengths(TEXT.replace("OFFSET 0 5 0", "OFFSET 60 5 0"), factor)
    found = read(tmp_path, scaled)
    assert found.unit_m == pytest.approx(unit)
    assert bool(found.notes) == (factor != 1)


def test_a_giant_keeps_the_usual_unit_with_a_note_that_names_the_option(tmp_path):
    found = read(tmp_path, scale_lengths(TEXT.replace("OFFSET 0 5 0", "OFFSET 60 5 0"), 1.7))
    assert found.unit_m == 0.01
    assert found.notes[0].startswith("The file gives no unit of length; 1 cm is assumed")
    assert "--unit" in found.notes[0]


def test_a_figure_in_no_known_unit_is_refused_and_read_in_the_unit_of_the_option(tmp_path):
    (tmp_path / "a.bvh").write_text(scale_lengths(TEXT.replace("OFFSET 0 5 0", "OFFSET 60 5 0"), 1000), encoding="utf-8")
    with pytest.raises(ReadError, match=r"figure is 1,[78]\d0 m tall.*--unit, one of mm"):
        bvh.read_bvh(tmp_path / "a.bvh")
    assert bvh.read_bvh(tmp_path / "a.bvh", options=ReadOptions(unit="mm")).unit_m == 0.001
    assert bvh.read_bvh(tmp_path / "a.bvh", options=ReadOptions(accept_contradictions=True)).unit_m == 0.01


@pytest.mark.parametrize("axis", ["-Y", "-Z"])
def test_an_animation_with_a_downward_axis_is_upright(tmp_path, axis):
    (tmp_path / "a.bvh").write_text(TEXT, encoding="utf-8")
    upright = bvh.read_bvh(tmp_path / "a.bvh")
    turn = ROTATIONS_TO_Y_UP[axis].T
    root, frames = np.array([0]), np.arange(upright.frame_count)
    turned = upright.replace_rotations(root, frames, turn @ upright.compute_local_rotations()[:, :1])
    turned = turned.replace_positions(root, frames, upright.compute_local_positions()[:, :1] @ turn.T)
    found = infer_up_axis(turned)
    assert f"The {axis} axis points up, because the head is above the feet along it (--up sets it)." in found.notes
    np.testing.assert_allclose(found.compute_world_poses()[0], upright.compute_world_poses()[0], atol=1e-9)


def test_the_up_axis_is_inferred_from_head_and_feet(tmp_path):
    turned = HIERARCHY
    for old, new in (("0 -60 0", "0 0 -60"), ("0 -50 5", "0 -5 -50"), ("0 60 0", "0 0 60"), ("0 40 0", "0 0 40")):
        turned = turned.replace(old, new)
    still = " ".join(["0"] * 11 + ["0", "60"] + ["0"] * 3)
    found = read(tmp_path, f"{turned}MOTION\nFrames: 1\nFrame Time: .01\n{still}\n")
    assert any("Z axis points up" in note for note in found.notes)
    position, _ = found.compute_world_poses()
    assert position[0, found.names.index("Head"), 1] == pytest.approx(1.0)


@needs_captures
@pytest.mark.parametrize(
    ("name", "joints", "frames", "rate"),
    [
        ("cmu/02_01.bvh", 31, 344, 120), ("cmu/01_01.bvh", 31, 2752, 120), ("bvh-other/louise.bvh", 18, 2998, 100),
        ("bvh-other/02_01_daz-friendly.bvh", 43, 344, 120), ("bvh-other/Male1_B3_Walk.bvh", 22, 183, 30),
    ],
)  # fmt: skip
def test_captures_are_complete_and_stand_on_the_floor(name, joints, frames, rate):
    found = bvh.read_bvh(CAPTURES / name)
    assert (len(found.names), found.frame_count, found.rate) == (joints, frames, rate)
    position, _ = found.compute_world_poses()
    np.testing.assert_array_equal(found.rotation_y_up_file, np.eye(3))
    height = np.ptp(position[..., 1], axis=1)
    assert 1.0 < np.median(height) < 2.0
    assert abs(np.median(position[..., 1].min(1))) < 0.3


def test_a_figure_without_any_position_is_read(tmp_path):
    rows = "\n".join(" ".join(["nan"] * 16) for _ in range(3))
    found = read(tmp_path, TEXT.replace("\n".join(ROWS), rows))
    assert np.isnan(found.values).all()


def test_displacements_are_distinguished_from_positions(tmp_path):
    found = read(tmp_path, TEXT.replace(" 60.0000 ", " 0.1 ").replace(" 60.5000 ", " 0.2 ").replace(" 61.0000 ", " 0.3 "))
    assert found.notes == ("The positions of Chest are near zero; they are taken as displacements from the offsets.",)
    assert found.is_position_added.tolist() == [False, False, False, True, False]
    np.testing.assert_allclose(found.compute_local_positions()[:, 3, 1], [0.601, 0.602, 0.603])


def test_displacements_that_are_not_small_are_those_of_the_whole_file(tmp_path):
    found = read(tmp_path, TEXT.replace(" 60.0000 ", " 11.0 ").replace(" 60.5000 ", " 12.0 ").replace(" 61.0000 ", " 13.0 "))
    np.testing.assert_allclose(found.compute_local_positions()[:, 3, 1], [0.71, 0.72, 0.73])


def test_prop_with_a_root_of_its_own_is_read_beside_the_figure(tmp_path):
    prop = "ROOT Sword\n{\nOFFSET 0 0 0\nCHANNELS 3 Xposition Yposition Zposition\nEnd Site\n{\nOFFSET 0 0 90\n}\n}\nMOTION"
    rows = [f"{row} {10 * frame} 0 5" for frame, row in enumerate(ROWS)]
    found = read(tmp_path, TEXT.replace("MOTION", prop).replace("\n".join(ROWS), "\n".join(rows)))
    plain = read(tmp_path, TEXT)
    assert (found.names[-1], found.parents[-1], found.unit_m) == ("Sword", -1, plain.unit_m)
    position = found.compute_world_poses()[0]
    np.testing.assert_allclose(position[:, -1], [[0, 0, 0.05], [0.1, 0, 0.05], [0.2, 0, 0.05]])
    np.testing.assert_array_equal(position[:, :-1], plain.compute_world_poses()[0])


def test_a_long_motion_is_written_block_by_block(tmp_path, monkeypatch):
    subject = draw_subject(np.random.default_rng(2), asymmetric=False)
    motion = compose_motion(subject, 1.0, 30.0)
    bvh.write_bvh(tmp_path / "once.bvh", subject.skeleton, motion, 30.0)
    monkeypatch.setattr(windows, "MAX_BLOCK_FRAMES", 7)
    bvh.write_bvh(tmp_path / "blocks.bvh", subject.skeleton, motion, 30.0)
    assert (tmp_path / "blocks.bvh").read_bytes() == (tmp_path / "once.bvh").read_bytes()


def test_a_sword_in_one_hand_is_no_part_of_the_height(tmp_path):
    body = compose_motion(draw_subject(np.random.default_rng(0), asymmetric=False), 0.2, 30.0)
    skeleton = load_cmu31_body().skeleton
    bvh.write_bvh(tmp_path / "body.bvh", skeleton, body, 30.0)
    text = (tmp_path / "body.bvh").read_text()
    hand = text.index("JOINT RightFingerBase")
    channels = text.index("\n", text.index("CHANNELS", hand)) + 1
    sword = "JOINT Sword\n{\nOFFSET 0 -5 0\nCHANNELS 0\nEnd Site\n{\nOFFSET 0 -90 0\n}\n}\n"
    armed = read(tmp_path, text[:channels] + sword + text[channels:])
    assert estimate_height(armed) == pytest.approx(estimate_height(bvh.read_bvh(tmp_path / "body.bvh")), rel=1e-6)


def test_body_below_a_floor_with_a_camera_is_found_without_known_names():
    parents = np.array([-1, 0, 0, 2, 3, 4, 2, 6, 7, 2, 9, 10])
    count = len(parents)
    names, none = tuple(f"j{joint}" for joint in range(count)), tuple(np.zeros((0, 3)) for _ in parents)
    figure = Animation(names, parents, np.zeros((count, 3)), none, ((),) * count, np.zeros((1, 0)), 30.0)
    assert figure.body_root == 2


@settings(max_examples=200)
@given(st.binary(max_size=6), st.integers(0, len(TEXT)), st.integers(0, 120))
def test_damaged_files_are_read_or_refused_with_a_message(tmp_path_factory, inserted, at, removed):
    data, folder = TEXT.encode(), tmp_path_factory.getbasetemp()
    found, refused = None, ""
    try:
        found = read(folder, data[:at] + inserted + data[at + removed :])
    except ReadError as error:
        refused = str(error)
    if found is None:
        assert re.match(rf"{re.escape(str(folder))}/\w+\.bvh\b.*[.)]$", refused, re.DOTALL)
    else:
        assert found.compute_world_poses()[0].shape == (found.frame_count, len(found.names), 3)


BONES = {"Hips": (0, 92, 0), "Chest": (0, 50, 0), "Head": (0, 30, 0), "Hand": (60, 20, 0), "Leg": (9, -5, 0), "Foot": (0, -80, 0)}
PARENTS = {"Hips": "", "Chest": "Hips", "Head": "Chest", "Hand": "Chest", "Leg": "Hips", "Foot": "Leg"}
TIPS = {"Head": (0, 15, 0), "Hand": (15, 0, 0), "Foot": (0, -5, 15)}


def write_figure(
    offsets: Mapping[str, tuple[float, ...]], above: tuple[str, ...] = (), scale: float = 1.0, frames: int = 3
) -> str:
    """Return a BVH of a figure whose bones stand in position channels, with any offsets, below nodes that do not move."""

    def write_joint(name: str, keyword: str) -> str:
        lines = f"{keyword} {name}\n{{\nOFFSET {' '.join(map(repr, offsets.get(name, (0.0,) * 3)))}\n"
        lines += "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation\n"
        order.append(name)
        lines += "".join(write_joint(child, "JOINT") for child, parent in parents.items() if parent == name)
        if name in TIPS:
            lines += f"End Site\n{{\nOFFSET {' '.join(repr(scale * x) for x in TIPS[name])}\n}}\n"
        return lines + "}\n"

    order: list[str] = []
    parents = {**dict(zip(above, ("", *above), strict=False)), **PARENTS, "Hips": above[-1] if above else ""}
    text = "HIERARCHY\n" + write_joint(next(name for name, parent in parents.items() if not parent), "ROOT")
    text += f"MOTION\nFrames: {frames}\nFrame Time: 0.01\n"
    for t in range(frames):
        rows = [np.multiply(BONES.get(name, (0, 0, 0)), scale) + (name == "Hips") * np.array([t, 0, 0]) * scale for name in order]
        text += " ".join(f"{' '.join(map(repr, row.tolist()))} {5.0 * t} 0 0" for row in rows) + "\n"
    return text


@settings(max_examples=30)
@given(
    st.dictionaries(st.sampled_from([*BONES, "Reference"]), st.tuples(*[st.floats(-900, 900)] * 3)),
    st.sampled_from([(), ("Reference",), ("Armature", "Reference")]),
)
def test_position_channels_replace_the_offset_of_any_joint(tmp_path_factory, offsets, above):
    folder = tmp_path_factory.getbasetemp()
    plain, found = read(folder, write_figure(BONES)), read(folder, write_figure({**BONES, **offsets}, above))
    assert not found.is_position_added.any()
    assert (found.unit_m, found.notes) == (plain.unit_m, plain.notes)
    positions, names = found.compute_world_poses()[0], [found.names.index(name) for name in BONES]
    # The nodes above turn like the others, about the origin.
    if not above:
        np.testing.assert_allclose(positions[:, names], plain.compute_world_poses()[0], atol=1e-9)
    np.testing.assert_allclose(positions[0, names], plain.compute_world_poses()[0][0], atol=1e-9)
    lengths = np.linalg.norm(found.bone_offsets[names[1:]], axis=1) * found.unit_m
    np.testing.assert_allclose(lengths, [np.linalg.norm(BONES[name]) / 100 for name in list(BONES)[1:]])


@pytest.mark.parametrize("unit_m", [0.01, 1.0, 0.001, 0.0254, 0.0254 / 0.45, 0.3048])
@pytest.mark.parametrize(
    "offsets", [{}, {"Hips": (450.0, 0.0, 0.0)}, {"Reference": (0.0, 0.0, -450.0)}], ids=["zero", "hips", "root"]
)
def test_the_unit_is_that_of_the_posed_figure(tmp_path, unit_m, offsets):
    found = read(tmp_path, write_figure(offsets, ("Reference",), 0.01 / unit_m))
    assert found.unit_m == pytest.approx(unit_m)
    height = np.ptp(found.compute_world_poses()[0][0, :, 1])
    assert height == pytest.approx(0.92 + 0.8, abs=1e-9)  # from the reference on the floor to the head


def test_bones_that_change_in_length_are_noted(tmp_path):
    text = write_figure(BONES, frames=2)
    found = read(tmp_path, text[: text.rindex("0.0 50.0 0.0")] + "0.0 53.0 0.0" + text[text.rindex("0.0 50.0 0.0") + 12 :])
    change = "One bone changes in length, that to Chest by 30 mm"
    assert found.notes == (f"{change}; the copy of the file keeps this, the skeleton has their median lengths.",)
    np.testing.assert_allclose(found.bone_offsets[found.names.index("Chest")], [0, 51.5, 0])


ENCODED_TEXTS = {
    "utf-16": TEXT.encode("utf-16"),
    "utf-16-le": TEXT.encode("utf-16-le"),
    "utf-16-be": ("\ufeff" + TEXT).encode("utf-16-be"),
    "utf-32": TEXT.encode("utf-32"),
    "comments": b"# exported\n\n// twice\r\n" + TEXT.replace("MOTION", "# motion follows\nMOTION").encode(),
    "blank lines": b"\n \n" + TEXT.encode(),
    "decimal commas": TEXT.replace(".", ",").encode(),
}


@pytest.mark.parametrize("data", ENCODED_TEXTS.values(), ids=ENCODED_TEXTS.keys())
def test_encodings_comments_and_decimal_commas_are_read(tmp_path, data):
    (tmp_path / "a.bvh").write_bytes(data)
    found = capture.read_capture(tmp_path / "a.bvh")
    assert isinstance(found, Animation)
    assert (found.names, found.rate, found.notes) == (("Hips", "Left Knee", "Ns:Foot", "Chest", "Head"), 120.0, ())
    assert found.offsets.tolist() == [[1, 2, 3], [0, -60, 0], [0, -50, 5], [0, 60, 0], [0, 40, 0]]
    np.testing.assert_array_equal(found.values, VALUES)


def test_damaged_utf_16_is_named(tmp_path):
    with pytest.raises(ReadError, match=r"a\.bvh: is damaged UTF-16 text; save it again as UTF-8\."):
        read(tmp_path, TEXT.encode("utf-16") + b"\n")
