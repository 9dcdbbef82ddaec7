"""Marker set files: reading, errors in them, and writing."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.errors import SceneError, WriteError
from mocapfix.marker_sets import load_marker_set, load_shipped_marker_sets, write_marker_set
from mocapfix.skeleton import load_cmu31_body


def test_unknown_name_lists_the_shipped_sets():
    with pytest.raises(SceneError, match=r"baseline41.*cmu41, frontwaist53, helen-hayes, .*YAML"):
        load_marker_set("baseline41")


def test_set_is_found_by_its_other_name():
    assert load_marker_set("hdm05") is load_marker_set("cmu41")
    names = [name for each in load_shipped_marker_sets() for name in (each.name, *each.other_names)]
    assert len(set(names)) == len(names)


GOOD = """
name: mine
title: Mine
skeleton: cmu31
markers:
  TOP: {joint: Head, offset: [0, 0.2, 0], spread: 0.01, aliases: [CROWN], optional: true}
  HIP: {joint: Hips, offset: [0.1, 0, 0.1], spread: 0.02}
"""


def test_file_of_a_studio(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(GOOD)
    marker_set = load_marker_set(path)
    assert (marker_set.name, marker_set.labels, marker_set.aliases) == ("mine", ("TOP", "HIP"), (("CROWN",), ()))
    assert (marker_set.optional_labels, marker_set.required_labels) == ({"TOP"}, ("HIP",))
    assert [load_cmu31_body().skeleton.names[j] for j in marker_set.joints] == ["Head", "Hips"]
    np.testing.assert_array_equal(marker_set.marker_offsets, [[0, 0.2, 0], [0.1, 0, 0.1]])
    np.testing.assert_array_equal(marker_set.marker_spread, [0.01, 0.02])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("joint: Head", "joint: Skull", r"markers\.TOP\.joint: there is no joint 'Skull'; the joints are Hips, "),
        ("[0, 0.2, 0]", "[0, 0.2]", r"markers\.TOP\.offset\.2: "),
        ("[0, 0.2, 0]", "[0, .nan, 0]", r"markers\.TOP\.offset\.1: "),
        ("spread: 0.02", "spread: 0", r"markers\.HIP\.spread: .*greater than 0"),
        ("skeleton: cmu31", "skeleton: smpl", "skeleton: .*'cmu31'"),
        ("title: Mine", "tilte: Mine", "title: "),
        ("title: Mine", "title: Mine\ncolour: red", "colour: "),
        ("[CROWN]", "[hip]", "markers: HIP names more than one marker"),
        ("[CROWN]", "[T.O.P]", "markers: TOP names more than one marker"),
        ("TOP:", "'._':", r"markers: \._ has neither letters nor digits"),
        ("optional: true", "optional: perhaps", r"markers\.TOP\.optional: "),
        ("name: mine", "name: [", "line "),
        (GOOD, "just text", "no key: value pairs"),
    ],
)
def test_error_names_the_wrong_key(tmp_path, old, new, message):
    path = tmp_path / "mine.yaml"
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(SceneError, match=rf"mine\.yaml.*{message}"):
        load_marker_set(path)


@pytest.mark.parametrize("marker_set", load_shipped_marker_sets(), ids=lambda each: each.name)
def test_written_set_is_read_back(marker_set, tmp_path):
    write_marker_set(tmp_path / "mine.yaml", marker_set, "Two lines\n\nof comment.")
    assert (tmp_path / "mine.yaml").read_text().startswith("# Two lines\n#\n# of comment.\nname: ")
    back = load_marker_set(tmp_path / "mine.yaml")
    assert all(
        getattr(back, name) == getattr(marker_set, name) for name in ("name", "title", "labels", "aliases", "optional_labels")
    )
    for name in ("joints", "marker_offsets", "marker_spread"):
        np.testing.assert_array_equal(getattr(back, name), getattr(marker_set, name))


LABELS = st.text(st.characters(codec="utf-8", categories=("L", "N", "P", "S", "Zs")), min_size=1)


@given(labels=st.lists(LABELS, min_size=1, max_size=5))
def test_any_labels_can_be_written(tmp_path_factory, labels):
    names = {f"{label}{k}x": label for k, label in enumerate(labels)}
    count, path = len(names), tmp_path_factory.mktemp("set") / "mine.yaml"
    marker_set = replace(
        load_marker_set("cmu41"), labels=tuple(names), joints=np.zeros(count, int), marker_offsets=np.ones((count, 3)),
        marker_spread=np.ones(count), aliases=((),) * count,
    )  # fmt: skip
    try:
        write_marker_set(path, marker_set)
        assert load_marker_set(path).labels == marker_set.labels
    except SceneError as error:
        assert "names more than one marker" in str(error)  # noqa: PT017


def test_missing_folder_is_an_error(tmp_path):
    with pytest.raises(WriteError, match=r"mine\.yaml: cannot be written"):
        write_marker_set(tmp_path / "nowhere" / "mine.yaml", load_marker_set("cmu41"))
