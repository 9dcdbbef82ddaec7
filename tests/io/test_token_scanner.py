import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.io.file_content import scan_tokens

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
