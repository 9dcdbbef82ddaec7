import warnings
from dataclasses import replace
from pathlib import Path

import c3d
import ezc3d
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mocapfix.errors import WriteError
from mocapfix.io import capture
from mocapfix.io.patches import patch_c3d
from mocapfix.labels.fragments import relabel_samples
from mocapfix.model.faults import Fragment
from mocapfix.model.take import C3dLayout, Take
from mocapfix.options import ReadOptions
from tests.c3d_files import ENCODINGS, c3d_bytes
from tests.captures import CAPTURES, needs_captures

UNREADABLE = {"bad_parameter_section.c3d", "empty.c3d"}
# c3d 0.6.0 fails on a parameter that occurs twice, and on two different analog rates.
NOT_BY_C3D = {"PiG_Calibration-FlatFoot-Hole.c3d", "01_01.c3d", "05_13.c3d"}
READABLE = sorted(path for folder in ("c3d", "cmu") for path in (CAPTURES / folder).glob("*.c3d") if path.name not in UNREADABLE)

LABELS = ("*1", "LFHD", "LANK", "RANK")  # the first is not a marker, so that marker and point indices differ
FRAMES, MARKERS = 5, 3
# Whole counts of 0.1 mm; one marker is missing in one frame.
XYZ = np.arange(1, 61, dtype=float).reshape(FRAMES, 4, 3) * 13.7
WORDS = np.where(np.arange(20).reshape(FRAMES, 4) == 10, -1, 0x0102)


def write_and_read(folder: Path, encoding, vertical="+Z") -> Take:
    path = folder / "before.c3d"
    path.write_bytes(c3d_bytes(XYZ, LABELS, WORDS, encoding, extra={"POINT:Y_SCREEN": vertical}))
    return capture.read_take(path)


def find_sample_bytes(take: Take, frame: int, marker: int) -> slice:
    """Return where the four words of a sample are, computed by hand."""
    layout = take.layout
    assert isinstance(layout, C3dLayout)
    size = 16 if layout.is_float else 8
    start = layout.data_start_byte + frame * layout.frame_stride_bytes + size * int(take.point_columns[marker])
    return slice(start, start + size)


def name_unit(take: Take) -> str:
    """Return the unit of the file of a take."""
    assert take.layout is not None
    return {0.001: "mm", 0.01: "cm", 1.0: "m"}[take.layout.unit_m]


def assert_only_changed(before: Take, target: Path, changed: np.ndarray) -> Take:
    """Check that only the bytes of changed samples differ and that all others read back bit for bit; return the copy."""
    assert before.path is not None
    old, new = (np.frombuffer(path.read_bytes(), "u1") for path in (before.path, target))
    allowed = np.zeros(len(old), bool)
    for frame, marker in np.argwhere(changed):
        allowed[find_sample_bytes(before, frame, marker)] = True
    np.testing.assert_array_equal(new[~allowed], old[~allowed])
    assert before.up_axis is not None
    known = ReadOptions(unit=name_unit(before), up_axis=before.up_axis.letter, accept_contradictions=True)
    copy = capture.read_take(target, known)  # the changed samples need not be those of a person
    assert copy.markers[~changed].tobytes() == before.markers[~changed].tobytes()
    return copy


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_an_unchanged_copy_is_byte_identical(tmp_path, encoding):
    before = write_and_read(tmp_path, encoding)
    assert patch_c3d(tmp_path / "after.c3d", before, before.replace_markers(before.markers.copy())) == []
    assert (tmp_path / "after.c3d").read_bytes() == (tmp_path / "before.c3d").read_bytes()


