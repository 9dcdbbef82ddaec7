from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.solve.kinematics import compute_joint_and_marker_positions
from mocapfix.solve.lost_in_sight import BODY_PARTS, compute_distance_ranges, find_lost_parts
from mocapfix.synthetic import compose_take

LEFT_ARM = ("LUPA", "LELB", "LFRM", "LWRA", "LWRB", "LFIN")
LEFT_FOREARM = ("LFRM", "LWRA", "LWRB", "LFIN")
LEFT_FOOT = ("LHEE", "LTOE", "LMT5")


@pytest.fixture(scope="module")
def scene():
    """Two seconds of reaching in which body and markers agree."""
    truth = compose_take(seed=3, seconds=6.0, rate=60.0)
    _, body_markers = compute_joint_and_marker_positions(truth.subject, truth.motion)
    return truth.subject, truth.marker_positions, body_markers


def find_columns(subject, labels):
    return [subject.labels.index(label) for label in labels]


def count_lost(scene, *, markers=None, inliers=None, body_markers=None):
    subject, seen, body = scene
    markers = seen if markers is None else markers
    inliers = ~np.isnan(markers[..., 0]) if inliers is None else inliers
    parts = find_lost_parts(markers, inliers, subject, body if body_markers is None else body_markers)
    return {part.name: part.frame_count for part in parts}


def shift_body(scene, labels, frames, offset=(0, 0.3, 0)):
    subject, _, body = scene
    shifted = body.copy()
    shifted[np.ix_(frames, find_columns(subject, labels))] += offset
    return shifted


def test_a_body_at_its_markers_has_lost_nothing(scene):
    assert count_lost(scene) == {}


def test_a_lost_arm_counts_once_with_its_frames_and_distance(scene):
    subject, markers, _ = scene
    body = shift_body(scene, LEFT_ARM, [50, 51, 52, 60])
    (part,) = find_lost_parts(markers, np.ones(markers.shape[:2], bool), subject, body)
    assert part.name == "left arm"
    assert np.flatnonzero(part.frames).tolist() == [50, 51, 52, 60]
    assert part.distance_m[50] == pytest.approx(0.3, abs=0.015)
    assert np.isnan(part.distance_m[0])
    assert [subject.labels[k] for k in np.flatnonzero(part.markers[51])] == [
        label for label in subject.labels if label in LEFT_ARM
    ]


def test_a_lost_foot_or_forearm_counts_as_such(scene):
    assert count_lost(scene, body_markers=shift_body(scene, LEFT_FOOT, range(10, 20), (0.12, 0, 0))) == {"left foot": 10}
    # 4 of 6 markers by 80 mm: a mean of 53 mm over the arm, of 80 mm over the forearm
    assert count_lost(scene, body_markers=shift_body(scene, LEFT_FOREARM, range(5), (0.08, 0, 0))) == {"left forearm": 5}


def test_a_frame_counts_for_one_part_only(scene):
    # so far that the means over lower leg and leg exceed the limit as well
    body = shift_body(scene, LEFT_FOOT, range(10, 20), (0, 0.4, 0))
    assert count_lost(scene, body_markers=body) == {"left foot": 10}
    subject, _, _ = scene
    body[15:20, find_columns(subject, ["LSHN", "LANK"])] += [0, 0.2, 0]
    assert count_lost(scene, body_markers=body) == {"left lower leg": 5, "left foot": 5}
    body[18:20, find_columns(subject, ["LTHI", "LKNE"])] += [0, 0.1, 0]
    assert count_lost(scene, body_markers=body) == {"left leg": 2, "left lower leg": 3, "left foot": 5}


def test_a_distance_below_the_limit_does_not_count(scene):
    assert count_lost(scene, body_markers=shift_body(scene, LEFT_ARM, range(10), (0.045, 0, 0))) == {}


def test_samples_taken_for_faults_count_if_they_keep_their_distance_on_the_segment(scene):
    subject, markers, _ = scene
    inliers = np.ones(markers.shape[:2], bool)
    inliers[np.ix_(range(50, 55), find_columns(subject, LEFT_ARM))] = False
    assert count_lost(scene, inliers=inliers, body_markers=shift_body(scene, LEFT_ARM, range(50, 55))) == {"left arm": 5}


def test_a_spike_that_keeps_its_distances_by_chance_is_no_lost_foot(scene):
    subject, markers, _ = scene
    toe, outer, heel = (markers[30, column] for column in find_columns(subject, ["LTOE", "LMT5", "LHEE"]))
    axis = (outer - toe) / np.linalg.norm(outer - toe)
    spike = markers.copy()
    spike[30, subject.labels.index("LHEE")] = toe + Rotation.from_rotvec(np.radians(60) * axis).apply(heel - toe)
    inliers = np.ones(markers.shape[:2], bool)
    assert count_lost(scene, markers=spike, inliers=inliers) == {}  # the other markers of the foot lie on the body
    inliers[30, subject.labels.index("LHEE")] = False
    assert count_lost(scene, markers=spike, inliers=inliers) == {}


