from dataclasses import replace

import numpy as np
import pytest

from mocapfix.errors import WriteError
from mocapfix.io import asf_amc, bvh
from mocapfix.io.patches import patch_animation
from mocapfix.options import ReadOptions
from tests.asf_files import AMC, ASF
from tests.bvh_files import TEXT
from tests.captures import CAPTURES, needs_captures


@pytest.fixture
def figure(tmp_path):
    (tmp_path / "in.bvh").write_bytes(TEXT.replace("\n", "\r\n").encode())
    return bvh.read_bvh(tmp_path / "in.bvh")


def test_only_changed_numbers_are_replaced(figure, tmp_path):
    values = figure.values.copy()
    values[1, 6], values[2, 15], values[0, 0] = -7.25, 1234.56785001, -0.0
    patch_animation(tmp_path / "out.bvh", figure, values)
    expected = TEXT.replace("16.0000", "-7.2500").replace(" 7.2000", " 1234.5679").replace("10.5000", "-0.0000")
    assert (tmp_path / "out.bvh").read_bytes() == expected.replace("\n", "\r\n").encode()


def test_new_numbers_have_the_most_frequent_decimals(tmp_path):
    text = TEXT.replace("0000 ", "0 ").replace("0000\n", "0\n").replace("10.50 ", "10 ").replace("11.0 ", "1.1e1 ")
    (tmp_path / "in.bvh").write_text(text, encoding="utf-8")
    figure = bvh.read_bvh(tmp_path / "in.bvh")
    values = figure.values.copy()
    values[0, 6] = 1 / 3
    patch_animation(tmp_path / "out.bvh", figure, values)
    assert (tmp_path / "out.bvh").read_text(encoding="utf-8") == text.replace(" 15.0 ", " 0.3 ", 1)


def test_an_unchanged_copy_of_whole_numbers_is_byte_identical(tmp_path):
    (tmp_path / "in.bvh").write_text(TEXT.replace(".0000", "").replace("000", ""), encoding="utf-8")
    figure = bvh.read_bvh(tmp_path / "in.bvh")
    figure = replace(figure, values=np.round(figure.values))
    patch_animation(tmp_path / "out.bvh", figure, figure.values)
    assert (tmp_path / "out.bvh").read_bytes() == (tmp_path / "in.bvh").read_bytes()


def test_missing_numbers_can_be_filled(figure, tmp_path):
    text = TEXT.replace("16.0000", "nan")
    (tmp_path / "in.bvh").write_text(text, encoding="utf-8")
    figure = bvh.read_bvh(tmp_path / "in.bvh")
    patch_animation(tmp_path / "out.bvh", figure, figure.values)
    assert (tmp_path / "out.bvh").read_text(encoding="utf-8") == text
    patch_animation(tmp_path / "out.bvh", figure, np.nan_to_num(figure.values, nan=2.5))
    assert (tmp_path / "out.bvh").read_text(encoding="utf-8") == TEXT.replace("16.0000", "2.5000")


def test_an_amc_in_radians_is_patched_in_radians(tmp_path):
    (tmp_path / "09.asf").write_text(ASF, encoding="utf-8")
    text = AMC.replace(":DEGREES", ":RADIANS").replace("lfoot 7.5 8.5", "lfoot 0.5 0.25")
    (tmp_path / "09_01.amc").write_text(text, encoding="utf-8")
    before = asf_amc.read_amc(tmp_path / "09_01.amc")
    foot = before.get_rotation_channels(before.names.index("lfoot"))[0]
    values = before.values.copy()
    values[1, foot] *= 2
    patch_animation(tmp_path / "out.amc", before, values)
    written = (tmp_path / "out.amc").read_text(encoding="utf-8")
    assert written == text.replace("lfoot 0.5 0.25", "lfoot 1.0 0.5")


