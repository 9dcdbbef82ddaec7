"""Format detection from content, and captures of every format."""

import gzip

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.errors import ReadError, TakeError
from mocapfix.io import capture
from mocapfix.model.animation import Animation
from mocapfix.options import ReadOptions
from tests.asf_files import AMC, ASF, FRAMES
from tests.bvh_files import TEXT
from tests.c3d_files import c3d_bytes
from tests.captures import CAPTURES, needs_captures
from tests.text_files import LABELS, STANDING, motive, motive_rows, nexus, qualisys, trc, workstation

PLAIN = "frame,time_s," + ",".join(f"{label}_{axis}_mm" for label in LABELS for axis in "XYZ") + "\n"
PLAIN += "".join(f"{t},{t / 100}," + ",".join(f"{x}" for x in row.ravel()) + "\n" for t, row in enumerate(STANDING))
COMPLETE_FILES = {  # one of each format
    "C3D": c3d_bytes(STANDING, LABELS),
    "TRC": trc().encode(),
    "TRC in UTF-16": trc().encode("utf-16"),
    "Motive CSV": motive().encode(),
    "Motive CSV 1.1": motive_rows(STANDING / 1000, LABELS).encode(),
    "Nexus CSV": nexus().encode(),
    "Nexus CSV, old": workstation().encode(),
    "Qualisys TSV": qualisys().encode(),
    "Qualisys TSV, bare": qualisys(columns=(), named=False).encode(),
    "plain CSV": PLAIN.encode(),
}

UNSUPPORTED_FILES = {
    "empty": (b"", "is empty"),
    "text": (b"Dear all,\nthe take is attached.\n" * 200, "one of: C3D, TRC"),
    "binary": (bytes(range(256)) * 20, "one of: C3D, TRC"),
    "gzip": (gzip.compress(b"PathFileType\t4"), r"compressed \(gzip\); extract it"),
    "zip": (b"PK\x03\x04" + bytes(100), r"compressed \(zip\)"),
}