def test_fewer_than_three_seen_markers_show_nothing(scene):
    subject, markers, _ = scene
    hidden = markers.copy()
    hidden[:, find_columns(subject, LEFT_ARM[:4])] = np.nan
    assert count_lost(scene, markers=hidden, body_markers=shift_body(scene, LEFT_ARM, range(50, 55))) == {}


def test_scattered_markers_are_no_lost_limb(scene):
    subject, markers, _ = scene
    rng = np.random.default_rng(0)
    scattered = markers.copy()
    columns = find_columns(subject, LEFT_ARM)
    direction = rng.normal(size=(20, len(columns), 3))
    scattered[np.ix_(range(50, 70), columns)] += 0.4 * direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    faulty = np.ones(markers.shape[:2], bool)
    faulty[np.ix_(range(50, 70), columns)] = False
    assert count_lost(scene, markers=scattered, inliers=faulty) == {}


def test_one_marker_far_from_its_segment_is_left_out(scene):
    subject, markers, _ = scene
    spiked = markers.copy()
    spiked[50:60, find_columns(subject, ["LTOE"])] += [0.0, 0.5, 0.0]
    assert count_lost(scene, markers=spiked) == {}
    # and does not hide that the others show the foot elsewhere
    assert count_lost(scene, markers=spiked, body_markers=shift_body(scene, ("LSHN", "LANK", *LEFT_FOOT), range(50, 60))) == {
        "left lower leg": 10
    }


def test_an_arm_reached_to_where_its_bones_cannot_is_not_consistent(scene):
    subject, markers, _ = scene
    moved = markers.copy()
    moved[np.ix_(range(50, 60), find_columns(subject, ("LFRM", "LWRA", "LWRB")))] += [0.0, 3.0, 0.0]
    lost = count_lost(scene, markers=moved)
    assert "left arm" in lost or "left forearm" in lost  # three markers that agree with one another are evidence
    moved[np.ix_(range(50, 60), find_columns(subject, ("LWRB",)))] = np.nan
    assert count_lost(scene, markers=moved) == {}  # two are not


def test_ranges_of_distances_hold_in_every_frame(scene):
    subject, markers, _ = scene
    columns = np.array(find_columns(subject, LEFT_ARM))
    low_m, high_m = compute_distance_ranges(markers, np.ones(markers.shape[:2], bool), subject, columns)
    distance_m = np.linalg.norm(markers[:, columns, None] - markers[:, None, columns], axis=-1)
    pairs = ~np.eye(len(columns), dtype=bool)
    assert ((distance_m >= low_m) & (distance_m <= high_m))[:, pairs].all()
    same = subject.joints[columns][:, None] == subject.joints[columns]
    assert np.ptp([low_m[same & pairs], high_m[same & pairs]], axis=0) == pytest.approx(0.05, abs=0.01)


def test_parts_name_joints_of_the_skeleton(scene):
    subject = scene[0]
    assert {name for names in BODY_PARTS.values() for name in names} == set(subject.skeleton.names)
    fewer = replace(subject, joints=np.zeros_like(subject.joints))
    assert {part.name for part in find_lost_parts(scene[1], np.ones(scene[1].shape[:2], bool), fewer, scene[1] + 0.1)} == {
        "pelvis"
    }


def test_two_equal_spikes_do_not_outvote_two_sound_markers(scene):
    subject, markers, _ = scene
    spiked = markers.copy()
    columns = find_columns(subject, ["LFHD", "LBHD"])
    spiked[10, columns] += [0, 0.3, 0]
    inliers = np.ones(markers.shape[:2], bool)
    inliers[10, columns] = False
    assert count_lost(scene, markers=spiked, inliers=inliers) == {}
    # without the sound markers beside them the same samples count
    hidden = spiked.copy()
    hidden[10, find_columns(subject, ["RFHD"])] = np.nan
    inliers[10, find_columns(subject, ["RFHD", "RBHD"])] = False
    hidden[10, find_columns(subject, ["RBHD"])] += [0, 0.3, 0]
    assert count_lost(scene, markers=hidden, inliers=inliers) == {"head": 1}


def test_of_two_contradicting_markers_the_one_off_the_body_is_ignored(scene):
    subject, markers, _ = scene
    wrong = markers.copy()
    wrong[10, find_columns(subject, ["LHEE"])] = np.nan
    wrong[10, find_columns(subject, ["LMT5"])] += [0, 0.25, 0]
    wrong[10, find_columns(subject, ["LSHN", "LANK", "LTHI"])] = np.nan
    assert count_lost(scene, markers=wrong) == {}
