"""Messages of at most two lines: the lists in them, and the sentences that grow with the data."""

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.errors import (
    MAX_LIST_LENGTH,
    MAX_LISTED_NAMES,
    MAX_MESSAGE_LENGTH,
    MAX_NAME_LENGTH,
    MocapfixError,
    format_name_list,
    join_names,
    shorten_message,
)
from mocapfix.io.capture import read_capture
from mocapfix.labels import multi_subject
from mocapfix.labels.label_summary import describe_labelling
from mocapfix.model.take import Take
from mocapfix.options import SubjectOptions, build_clean_options, check_take_options
from mocapfix.report import notes
from mocapfix.report.report import RigidGroupEntry
from mocapfix.solve.lost_in_sight import LostPart
from mocapfix.subject.library import choose_marker_set, load_marker_set, resolve_subject
from tests.captures import CAPTURES, needs_captures

MARKERS, FRAMES = 400, 40
LABELS = tuple(f"Subject 8:Marker of the left side {m}" for m in range(MARKERS))


@given(st.lists(st.text(min_size=1, max_size=130), max_size=200))
def test_list_of_names_is_bounded_and_counts_all(names):
    text = format_name_list(names)
    assert len(text) <= max(MAX_LIST_LENGTH, MAX_NAME_LENGTH) + len(" and 199 more")
    short = [name for name in names if name.isalnum() and len(name) < 8]
    listed, _, more = format_name_list(short).partition(" and ")
    assert len(listed.split(", ")) + int(more.split()[0] if more else 0) == max(1, len(short))
    assert all(name in short for name in listed.split(", ")) or not short


def test_few_names_are_listed_as_they_are():
    assert format_name_list(["a"] * MAX_LISTED_NAMES) == ", ".join(["a"] * MAX_LISTED_NAMES)
    assert format_name_list(["a"] * 30) == f"{', '.join(['a'] * MAX_LISTED_NAMES)} and 24 more"
    assert format_name_list([]) == "(none)"
    assert join_names(["a", "b", "c"]) == "a, b and c"
    assert join_names(["a"] * 9) == "a, a, a, a, a, a and 3 more"


@given(st.text(alphabet="abc /:\n", max_size=600))
def test_shortened_message_keeps_its_beginning_and_end(message):
    short = shorten_message(message)
    path = message.partition(": ")[0]
    assert len(short) <= MAX_MESSAGE_LENGTH + (len(path) + 2 if "/" in path else 0)
    assert short == message or " ... " in short


def test_path_of_a_message_is_not_shortened():
    path, problem = f"/{'folder/' * 60}walk.c3d", "has a fault; export it again."
    assert shorten_message(f"{path}: {problem}") == f"{path}: {problem}"
    long = shorten_message(f"{path}: has {'a very long list, ' * 30}and this; export it again.")
    assert long.startswith(f"{path}: has a very long list, ")
    assert long.endswith("and this; export it again.")


def build_take(visible=True) -> Take:
    markers = np.random.default_rng(0).normal(size=(FRAMES, MARKERS, 3))
    return Take(np.where(visible, markers, np.nan), LABELS, 100.0, sample_sd=np.full((FRAMES, MARKERS), 0.1))


def get_message(function, *arguments) -> str:
    with pytest.raises(MocapfixError) as raised:
        function(*arguments)
    return str(raised.value)


def list_long_messages() -> dict[str, str]:
    """Return sentences about takes with 400 markers, by what they are about."""
    take, residual_m = build_take(), np.full((FRAMES, MARKERS), 0.09)
    scattered = np.where(np.arange(FRAMES)[:, None] % 12 < 6, 0.15, 0.01) + np.zeros(MARKERS)
    part = LostPart("right lower leg", np.arange(FRAMES) % 2 == 0, np.full(FRAMES, 0.3), np.ones((FRAMES, MARKERS), bool))
    groups = [RigidGroupEntry(name=f"group {n}", markers=list(LABELS[:50]), spread_mm=1.0) for n in range(40)]
    several = replace(take, labels=tuple(f"Person{m % 40}:{m}" for m in range(MARKERS)))
    return {
        "unassigned": " ".join(notes.describe_unassigned_markers(take, (0, 1))),
        "misplaced": " ".join(notes.describe_stray_markers(take, residual_m)),
        "strays": " ".join(notes.describe_stray_markers(take, scattered)),
        "lost part": notes.describe_lost_part(take, part, np.ones((FRAMES, MARKERS), bool)),
        "groups": " ".join(notes.describe_rigid_groups(groups, has_body=True)),
        "uncertain": " ".join(notes.describe_uncertain_fills(take)),
        "no set": choose_marker_set(LABELS).reason,
        "no set, short labels": choose_marker_set(("LASI", "RASI", *map(str, range(300)))).reason,
        "keep": get_message(check_take_options, take, build_clean_options(keep=tuple(f"NO{n}" for n in range(90)))),
        "set": get_message(load_marker_set, "cleveland"),
        "wrong set": get_message(resolve_subject, replace(take, labels=LABELS), SubjectOptions(marker_set="cmu41")),
        "subject": get_message(multi_subject.split_subjects, several, None, "Bob"),
        "labelling": max(describe_labelling(replace(take, label_confidence=residual_m), LABELS), key=len, default=""),
    }


def test_sentences_do_not_grow_with_the_data():
    messages = list_long_messages()
    assert {about: message for about, message in messages.items() if not 20 < len(message) <= MAX_MESSAGE_LENGTH} == {}


def test_body_that_does_not_fit_is_one_sentence_instead_of_a_note_for_each_marker():
    take = build_take()
    residual_m = np.full((FRAMES, MARKERS), 0.01)
    residual_m[:, :25] = 0.2
    (note,) = notes.describe_stray_markers(take, residual_m)
    assert note.startswith("25 of 400 markers (")
    assert "the subject file or the marker set is not that of this person." in note
    residual_m[:, 3:] = 0.01
    assert len(notes.describe_stray_markers(take, residual_m)) == 3


@needs_captures
def test_notes_on_reading_captures_are_of_two_lines():
    sentences: dict[str, list[str]] = {}
    for path in sorted((CAPTURES / "c3d").glob("*.c3d")):
        with suppress(MocapfixError):
            take = read_capture(path)
            assert isinstance(take, Take)
            sentences[path.name] = [*take.notes, *notes.describe_up_axis(take), *notes.describe_computed_points(take)]
            sentences[path.name].append(choose_marker_set(take.labels).reason)
    assert len(sentences) > 20
    assert [each for of_take in sentences.values() for each in of_take if len(each) > MAX_MESSAGE_LENGTH] == []
