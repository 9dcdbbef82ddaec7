import math
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.errors import ReadError
from mocapfix.io.file_content import decode_text, detect_delimiter, parse_document, read_file_bytes, scan_tokens

PATH = Path("walk.trc")


@given(data=st.binary() | st.text().map(str.encode))
def test_encoded_lines_are_the_bytes_of_the_file(data):
    try:
        document = parse_document(PATH, data)
    except ReadError:
        assert decode_text(data)[1][:6] in ("utf-16", "utf-32")  # only these can be invalid
        return
    assert document.newline.join(document.lines).encode(document.encoding) == data


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-32", "latin-1"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_lines_have_neither_byte_order_marks_nor_ends(encoding, end):
    document = parse_document(PATH, f"Tête{end}Fuß{end}".encode(encoding))
    assert [document.get_line(index) for index in range(3)] == ["Tête", "Fuß", ""]


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be"])
def test_utf_16_is_recognised_without_a_byte_order_mark(encoding):
    assert decode_text("Time,LFHD_X,Ü".ljust(40).encode(encoding))[1] != encoding  # 13 characters, then not ASCII
    assert decode_text("Time,LFHD_X,LFHD_Y,LFHD_Z,Ü\n".encode(encoding)) == ("Time,LFHD_X,LFHD_Y,LFHD_Z,Ü\n", encoding)
    assert decode_text(bytes([2, 80, *[0] * 60]))[1] == "utf-8"  # a C3D


def test_cells_may_be_quoted():
    document = parse_document(PATH, b'Take Name,"Walk, first", 3 \n1,2\n')
    assert document.split_cells(0, ",") == ["Take Name", "Walk, first", "3"]
    assert document.split_cells(1, ",") == ["1", "2"]


@pytest.mark.parametrize(("line", "delimiter"), [("a\tb,c\td", "\t"), ("1,5;2,5;3;;", ";"), ("a,b", ","), ("a b", ""), ("", "")])
def test_the_delimiter_is_detected(line, delimiter):
    assert detect_delimiter(line) == delimiter


def test_name_that_is_not_utf8_is_refused_in_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(ReadError, match=r"caf\\udce9\.c3d: its name or folder is not valid UTF-8; rename it\."):
        read_file_bytes(tmp_path / os.fsdecode(b"caf\xe9.c3d"))


SPELLINGS = ("{!r}", "{:.6f}", "{:.3e}", "{:.17E}", "{:g}", "{:+.2f}", "{:.20f}")


@given(st.lists(st.tuples(st.floats(allow_nan=False, allow_infinity=False), st.sampled_from(SPELLINGS)), min_size=1, max_size=60))
def test_numbers_are_parsed_as_python_does(values):
    spelled = [spelling.format(value) for value, spelling in values]
    tokens = scan_tokens("  ".join(spelled).encode())
    expected = np.array([float(word) for word in spelled])
    assert tokens.is_number.all()
    np.testing.assert_array_equal(tokens.values, expected)
    assert [math.copysign(1, x) for x in tokens.values] == [math.copysign(1, x) for x in expected]


def test_tokens_have_their_line_and_byte():
    data = b"MOTION here\n1 2\r\n\t3.5\r\r4\n\nlast"
    tokens = scan_tokens(data, data.index(b"here"))
    assert tokens.line_numbers.tolist() == [1, 2, 2, 3, 5, 7]
    assert [tokens.get_text(i) for i in range(len(tokens))] == ["here", "1", "2", "3.5", "4", "last"]
    assert [data[start : start + 1] for start in tokens.start_bytes] == [b"h", b"1", b"2", b"3", b"4", b"l"]
    assert tokens.is_number.tolist() == [False, True, True, True, True, False]
    assert scan_tokens(data, data.index(b"1 2")).line_numbers.tolist() == [2, 2, 3, 5, 7]


def test_spellings_of_not_a_number_are_nan():
    tokens = scan_tokens(b"nan NaN -nan(ind) -1.#IND 1.#QNAN inf -Infinity 1.#INF")
    assert tokens.is_number.all()
    assert np.isnan(tokens.values).all()


def test_other_words_are_not_numbers():
    tokens = scan_tokens(b"abc 1e 1-2 - + . 1,5 info 1_000 e5 0x10 1.2.3 --1")
    assert not tokens.is_number.any()


def test_an_empty_text_has_no_tokens():
    assert len(scan_tokens(b"")) == len(scan_tokens(b" \n ")) == 0
