from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mocapfix.errors import WriteError
from mocapfix.io import capture
from mocapfix.io.patches import patch_table
from mocapfix.labels.fragments import relabel_samples
from mocapfix.model.faults import Fragment
from mocapfix.model.take import TableLayout, Take
from mocapfix.options import ReadOptions
from tests.captures import CAPTURES
from tests.text_files import LABELS, STANDING, motive, motive_rows, nexus, qualisys, trc

TABLES = sorted(
    path
    for path in [*CAPTURES.glob("trc/*.trc"), *CAPTURES.glob("csv/*.csv"), *CAPTURES.glob("tsv/*.tsv")]
    if path.name not in ("Truncated.trc", "Movement_trial.csv", "optitrack_v1.1.csv")
)
WITH_GAPS = STANDING.copy()
WITH_GAPS[1, 2] = WITH_GAPS[2, 0] = np.nan
FILES = {  # text, missing text, fields before the first X, delimiter
    "TRC": (trc(WITH_GAPS), "", 2, "\t"),
    "TRC, nan": (trc(WITH_GAPS, missing="NaN"), "NaN", 2, "\t"),
    "TRC, zeros": (trc(WITH_GAPS, missing="0.00000"), "0.00000", 2, "\t"),
    "TRC, nines": (trc(WITH_GAPS, missing="9999999.0"), "9999999.0", 2, "\t"),
    "TRC, quoted": (trc(WITH_GAPS).replace("1700.000", '"1700.000"'), "", 2, "\t"),
    "TRC, decimal commas": (trc(WITH_GAPS).replace(".", ","), "", 2, "\t"),
    "Motive CSV": (motive(WITH_GAPS[..., [1, 2, 0]] / 1000), "", 10, ","),
    "Nexus CSV": (nexus(WITH_GAPS, after="\nDevices\n1000\n"), "", 2, ","),
    "Qualisys TSV": (qualisys(WITH_GAPS), "0.000", 2, "\t"),
}


def write_and_read(folder: Path, text: str, encoding: str = "utf-8") -> Take:
    path = folder / "before.txt"
    path.write_bytes(text.encode(encoding))
    return capture.read_take(path)


def convert_to_file_axes(take: Take) -> np.ndarray:
    """Return the markers (m) in file axes, because the up axis is estimated again when a copy is read."""
    assert isinstance(take.layout, TableLayout)
    return take.markers @ take.layout.rotation_y_up_file


def find_differing_fields(one: bytes, other: bytes, delimiter: str, encoding: str = "utf-8") -> set[tuple[int, int]]:
    """Return line and field of each difference between files with the same lines and fields."""
    a, b = (data.decode(encoding).split("\n") for data in (one, other))
    pairs = [(x.split(delimiter), y.split(delimiter)) for x, y in zip(a, b, strict=True)]
    return {(i, j) for i, (x, y) in enumerate(pairs) for j, cells in enumerate(zip(x, y, strict=True)) if cells[0] != cells[1]}


@pytest.mark.parametrize("name", FILES)
@settings(max_examples=12)
@given(
    values=arrays(float, (4, 3, 3), elements=st.floats(-3, 3)),
    edits=arrays(np.int8, (4, 3), elements=st.integers(0, 2)),
)
def test_only_fields_of_changed_samples_differ_and_they_read_back(tmp_path_factory, name, values, edits):
    text, missing, lead, delimiter = FILES[name]
    folder = tmp_path_factory.mktemp("patch")
    before = write_and_read(folder, text)
    assert isinstance(before.layout, TableLayout)
    assert before.layout.missing_text == missing.replace(".", before.layout.decimal_sign)
    step = 10.0 ** -int(before.layout.number_format[1:-1]) * before.layout.unit_m
    assume(not np.isclose(np.abs(values), step / 2, rtol=1e-6, atol=0).any())  # rounds up or down
    markers = np.where((edits == 1)[..., None], values, before.markers)
    markers[edits == 2] = np.nan
    lost = patch_table(folder / "after.txt", before, before.replace_markers(markers))

    old, new = ((folder / each).read_bytes() for each in ("before.txt", "after.txt"))
    first = int(before.layout.line_indices[0])
    allowed = {(first + t, lead + 3 * m + axis) for t, m in np.argwhere(edits > 0) for axis in range(3)}
    assert find_differing_fields(old, new, delimiter) <= allowed
    copy = capture.read_take(folder / "after.txt")
    was, wanted, became = (convert_to_file_axes(take) for take in (before, before.replace_markers(markers), copy))
    np.testing.assert_array_equal(became[edits == 0], was[edits == 0])
    is_zero = np.abs(markers).max(-1) <= step / 2  # rounds to all zeros, which read as missing
    assert lost == [(t, m) for t, m in np.argwhere((edits == 1) & is_zero).tolist()]
    filled = (edits == 1) & ~is_zero
    np.testing.assert_allclose(became[filled], wanted[filled], atol=0.501 * step)
    assert not copy.visible[edits == 2].any()


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-be", "latin-1"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_encoding_and_line_ends_are_kept(tmp_path, encoding, end):
    text = ("\ufeff" if encoding == "utf-16-be" else "") + trc(labels=("Tête", "LANK", "LFIN"), end=end)
    before = write_and_read(tmp_path, text, encoding)
    markers = before.markers.copy()
    markers[2, 1] += 0.001
    patch_table(tmp_path / "same.txt", before, before)
    patch_table(tmp_path / "after.txt", before, before.replace_markers(markers))
    assert (tmp_path / "same.txt").read_bytes() == (tmp_path / "before.txt").read_bytes()
    old, new = ((tmp_path / each).read_bytes().decode(encoding) for each in ("before.txt", "after.txt"))
    assert new == old.replace("2.500\t32.000\t82.000", "3.500\t33.000\t83.000")