@pytest.mark.parametrize("encoding", ENCODINGS)
@given(
    values=arrays(float, (FRAMES, MARKERS, 3), elements=st.floats(-3, 3).map(lambda metres: round(metres, 9))),
    sample_sd=arrays(float, (FRAMES, MARKERS), elements=st.floats(0, 0.05) | st.just(np.nan)),
    edits=arrays(np.int8, (FRAMES, MARKERS), elements=st.integers(0, 2)),
    vertical=st.sampled_from(["+X", "+Y", "+Z"]),
)
def test_only_changed_samples_differ_and_they_read_back(tmp_path_factory, encoding, values, sample_sd, edits, vertical):
    folder = tmp_path_factory.mktemp("patch")
    before = write_and_read(folder, encoding, vertical)
    assert isinstance(before.layout, C3dLayout)
    markers = np.where((edits == 1)[..., None], values, before.markers)
    markers[edits == 2] = np.nan
    lost = patch_c3d(folder / "after.c3d", before, before.replace_markers(markers, sample_sd))

    copy = assert_only_changed(before, folder / "after.c3d", edits > 0)
    is_zero = np.abs(markers).max(-1) < (0.5e-4 if not encoding[1] else 1e-10)  # rounds to all zeros, which read as missing
    assert lost == [(t, m) for t, m in np.argwhere((edits == 1) & is_zero).tolist()]
    filled = (edits == 1) & ~is_zero
    step = 0.5e-4 if not encoding[1] else 3e-7
    np.testing.assert_allclose(copy.markers[filled], markers[filled], atol=step * 1.001)
    assert not copy.visible[edits == 2].any()


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_words_of_filled_and_removed_samples(tmp_path, encoding):
    before = write_and_read(tmp_path, encoding)
    markers, sample_sd = before.markers.copy(), np.full((FRAMES, MARKERS), np.nan)
    places = [(0, 0), (1, 1), (2, 1), (3, 0), (4, 2)]
    for place in places:
        markers[place] = (0.1, 1.25, -0.3)  # metres, Y up; the file is in mm, Z up: (-300, 100, 1250)
    sample_sd[0, 0], sample_sd[1, 1], sample_sd[2, 1], sample_sd[3, 0] = 0.0021, 1.0, 0.0, 0.00001
    markers[4, 2] = np.nan
    patch_c3d(tmp_path / "after.c3d", before, before.replace_markers(markers, sample_sd))

    data = (tmp_path / "after.c3d").read_bytes()
    xyz = (-300, 100, 1250) if encoding[1] else (-3000, 1000, 12500)
    # 2.1 mm are 21 counts of 0.1 mm. No residual is 0, which means measured, or larger than a byte.
    wanted = [(*xyz, 21), (*xyz, 255), (*xyz, 1), (*xyz, 1), (0, 0, 0, -1)]
    for place, words in zip(places, wanted, strict=True):
        assert data[find_sample_bytes(before, *place)] == encode_words(words, encoding)


def encode_words(words, encoding) -> bytes:
    """Return four words as tests/c3d_files.py stores a sample in a file of one point and one frame."""
    scale = 1.0
    made = c3d_bytes(np.array(words[:3], float).reshape(1, 1, 3), ["A"], np.array([[words[3]]]), encoding, scale)
    return made[-256 - 3 * (4 if encoding[1] else 2) - (16 if encoding[1] else 8) :][: 16 if encoding[1] else 8]


@pytest.mark.parametrize("processor", [84, 85, 86])
def test_values_too_large_for_an_integer_file_are_missing_and_returned(tmp_path, processor):
    before = write_and_read(tmp_path, (processor, False))
    markers = before.markers.copy()
    markers[0, 1] = (0, 3.2768, 0)  # 32,768 counts of 0.1 mm
    markers[1, 1] = (0, 3.2767, 0)
    markers[3, 2] = (0, 0, -50)
    assert patch_c3d(tmp_path / "after.c3d", before, before.replace_markers(markers)) == [(0, 1), (3, 2)]
    copy = capture.read_take(tmp_path / "after.c3d")
    assert not copy.visible[0, 1]
    assert not copy.visible[3, 2]
    np.testing.assert_allclose(copy.markers[1, 1], (0, 3.2767, 0))


def test_the_input_is_never_overwritten(tmp_path):
    before = write_and_read(tmp_path, (84, True))
    original = (tmp_path / "before.c3d").read_bytes()
    (tmp_path / "link.c3d").symlink_to(tmp_path / "before.c3d")
    for target in (tmp_path / "before.c3d", tmp_path / "link.c3d"):
        with pytest.raises(WriteError, match="is the input itself"):
            patch_c3d(target, before, before.replace_markers(before.markers + 1))
    assert (tmp_path / "before.c3d").read_bytes() == original


def test_refused_copies_leave_no_files(tmp_path):
    before = write_and_read(tmp_path, (84, True))
    with pytest.raises(WriteError, match="was not read from a C3D"):
        patch_c3d(tmp_path / "after.c3d", replace(before, layout=None), before)
    with pytest.raises(WriteError, match="there is no source file"):
        patch_c3d(tmp_path / "after.c3d", replace(before, path=None), before)
    with pytest.raises(WriteError, match=r"nowhere.*cannot be written"):
        patch_c3d(tmp_path / "nowhere" / "after.c3d", before, before)
    (tmp_path / "before.c3d").write_bytes((tmp_path / "before.c3d").read_bytes()[:1200])
    with pytest.raises(WriteError, match="has become shorter"):
        patch_c3d(tmp_path / "after.c3d", before, before)
    (tmp_path / "before.c3d").unlink()
    with pytest.raises(WriteError, match="can no longer be read"):
        patch_c3d(tmp_path / "after.c3d", before, before)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(("frames", "points"), [(66_000, 1), (2, 600)])
