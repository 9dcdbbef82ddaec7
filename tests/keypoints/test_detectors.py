from itertools import pairwise

import numpy as np
import pytest

from mocapfix.errors import SceneError
from mocapfix.keypoints import detectors
from mocapfix.skeleton import load_cmu31_body

BODY_25 = (
    "Nose", "Neck", "RShoulder", "RElbow", "RWrist", "LShoulder", "LElbow", "LWrist", "MidHip", "RHip", "RKnee", "RAnkle",
    "LHip", "LKnee", "LAnkle", "REye", "LEye", "REar", "LEar", "LBigToe", "LSmallToe", "LHeel", "RBigToe", "RSmallToe", "RHeel",
)  # fmt: skip
PAIRS = ("eye", "ear", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")


def load_on_rest_pose(name: str) -> tuple[detectors.KeypointDetector, np.ndarray]:
    """Return a detector and its points (V, 3) on the average body in its T-pose."""
    skeleton = load_cmu31_body().skeleton
    joints = np.zeros((31, 3))
    for j in range(1, 31):
        joints[j] = joints[skeleton.parents[j]] + skeleton.offsets[j]
    detector = detectors.load_detector(name, skeleton)
    return detector, joints[detector.joints] + detector.offsets


def test_points_are_in_the_detectors_order():
    skeleton = load_cmu31_body().skeleton
    assert detectors.load_detector("openpose", skeleton).labels == BODY_25
    sided = [f"{side}_{name}" for name in PAIRS for side in ("left", "right")]
    assert detectors.load_detector("coco", skeleton).labels == ("nose", *sided)


@pytest.mark.parametrize("name", ["openpose", "coco"])
def test_left_mirrors_right(name):
    detector, points = load_on_rest_pose(name)
    other = {"L": "R", "l": "r"}
    for label, point in zip(detector.labels, points, strict=True):
        twin = label.replace("left", "right") if name == "coco" else other.get(label[0], label[0]) + label[1:]
        if twin in detector.labels and twin != label:
            np.testing.assert_allclose(points[detector.labels.index(twin)], point * [-1, 1, 1], atol=1e-12)


def test_t_pose_points_are_anatomical():
    detector, points = load_on_rest_pose("openpose")
    at = dict(zip(detector.labels, points, strict=True))
    for above, below in pairwise(("LEye", "Nose", "Neck", "LShoulder", "LHip", "LKnee", "LAnkle", "LHeel")):
        assert at[above][1] > at[below][1]
    assert at["Nose"][2] > at["LEye"][2] > at["LEar"][2]  # it faces +Z
    assert at["LBigToe"][2] > at["LSmallToe"][2] > at["LHeel"][2]
    assert at["LWrist"][0] > at["LElbow"][0] > at["LShoulder"][0] > 0
    assert 0.24 < np.linalg.norm(at["LWrist"] - at["LElbow"]) < 0.29  # 0.146 of the stature (Winter)


def test_both_detectors_agree_on_shared_points():
    (coco, points), (openpose, others) = load_on_rest_pose("coco"), load_on_rest_pose("openpose")
    for label, twin in (("nose", "Nose"), ("left_wrist", "LWrist"), ("right_hip", "RHip"), ("right_ankle", "RAnkle")):
        np.testing.assert_array_equal(points[coco.labels.index(label)], others[openpose.labels.index(twin)])


def test_unknown_detector_error_lists_the_known_ones():
    with pytest.raises(SceneError, match=r"Unknown keypoint order 'mpii'; choose one of: coco, openpose"):
        detectors.load_detector("mpii", load_cmu31_body().skeleton)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("sd: 0.02}", "sd: -1}", "points.Nose.sd"),
        ("joint: Head", "joint: Snout", "points.Nose.joint: .*Snout"),
        ("key:", "keys:", "key"),
    ],
)
def test_invalid_detector_file_error_names_the_key(tmp_path, monkeypatch, old, new, message):
    text = (detectors.find_shipped_folder("scenes") / "keypoints" / "openpose.yaml").read_text(encoding="utf-8")
    (tmp_path / "keypoints").mkdir()
    (tmp_path / "keypoints" / "mine.yaml").write_text(text.replace(old, new), encoding="utf-8")
    monkeypatch.setattr(detectors, "find_shipped_folder", lambda _: tmp_path)
    with pytest.raises(SceneError, match=message):
        detectors.load_detector("mine", load_cmu31_body().skeleton)