@pytest.mark.parametrize("case", UNSUPPORTED_FILES)
def test_unsupported_files_are_refused_with_their_name(tmp_path, case):
    data, words = UNSUPPORTED_FILES[case]
    path = tmp_path / "walk.c3d"
    path.write_bytes(data)
    with pytest.raises(ReadError, match=words) as error:
        capture.read_capture(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("end", [b"\r", b"\n", b"\r\n"])
@pytest.mark.parametrize("kind", [kind for kind in COMPLETE_FILES if kind not in ("C3D", "TRC in UTF-16")])
def test_any_line_ends_are_read(tmp_path, kind, end):
    path = tmp_path / "walk"
    path.write_bytes(COMPLETE_FILES[kind].replace(b"\r\n", b"\n").replace(b"\n", end))
    assert capture.read_take(path).markers.shape == (4, 3, 3)


TEXT_KINDS = [kind for kind in COMPLETE_FILES if kind not in ("C3D", "TRC in UTF-16")]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32"])
@pytest.mark.parametrize("before", ["", "\r\n", "# exported by a program\r\n\r\n", "// by hand\r\n% twice\r\n"])
@pytest.mark.parametrize("kind", TEXT_KINDS)
def test_encodings_and_leading_comments_change_nothing(tmp_path, kind, before, encoding):
    plain, path = COMPLETE_FILES[kind].decode(), tmp_path / "walk"
    path.write_bytes(plain.encode())
    expected = capture.read_take(path)
    end = "\r\n" if "\r\n" in plain else "\n"
    path.write_bytes((before.replace("\r\n", end) + plain).encode(encoding))
    found = capture.read_take(path)
    np.testing.assert_array_equal(found.markers, expected.markers)
    assert (found.labels, found.rate, found.first_frame) == (expected.labels, expected.rate, expected.first_frame)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32"])
@pytest.mark.parametrize("sign", [".", ","])
def test_amc_and_asf_in_any_encoding(tmp_path, encoding, sign):
    (tmp_path / "09.asf").write_text(ASF, encoding="utf-8")
    (tmp_path / "09_01.amc").write_text(AMC, encoding="utf-8")
    expected = capture.read_capture(tmp_path / "09_01.amc")
    (tmp_path / "09.asf").write_bytes(ASF.replace(".", sign).encode(encoding))
    header, body = AMC.split("\n7\n")
    (tmp_path / "09_01.amc").write_bytes((header + "\n7\n" + body.replace(".", sign)).encode(encoding))
    found = capture.read_capture(tmp_path / "09_01.amc")
    assert isinstance(found, Animation)
    assert isinstance(expected, Animation)
    np.testing.assert_array_equal(found.values, expected.values)
    np.testing.assert_array_equal(found.offsets, expected.offsets)


def test_missing_files_and_folders_are_refused(tmp_path):
    with pytest.raises(ReadError, match=r"none\.c3d: there is no such file"):
        capture.read_capture(tmp_path / "none.c3d")
    with pytest.raises(ReadError, match="is a folder"):
        capture.read_capture(tmp_path)


def test_the_format_is_detected_from_the_content(tmp_path):
    path = tmp_path / "walk.trc"
    path.write_bytes(c3d_bytes(STANDING, LABELS))
    assert capture.read_take(path).labels == LABELS


@pytest.mark.parametrize("name", COMPLETE_FILES)
def test_each_file_matches_exactly_one_format(name, tmp_path):
    head = capture.extract_head(COMPLETE_FILES[name])
    kinds = [kind.name for kind in capture.FILE_FORMATS if kind.matches(head)]
    assert len(kinds) == 1
    assert name.startswith(kinds[0])
    (tmp_path / "take").write_bytes(COMPLETE_FILES[name])
    assert set(capture.read_take(tmp_path / "take").labels) == set(LABELS)


def test_an_empty_file_matches_no_format():
    assert not any(kind.matches(b"") for kind in capture.FILE_FORMATS)


@pytest.mark.parametrize("name", [name for name in COMPLETE_FILES if name != "C3D"])
@given(data=st.data())
def test_damaged_texts_are_read_or_refused(tmp_path_factory, name, data):
    damaged = bytearray(COMPLETE_FILES[name])
    path = tmp_path_factory.mktemp("damaged") / "take"
    for _ in range(data.draw(st.integers(0, 3), "changes")):
        damaged[data.draw(st.integers(0, len(damaged) - 1), "place")] = data.draw(st.integers(0, 255), "byte")
    path.write_bytes(damaged[: data.draw(st.integers(0, len(damaged)), "kept")])
    try:
        take = capture.read_take(path)
    except ReadError:
        return
    assert take.markers.shape == (take.frame_count, len(take.labels), 3)


@pytest.mark.parametrize(
    "name", [name for name in COMPLETE_FILES if name not in ("C3D", "TRC in UTF-16", "Motive CSV 1.1", "plain CSV")]
)
@given(kept=st.integers(0, 100))
def test_texts_cut_off_within_their_last_line_are_refused(tmp_path_factory, name, kept):
    complete = COMPLETE_FILES[name].rstrip(b"\r\n\0")
    last = len(complete) - len(complete.splitlines()[-1])
    path = tmp_path_factory.mktemp("cut") / "take"
    path.write_bytes(complete[: last + 1 + kept * (len(complete) - last - 30) // 100])
    with pytest.raises(ReadError, match="is cut off"):
        capture.read_capture(path)


COUNTS = {  # frames, markers, rate, first frame, missing samples; from each file's header and by hand
    "trc/Anto.trc": (128, 34, 100, 1, 0),
    "trc/Gait.trc": (487, 33, 100, 1, 7306),  # 33 of the 66 have names
    "trc/ballet_reduced.trc": (100, 41, 30, 1, 0),
    "trc/crlf.trc": (10, 41, 60, 1, 0),
    "trc/dataWithBlanksForMissingMarkers.trc": (464, 34, 250, 1, 12227),  # without 6 joint centres
    "trc/pyomeca_markers.trc": (93, 51, 100, 1, 0),  # of 652 frames that its header declares
    "trc/subject02_running.trc": (600, 41, 60, 1, 600),  # one marker is 0 0 0 throughout
    "trc/walk_free_01.trc": (73, 41, 60, 185, 0),  # of 900
    "csv/Sample_Static.csv": (275, 35, 100, 1, 0),
    "csv/vicon_markers.csv": (580, 51, 100, 1, 305),
    "csv/optitrack_v1.1.csv": (548, 5, 120, 0, 628),
    "tsv/qualisys_Measurement1.tsv": (2000, 15, 100, 1, 0),
}


@needs_captures
@pytest.mark.parametrize("name", COUNTS)
def test_captures_have_the_counts_of_their_headers(name):
    take = capture.read_take(CAPTURES / name)
    missing = int((~take.visible).sum())
    assert (take.frame_count, len(take.labels), take.rate, take.first_frame, missing) == COUNTS[name]
    # What a laboratory captures lies above its floor and within a few metres.
    assert -0.1 < np.nanmin(np.nanpercentile(take.markers[..., 1], 5)) < np.nanpercentile(take.markers[..., 1], 95) < 2.5


@needs_captures
def test_a_trial_is_equal_from_its_csv_and_its_c3d():
    csv, c3d = capture.read_take(CAPTURES / "csv" / "vicon_markers.csv"), capture.read_take(CAPTURES / "c3d" / "Vicon.c3d")
    assert csv.bare_labels == c3d.bare_labels
    np.testing.assert_array_equal(csv.visible, c3d.visible)
    np.testing.assert_allclose(csv.markers, c3d.markers, atol=1e-5)  # the CSV has six digits


@needs_captures
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("trc/Truncated.trc", "line 3: the file ends before its markers are named"),
        ("csv/Movement_trial.csv", "has model outputs and no trajectories"),
        ("csv/accad_quickwalk_TXT.zip", r"compressed \(zip\)"),
    ],
)
def test_captures_without_trajectories_are_refused(name, words):
    with pytest.raises(ReadError, match=words):
        capture.read_capture(CAPTURES / name)


def test_an_animation_is_detected_from_its_content(tmp_path):
    (tmp_path / "walk.txt").write_text("\ufeff\n" + TEXT, encoding="utf-8")
    animation = capture.read_capture(tmp_path / "walk.txt")
    assert isinstance(animation, Animation)
    assert animation.names == ("Hips", "Left Knee", "Ns:Foot", "Chest", "Head")
    np.testing.assert_allclose(animation.compute_world_poses()[0][0, 0], [0.105, 0.9, -0.0325])
    rotated = capture.read_capture(tmp_path / "walk.txt", ReadOptions(up_axis="Z"))
    assert isinstance(rotated, Animation)
    np.testing.assert_allclose(rotated.compute_world_poses()[0][0, 0], [0.9, -0.0325, 0.105])


def test_a_take_is_not_read_from_an_animation(tmp_path):
    (tmp_path / "walk.bvh").write_text(TEXT, encoding="utf-8")
    with pytest.raises(TakeError, match=r"walk\.bvh: has joints and no markers"):
        capture.read_take(tmp_path / "walk.bvh")


def test_an_amc_is_detected_with_and_without_keywords(tmp_path):
    (tmp_path / "09.asf").write_text(ASF, encoding="utf-8")
    for text in (AMC, FRAMES, f"# a comment\n{FRAMES}"):
        (tmp_path / "09_01.dat").write_text(text, encoding="utf-8")
        animation = capture.read_capture(tmp_path / "09_01.dat")
        assert isinstance(animation, Animation)
        assert (animation.names[0], animation.first_frame, animation.frame_count) == ("root", 7, 2)


def test_an_asf_alone_is_refused(tmp_path):
    (tmp_path / "09.asf").write_text(ASF, encoding="utf-8")
    with pytest.raises(ReadError, match=r"09\.asf: is a skeleton without motion; name the AMC"):
        capture.read_capture(tmp_path / "09.asf")
