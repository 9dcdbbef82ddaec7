from dataclasses import replace

import numpy as np
import pytest

from mocapfix.hands.solve_hands import HandMotion
from mocapfix.model.body_fit import RememberedGap
from mocapfix.model.detected import Detected
from mocapfix.model.faults import Fault
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.report.notes import (
    describe_copies,
    describe_frame_steps,
    describe_hands,
    describe_lost_part,
    describe_remembered_gaps,
    describe_stray_markers,
    describe_unassigned_markers,
    describe_uncertain_fills,
    describe_unobserved_joints,
)
from mocapfix.report.terms import JOINT_TERMS
from mocapfix.solve.lost_in_sight import LostPart
from mocapfix.synthetic import draw_subject
from tests.hands.composed_hands import build_hand

NAN = np.nan
RATE, FRAMES = 100.0, 40


def build_take(*labels) -> Take:
    return Take(np.ones((FRAMES, len(labels), 3)), labels, RATE, 101)


def test_a_marker_far_from_the_body_in_most_frames_may_have_a_wrong_label():
    residual_m = np.full((FRAMES, 3), 0.01)
    residual_m[:21, 0] = 0.061  # more than half
    residual_m[:20, 1] = 0.061  # half
    residual_m[:10, 2], residual_m[15:, 2] = 0.061, NAN  # two thirds of the known samples
    assert describe_stray_markers(build_take("A", "B", "C"), residual_m) == [
        "A is more than 60 mm from the body in most of its frames; check its label.",
        "C is more than 60 mm from the body in most of its frames; check its label.",
    ]


def test_a_given_subject_that_no_marker_fits_is_named_and_not_the_labels():
    residual_m = np.full((FRAMES, 3), 0.0123)
    residual_m[:, 0] = 0.07
    assert describe_stray_markers(build_take("A", "B", "C"), residual_m, has_given_subject=True) == [
        "Half of the samples are more than 12 mm from where the given subject has their markers: it is another person, or they "
        "were attached again. Leave out --subject or --like, or calibrate again."
    ]
    residual_m[:, 1:] = 0.007  # attached again, 5 mm off
    (note,) = describe_stray_markers(build_take("A", "B", "C"), residual_m, has_given_subject=True)
    assert note.startswith("A is more than 60 mm")


def test_a_marker_far_from_the_body_for_a_while_is_listed_with_its_frames():
    residual_m = np.full((FRAMES, 2), 0.01)
    residual_m[10:15, 0] = [0.11, 0.12, 0.15, 0.2, 0.3]  # 0.05 s
    residual_m[20:24, 0] = 0.2  # shorter
    residual_m[30:35, 1] = 0.1  # at the limit
    assert describe_stray_markers(build_take("A", "B"), residual_m) == [
        "A, frames 111 to 115: 150 mm from the body, left unchanged; its label was assumed to be right."
    ]


def test_a_label_swap_is_mentioned_only_where_one_is_suspected():
    residual_m = np.full((FRAMES, 3), 0.01)
    residual_m[10:15] = 0.15
    suspected = Fault("swap", 0, 8, 12, 0.2, "", 0.5, other_markers=(1,))
    assert describe_stray_markers(
        build_take("A", "B", "C"), residual_m, [suspected, replace(suspected, marker=2, confidence=0.9)]
    ) == [
        "A, frames 111 to 115: 150 mm from the body, left unchanged; check the suspected label swap.",
        "B, frames 111 to 115: 150 mm from the body, left unchanged; check the suspected label swap.",
        "C, frames 111 to 115: 150 mm from the body, left unchanged; its label was assumed to be right.",
    ]


def test_samples_that_another_note_describes_are_not_listed():
    residual_m = np.full((FRAMES, 2), 0.01)
    residual_m[10:15] = 0.15
    described = np.zeros((FRAMES, 2), bool)
    described[:, 0] = True
    (note,) = describe_stray_markers(build_take("A", "B"), residual_m, (), described)
    assert note.startswith("B, ")


