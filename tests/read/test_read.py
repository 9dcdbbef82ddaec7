"""What a file is is told by what it holds."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.animations import joint_points
from mocapfix.errors import ReadError
from mocapfix.read import capture
from tests.asf_files import AMC, ASF, FRAMES
from tests.bvh_files import TEXT
from tests.c3d_files import c3d_bytes
from tests.text_files import LABELS, STANDING, motive, motive_rows, nexus, qualisys, trc, workstation

CAPTURES = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "captures"
with_captures = pytest.mark.skipif(not CAPTURES.is_dir(), reason="no captures beside the repository")
PLAIN = "frame,time_s," + ",".join(f"{label}_{axis}_mm" for label in LABELS for axis in "XYZ") + "\n"
PLAIN += "".join(f"{t},{t / 100}," + ",".join(f"{x}" for x in row.ravel()) + "\n" for t, row in enumerate(STANDING))
WHOLE = {  # one of each kind
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

STRANGE = {
    "empty": (b"", "is empty"),
    "text": (b"Dear all,\nthe take is attached.\n" * 200, "one of: C3D, TRC"),
    "binary": (bytes(range(256)) * 20, "one of: C3D, TRC"),
    "gzip": (gzip.compress(b"PathFileType\t4"), r"packed \(gzip\); unpack it"),
    "zip": (b"PK\x03\x04" + bytes(100), r"packed \(zip\)"),
}


@pytest.mark.parametrize("case", STRANGE)
def test_a_file_of_no_kind_is_one_sentence(tmp_path, case):
    data, words = STRANGE[case]
    path = tmp_path / "walk.c3d"
    path.write_bytes(data)
    with pytest.raises(ReadError, match=words) as error:
        capture.read_capture(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("end", [b"\r", b"\n", b"\r\n"])
@pytest.mark.parametrize("kind", [kind for kind in WHOLE if kind not in ("C3D", "TRC in UTF-16")])
def test_lines_may_end_in_any_way(tmp_path, kind, end):
    path = tmp_path / "walk"
    path.write_bytes(WHOLE[kind].replace(b"\r\n", b"\n").replace(b"\n", end))
    assert capture.read_capture(path).markers.shape == (4, 3, 3)


def test_no_such_file_and_a_folder(tmp_path):
    with pytest.raises(ReadError, match=r"none\.c3d: there is no such file"):
        capture.read_capture(tmp_path / "none.c3d")
    with pytest.raises(ReadError, match="is a folder"):
        capture.read_capture(tmp_path)


def test_content_tells_and_not_the_suffix(tmp_path):
    path = tmp_path / "walk.trc"
    path.write_bytes(c3d_bytes(STANDING, LABELS))
    assert capture.read_capture(path).labels == LABELS


@pytest.mark.parametrize("name", WHOLE)
def test_each_kind_is_recognised_by_itself_alone(name, tmp_path):
    head = capture.extract_head(WHOLE[name])
    kinds = [kind.name for kind in capture.FILE_FORMATS if kind.matches(head)]
    assert len(kinds) == 1
    assert name.startswith(kinds[0])
    (tmp_path / "take").write_bytes(WHOLE[name])
    assert set(capture.read_capture(tmp_path / "take").labels) == set(LABELS)


def test_no_kind_recognises_nothing():
    assert not any(kind.matches(b"") for kind in capture.FILE_FORMATS)


@pytest.mark.parametrize("name", [name for name in WHOLE if name != "C3D"])
@given(data=st.data())
def test_a_damaged_text_gives_a_take_or_a_read_error_and_nothing_else(tmp_path_factory, name, data):
    whole = bytearray(WHOLE[name])
    path = tmp_path_factory.mktemp("damaged") / "take"
    for _ in range(data.draw(st.integers(0, 3), "changes")):
        whole[data.draw(st.integers(0, len(whole) - 1), "place")] = data.draw(st.integers(0, 255), "byte")
    path.write_bytes(whole[: data.draw(st.integers(0, len(whole)), "kept")])
    try:
        take = capture.read_capture(path)
    except ReadError:
        return
    assert take.markers.shape == (take.frame_count, len(take.labels), 3)


@pytest.mark.parametrize("name", [name for name in WHOLE if name not in ("C3D", "TRC in UTF-16", "Motive CSV 1.1", "plain CSV")])
@given(kept=st.integers(0, 100))
def test_a_text_that_is_cut_off_within_its_last_lines_numbers_is_not_taken_for_whole(tmp_path_factory, name, kept):
    whole = WHOLE[name].rstrip(b"\r\n\0")
    last = len(whole) - len(whole.splitlines()[-1])
    path = tmp_path_factory.mktemp("cut") / "take"
    path.write_bytes(whole[: last + 1 + kept * (len(whole) - last - 30) // 100])
    with pytest.raises(ReadError, match="is cut off"):
        capture.read_capture(path)


COUNTS = {  # frames, markers, rate, first frame, missing samples; by each file's header and by hand
    "trc/Anto.trc": (128, 34, 100, 1, 0),
    "trc/Gait.trc": (487, 33, 100, 1, 7306),  # 33 of the 66 have names
    "trc/ballet_reduced.trc": (100, 41, 30, 1, 0),
    "trc/crlf.trc": (10, 41, 60, 1, 0),
    "trc/dataWithBlanksForMissingMarkers.trc": (464, 40, 250, 1, 15005),
    "trc/pyomeca_markers.trc": (93, 51, 100, 1, 0),  # of 652 frames that its header promises
    "trc/subject02_running.trc": (600, 41, 60, 1, 600),  # one marker is 0 0 0 throughout
    "trc/walk_free_01.trc": (73, 41, 60, 185, 0),  # of 900
    "csv/Sample_Static.csv": (275, 35, 100, 1, 0),
    "csv/vicon_markers.csv": (580, 51, 100, 1, 305),
    "csv/optitrack_v1.1.csv": (548, 5, 120, 0, 628),
    "tsv/qualisys_Measurement1.tsv": (2000, 15, 100, 1, 0),
}


@with_captures
@pytest.mark.parametrize("name", COUNTS)
def test_captures_have_what_their_headers_say(name):
    take = capture.read_capture(CAPTURES / name)
    missing = int((~take.visible).sum())
    assert (take.frame_count, len(take.labels), take.rate, take.first_frame, missing) == COUNTS[name]
    # What a laboratory captures lies above its floor and within a few metres.
    assert -0.1 < np.nanmin(np.nanpercentile(take.markers[..., 1], 5)) < np.nanpercentile(take.markers[..., 1], 95) < 2.5


@with_captures
def test_a_trial_is_the_same_from_its_csv_and_its_c3d():
    csv, c3d = capture.read_capture(CAPTURES / "csv" / "vicon_markers.csv"), capture.read_capture(CAPTURES / "c3d" / "Vicon.c3d")
    assert csv.bare_labels == c3d.bare_labels
    np.testing.assert_array_equal(csv.visible, c3d.visible)
    np.testing.assert_allclose(csv.markers, c3d.markers, atol=1e-5)  # the CSV has six digits


@with_captures
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("trc/Truncated.trc", "line 3: the file ends before its markers are named"),
        ("csv/Movement_trial.csv", "holds model outputs and no trajectories"),
        ("csv/accad_quickwalk_TXT.zip", r"packed \(zip\)"),
    ],
)
def test_captures_that_hold_no_take_say_so(name, words):
    with pytest.raises(ReadError, match=words):
        capture.read_capture(CAPTURES / name)


def test_an_animation_is_told_by_what_it_holds_and_is_a_take_of_its_joints(tmp_path):
    (tmp_path / "walk.txt").write_text("\ufeff\n" + TEXT)
    take = capture.read_capture(tmp_path / "walk.txt")
    assert take.labels == ("Hips", "Left Knee", "Ns:Foot", "Chest", "Head")
    np.testing.assert_allclose(take.markers[0, 0], [0.105, 0.9, -0.0325])
    turned = capture.read_capture(tmp_path / "walk.txt", up_axis="Z")
    np.testing.assert_allclose(turned.markers[0, 0], [0.9, -0.0325, 0.105])
    np.testing.assert_allclose(joint_points.get_animation(turned).compute_world_poses()[0], turned.markers)


def test_an_amc_is_told_with_and_without_its_keywords(tmp_path):
    (tmp_path / "09.asf").write_text(ASF)
    for text in (AMC, FRAMES, f"# somebody's\n{FRAMES}"):
        (tmp_path / "09_01.dat").write_text(text)
        take = capture.read_capture(tmp_path / "09_01.dat")
        assert (take.labels[0], take.first_frame, take.frame_count) == ("root", 7, 2)


def test_a_skeleton_alone_is_no_take(tmp_path):
    (tmp_path / "09.asf").write_text(ASF)
    with pytest.raises(ReadError, match=r"09\.asf: is a skeleton without motion; name the AMC"):
        capture.read_capture(tmp_path / "09.asf")