def test_more_frames_or_labels_than_a_word_or_a_parameter_holds(tmp_path, encoding, frames, points):
    """The last sample of the last marker changes in a file with more frames or labels than the original format allows."""
    if encoding == (85, True) and frames > 65_535:
        pytest.skip("building DEC floats one by one is too slow")
    path, labels = tmp_path / "before.c3d", [f"M{i}" for i in range(points)]
    extra = {"POINT:LONG_FRAMES": float(frames), "POINT:Y_SCREEN": "+Y"}
    path.write_bytes(c3d_bytes(np.full((frames, points, 3), 50.0), labels, encoding=encoding, extra=extra))
    before = capture.read_take(path)
    markers = before.markers.copy()
    markers[-1, -1] = (0.1, 1.25, -0.3)
    assert patch_c3d(tmp_path / "after.c3d", before, before.replace_markers(markers)) == []
    changed = np.zeros((frames, points), bool)
    changed[-1, -1] = True
    copy = assert_only_changed(before, tmp_path / "after.c3d", changed)
    assert (copy.frame_count, copy.labels) == (frames, tuple(labels))
    np.testing.assert_allclose(copy.markers[-1, -1], markers[-1, -1], rtol=1e-6)


def test_a_copy_has_the_markers_of_the_original(tmp_path):
    path = tmp_path / "before.c3d"
    path.write_bytes(c3d_bytes(np.ones((2, 6, 3)), list("ABCDEF")))  # all residual words 0
    before = capture.read_take(path)
    markers = before.markers.copy()
    markers[0, 0] += 0.5
    patch_c3d(tmp_path / "after.c3d", before, before.replace_markers(markers))
    assert capture.read_take(tmp_path / "after.c3d").labels == before.labels


# Relabelled samples


FOUR_LABELS = ("*12", "A", "B", "A-1")  # unlabelled, two markers, and one that continues another one
SAMPLE_WORDS = 0x0103 + np.arange(4 * FRAMES).reshape(FRAMES, 4)  # every sample has another residual word
MISSING_WORDS = (0, 0, 0, -1)


def write_and_read_four(folder: Path, encoding) -> Take:
    """Return a take with B throughout, *12 in frames 0 and 1, A-1 in frames 2 and 3, and A otherwise."""
    visible = np.ones((FRAMES, 4), bool)
    visible[2:, 0] = visible[[0, 1, 4], 3] = visible[:4, 1] = False
    path = folder / "before.c3d"
    path.write_bytes(c3d_bytes(np.where(visible[..., None], XYZ, 0), FOUR_LABELS, np.where(visible, SAMPLE_WORDS, -1), encoding))
    take = capture.read_take(path)
    assert take.unlabelled is not None
    assert (take.labels, take.unlabelled.labels) == (("A", "B", "A-1"), ("*12",))
    return take


def read_sample_bytes(path: Path, take: Take) -> np.ndarray:
    """Return the bytes (T, P, bytes) of each sample in the file."""
    layout = take.layout
    assert isinstance(layout, C3dLayout)
    return layout.view_words(path.read_bytes()).copy().view("u1").reshape(FRAMES, 4, -1)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_exchanged_samples_keep_their_words(tmp_path, encoding):
    before = write_and_read_four(tmp_path, encoding)
    patch_c3d(tmp_path / "after.c3d", before, before.exchange_labels((0, 1), 3, 4))
    old, new = (read_sample_bytes(tmp_path / name, before) for name in ("before.c3d", "after.c3d"))
    wanted = old.copy()
    wanted[4, [1, 2]] = old[4, [2, 1]]
    wanted[3, 1] = old[3, 2]  # A is missing in frame 3
    np.testing.assert_array_equal(new[:, :2], wanted[:, :2])
    np.testing.assert_array_equal(new[[0, 1, 2, 4], 2:], wanted[[0, 1, 2, 4], 2:])
    assert not capture.read_take(tmp_path / "after.c3d").visible[3, 1]
    assert new[3, 2].tobytes() == encode_words(MISSING_WORDS, encoding)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(("donor", "point", "frames"), [(2, 3, slice(2, 4)), (3, 0, slice(0, 2))], ids=["A-1", "*12"])
def test_a_joined_fragment_keeps_its_words_and_its_donor_becomes_missing(tmp_path, encoding, donor, point, frames):
    before = write_and_read_four(tmp_path, encoding)
    fragment = Fragment("fragment", 0, frames.start, frames.stop - 1, 0.0, "", donor=donor, relation="continues")
    joined = relabel_samples(before, [fragment])
    patch_c3d(tmp_path / "after.c3d", before, joined)
    old, new = (read_sample_bytes(tmp_path / name, before) for name in ("before.c3d", "after.c3d"))
    np.testing.assert_array_equal(new[frames, 1], old[frames, point])
    assert {each.tobytes() for each in new[frames, point]} == {encode_words(MISSING_WORDS, encoding)}
    new[frames, [1, point]] = old[frames, [1, point]]
    np.testing.assert_array_equal(new, old)
    again = capture.read_take(tmp_path / "after.c3d")
    np.testing.assert_array_equal(again.markers[:, :2], joined.markers[:, :2])


