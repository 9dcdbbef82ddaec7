"""Labels of finger markers: exchanges with known answers are undone, clean hands stay as they are."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.detect.loop import detect_on_trajectories
from mocapfix.hands.finger_labels import cut_unseen_changes, find_finger_faults, label_unlabelled_fingers, may_show_fingers
from mocapfix.hands.finger_markers import SIDES
from mocapfix.hands.hand_model import HAND_JOINTS
from mocapfix.hands.solve_hands import trace_palm
from mocapfix.io.c3d import write_c3d
from mocapfix.labels.label_swaps import undo_label_exchanges
from mocapfix.model.faults import FaultReview, build_fault_mask
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions
from mocapfix.pipeline import clean, label
from mocapfix.solve.kinematics import compute_joint_and_marker_positions
from mocapfix.stats.rigid_alignment import compute_rotations
from mocapfix.subject.library import load_marker_set
from mocapfix.synthetic import compose_motion, draw_subject
from tests.hands.composed_hands import RATE_HZ, build_hand, carry_markers

TIPS = ["THM6", "IDX6", "MID6", "RNG6", "PNK6"]


@pytest.fixture(scope="module")
def body():
    """Return a body with the markers of both hands, whose fingers bend one after the other."""
    subject = draw_subject(np.random.default_rng(5), False, "frontwaist53")
    motion = compose_motion(subject, 4.0, RATE_HZ)
    markers, labels = [compute_joint_and_marker_positions(subject, motion)[1]], [*subject.labels]
    time = np.arange(motion.frame_count) / RATE_HZ
    for side in SIDES:
        hand = build_hand(side, TIPS)
        root, local = hand.place_palm(trace_palm(subject, motion, side))
        codes = np.sin(2 * np.pi * (0.4 * time[:, None] + np.arange(hand.model.prior.code_size) / 7))
        vectors = hand.model.prior.decode(codes)
        local[:, HAND_JOINTS] = local[:, HAND_JOINTS] @ compute_rotations(vectors[:, HAND_JOINTS])
        markers.append(carry_markers(hand, (root, local)))
        labels += hand.markers.markers.labels
    return subject, motion, Take(np.concatenate(markers, axis=1), tuple(labels), RATE_HZ)


def exchange(take, one, other, first, last):
    return take.exchange_labels((take.labels.index(one), take.labels.index(other)), first, last)


@pytest.mark.parametrize("shown", [TIPS, ["MID6"]])
def test_clean_fingers_keep_their_labels(body, shown):
    subject, motion, take = body
    kept = np.array([m for m, label in enumerate(take.labels) if label[1:] not in TIPS or label[1:] in shown])
    assert find_finger_faults(take.select(kept, take.visible), subject, motion) == []


@pytest.mark.parametrize(("one", "other", "first", "last"), [
    ("LIDX6", "LMID6", 50, 52),  # three frames
    ("LRNG6", "LPNK6", 20, 160),  # more than half of the take
    ("LIDX6", "RIDX6", 100, 130),  # both hands
    ("RTHM6", "RIDX6", 0, 239),  # never right
])  # fmt: skip
def test_an_exchange_is_found_and_undone(body, one, other, first, last):
    subject, motion, take = body
    wrong = exchange(take, one, other, first, last)
    faults = find_finger_faults(wrong, subject, motion)
    assert [({take.labels[m] for m in each.markers}, each.first, each.last) for each in faults] == [({one, other}, first, last)]
    assert faults[0].kind == "swap"
    np.testing.assert_array_equal(undo_label_exchanges(wrong, faults).markers, take.markers)


def test_labels_that_change_in_a_gap_follow_the_poses_of_the_hand(body):
    subject, motion, take = body
    markers = take.markers.copy()
    columns = [take.labels.index(label) for label in ("LIDX6", "LMID6")]
    markers[80:100, columns] = markers[150:170, columns] = np.nan
    right = take.replace_markers(markers)
    wrong = exchange(right, "LIDX6", "LMID6", 100, 149)
    faults = find_finger_faults(wrong, subject, motion)
    np.testing.assert_array_equal(undo_label_exchanges(wrong, faults).markers, right.markers)


def test_a_cycle_of_three_fingers_is_undone(body):
    subject, motion, take = body
    cycle = tuple(take.labels.index(label) for label in ("RIDX6", "RMID6", "RRNG6"))
    wrong = take.exchange_labels(cycle, 60, 90)
    faults = find_finger_faults(wrong, subject, motion)
    np.testing.assert_array_equal(undo_label_exchanges(wrong, faults).markers, take.markers)


def test_a_sample_under_the_label_of_a_missing_finger_goes_back(body):
    subject, motion, take = body
    one, other = (take.labels.index(label) for label in ("LMID6", "LPNK6"))
    markers = take.markers.copy()
    markers[70:110, other] = np.nan
    right = take.replace_markers(markers)
    wrong = right.exchange_labels((one, other), 80, 100)
    faults = find_finger_faults(wrong, subject, motion)
    np.testing.assert_array_equal(undo_label_exchanges(wrong, faults).markers, right.markers)


def test_a_point_that_no_finger_can_be_is_a_ghost(body, tmp_path):
    subject, motion, take = body
    middle, markers = take.labels.index("LMID6"), take.markers.copy()
    markers[70:110, middle] = np.nan
    markers[80:96, middle] = take.markers[80, middle] + [0.05, 0.07, -0.05]
    wrong = take.replace_markers(markers)
    faults = find_finger_faults(wrong, subject, motion)
    assert [(fault.kind, fault.markers, fault.first, fault.last) for fault in faults] == [("ghost", (middle,), 80, 95)]
    path = tmp_path / "walk.c3d"
    write_c3d(path, exchange(wrong, "LMID6", "LRNG6", 85, 120))
    result = clean(path, is_fast=True)
    (note,) = (note for note in result.subject_report["notes"] if "LRNG6" in note or "finger markers" in note)
    assert note.startswith("The finger markers of the left hand and right hand are filled and not solved")
    assert not build_fault_mask(result.faults.select_kinds("ghost"), markers.shape[:2])[
        :, np.arange(len(take.labels)) != middle
    ].any()
    assert result.faults.compute_faulty_mask(result.relabelled_take)[80:96, middle].all()


def test_fingers_of_a_hand_without_a_palm_are_judged_by_their_trajectories(body):
    subject, motion, take = body
    names = [subject.skeleton.names[joint] for joint in subject.joints]
    lost = {
        label for label, name in zip(subject.labels, names, strict=True) if name in ("LeftForeArm", "LeftHand", "LeftFingerBase")
    }
    kept = np.array([m for m, label in enumerate(take.labels) if label not in lost])
    wrong = exchange(exchange(take, "LIDX6", "LMID6", 50, 60), "RIDX6", "RMID6", 50, 60)
    marker_set = load_marker_set("frontwaist53")
    for part, expected in ((wrong.select(kept, wrong.visible), [{"LIDX6", "LMID6"}]), (wrong, [])):
        found = detect_on_trajectories(part, marker_set, None, FaultReview(), CleanOptions())
        assert [{part.labels[m] for m in fault.markers} for fault in found.label_faults] == expected
    without = subject.select_markers([label for label in subject.labels if label not in lost])
    part = wrong.select(kept, wrong.visible)
    assert [{part.labels[m] for m in fault.markers} for fault in find_finger_faults(part, without, motion)] == [
        {"RIDX6", "RMID6"}
    ]


def test_previews_undo_exchanges_of_fingers(body, tmp_path):
    _, _, take = body
    path = tmp_path / "walk.c3d"
    write_c3d(path, exchange(take, "LIDX6", "LMID6", 50, 60))
    faults = clean(path, is_fast=True).faults.select_kinds("swap")
    assert [({take.labels[m] for m in fault.markers}, fault.first, fault.last) for fault in faults] == [
        ({"LIDX6", "LMID6"}, 50, 60)
    ]


def test_bodies_without_finger_markers_have_none(body):
    subject, motion, take = body
    assert (
        find_finger_faults(Take(take.markers, tuple(f"X{n}" for n in range(take.markers.shape[1])), RATE_HZ), subject, motion)
        == []
    )


def test_a_tracklet_ends_where_its_label_changes_unseen():
    seen = np.array([[0, 1], [0, 1], [1, 0], [1, 0]])  # both change their columns in sight
    np.testing.assert_array_equal(cut_unseen_changes(seen, seen >= 0), seen)
    unseen = np.array([[0, -1], [0, -1], [-1, 0], [-1, 0]])  # it may be another point
    np.testing.assert_array_equal(cut_unseen_changes(unseen, unseen >= 0), [[0, -1], [0, -1], [-1, 1], [-1, 1]])


def hide_labels(take, subject, dropped=()):
    """Return the take with the labels of its body, and its finger markers in another order without theirs, and these."""
    fingers = [m for m in range(len(subject.labels), len(take.labels)) if take.labels[m] not in dropped]
    order = np.random.default_rng(0).permutation(fingers)
    unlabelled = Take(take.markers[:, order], tuple(f"*{n}" for n in range(len(order))), RATE_HZ)
    of_body = np.arange(len(subject.labels))
    labelled = Take(take.markers[:, of_body], take.labels[: len(of_body)], RATE_HZ, unlabelled=unlabelled)
    return labelled, [take.labels[m] for m in order]


def test_fingers_without_labels_get_those_of_their_set(body):
    subject, motion, take = body
    hidden, truth = hide_labels(take, subject)
    assert may_show_fingers(hidden, load_marker_set("frontwaist53"))
    found = label_unlabelled_fingers(hidden, subject, motion)
    assert found is not None
    labels, names = found
    for column, name in enumerate(truth):
        assert {names[m] for m in labels.marker_indices[:, column]} == {name}
    assert (labels.confidence > 0.8).all()


@pytest.mark.parametrize("hidden", [["LMID6", "LRNG6", "RTHM6"], ["RIDX6"], [f"L{name}" for name in TIPS]])
def test_fingers_beside_labelled_ones_get_the_labels_that_are_left(body, hidden):
    subject, motion, take = body
    shown = np.array([m for m, label in enumerate(take.labels) if label not in hidden])
    unlabelled = Take(
        take.markers[:, [take.labels.index(label) for label in hidden]], tuple(f"*{n}" for n in range(len(hidden))), RATE_HZ
    )
    partly = replace(take.select(shown, take.visible), unlabelled=unlabelled)
    assert may_show_fingers(partly, load_marker_set("frontwaist53"))
    found = label_unlabelled_fingers(partly, subject, motion)
    assert found is not None
    labels, names = found
    assert set(names) == set(hidden)
    np.testing.assert_array_equal(
        labels.marker_indices, np.tile([names.index(label) for label in hidden], (len(take.markers), 1))
    )


def test_points_that_are_no_finger_set_keep_no_label(body):
    subject, motion, take = body
    hidden, _ = hide_labels(take, subject, {f"{side}{name}" for side in "LR" for name in TIPS[:3]})  # two a hand
    assert label_unlabelled_fingers(hidden, subject, motion) is None


def test_hands_with_finger_labels_and_bodies_without_points_near_them_show_no_unlabelled_fingers(body):
    subject, _, take = body
    hidden, _ = hide_labels(take, subject)
    assert hidden.unlabelled is not None
    marker_set = load_marker_set("frontwaist53")
    assert not may_show_fingers(take, marker_set)
    one = Take(hidden.unlabelled.markers[:, :1], ("*0",), RATE_HZ)  # a set of ten has five more
    assert not may_show_fingers(replace(take, unlabelled=one), marker_set)
    far = replace(hidden.unlabelled, markers=hidden.unlabelled.markers + 1.0)
    assert not may_show_fingers(replace(hidden, unlabelled=far), marker_set)
    assert not may_show_fingers(hidden, load_marker_set("cmu41"))


def test_a_file_with_a_labelled_body_is_labelled_to_the_tips(body, tmp_path):
    subject, _, take = body
    hidden, truth = hide_labels(take, subject)
    path = tmp_path / "walk.c3d"
    write_c3d(path, hidden)
    labelled = label(path)
    assert clean(path, is_fast=True).input_take.labels == labelled.labels
    assert set(labelled.labels) == {*subject.labels, *truth}
    for name in take.labels:
        np.testing.assert_allclose(
            labelled.markers[:, labelled.labels.index(name)], take.markers[:, take.labels.index(name)], atol=1e-5
        )
    assert "Labelled by mocapfix: 2400 samples of 10 markers." in labelled.notes
    assert not any("Left without a label" in note for note in labelled.notes)
