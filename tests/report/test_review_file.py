"""The changes file: what is written is read back, and each fault of its form is named by a sentence."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.changes import Change, Decision, SampleState
from mocapfix.errors import SceneError
from mocapfix.faults import Fault, Fragment, MarkerShift
from mocapfix.report import review_file
from mocapfix.take import Take

FIRST = 101


def take(name="walk.c3d", first=FIRST) -> Take:
    loose = Take(np.ones((50, 1, 3)), ("*12",), 100.0)
    return Take(np.ones((50, 3, 3)), ("Jim:LFHD", "C7", "RBAC"), 100.0, first, Path("folder") / name, unlabelled=loose)


def change(kind="spike", markers=("C7",), first=110, last=112, decision: Decision = "reject", **given) -> Change:
    said = {
        "samples": 3,
        "why": "It jumps: \u00e4 \U0001f600.",
        "method": "estimated",
        "before": SampleState(0, 81.3),
        "after": SampleState(0, None),
    }
    return Change(
        f"{kind}-{markers[0]}-{first}", kind, tuple(markers), first, last, predicted_mm=1.2, decision=decision, **(said | given)
    )


def decided(tmp_path, *changes):
    path = tmp_path / "walk.changes.yaml"
    review_file.write_review_file(path, take(), changes)
    return review_file.read_review_file(path, take())


def test_a_decision_comes_back_with_indices_into_the_take(tmp_path):
    (found,) = decided(tmp_path, change(), change("gap", ("RBAC",), decision="accept"))
    assert (found.markers, found.first, found.last, found.decision) == ((1,), 9, 11, "reject")
    (found,) = decided(tmp_path, change("fragment", ("Jim:LFHD", "*12"), FIRST, FIRST + 49, "keep"))
    assert (found.markers, found.first, found.last, found.decision) == ((0, 3), 0, 49, "keep")


words = st.text(st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"]), max_size=60)


@given(
    why=words,
    method=words,
    missing=st.integers(0, 9),
    off=st.none() | st.floats(0, 1e4),
    decision=st.sampled_from(["reject", "keep"]),
)
def test_whatever_is_said_of_a_change_is_read_back_as_it_was(tmp_path_factory, why, method, missing, off, decision):
    was = change(why=why, method=method, before=SampleState(missing, off), decision=decision)
    (found,) = decided(tmp_path_factory.mktemp("said"), was)
    assert found.to_change() == replace(was, samples=0, after=was.before)  # a change that was not made


def test_a_file_without_changes_decides_nothing(tmp_path):
    assert decided(tmp_path) == ()


def test_the_file_says_how_to_decide_and_is_in_the_files_own_frames(tmp_path):
    decided(tmp_path, change())
    text = (tmp_path / "walk.changes.yaml").read_text(encoding="utf-8")
    assert all(f"#   {word}" in text for word in ("accept", "reject", "keep"))
    said = yaml.safe_load(text)
    assert (said["take"], said["frames"]) == ("walk.c3d", [101, 150])
    assert (said["changes"][0]["first"], said["changes"][0]["last"]) == (110, 112)


# what is wrong with a file


def broken(tmp_path, *keys, value=None, drop=False) -> Path:
    """-> a changes file in which what is at `keys` is another value, or is not there"""
    path = tmp_path / "walk.changes.yaml"
    review_file.write_review_file(path, take(), [change("gap", ("RBAC",)), change()])
    said = yaml.safe_load(path.read_text(encoding="utf-8"))
    inner = said
    for key in keys[:-1]:
        inner = inner[key]
    if drop:
        del inner[keys[-1]]
    else:
        inner[keys[-1]] = value
    path.write_text(yaml.safe_dump(said), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("keys", "value", "sentence"),
    [
        (("changes", 1, "decision"), "rejct", "changes.1.decision: Input should be 'accept', 'reject' or 'keep'."),
        (("changes", 1, "decision"), False, "changes.1.decision: Input should be 'accept', 'reject' or 'keep'."),
        (("changes", 1, "kind"), "spyke", "changes.1.kind: Input should be 'gap', "),
        (("changes", 1, "markers"), ["C7", "NOSE"], "changes.1.markers: walk.c3d has no marker NOSE."),
        (("changes", 1, "markers"), [], "changes.1.markers: "),
        (("changes", 1, "markers"), "C7", "changes.1.markers: "),
        (("changes", 1, "first"), "soon", "changes.1.first: "),
        (("changes", 1, "first"), 100, "changes.1: frames 100 to 112 are not in walk.c3d."),
        (("changes", 1, "last"), 151, "changes.1: frames 110 to 151 are not in walk.c3d."),
        (("changes", 1, "last"), 109, "changes.1: frames 110 to 109 are not in walk.c3d."),
        (("changes", 1, "before", "missing"), None, "changes.1.before.missing: "),
        (("changes", 1, "decison"), "reject", "changes.1.decison: there is no such key; look for a slip in its name."),
        (("changes",), "none", "changes: "),
        (("frames",), [101], "frames"),
        (("frames",), [1, 50], "frames: is about frames 1 to 50; walk.c3d has 101 to 150."),
        (("take",), "run.c3d", "take: is about run.c3d, not walk.c3d"),
        (("note",), "mine", "note: there is no such key; look for a slip in its name."),
    ],
)
def test_each_fault_of_the_form_is_named_by_file_and_key(tmp_path, keys, value, sentence):
    path = broken(tmp_path, *keys, value=value)
    with pytest.raises(SceneError) as error:
        review_file.read_review_file(path, take())
    assert str(error.value).startswith(f"{path}: {sentence}")
    assert str(error.value).endswith(".")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("keys", [("take",), ("frames",), ("changes",), ("changes", 0, "decision"), ("changes", 0, "markers")])
def test_a_key_that_is_missing_is_named(tmp_path, keys):
    path = broken(tmp_path, *keys, drop=True)
    with pytest.raises(SceneError, match=rf"{'.'.join(map(str, keys))}: is missing\.$"):
        review_file.read_review_file(path, take())


@pytest.mark.parametrize("text", ["", "take: [", "just words", "- a\n- list\n", "take: walk.c3d\n\tframes: 3\n", "\x00"])
def test_what_is_no_yaml_of_this_form_is_a_sentence(tmp_path, text):
    path = tmp_path / "walk.changes.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SceneError) as error:
        review_file.read_review_file(path, take())
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_file_that_is_not_there_is_a_sentence(tmp_path):
    with pytest.raises(SceneError, match=r"gone\.yaml: cannot be read"):
        review_file.read_review_file(tmp_path / "gone.yaml", take())


# what a decision is about, and what it vouches for


def test_a_decision_is_about_the_fault_of_its_kind_marker_and_frames(tmp_path):
    (found,) = decided(tmp_path, change())
    assert found.matches(Fault("spike", 1, 11, 13, 0.1, ""))  # found somewhat later than it was
    assert not found.matches(Fault("spike", 1, 12, 13, 0.1, ""))
    assert not found.matches(Fault("spike", 2, 9, 11, 0.1, ""))
    assert not found.matches(Fault("ghost", 1, 9, 11, 0.1, ""))


def test_what_is_kept_is_no_fault_and_all_else_may_be(tmp_path):
    stands = review_file.build_fault_filter(take(), decided(tmp_path, change("swap", ("Jim:LFHD", "C7"), 110, 119, "keep")))
    assert not stands(Fault("swap", 0, 9, 18, 0.1, "", 1.0, (1,)))
    assert not stands(Fault("spike", 1, 18, 20, 0.1, ""))
    assert not stands(Fragment("fragment", 2, 5, 10, 0.1, "", donor=1))
    assert stands(Fault("spike", 1, 19, 20, 0.1, ""))
    assert stands(Fault("spike", 2, 9, 18, 0.1, ""))
    assert stands(Fault("gap", 0, 12, 13, 0.1, ""))  # what is not there nobody has measured


@pytest.mark.parametrize("decision", ["reject", "keep"])
def test_a_move_that_is_not_accepted_is_none_and_spikes_after_it_are_looked_for(tmp_path, decision):
    stands = review_file.build_fault_filter(take(), decided(tmp_path, change("moved", ("C7",), 110, 150, decision)))
    assert not stands(MarkerShift("moved", 1, 10, 49, 0.04, "", settled_frame=10))
    assert stands(MarkerShift("moved", 2, 10, 49, 0.04, "", settled_frame=10))
    assert stands(Fault("spike", 1, 20, 20, 0.1, ""))


def test_what_is_rejected_is_still_a_fault(tmp_path):
    assert review_file.build_fault_filter(take(), decided(tmp_path, change()))(Fault("spike", 1, 9, 11, 0.1, ""))
