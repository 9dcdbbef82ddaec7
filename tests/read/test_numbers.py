import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.read.token_scanner import scan_tokens

SPELLINGS = ("{!r}", "{:.6f}", "{:.3e}", "{:.17E}", "{:g}", "{:+.2f}", "{:.20f}")


@given(st.lists(st.tuples(st.floats(allow_nan=False, allow_infinity=False), st.sampled_from(SPELLINGS)), min_size=1, max_size=60))
def test_numbers_are_what_python_reads(told):
    spelled = [form.format(value) for value, form in told]
    found = scan_tokens("  ".join(spelled).encode())
    expected = np.array([float(word) for word in spelled])
    assert found.is_number.all()
    np.testing.assert_array_equal(found.values, expected)
    assert [math.copysign(1, x) for x in found.values] == [math.copysign(1, x) for x in expected]


def test_words_know_their_line_and_their_byte():
    data = b"MOTION here\n1 2\r\n\t3.5\r\r4\n\nlast"
    found = scan_tokens(data, data.index(b"here"))
    assert found.line_numbers.tolist() == [1, 2, 2, 3, 5, 7]
    assert [found.get_text(i) for i in range(len(found))] == ["here", "1", "2", "3.5", "4", "last"]
    assert [data[start : start + 1] for start in found.start_bytes] == [b"h", b"1", b"2", b"3", b"4", b"l"]
    assert found.is_number.tolist() == [False, True, True, True, True, False]
    assert scan_tokens(data, data.index(b"1 2")).line_numbers.tolist() == [2, 2, 3, 5, 7]


def test_what_programs_write_for_no_number_is_nan():
    found = scan_tokens(b"nan NaN -nan(ind) -1.#IND 1.#QNAN inf -Infinity 1.#INF")
    assert found.is_number.all()
    assert np.isnan(found.values).all()


def test_other_words_are_no_numbers():
    found = scan_tokens(b"abc 1e 1-2 - + . 1,5 info 1_000 e5 0x10 1.2.3 --1")
    assert not found.is_number.any()


def test_an_empty_text_has_no_words():
    assert len(scan_tokens(b"")) == len(scan_tokens(b" \n ")) == 0
