"""Marker sets learned from a synthetic take with known person and motion."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.errors import TakeError
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.solve import mean_pose
from mocapfix.subject import label_words, marker_set_fit, unlabelled_markers
from mocapfix.subject.library import load_marker_set
from mocapfix.synthetic import compose_take

BODY, CMU = load_cmu31_body(), load_marker_set("cmu41")
POSES = mean_pose.load_mean_pose_prior("mean-pose", BODY.skeleton)
NAMELESS = tuple(f"P{m}" for m in range(41))
HIDDEN = ("LUPA", "RBAC", "LTHI", "RSHN", "RTOE", "LBHD", "RFIN", "LBWT")


@pytest.fixture(scope="module")
def truth():
    return compose_take(seed=5, seconds=6.0, rate=25.0)


@pytest.fixture(scope="module")
def take(truth):
    return Take(truth.damaged_positions, truth.labels, truth.rate)


def part(kept: list[str]):
    rows = [CMU.labels.index(label) for label in kept]
    where = {"joints": CMU.joints[rows], "marker_offsets": CMU.marker_offsets[rows], "marker_spread": CMU.marker_spread[rows]}
    return replace(CMU, labels=tuple(kept), aliases=((),) * len(rows), **where)


def right(found, truth) -> float:
    return float((found.attachment.joints == truth.subject.joints).mean())


def test_unknown_labels_find_their_segment_and_offset(truth, take):
    labels = tuple(f"X{label}" if label in HIDDEN else label for label in truth.labels)
    found = marker_set_fit.fit_marker_set(
        take, labels, part([label for label in truth.labels if label not in HIDDEN]), 10.0, BODY, POSES
    )
    assert right(found, truth) == 1.0
    assert found.mean_residual_m < 0.008
    size = np.linalg.norm(found.subject.skeleton.offsets) / np.linalg.norm(truth.subject.skeleton.offsets)
    m = [truth.labels.index(label) for label in HIDDEN]
    off = np.linalg.norm(found.attachment.offsets[m] / size - truth.subject.marker_offsets[m], axis=1)
    assert np.median(off) < 0.03  # people's places vary by 0.02
    assert set(found.marker_set.labels) == set(labels)


def test_held_and_static_markers_are_left_out(truth, take):
    hand = BODY.skeleton.find_joint("LeftHand")
    joints = truth.joint_positions
    stick = joints[:, hand] + 3 * (joints[:, hand] - joints[:, BODY.skeleton.find_joint("LeftForeArm")])
    floor = np.tile([0.5, 0.0, 0.5], (len(stick), 1))
    more = take.replace_markers(np.concatenate([take.markers, stick[:, None], floor[:, None]], axis=1))
    more = replace(more, labels=(*truth.labels, "stick", "floor"))
    found = marker_set_fit.fit_marker_set(more, more.labels, CMU, 10.0, BODY, POSES)
    assert found.marker_set.labels == truth.labels
    reason = found.attachment.rejection_reasons[-2]
    assert "on a prop or another segment" in reason or "moves by" in reason
    assert "moves by" in found.attachment.rejection_reasons[-1]


def test_labels_alone_determine_the_body(truth, take):
    labels = tuple(label.replace("FRM", "Forearm").replace("KNE", "_Knee_out").replace("HEE", "Ferse") for label in truth.labels)
    guess = label_words.guess_marker_set_from_words(labels)
    assert guess.describe_missing_body(guess.labels) == ""
    found = marker_set_fit.fit_marker_set(take, labels, guess, 4.0, BODY, POSES)
    assert right(found, truth) > 0.95
    assert found.mean_residual_m < 0.008


def test_unnamed_markers_determine_the_body(truth, take):
    guess = unlabelled_markers.guess_from_marker_cloud(take, NAMELESS)
    rode = dict(zip(NAMELESS, truth.subject.joints, strict=True))
    assert sum(rode[label] == joint for label, joint in zip(guess.labels, guess.joints, strict=True)) > 0.9 * len(NAMELESS)


def test_too_few_markers_are_rejected(take):
    few = replace(take, markers=take.markers[:, :12], labels=take.labels[:12])
    with pytest.raises(TakeError, match=r"shows fewer than 20 markers at once.*--like"):
        unlabelled_markers.guess_from_marker_cloud(few, NAMELESS[:12])


def test_guess_with_which_no_marker_moves_is_rejected(truth, take, monkeypatch):
    monkeypatch.setattr(marker_set_fit, "build_marker_set", lambda *_: part([]))
    with pytest.raises(TakeError, match=r"no marker moves with the body that was assumed\.$"):
        marker_set_fit.fit_marker_set(take, truth.labels, part(list(truth.labels)), 10.0, BODY, POSES)


def test_markers_are_assigned_one_to_one():
    distance = np.array([[0.01, 0.02, 0.3], [0.0, 0.1, 0.3], [np.nan] * 3, [0.2, 0.2, 0.2]])
    assigned, misfit = unlabelled_markers.assign_nearest(distance, 0.15)
    assert assigned.tolist() == [1, 0, -1, -1]
    assert misfit == pytest.approx((0.02 + 0.0 + 0.15) / 3)