def test_an_exchanged_and_then_changed_sample_is_an_estimate(tmp_path):
    before = write_and_read_four(tmp_path, (84, True))
    after = before.exchange_labels((0, 1), 4, 4)
    after.markers[4, 0], sample_sd = 0.5, np.full(after.visible.shape, np.nan)
    sample_sd[4, 0] = 0.0021
    patch_c3d(tmp_path / "after.c3d", before, replace(after, sample_sd=sample_sd))
    data = (tmp_path / "after.c3d").read_bytes()
    assert data[find_sample_bytes(before, 4, 0)] == encode_words((500, 500, 500, 21), (84, True))
    assert data[find_sample_bytes(before, 4, 1)] == (tmp_path / "before.c3d").read_bytes()[find_sample_bytes(before, 4, 0)]


def read_with_ezc3d(path: Path) -> np.ndarray:
    """Return the coordinates (T, P, 3) in file units."""
    return ezc3d.c3d(str(path))["data"]["points"][:3].transpose(2, 1, 0)


def read_with_c3d(path: Path) -> np.ndarray:
    """Return the coordinates (T, P, 3) in file units."""
    with warnings.catch_warnings(action="ignore"), path.open("rb") as handle:
        return np.array([points[:, :3] for _, points, _ in c3d.Reader(handle).read_frames()])


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_changed_samples_agree_with_the_c3d_library(tmp_path, encoding):
    before, target = write_and_read(tmp_path, encoding), tmp_path / "after.c3d"
    layout = before.layout
    assert isinstance(layout, C3dLayout)
    markers, sample_sd = before.markers.copy(), np.full((FRAMES, MARKERS), np.nan)
    markers[1, 1], markers[4, 2], sample_sd[1, 1] = (0.1, 1.25, -0.3), np.nan, 0.0021
    assert patch_c3d(target, before, before.replace_markers(markers, sample_sd)) == []
    with warnings.catch_warnings(action="ignore"), target.open("rb") as handle:
        points = np.array([points for _, points, _ in c3d.Reader(handle).read_frames()])
    np.testing.assert_allclose(points[1, 2, :4], (-300, 100, 1250, 2.1), rtol=1e-6)  # mm, Z up, and the residual
    assert points[4, 3, 3] == -1
    was, now = (layout.view_words(path.read_bytes()) for path in (tmp_path / "before.c3d", target))
    np.testing.assert_array_equal(np.argwhere((was != now).any(-1)), [(1, 2), (4, 3)])


@needs_captures
@pytest.mark.parametrize("path", READABLE, ids=lambda path: path.name)
def test_changed_captures_agree_with_other_libraries(tmp_path, path):
    before = capture.read_take(path)
    layout = before.layout
    assert isinstance(layout, C3dLayout)
    target, rng = tmp_path / path.name, np.random.default_rng(7)
    markers, changed = before.markers.copy(), rng.random(before.visible.shape) < 0.005
    markers[changed] = rng.uniform(0.05, 0.8, (changed.sum(), 3))
    assert patch_c3d(target, before, before.replace_markers(markers)) == []
    wanted = (markers @ layout.rotation_y_up_file / layout.unit_m)[changed]
    readers = [read_with_ezc3d] * (layout.processor_type != 86) + [read_with_c3d] * (path.name not in NOT_BY_C3D)
    for reader in readers:
        old, new = (reader(each)[:, before.point_columns] for each in (path, target))
        max_error = 0.501 * layout.scale_factor if not layout.is_float else 1e-4 * 0.001 / layout.unit_m
        np.testing.assert_allclose(new[changed], wanted, atol=max_error)
        np.testing.assert_array_equal(new[~changed], old[~changed])


@needs_captures
@pytest.mark.parametrize("path", READABLE, ids=lambda path: path.name)
def test_captures_keep_all_other_bytes(tmp_path, path):
    before = capture.read_take(path)
    target = tmp_path / path.name
    assert patch_c3d(target, before, before) == []
    assert target.read_bytes() == path.read_bytes()

    assert isinstance(before.layout, C3dLayout)
    rng = np.random.default_rng(7)
    markers, changed = before.markers.copy(), rng.random(before.visible.shape) < 0.01
    new = rng.uniform(0.05, 0.8, (*changed.shape, 3))
    markers[changed] = np.where(rng.random(changed.shape) < 0.7, 1.0, np.nan)[changed, None] * new[changed]
    assert patch_c3d(target, before, before.replace_markers(markers)) == []
    copy = assert_only_changed(before, target, changed)
    step = 1e-7 if before.layout.is_float else 0.5001 * before.layout.scale_factor * before.layout.unit_m
    np.testing.assert_allclose(copy.markers[changed], markers[changed], atol=step)
