import numpy as np
import pytest

from mocapfix.report import notes
from mocapfix.take import Take

NAN = np.nan
RATE, FRAMES = 100.0, 40


def take(*labels) -> Take:
    return Take(np.ones((FRAMES, len(labels), 3)), labels, RATE, 101)


def test_a_marker_far_from_the_body_most_of_the_time_is_asked_after():
    error = np.full((FRAMES, 3), 0.01)
    error[:21, 0] = 0.061  # more than half
    error[:20, 1] = 0.061  # half
    error[:10, 2], error[15:, 2] = 0.061, NAN  # of what is known, two thirds
    assert notes.describe_stray_markers(take("A", "B", "C"), error) == [
        "A lies more than 60 mm from the body for half the take: is it labelled right?",
        "C lies more than 60 mm from the body for half the take: is it labelled right?",
    ]


def test_a_marker_that_goes_far_for_a_while_is_named_with_its_frames():
    error = np.full((FRAMES, 2), 0.01)
    error[10:15, 0] = [0.11, 0.12, 0.15, 0.2, 0.3]  # 0.05 s
    error[20:24, 0] = 0.2  # shorter
    error[30:35, 1] = 0.1  # no farther than that
    off = "lies 150 mm from the body and was kept; look for swapped labels."
    assert notes.describe_stray_markers(take("A", "B"), error) == [f"A, frames 111 to 115: {off}"]


def test_nothing_is_said_of_markers_near_the_body_or_never_held_against_it():
    error = np.full((FRAMES, 2), 0.06)
    error[:, 1] = NAN
    assert notes.describe_stray_markers(take("A", "B"), error) == []


@pytest.mark.parametrize(
    ("labels", "columns", "said"),
    [
        (("A", "B"), [0, 1], []),
        (("A", "Wand"), [0], ["Not of its marker set, so filled only from how markers move together: Wand."]),
        (
            ("Jim:A", "Ann:A"),
            [0],
            ["The body is Jim's. Not of its marker set, so filled only from how markers move together: Ann:A."],
        ),
    ],
)
def test_markers_that_are_not_the_persons_are_named(labels, columns, said):
    assert notes.describe_unassigned_markers(take(*labels), np.array(columns)) == said


def test_joints_whose_markers_are_never_seen_are_named_once(cleaned):
    subject = cleaned.result.subject
    worn = Take(np.ones((FRAMES, len(subject.labels), 3)), subject.labels, RATE)
    assert notes.describe_unobserved_joints(worn, subject) == []
    joint = subject.skeleton.index("LeftHand")
    on = [k for k in range(len(subject.labels)) if subject.joints[k] == joint]
    worn.markers[:, on[:-1]] = NAN
    assert notes.describe_unobserved_joints(worn, subject) == []
    worn.markers[:, on] = NAN
    assert notes.describe_unobserved_joints(worn, subject) == [
        "No marker of LeftHand is in the take: there the pose is people's mean pose."
    ]


def test_fills_that_are_hardly_more_than_guesses_are_counted_and_their_markers_named():
    deviation = np.full((FRAMES, 3), NAN)
    deviation[3:6, 0], deviation[7, 2], deviation[8, 1] = 0.0601, 0.2, 0.06
    filled = take("A", "B", "C").replace_markers(np.ones((FRAMES, 3, 3)), deviation)
    assert notes.describe_uncertain_fills(filled) == [
        "4 filled samples are hardly more than guesses, with a predicted error above 60 mm: A, C."
    ]
    assert notes.describe_uncertain_fills(take("A")) == []


def test_of_a_body_that_fits_there_is_nothing_to_say(cleaned):
    assert cleaned.result.report["notes"] == []
