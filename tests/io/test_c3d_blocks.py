"""Words of header and parameters that contradict one another or the size of the data."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.errors import ReadError
from mocapfix.io.capture import read_capture_bytes, read_take
from mocapfix.io.force_plates import read_force_plates
from mocapfix.model.take import Take
from tests.c3d_files import ENCODINGS, c3d_bytes, get_layout, replace_word, vax

FRAMES, POINTS, CHANNELS, SAMPLES = 70, 7, 4, 6
LABELS = ("LFHD", "RFHD", "CLAV", "LANK", "RANK", "LFIN", "RFIN")
HEIGHTS = np.array([1700, 1710, 1400, 80, 90, 800, 820])
ANALOG_PARAMETERS = {"ANALOG:USED": CHANNELS, "ANALOG:RATE": 120.0 * SAMPLES}


def compose_points() -> np.ndarray:
    """Return points in mm, Z up, that walk along X with 1 m/s, in whole counts of 0.1."""
    xyz = np.zeros((FRAMES, POINTS, 3))
    seconds = np.arange(FRAMES)[:, None] / 120
    xyz[..., 0] = 1000 * seconds + np.arange(POINTS) * 20
    xyz[..., 1] = np.linspace(-300, 300, POINTS) + 40 * np.sin(6 * seconds + np.arange(POINTS))
    xyz[..., 2] = HEIGHTS + 30 * np.cos(6 * seconds + np.arange(POINTS))
    return np.round(xyz, 1)


def build(encoding=(84, True), is_padded=False, extra=None) -> bytes:
    extra = {**ANALOG_PARAMETERS, "POINT:Y_SCREEN": "+Z", **(extra or {})}
    data = c3d_bytes(compose_points(), LABELS, encoding=encoding, extra=extra, analog=(CHANNELS, SAMPLES))[:-256]
    return data + bytes(-len(data) % 512) if is_padded else data


def read(data: bytes, tmp_path) -> Take:
    take = read_capture_bytes(tmp_path / "take.c3d", data)
    assert isinstance(take, Take)
    return take


def flip_header_scale(data: bytes) -> bytes:
    """Return a C3D whose header has the other sign of the scale: in DEC and Intel floats the last bit in memory differs."""
    scale = {84: struct.pack("<f", 0.1), 85: vax(np.float32(0.1).item()), 86: struct.pack(">f", 0.1)}[data[512 + 3]]
    other = {84: struct.pack("<f", -0.1), 85: vax(np.float32(-0.1).item()), 86: struct.pack(">f", -0.1)}[data[512 + 3]]
    return data[:12] + (other if data[12:16] == scale else scale) + data[16:]


def flip_scales(encoding, is_padded, is_header_flipped) -> bytes:
    data = build(encoding, is_padded, {"POINT:SCALE": 0.1 if encoding[1] else -0.1})
    return flip_header_scale(data) if is_header_flipped else data


BLOCK = 2 + (build().index(struct.pack("<f", compose_points()[0, 0, 1])) - 1024) // 512 + 1
WRONG = {
    "channels in place of analog values": lambda e, p: replace_word(build(e, p), 3, CHANNELS),
    "no analog values": lambda e, p: replace_word(build(e, p), 3, 0),
    "any number of analog values": lambda e, p: replace_word(build(e, p), 3, 1234),
    "no samples in a frame": lambda e, p: replace_word(build(e, p), 10, 0),
    "channels, and no samples in a frame": lambda e, p: replace_word(replace_word(build(e, p), 3, CHANNELS), 10, 0),
    "channels, without parameters of analog": lambda e, p: replace_word(
        build(e, p, {"ANALOG:USED": None, "ANALOG:RATE": None}), 3, CHANNELS
    ),
    "no number of analog values anywhere": lambda e, p: replace_word(
        replace_word(build(e, p, {"ANALOG:USED": None, "ANALOG:RATE": None}), 3, 0), 10, 0
    ),
    "other points in the header": lambda e, p: replace_word(build(e, p), 2, POINTS + 3),
    "no points in the header": lambda e, p: replace_word(build(e, p), 2, 0),
    "more points in POINT:USED": lambda e, p: build(e, p, {"POINT:USED": POINTS + 5}),
    "fewer points in POINT:USED": lambda e, p: build(e, p, {"POINT:USED": POINTS - 1}),
    "scale of the other type": lambda e, p: flip_scales(e, p, False),
    "both scales of the other type": lambda e, p: flip_scales(e, p, True),
    "header's scale of the other type": lambda e, p: flip_header_scale(build(e, p)),
    "other first block in POINT:DATA_START": lambda e, p: build(e, p, {"POINT:DATA_START": BLOCK + 2}),
    "later first block in the header": lambda e, p: replace_word(build(e, p, {"POINT:DATA_START": BLOCK}), 9, BLOCK + 1),
    "earlier first block in the header": lambda e, p: replace_word(build(e, p), 9, BLOCK - 1),
    "no first block": lambda e, p: replace_word(build(e, p), 9, 0),
    "more frames in the header": lambda e, p: replace_word(build(e, p), 5, FRAMES + 10),
    "more frames in POINT:FRAMES": lambda e, p: build(e, p, {"POINT:FRAMES": FRAMES + 10}),
    "channels, and the scale of the other type": lambda e, p: replace_word(flip_scales(e, p, False), 3, CHANNELS),
    "channels, other points, later block": lambda e, p: replace_word(
        replace_word(replace_word(build(e, p, {"POINT:DATA_START": BLOCK}), 3, CHANNELS), 2, POINTS + 3), 9, BLOCK + 1
    ),
}  # fmt: skip


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("is_padded", [False, True], ids=["cut", "padded"])
def test_wrong_words_do_not_change_the_samples(tmp_path, encoding, is_padded):
    right = read(build(encoding, is_padded), tmp_path)
    assert right.notes == ()
    np.testing.assert_allclose(right.markers, compose_points()[..., [1, 2, 0]] / 1000, atol=1e-6)
    for name, make in WRONG.items():
        take = read(make(encoding, is_padded), tmp_path)
        np.testing.assert_array_equal(take.markers, right.markers, err_msg=name)
        assert get_layout(take).analog_word_count == CHANNELS * SAMPLES, name
        has_note = name.startswith(("no samples", "no first", "more frames", "no number", "earlier"))
        assert has_note or len(take.notes) >= 1, name


def test_the_note_names_what_was_wrong(tmp_path):
    take = read(replace_word(build(), 3, CHANNELS), tmp_path)
    assert take.notes == (
        "The header says 4 analog values in a frame; by size and values the file has 24 analog values in a frame.",
    )


def test_force_plates_are_read_where_the_analog_values_are(tmp_path):
    plate = {
        "ANALOG:GEN_SCALE": 1.0,
        "ANALOG:SCALE": 1.0,
        "FORCE_PLATFORM:TYPE": 1,
    }
    data = replace_word(build(extra=plate), 3, CHANNELS)
    layout = get_layout(read(data, tmp_path))
    right = build(extra=plate)
    np.testing.assert_array_equal(layout.view_analog_words(data), get_layout(read(right, tmp_path)).view_analog_words(right))
    assert read_force_plates(data, layout, 100.0) == []


@given(keep=st.integers(3000, len(build()) - 1), words=st.sampled_from([CHANNELS, 0, CHANNELS * SAMPLES]))
def test_files_that_were_cut_off_are_refused_or_end_with_a_frame(tmp_path_factory, keep, words):
    data = replace_word(build(), 3, words)[:keep]
    right = compose_points()[..., [1, 2, 0]] / 1000
    try:
        take = read(data, tmp_path_factory.getbasetemp())
    except ReadError:
        pass
    else:
        markers = [LABELS.index(label) for label in take.labels]  # without those that no frame shows
        np.testing.assert_allclose(take.markers, right[: take.frame_count, markers], atol=1e-6)


def test_contradictions_that_nothing_settles_are_refused(tmp_path):
    xyz = np.random.default_rng(1).normal(0, 500, (40, 6, 3))
    data = c3d_bytes(xyz, LABELS[:6], extra={"POINT:USED": 5}, analog=(0, 0))[:-256]
    with pytest.raises(ReadError, match=r"contradict one another, and none fits.*5 points or 6 points.*export it again"):
        read(data + bytes(-len(data) % 512), tmp_path)


def test_two_readings_that_fit_are_refused(tmp_path):
    still = np.repeat(compose_points()[:1], 4, axis=0)[:, :6]
    data = c3d_bytes(still, LABELS[:4], np.full((4, 6), -1), extra={"POINT:USED": 5}, analog=(0, 0))[:-256]
    with pytest.raises(ReadError, match=r"several readings fit its data \(4 points or 5 points or 6 points\); export it again"):
        read(data + bytes(-len(data) % 512), tmp_path)


@pytest.mark.parametrize(
    ("extra", "rate", "words"),
    [
        ({"POINT:RATE": 60.0}, 120, "POINT:RATE says 60 Hz; the header and the analog rate say 120 Hz"),
        ({"POINT:RATE": 60.0, "ANALOG:RATE": 60.0 * SAMPLES}, 60, "The header says 120 Hz; POINT:RATE, 60 Hz, was used"),
        ({"POINT:RATE": 60.0, "ANALOG:RATE": None}, 60, "The header says 120 Hz"),
    ],
)
def test_two_rates(tmp_path, extra, rate, words):
    take = read(build(extra=extra), tmp_path)
    assert take.rate == rate
    assert words in " ".join(take.notes)


def test_a_file_that_declares_no_frames_is_refused(tmp_path):
    path = tmp_path / "take.c3d"
    data = bytearray(c3d_bytes(np.ones((20, 4, 3)), ("LFHD", "RFHD", "LBHD", "RBHD"), extra={"POINT:FRAMES": 0}))
    data[6:10] = struct.pack("<HH", 1, 0)
    path.write_bytes(data)
    with pytest.raises(ReadError, match="no frames"):
        read_take(path)
