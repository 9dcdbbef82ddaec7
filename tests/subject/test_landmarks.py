"""Landmarks: one place for each in all marker sets, and an order of them along the body."""

import numpy as np
import pytest

from mocapfix.errors import SceneError
from mocapfix.keypoints.film_solver import load_detector
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.subject.library import find_landmark, load_landmarks, load_marker_set

SAME_PLACES = {
    "left lateral femoral epicondyle": ("cmu41.LKNE", "plug-in-gait39.LKNE", "helen-hayes.L.Knee", "qualisys-sports.LKneeOut"),
    "right medial femoral epicondyle": ("plug-in-gait39.RKNM", "helen-hayes.R.Knee.Medial", "qualisys-sports.RKneeIn"),
    "left lateral malleolus": ("cmu41.LANK", "plug-in-gait39.LANK", "opensim-gait.L.Ankle.Lat"),
    "left medial malleolus": ("plug-in-gait39.LMED", "opensim-gait.L.Ankle.Med"),
    "right heel": ("cmu41.RHEE", "production57.RHEL", "optitrack-core50.RHeel"),
    "left first metatarsal head": ("plug-in-gait39.LMT1", "frontwaist53.LMT1", "optitrack-core50.LToeIn"),
    "left fifth metatarsal head": ("cmu41.LMT5", "qualisys-sports.LForefoot5"),
    "left anterior superior iliac spine": ("plug-in-gait39.LASI", "helen-hayes.L.ASIS", "optitrack-core50.WaistLFront"),
    "right posterior superior iliac spine": ("plug-in-gait39.RPSI", "opensim-gait.R.PSIS"),
    "sacrum": ("plug-in-gait39.SACR", "helen-hayes.V.Sacral"),
    "left acromion": ("cmu41.LSHO", "optitrack-core50.LShoulderTop"),
    "left lateral humeral epicondyle": ("cmu41.LELB", "qualisys-sports.LElbowOut"),
    "left medial humeral epicondyle": ("frontwaist53.LIEL", "qualisys-sports.LElbowIn"),
    "right radial styloid process": ("plug-in-gait39.RWRA", "optitrack-core50.RWristOut"),
    "right ulnar styloid process": ("plug-in-gait39.RWRB", "optitrack-core50.RWristIn"),
    "jugular notch": ("cmu41.CLAV", "helen-hayes.IJ"),
    "xiphoid process": ("cmu41.STRN", "helen-hayes.PX"),
    "tenth thoracic vertebra": ("cmu41.T10",),
    "left front of head": ("cmu41.LFHD", "plug-in-gait39.LFHD"),
}
"""a landmark, and markers that are placed on it"""


@pytest.mark.parametrize("name", SAME_PLACES)
def test_a_landmark_has_one_place_in_all_sets(name):
    landmark, joint_names = find_landmark(name), load_cmu31_body().skeleton.names
    for marker in SAME_PLACES[name]:
        set_name, _, label = marker.partition(".")
        marker_set = load_marker_set(set_name)
        k = marker_set.labels.index(label)
        assert joint_names[marker_set.joints[k]] == landmark.joint_name
        np.testing.assert_array_equal(marker_set.marker_offsets[k], landmark.offset)


def find_rest_position(name: str) -> np.ndarray:
    """Return where a landmark is on the average body at rest: left is +x, up +y, front +z."""
    landmark, skeleton = find_landmark(name), load_cmu31_body().skeleton
    return skeleton.rest_positions[skeleton.find_joint(landmark.joint_name)] + landmark.offset