@needs_captures
@pytest.mark.parametrize("name", ["cmu/02_01.bvh", "bvh-other/louise.bvh", "bvh-other/02_01_daz-friendly.bvh"])
def test_captures_change_only_where_values_changed(name, tmp_path):
    before = bvh.read_bvh(CAPTURES / name)
    patch_animation(tmp_path / "same.bvh", before, before.values)
    assert (tmp_path / "same.bvh").read_bytes() == (CAPTURES / name).read_bytes()
    values, rng = before.values.copy(), np.random.default_rng(0)
    frames, columns = rng.integers(0, before.frame_count, 500), rng.integers(0, values.shape[1], 500)
    values[frames, columns] += rng.normal(0, 20, 500)
    patch_animation(tmp_path / "changed.bvh", before, values)
    after = bvh.read_bvh(tmp_path / "changed.bvh")
    np.testing.assert_allclose(after.values, values, atol=0.51e-3)
    kept = values == before.values
    np.testing.assert_array_equal(after.values[kept], before.values[kept])


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30])
def test_values_without_a_spelling_are_refused(figure, tmp_path, bad):
    values = figure.values.copy()
    values[1, 6] = bad
    with pytest.raises(WriteError, match="in frame 2 a value of Left Knee is"):
        patch_animation(tmp_path / "out.bvh", figure, values)
    assert [each.name for each in tmp_path.iterdir()] == ["in.bvh"]


def test_the_input_is_never_overwritten_and_must_be_unchanged(figure, tmp_path):
    with pytest.raises(WriteError, match="is the input itself"):
        patch_animation(tmp_path / "in.bvh", figure, figure.values)
    (tmp_path / "in.bvh").write_text("HIERARCHY", encoding="utf-8")
    with pytest.raises(WriteError, match="has become shorter"):
        patch_animation(tmp_path / "out.bvh", figure, figure.values)
    (tmp_path / "in.bvh").unlink()
    with pytest.raises(WriteError, match="can no longer be read"):
        patch_animation(tmp_path / "out.bvh", figure, figure.values)
    with pytest.raises(WriteError, match="there is no source file"):
        patch_animation(tmp_path / "out.bvh", replace(figure, path=None), figure.values)
    with pytest.raises(WriteError, match="there is no file with these numbers"):
        patch_animation(tmp_path / "out.bvh", replace(figure, value_byte_offsets=None), figure.values)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-8-sig"])
@pytest.mark.parametrize("sign", [".", ","])
def test_a_copy_keeps_encoding_and_decimal_sign(tmp_path, encoding, sign):
    text = ("# comment\r\n" + TEXT.replace("Hips", "Hüfte")).replace(".", sign)
    (tmp_path / "in.bvh").write_bytes(text.encode(encoding))
    figure = bvh.read_bvh(tmp_path / "in.bvh")
    values = figure.values.copy()
    patch_animation(tmp_path / "out.bvh", figure, values)
    assert (tmp_path / "out.bvh").read_bytes() == (tmp_path / "in.bvh").read_bytes()
    values[1, 6] = -7.25
    patch_animation(tmp_path / "out.bvh", figure, values)
    assert (tmp_path / "out.bvh").read_bytes() == text.replace(f"16{sign}0000", f"-7{sign}2500").encode(encoding)


@pytest.mark.parametrize(("frame_time", "option"), [("8.3333", None), ("120", None), ("0", 120.0), (".0166667", 120.0)])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_a_wrong_frame_time_is_corrected_in_the_copy(tmp_path, frame_time, option, encoding):
    (tmp_path / "in.bvh").write_bytes(TEXT.replace(".0083333", frame_time).encode(encoding))
    figure = bvh.read_bvh(tmp_path / "in.bvh", options=ReadOptions(rate_hz=option))
    patch_animation(tmp_path / "out.bvh", figure, figure.values)
    assert (tmp_path / "out.bvh").read_bytes().decode(encoding) == TEXT.replace(".0083333", "0.0083333333")
    assert bvh.read_bvh(tmp_path / "out.bvh").notes == ()
