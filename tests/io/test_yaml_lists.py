import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from mocapfix.io.yaml_files import InlineSequence, dump_yaml, dump_yaml_list

WORDS = st.sampled_from(
    ["LFHD", "yes", "No", "null", "1e3", "12:30", "a: b", "x #y", "Jim:LFHD", "-", "", "é", "a ", "it's", "="]
)
TEXTS = st.one_of(
    st.text("aB1 :#,;()[]{}'\"-+%&*!|>@`.é\n", max_size=30),
    WORDS,
    st.lists(WORDS, min_size=1, max_size=40).map(" ".join),
)
NUMBERS = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(allow_nan=False), st.sampled_from([0.1, 12.5, 1e-7, 1e17]))
ITEMS = st.fixed_dictionaries(
    {
        "id": TEXTS,
        "markers": st.lists(TEXTS, min_size=1, max_size=3).map(InlineSequence),
        "samples": NUMBERS,
        "why": TEXTS,
        "before": st.fixed_dictionaries({"missing": NUMBERS, "off_body_mm": NUMBERS}),
    }
)


@settings(max_examples=300)
@given(st.lists(ITEMS, max_size=4))
def test_list_has_the_text_that_pyyaml_writes(items):
    assert dump_yaml_list("changes", items, 80) == dump_yaml({"changes": items}, 80)


def test_long_list_is_read_back():
    items = [{"id": f"spike-{n}", "markers": InlineSequence(["LFHD"]), "why": "It jumps 9 mm.", "mm": 0.5} for n in range(2000)]
    assert yaml.safe_load(dump_yaml_list("changes", items))["changes"] == [{**item, "markers": ["LFHD"]} for item in items]