def test_short_lines_are_extended_for_filled_samples(tmp_path):
    lines = trc().split("\r\n")
    lines[7] = "\t".join(lines[7].split("\t")[:5])
    before = write_and_read(tmp_path, "\r\n".join(lines))
    markers = before.markers.copy()
    markers[1, 2] = (0.0215, 1.001, 0.401)
    patch_table(tmp_path / "after.txt", before, before.replace_markers(markers))
    after = (tmp_path / "after.txt").read_bytes().decode().split("\r\n")
    assert after[7] == lines[7] + "\t\t\t\t401.000\t21.500\t1001.000"
    assert after[:7] + after[8:] == lines[:7] + lines[8:]


def test_exchanged_samples_keep_their_text(tmp_path):
    text = trc().replace("1701.000", "1.7010E+03").replace("81.000", "81")
    before = write_and_read(tmp_path, text)
    patch_table(tmp_path / "after.txt", before, before.exchange_labels((0, 1), 1, 1))
    old, new = ((tmp_path / each).read_bytes().decode().split("\r\n") for each in ("before.txt", "after.txt"))
    cells = old[7].split("\t")
    assert new[7].split("\t") == cells[:2] + cells[5:8] + cells[2:5] + cells[8:]
    assert new[:7] + new[8:] == old[:7] + old[8:]


def test_an_unlabelled_fragment_is_moved_to_its_marker(tmp_path):
    xyz = np.concatenate([STANDING, STANDING[:, :1] * np.nan], axis=1)
    xyz[2, 3], xyz[2, 0] = xyz[2, 0], np.nan
    before = write_and_read(tmp_path, trc(xyz, [*LABELS, "*7"]))
    piece = Fragment("fragment", 0, 2, 2, 0.0, "", donor=3, relation="continues")
    assert patch_table(tmp_path / "after.txt", before, relabel_samples(before, [piece])) == []
    copy = capture.read_take(tmp_path / "after.txt")
    np.testing.assert_allclose(copy.markers, STANDING[..., [1, 2, 0]] / 1000, atol=1e-12)
    assert copy.unlabelled is None


def test_refused_copies_leave_no_files(tmp_path):
    before = write_and_read(tmp_path, trc())
    with pytest.raises(WriteError, match="is the input itself"):
        patch_table(tmp_path / "before.txt", before, before)
    with pytest.raises(WriteError, match="does not have a field for every sample"):
        patch_table(tmp_path / "after.txt", replace(before, layout=None), before)
    (tmp_path / "before.txt").write_text("gone\n", encoding="utf-8")
    with pytest.raises(WriteError, match="has become shorter"):
        patch_table(tmp_path / "after.txt", before, before)
    (tmp_path / "before.txt").unlink()
    with pytest.raises(WriteError, match="can no longer be read"):
        patch_table(tmp_path / "after.txt", before, before)
    assert not list(tmp_path.iterdir())
    rows = write_and_read(tmp_path, motive_rows(WITH_GAPS / 1000, LABELS))
    with pytest.raises(WriteError, match="does not have a field for every sample"):
        patch_table(tmp_path / "after.txt", rows, rows)


@pytest.mark.skipif(not TABLES, reason="no captures beside the repository")
@pytest.mark.parametrize("path", TABLES, ids=lambda path: path.name)
def test_captures_differ_only_in_changed_samples(path, tmp_path):
    before = capture.read_take(path)
    patch_table(tmp_path / "same", before, before)
    assert (tmp_path / "same").read_bytes() == path.read_bytes()
    markers, rng = before.markers.copy(), np.random.default_rng(0)
    changed = rng.random(before.visible.shape) < 0.02
    markers[changed] = rng.normal(size=(changed.sum(), 3))
    patch_table(tmp_path / "after", before, before.replace_markers(markers))
    copy = capture.read_take(tmp_path / "after", ReadOptions(accept_contradictions=True))  # bodies with samples moved by metres
    assert copy.markers[~changed].tobytes() == before.markers[~changed].tobytes()
    np.testing.assert_allclose(copy.markers[changed], markers[changed], atol=1e-6)
