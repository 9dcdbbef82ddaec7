"""The review file: it is read back as written, errors are located, and decisions apply to the right faults."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.errors import SceneError
from mocapfix.io.changes_file import (
    CHANGES_FILE_LINE_LENGTH,
    Review,
    ReviewedChange,
    ReviewIndex,
    build_fault_review,
    load_changes,
    read_changes_file,
    write_changes_file,
)
from mocapfix.io.shipped import InlineSequence, dump_yaml, load_yaml
from mocapfix.model.changes import Change, Decision, SampleState, serialize_changes
from mocapfix.model.faults import Fault, Fragment, MarkerShift
from mocapfix.model.take import Take

FIRST_FRAME = 101


def build_take(name="walk.c3d", first_frame=FIRST_FRAME) -> Take:
    unlabelled = Take(np.ones((50, 1, 3)), ("*12",), 100.0)
    labels = ("Jim:LFHD", "C7", "RBAC")
    return Take(np.ones((50, 3, 3)), labels, 100.0, first_frame, Path("folder") / name, unlabelled=unlabelled)


def build_change(kind="spike", markers=("C7",), first=110, last=112, decision: Decision = "reject", **fields) -> Change:
    defaults: dict[str, Any] = {
        "samples": 3,
        "why": "It jumps: \u00e4 \U0001f600.",
        "method": "estimated",
        "before": SampleState(0, 81.3),
        "after": SampleState(0, None),
        "predicted_mm": 1.2,
    }
    return Change(f"{kind}-{markers[0]}-{first}", kind, tuple(markers), first, last, decision=decision, **(defaults | fields))


def write_and_read(folder, *changes):
    path = folder / "walk.changes.yaml"
    write_changes_file(path, build_take(), changes)
    return read_changes_file(path, build_take()).declined


def review_changes(folder, *changes) -> Review:
    return Review(write_and_read(folder, *changes))


def test_declined_changes_have_indices_into_the_take(tmp_path):
    (found,) = write_and_read(tmp_path, build_change(), build_change("gap", ("RBAC",), decision="accept"))
    assert (found.markers, found.first, found.last, found.entry.decision) == ((1,), 9, 11, "reject")
    fragment = build_change("fragment", ("Jim:LFHD", "*12"), FIRST_FRAME, FIRST_FRAME + 49, "keep")
    (found,) = write_and_read(tmp_path, fragment)
    assert (found.markers, found.first, found.last, found.entry.decision) == ((0, 3), 0, 49, "keep")


texts = st.text(st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"]), max_size=60)


@given(
    why=texts,
    method=texts,
    missing=st.integers(0, 9),
    off_body_mm=st.none() | st.floats(0, 1e4),
    decision=st.sampled_from(["reject", "keep"]),
)
def test_any_declined_change_is_read_back_as_written(tmp_path_factory, why, method, missing, off_body_mm, decision):
    change = build_change(why=why, method=method, before=SampleState(missing, off_body_mm), decision=decision)
    (found,) = write_and_read(tmp_path_factory.mktemp("review"), change)
    assert found.to_change() == replace(change, samples=0, after=change.before)  # it is not applied


words = st.from_regex(r"([a-zA-Z0-9_.()/*:#,~-]{1,9} ?){1,12}", fullmatch=True) | st.sampled_from(
    ["no", "N", "Null", "1e3", "a, b"]
)


@given(why=words | texts, labels=st.lists(words, min_size=1, max_size=9), off_body_mm=st.none() | st.floats())
def test_changes_are_written_as_pyyaml_writes_them(tmp_path_factory, why, labels, off_body_mm):
    path = tmp_path_factory.mktemp("review") / "walk.changes.yaml"
    change = build_change(why=why, markers=labels, before=SampleState(3, off_body_mm))
    write_changes_file(path, build_take(), [change])
    (entry,) = serialize_changes([change])
    expected = dump_yaml({"changes": [{**entry, "markers": InlineSequence(labels)}]}, CHANGES_FILE_LINE_LENGTH)
    assert path.read_text("utf-8").endswith(f"\n{expected}")
    assert load_or_fail(load_changes, path.read_text("utf-8")) == load_or_fail(load_yaml, path.read_text("utf-8"))


def load_or_fail(load, text: str) -> str:
    """Return what a text contains as text, since NaN is not equal to itself, "invalid" if it is no YAML."""
    try:
        return repr(load(text))
    except (yaml.YAMLError, ValueError, TypeError):
        return "invalid"


STRUCTURE = ["- ", "  ", "\n", ": ", "'", '"', "&a ", "*a", "# ", "{", "]", "|\n", "x: 1\n", "12:30", "changes:\n", "- &a b\n"]
pieces = st.sampled_from(STRUCTURE) | texts


@given(
    edits=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 30), pieces), max_size=3),
    labels=st.lists(words, min_size=1, max_size=2),
)
def test_an_edited_file_is_read_as_pyyaml_reads_it(tmp_path_factory, edits, labels):
    path = tmp_path_factory.mktemp("review") / "walk.changes.yaml"
    write_changes_file(path, build_take(), [build_change("gap", labels, why="It is missing."), build_change(), build_change()])
    text = path.read_text("utf-8")
    start = text.index("\ntake:") + 1
    for place, dropped, piece in edits:
        at = start + round(place * (len(text) - start))
        text = text[:at] + piece + text[at + dropped :]
    assert load_or_fail(load_changes, text) == load_or_fail(load_yaml, text)


def test_a_key_without_a_value_is_null(tmp_path):
    path = tmp_path / "walk.changes.yaml"
    write_changes_file(path, build_take(), [build_change(why="It jumps.", predicted_mm=None)])
    path.write_text(path.read_text("utf-8").replace("predicted_mm: null", "predicted_mm:"), "utf-8")
    (found,) = read_changes_file(path, build_take()).declined
    assert found.entry.predicted_mm is None


def test_a_file_without_changes_declines_nothing(tmp_path):
    assert write_and_read(tmp_path) == ()


def test_the_file_explains_the_decisions_and_has_the_takes_frame_numbers(tmp_path):
    write_and_read(tmp_path, build_change())
    text = (tmp_path / "walk.changes.yaml").read_text(encoding="utf-8")
    assert all(f"#   {word}" in text for word in ("accept", "reject", "keep"))
    assert "markers: [C7]" in text  # short lists are on one line
    data = yaml.safe_load(text)
    assert (data["take"], data["frames"]) == ("walk.c3d", [101, 150])
    assert (data["changes"][0]["first"], data["changes"][0]["last"]) == (110, 112)


# errors in a file


def write_broken_file(folder, *keys, value=None, drop=False) -> Path:
    """Write a review file in which the value at `keys` is replaced or missing."""
    path = folder / "walk.changes.yaml"
    write_changes_file(path, build_take(), [build_change("gap", ("RBAC",)), build_change()])
    data = yaml.safe_load(path.read_text(encoding="utf-8"))
    inner = data
    for key in keys[:-1]:
        inner = inner[key]
    if drop:
        del inner[keys[-1]]
    else:
        inner[keys[-1]] = value
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("keys", "value", "sentence"),
    [
        (("changes", 1, "decision"), "rejct", "changes.1.decision: must be 'accept', 'reject' or 'keep'."),
        (("changes", 1, "decision"), False, "changes.1.decision: must be 'accept', 'reject' or 'keep'."),
        (("changes", 1, "kind"), "spyke", "changes.1.kind: must be 'gap', "),
        (("changes", 1, "markers"), ["C7", "NOSE"], "changes.1.markers: walk.c3d has no marker NOSE."),
        (("changes", 1, "markers"), [], "changes.1.markers: "),
        (("changes", 1, "markers"), "C7", "changes.1.markers: "),
        (("changes", 1, "first"), "soon", "changes.1.first: "),
        (("changes", 1, "first"), 100, "changes.1: frames 100 to 112 are not in walk.c3d, which has 101 to 150."),
        (("changes", 1, "last"), 151, "changes.1: frames 110 to 151 are not in walk.c3d, which has 101 to 150."),
        (("changes", 1, "last"), 109, "changes.1: frames 110 to 109 are not in walk.c3d, which has 101 to 150."),
        (("changes", 1, "before", "missing"), None, "changes.1.before.missing: "),
        (("changes", 1, "decison"), "reject", "changes.1.decison: "),
        (("changes",), "none", "changes: "),
        (("frames",), [101], "frames"),
        (("frames",), [1, 50], "frames: the file is for frames 1 to 50; walk.c3d has 101 to 150."),
        (("take",), "run.c3d", "take: the file is for run.c3d, not for walk.c3d"),
        (("note",), "mine", "note: "),
    ],
)
def test_an_error_names_the_file_and_the_key(tmp_path, keys, value, sentence):
    path = write_broken_file(tmp_path, *keys, value=value)
    with pytest.raises(SceneError) as error:
        read_changes_file(path, build_take())
    assert str(error.value).startswith(f"{path}: {sentence}")
    assert str(error.value).endswith(".")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("keys", [("take",), ("frames",), ("changes",), ("changes", 0, "decision"), ("changes", 0, "markers")])
def test_a_missing_key_is_named(tmp_path, keys):
    path = write_broken_file(tmp_path, *keys, drop=True)
    with pytest.raises(SceneError, match=rf"{'.'.join(map(str, keys))}: is missing\.$"):
        read_changes_file(path, build_take())


@pytest.mark.parametrize("text", ["", "take: [", "just words", "- a\n- list\n", "take: walk.c3d\n\tframes: 3\n", "\x00"])
def test_a_file_that_is_not_a_review_file_is_named(tmp_path, text):
    path = tmp_path / "walk.changes.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SceneError) as error:
        read_changes_file(path, build_take())
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(SceneError, match=r"gone\.yaml: "):
        read_changes_file(tmp_path / "gone.yaml", build_take())


# the faults to which a decision applies


def test_a_decision_matches_faults_of_its_kind_marker_and_frames(tmp_path):
    (reviewed,) = write_and_read(tmp_path, build_change())
    assert reviewed.matches(Fault("spike", 1, 11, 13, 0.1, ""))  # overlapping frames
    assert not reviewed.matches(Fault("spike", 1, 12, 13, 0.1, ""))
    assert not reviewed.matches(Fault("spike", 2, 9, 11, 0.1, ""))
    assert not reviewed.matches(Fault("ghost", 1, 9, 11, 0.1, ""))


@given(
    intervals=st.lists(st.tuples(st.integers(0, 1), st.integers(0, 40), st.integers(0, 9)), max_size=12),
    first=st.integers(0, 45),
    length=st.integers(0, 9),
)
def test_index_finds_what_matches_a_fault(tmp_path_factory, intervals, first, length):
    changes = [
        build_change(markers=(("Jim:LFHD", "C7")[marker],), first=FIRST_FRAME + start, last=FIRST_FRAME + start + more)
        for marker, start, more in intervals
    ]
    reviewed: tuple[ReviewedChange, ...] = write_and_read(tmp_path_factory.mktemp("review"), *changes)
    fault = Fault("spike", 1, first, min(first + length, 49), 0.1, "")
    assert ReviewIndex(reviewed).find_matches(fault) == [each for each in reviewed if each.matches(fault)]


def test_kept_samples_have_no_faults(tmp_path):
    swap = build_change("swap", ("Jim:LFHD", "C7"), 110, 119, "keep")
    is_accepted = build_fault_review(build_take(), review_changes(tmp_path, swap)).accepts
    assert not is_accepted(Fault("swap", 0, 9, 18, 0.1, "", 1.0, (1,)))
    assert not is_accepted(Fault("spike", 1, 18, 20, 0.1, ""))
    assert not is_accepted(Fragment("fragment", 2, 5, 10, 0.1, "", donor=1))
    assert is_accepted(Fault("spike", 1, 19, 20, 0.1, ""))
    assert is_accepted(Fault("spike", 2, 9, 18, 0.1, ""))
    assert is_accepted(Fault("gap", 0, 12, 13, 0.1, ""))  # missing samples cannot be declared correct


@pytest.mark.parametrize("decision", ["reject", "keep"])
def test_a_declined_shift_is_not_detected_but_later_spikes_are(tmp_path, decision):
    shift = build_change("moved", ("C7",), 110, 150, decision)
    is_accepted = build_fault_review(build_take(), review_changes(tmp_path, shift)).accepts
    assert not is_accepted(MarkerShift("moved", 1, 10, 49, 0.04, "", settled_frame=10))
    assert is_accepted(MarkerShift("moved", 2, 10, 49, 0.04, "", settled_frame=10))
    assert is_accepted(Fault("spike", 1, 20, 20, 0.1, ""))


def test_a_rejected_change_still_has_its_fault(tmp_path):
    is_accepted = build_fault_review(build_take(), review_changes(tmp_path, build_change())).accepts
    assert is_accepted(Fault("spike", 1, 9, 11, 0.1, ""))