@pytest.mark.parametrize("rate", [30.0, 120.0, 1000.0])
def test_jumps_repeats_and_absences_of_all_markers_are_named_with_their_frames(rate):
    labels = tuple("ABCDEFGH")
    path = np.arange(9000)[:, None, None] * np.array([2.4, 0.0, 0.6]) / rate
    markers = path + np.arange(8)[:, None] * 0.1 + np.random.default_rng(0).normal(0, 0.0003, (9000, 8, 3))
    take = Take(markers, labels, rate, 101)
    assert describe_frame_steps(take) == []
    markers[4094:, :7] += [0.0, 0.0, 0.4]  # one marker of eight stays
    assert describe_frame_steps(take) == [
        "All markers jump at frame 4195: frames are missing before, or takes are joined. Cut the take there: fills and motion "
        "beside it are not reliable."
    ]
    markers[4094:, :7] -= [0.0, 0.0, 0.4]
    markers[101:103] = markers[100]
    markers[8000:8400] = np.nan
    absent = ["No marker is visible in frames 8101–8500: any motion there is a guess."] * (rate < 1000.0)  # 0.4 s
    repeats = "2 frames repeat the frame before (202–203) while the body moves: the recording was held, or its rate was raised"
    assert describe_frame_steps(Take(markers, labels, rate, 101)) == [f"{repeats} (--rate).", *absent]
    assert describe_frame_steps(replace(take, markers=np.repeat(markers[:1], 50, axis=0))) == []  # at rest
    for frames in range(4):
        assert describe_frame_steps(replace(take, markers=markers[:frames])) == []
    fast = np.repeat(np.sin(np.arange(40) / 5)[:, None, None] * np.ones((8, 3)), 2, axis=0)  # 0.2 m a step, each frame twice
    (note,) = describe_frame_steps(replace(take, markers=fast))
    assert note.startswith("40 frames repeat the frame before")


def test_labels_with_the_same_samples_are_named():
    markers = np.random.default_rng(0).normal(0, 1, (300, 5, 3))
    take = Take(markers, ("A", "B", "C", "D", "E"), RATE, 1)
    assert describe_copies(take) == []
    markers[:, 3] = markers[:, 1]
    markers[:, [0, 2]] = np.nan  # absent
    assert describe_copies(replace(take, markers=markers)) == [
        "These labels have the same samples, so all but one of them are copies: B and D."
    ]
    markers[150:, 3] += 0.001
    assert describe_copies(replace(take, markers=markers)) == []


def build_lost_arm(*frames):
    lost, markers = np.zeros(FRAMES, bool), np.zeros((FRAMES, 3), bool)
    lost[list(frames)] = True
    markers[list(frames)] = True
    return LostPart("left arm", lost, np.where(lost, 0.31, NAN), markers)


def test_a_lost_limb_is_described_with_its_frames_markers_and_what_was_assumed():
    take, inliers = build_take("A", "B", "C"), np.ones((FRAMES, 3), bool)
    note = describe_lost_part(take, build_lost_arm(5, 6, 7, 20), inliers)
    assert note == (
        "The solved left arm is 310 mm from its markers (A, B and 1 more) in 4 frames (106–108 and 121). They are plausible "
        "and left unchanged; do not use it there."
    )
    inliers[5] = False
    assert "They are plausible and 3 samples were taken for faults; do not use" in describe_lost_part(
        take, build_lost_arm(5, 6), inliers
    )
    many = describe_lost_part(take, build_lost_arm(*range(0, 40, 2)), inliers)
    assert "20 frames (101, 103 and 18 more intervals)" in many


def test_markers_near_the_body_or_without_residuals_have_no_note():
    residual_m = np.full((FRAMES, 2), 0.06)
    residual_m[:, 1] = NAN
    assert describe_stray_markers(build_take("A", "B"), residual_m) == []


@pytest.mark.parametrize(
    ("labels", "columns", "notes"),
    [
        (("A", "B"), [0, 1], []),
        (("A", "Wand"), [0], ["Not in its marker set, filled without the skeleton: Wand."]),
        (
            ("Jim:A", "Ann:A"),
            [0],
            ["The solved subject is Jim. Not in its marker set, filled without the skeleton: Ann:A."],
        ),
    ],
)
def test_markers_outside_the_marker_set_are_listed(labels, columns, notes):
    assert describe_unassigned_markers(build_take(*labels), columns) == notes


