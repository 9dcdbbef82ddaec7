"""A copy that differs where no change accounts for it is not written."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.contacts.contacts import GaitEvent
from mocapfix.errors import WriteError
from mocapfix.io import c3d_events, patches, text_tables
from mocapfix.io.c3d_events import add_c3d_events
from mocapfix.io.capture import read_take
from mocapfix.io.patches import check_c3d_copy, check_table_copy, patch_c3d, patch_table
from mocapfix.model.take import C3dLayout, Take
from mocapfix.options import ReadOptions
from tests.c3d_files import ENCODINGS, c3d_bytes, get_layout

LABELS = ("*1", "LFHD", "LANK", "RANK")
XYZ = np.arange(1, 61, dtype=float).reshape(5, 4, 3) * 13.7
CHANGED = (2, 1)  # frame and marker
LOST = (4, 0)


def prepare(folder: Path, encoding=(84, True)) -> tuple[Take, Take, Path]:
    """Return a take, the take with one sample moved and one removed, and the patched file."""
    path, target = folder / "before.c3d", folder / "after.c3d"
    path.write_bytes(c3d_bytes(XYZ, LABELS, encoding=encoding, extra={"POINT:Y_SCREEN": "+Z"}))
    before = read_take(path)
    markers = before.markers.copy()
    markers[CHANGED] += 0.05
    markers[LOST] = np.nan
    after = before.replace_markers(markers)
    target.unlink(missing_ok=True)
    assert patch_c3d(target, before, after) == []
    return before, after, target


def find_changed_bytes(layout: C3dLayout, take: Take) -> set[int]:
    """Return the bytes of the changed samples, computed by hand."""
    size = 4 * layout.word_size_bytes
    starts = [
        layout.data_start_byte + t * layout.frame_stride_bytes + size * int(take.point_columns[m]) for t, m in (CHANGED, LOST)
    ]
    return {start + k for start in starts for k in range(size)}


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_each_part_of_a_c3d_is_compared(tmp_path, encoding, monkeypatch):
    monkeypatch.setattr(patches, "BLOCK_BYTES", 1)  # so that each frame is a block
    before, after, target = prepare(tmp_path, encoding)
    layout, data = get_layout(before), target.read_bytes()
    check_c3d_copy(target, target, before, after, [])
    sample = 4 * layout.word_size_bytes
    first = layout.data_start_byte + CHANGED[0] * layout.frame_stride_bytes
    places = {
        "header or parameters": 300,
        "analog values": first + sample * layout.point_count + 1,
        "point 4 in frame 3": first + 3 * sample,
        "what follows its data": len(data) - 1,
    }
    for words, place in places.items():
        damaged = bytearray(data)
        damaged[place] ^= 1
        target.write_bytes(damaged)
        with pytest.raises(WriteError, match=rf"{words} would differ .* report"):
            check_c3d_copy(target, target, before, after, [])
    for cut in (data[:-1], data[: first + 3]):
        target.write_bytes(cut)
        with pytest.raises(WriteError):
            check_c3d_copy(target, target, before, after, [])


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_new_positions_are_compared(tmp_path, encoding, monkeypatch):
    monkeypatch.setattr(patches, "BLOCK_BYTES", 1)
    before, after, target = prepare(tmp_path, encoding)
    for frame, marker in (CHANGED, LOST):
        other = after.markers.copy()
        other[frame, marker] = after.markers[3, 2] + 0.003
        with pytest.raises(WriteError, match=f"new position of {before.labels[marker]} in frame {frame + 1}"):
            check_c3d_copy(target, target, before, after.replace_markers(other), [])
    with pytest.raises(WriteError, match="point 3 in frame 3"):
        check_c3d_copy(target, target, before, before, [])


@given(st.data())
def test_any_byte_that_differs_is_found(tmp_path_factory, data):
    before, after, target = prepare(tmp_path_factory.getbasetemp())
    content = bytearray(target.read_bytes())
    place = data.draw(st.integers(0, len(content) - 1))
    content[place] ^= data.draw(st.integers(1, 255))
    target.write_bytes(content)
    if place not in find_changed_bytes(get_layout(before), before):
        with pytest.raises(WriteError):
            check_c3d_copy(target, target, before, after, [])


def test_samples_that_come_from_another_point_are_compared(tmp_path):
    before, _, target = prepare(tmp_path)
    swapped = before.exchange_labels((0, 1), 1, 2)
    target.unlink()
    patch_c3d(target, before, swapped)
    check_c3d_copy(target, target, before, swapped, [])
    content = bytearray(target.read_bytes())
    layout = get_layout(before)
    content[layout.data_start_byte + layout.frame_stride_bytes + 16 * int(before.point_columns[0]) + 1] ^= 1
    target.write_bytes(content)
    with pytest.raises(WriteError, match="new position of LFHD in frame 2"):
        check_c3d_copy(target, target, before, swapped, [])


def test_nothing_is_written_if_a_copy_is_wrong(tmp_path, monkeypatch):
    before, after, target = prepare(tmp_path)
    target.unlink()
    encode = patches.encode_samples
    monkeypatch.setattr(patches, "encode_samples", lambda layout, samples: encode(layout, samples)[:, ::-1])
    with pytest.raises(WriteError, match="nothing was written; please report it"):
        patch_c3d(target, before, after)
    assert [each.name for each in tmp_path.iterdir()] == ["before.c3d"]


def test_added_events_change_nothing_else(tmp_path, monkeypatch):
    before, _, target = prepare(tmp_path)
    data, start = target.read_bytes(), get_layout(before).data_start_byte
    replace_events = c3d_events._replace_events
    events = {"": [GaitEvent("left", "foot strike", 0.5, "markers")]}
    for damage, words in ((lambda head: head.replace(b"LANK", b"LANX"), "POINT:LABELS"), (lambda head: head[:-512], "")):
        monkeypatch.setattr(c3d_events, "_replace_events", lambda *args, damage=damage: damage(replace_events(*args)))
        with pytest.raises(WriteError, match=f"{words}.* would differ"):
            add_c3d_events(target, start, events, 1, 120)
        assert target.read_bytes() == data
    monkeypatch.undo()
    assert add_c3d_events(target, start, events, 1, 120) == 1


def prepare_table(folder: Path, kind: str) -> tuple[Take, Take, Path]:
    path, target = folder / f"before.{kind}", folder / f"after.{kind}"
    take = Take(XYZ[..., [1, 2, 0]] / 1000, ("LFHD", "RFHD", "LANK", "RANK"), 120.0)
    (text_tables.write_trc if kind == "trc" else text_tables.write_csv)(path, take)
    before = read_take(path, ReadOptions(up_axis="Z"))
    markers = before.markers.copy()
    markers[CHANGED] += 0.05
    markers[LOST] = np.nan
    after = before.replace_markers(markers)
    assert patch_table(target, before, after) == []
    return before, after, target


@pytest.mark.parametrize("kind", ["trc", "csv"])
def test_each_cell_of_a_table_is_compared(tmp_path, kind):
    before, after, target = prepare_table(tmp_path, kind)
    check_table_copy(target, target, before, after, [])
    text = target.read_bytes().decode()
    delimiter = "\t" if kind == "trc" else ","
    lines = text.split("\n")
    row = next(k for k, line in enumerate(lines) if line.startswith(f"{1 + CHANGED[0]}{delimiter}"))
    cells = lines[row].split(delimiter)
    damages = {
        "header": text.replace("LFHD", "LFHX"),
        "shifted cells": "\n".join([*lines[:row], delimiter.join([*cells[:2], "", *cells[2:]]), *lines[row + 1 :]]),
        "another sample": text.replace(cells[2], cells[2] + "0"),
        "the changed sample": text.replace(cells[5], cells[6]),
        "a line": "\n".join([*lines[:row], *lines[row + 1 :]]),
        "line ends": text.replace("\r\n", "\n") if "\r" in text else text.replace("\n", "\r\n"),
        "a removed sample": text.replace(f"{delimiter}{delimiter}{delimiter}", f"{delimiter}1{delimiter}1{delimiter}", 1),
    }
    for name, damaged in damages.items():
        assert damaged != text, name
        target.write_bytes(damaged.encode())
        with pytest.raises(WriteError, match="would differ from the input"):
            check_table_copy(target, target, before, after, [])
    target.write_bytes(text.encode())
    moved = after.markers.copy()
    moved[2, 2] += 0.01
    with pytest.raises(WriteError, match="new position of LANK in frame 3"):
        check_table_copy(target, target, before, after.replace_markers(moved), [])


@pytest.mark.parametrize("decimals", [3, 6, 9])
def test_coordinates_with_exponents_are_compared_within_their_last_decimal(tmp_path, decimals):
    rows = [",".join([f"{t / 100:.2f}", *(f"{value:.{decimals}e}" for value in row.ravel())]) for t, row in enumerate(XYZ[:, 1:])]
    names = ["Time (s)", *(f"{label}_{axis}_mm" for label in LABELS[1:] for axis in "XYZ")]
    path, target = tmp_path / "before.csv", tmp_path / "after.csv"
    path.write_text("\n".join([",".join(names), *rows, ""]), encoding="utf-8")
    before = read_take(path, ReadOptions(up_axis="Z"))
    after = before.replace_markers(before.markers + np.pi / 1000)
    assert patch_table(target, before, after) == []
    with pytest.raises(WriteError, match="new position of LFHD in frame 1"):
        check_table_copy(target, target, before, after.replace_markers(after.markers + 1e-5), [])
