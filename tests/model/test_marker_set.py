"""Reading labels, and matching them with a marker set."""

import numpy as np
import pytest

from mocapfix.model.marker_set import fold_label, iterate_label_readings
from mocapfix.subject.library import load_marker_set, load_shipped_marker_sets

CMU = load_marker_set("cmu41")
EACH = pytest.mark.parametrize("marker_set", load_shipped_marker_sets(), ids=lambda each: each.name)


@pytest.mark.parametrize("name", ["R.Thigh.Upper", "R_Thigh_Upper", "r thigh upper", "RThighUpper", "R-Thigh.upper "])
def test_case_and_separators_are_ignored(name):
    assert fold_label(name) == "RTHIGHUPPER"


@pytest.mark.parametrize(
    ("label", "readings"),
    [
        ("LFHD", [("", "LFHD")]),
        ("Jim:LFHD", [("Jim:", "LFHD")]),
        ("A:B:LFHD", [("A:B:", "LFHD")]),
        ("Q_LThigh", [("", "QLTHIGH"), ("Q_", "LTHIGH")]),
        ("Skeleton_2_LThigh", [("", "SKELETON2LTHIGH"), ("Skeleton_", "2LTHIGH"), ("Skeleton_2_", "LTHIGH")]),
        ("Skeleton 001:LThigh", [("Skeleton 001:", "LTHIGH")]),
        ("LFHD_", [("", "LFHD")]),
    ],
)
def test_readings_of_a_label(label, readings):
    assert list(iterate_label_readings(label)) == readings


@EACH
@pytest.mark.parametrize("seed", range(5))
def test_labels_match_in_any_order_case_and_alias(marker_set, seed):
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(marker_set.labels)).tolist()
    names = [str(rng.choice([marker_set.labels[k], *marker_set.aliases[k]])) for k in order]
    labels = [f"Jim:{rng.choice([name, name.lower(), '_'.join(name)])} " for name in names]
    assert marker_set.match_labels(labels) == {marker_set.labels[k]: index for index, k in enumerate(order)}


def test_own_name_and_first_label_take_precedence():
    assert CMU.match_labels(("LTIB", "LSHN", "LFHD", "lfhd")) == {"LSHN": 1, "LFHD": 2}


def test_subject_with_the_most_markers_is_used():
    labels = ("Prop:LFHD", "Prop:Handle", "Ann:C7", "Ann:LFHD", "LFWT")
    assert CMU.match_labels(labels) == {"C7": 2, "LFHD": 3}
    assert CMU.match_labels(()) == {}


@pytest.mark.parametrize("prefix", ["Jim:", "Q_", "Skeleton_2_", "Skeleton 001:", "Skeleton 001:Q_"])
def test_subject_prefixes(prefix):
    labels = ["Bat_Knob", *(prefix + label for label in CMU.labels), f"{prefix}Glove", "Other:LFHD"]
    assert CMU.match_labels(labels) == {label: k + 1 for k, label in enumerate(CMU.labels)}