def test_joints_without_visible_markers_are_listed_once(cleaned):
    subject = cleaned.result.subject
    is_observed = np.isin(np.arange(len(subject.skeleton.names)), subject.joints)
    assert describe_unobserved_joints(subject, is_observed) == []
    is_observed[subject.skeleton.find_joint("LeftHand")] = False
    note = "No visible marker on LeftHand: the mean pose is used there."
    assert describe_unobserved_joints(subject, is_observed) == [note]


def test_uncertain_fills_are_counted_with_their_markers():
    sample_sd = np.full((FRAMES, 3), NAN)
    sample_sd[3:6, 0], sample_sd[7, 2], sample_sd[8, 1] = 0.0601, 0.2, 0.06
    filled = build_take("A", "B", "C").replace_markers(np.ones((FRAMES, 3, 3)), sample_sd)
    limit = "are unreliable, with a predicted error above 104 mm: A, C."
    assert describe_uncertain_fills(filled) == [f"4 filled samples {limit}"]
    assert describe_uncertain_fills(filled, JOINT_TERMS) == [f"4 filled values {limit}"]
    assert describe_uncertain_fills(build_take("A")) == []


def test_a_body_that_fits_has_no_notes(cleaned):
    assert cleaned.result.report["notes"] == []


def test_limbs_from_the_memory_of_the_person_are_listed_with_their_source():
    names = load_cmu31_body().skeleton.names
    arm, feet = (tuple(map(names.index, joints)) for joints in (("LeftForeArm", "LeftHand"), ("LeftFoot", "RightFoot")))
    gaps = [
        RememberedGap(110, 120, arm, "walk2, 0:31-0:33"),
        RememberedGap(130, 170, feet, "walk3, 1:02-1:03"),
        *[RememberedGap(n, n + 1, arm, "walk2, 0:31-0:32") for n in (200, 210, 220)],
    ]
    take = Take(np.zeros((300, 1, 3)), ("A",), 120.0, first_frame=11)
    assert describe_remembered_gaps(take, gaps, names) == [
        "Inferred from the memory of the person: LeftFoot, RightFoot in frames 141\u2013181 from walk3, 1:02-1:03; left "
        "forearm in frames 121\u2013131 from walk2, 0:31-0:33; left forearm in frames 211\u2013212 from walk2, 0:31-0:32; "
        "and 2 more."
    ]
    assert describe_remembered_gaps(take, [], names) == []


def build_left_hand():
    """Return a hand of average length over four frames."""
    turns, points = np.tile(np.eye(3), (4, 15, 1, 1)), np.zeros((4, 20, 3))
    sd, seen = np.zeros((4, 20)), np.ones((4, 5), bool)
    return HandMotion(build_hand("Left"), points[:, 0], turns[:, 0], turns, points, sd, sd[:, :15], seen, sd[:, :0])


def describe_fingers(hands, *, is_preview=False, is_visible=True, has_forearm=True, marker_set="frontwaist53"):
    """Return the notes on the hands of a take with one finger marker on each."""
    take = Take(np.full((4, 3, 3), 0.5 if is_visible else np.nan), ("LIDX6", "RIDX6", "LANK"), 60.0)
    subject = replace(draw_subject(np.random.default_rng(0), False, "frontwaist53"), marker_set=marker_set)
    shown = [k for k, joint in enumerate(subject.joints) if has_forearm or "Right" not in subject.skeleton.names[joint]]
    subject = subject.select_markers({subject.labels[k] for k in shown})
    return describe_hands(Detected(take), subject, hands, is_preview=is_preview)


def test_finger_markers_that_are_not_solved_are_named_with_the_reason():
    solved = "The fingers of the left hand (189 mm long) are solved from their markers; files of motion have them."
    unused = "The finger markers of the right hand are filled and not solved: none of their samples can be used."
    assert describe_fingers([build_left_hand()], is_visible=False) == [solved, unused]
    (preview,) = describe_fingers([], is_preview=True)
    assert preview.startswith("The finger markers of the left hand and right hand are filled and not solved:")
    assert "--fast" in preview
    (_, hidden) = describe_fingers([build_left_hand()], has_forearm=False)
    assert hidden == "The finger markers of the right hand are filled and not solved: no marker shows the forearm."
    (windows,) = describe_fingers([])
    assert "windows" in windows
    assert describe_fingers([], marker_set="cmu41") == []