@pytest.mark.parametrize(
    ("axis", "names"),
    [
        (1, ("seventh cervical vertebra", "second thoracic vertebra", "midpoint of the lower tips of the shoulder blades",
             "eighth thoracic vertebra", "tenth thoracic vertebra", "twelfth thoracic vertebra", "first lumbar vertebra",
             "third lumbar vertebra", "fifth lumbar vertebra", "sacrum")),
        (1, ("left iliac crest", "left greater trochanter", "left lateral femoral epicondyle", "left tibial tuberosity",
             "left lateral malleolus", "left heel")),
        (1, ("jugular notch", "sternum", "xiphoid process")),
        (0, ("left lateral femoral epicondyle", "left knee keypoint", "left medial femoral epicondyle")),
        (0, ("left lateral malleolus", "left ankle keypoint", "left medial malleolus")),
        (0, ("left fifth metatarsal head", "left second metatarsal head", "left first metatarsal head")),
        (0, ("left hand", "left radial styloid process", "left lateral humeral epicondyle", "left acromion", "jugular notch")),
        (2, ("left tip of toe", "left second metatarsal head", "left heel")),
        (2, ("nose keypoint", "left eye keypoint", "left ear keypoint", "left mastoid process")),
        (2, ("left anterior superior iliac spine", "left iliac crest", "left posterior superior iliac spine", "sacrum")),
        (2, ("left tibial tuberosity", "left head of fibula")),
    ],
)  # fmt: skip
def test_landmarks_are_ordered_as_in_anatomy(axis, names):
    positions = [find_rest_position(name)[axis] for name in names]
    assert positions == sorted(positions, reverse=True)


def test_right_landmarks_mirror_the_left_ones():
    left, right = find_landmark("left acromion"), find_landmark("right acromion")
    assert (left.joint_name, right.joint_name) == ("LeftShoulder", "RightShoulder")
    np.testing.assert_array_equal(left.offset * [-1, 1, 1], right.offset)


@pytest.mark.parametrize("name", ["acromion", "left sacral bone", "elbow", ""])
def test_unknown_landmark_lists_the_known_ones(name):
    with pytest.raises(ValueError, match=rf"there is no landmark '{name}'; the landmarks are vertex, .* and \d+ more"):
        find_landmark(name)


def test_spread_of_landmarks_is_that_of_markers():
    assert all(0.005 < landmark.spread <= 0.06 for landmark in load_landmarks().values())


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("{landmark: left knee}", r"markers\.A\.landmark: there is no landmark 'left knee'"),
        ("{landmark: sacrum, joint: Hips}", "either a landmark or a joint"),
        ("{joint: Hips, offset: [0, 0, 0]}", "needs a joint, an offset and a spread, or a landmark"),
    ],
)
def test_invalid_places_are_errors(tmp_path, place, message):
    path = tmp_path / "mine.yaml"
    path.write_text(f"name: mine\ntitle: Mine\nskeleton: cmu31\nmarkers:\n  A: {place}\n", encoding="utf-8")
    with pytest.raises(SceneError, match=message):
        load_marker_set(path)


def test_landmark_of_a_studio_set_takes_its_own_spread(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(
        "name: mine\ntitle: Mine\nskeleton: cmu31\npoint_sd: 0.02\n"
        "markers:\n  A: {landmark: right heel, spread: 0.04}\n  B: {landmark: sacrum}\n",
        encoding="utf-8",
    )
    marker_set = load_marker_set(path)
    np.testing.assert_array_equal(marker_set.marker_spread, [0.04, find_landmark("sacrum").spread])
    assert marker_set.point_sd == 0.02


@pytest.mark.parametrize(("detector_name", "set_name"), [("openpose", "body25"), ("coco", "coco17")])
def test_keypoints_in_images_and_in_space_have_the_same_places(detector_name, set_name):
    detector = load_detector(detector_name, load_cmu31_body().skeleton)
    marker_set = load_marker_set(set_name)
    assert set(detector.labels) == set(marker_set.labels)
    for label, joint, offset in zip(detector.labels, detector.joints, detector.offsets, strict=True):
        k = marker_set.labels.index(label)
        assert marker_set.joints[k] == joint, label
        np.testing.assert_array_equal(marker_set.marker_offsets[k], offset, label)
