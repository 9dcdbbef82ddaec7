"""The keypoints of the shipped detectors, and reading the files that detectors write."""

import json
from itertools import pairwise

import numpy as np
import pytest

from mocapfix.errors import ReadError, SceneError
from mocapfix.keypoints import film_solver
from mocapfix.model.skeleton import load_cmu31_body

SKELETON = load_cmu31_body().skeleton


def person(x: float, confidence: float = 0.9, points: int = 25, key: str = "pose_keypoints_2d") -> dict:
    """Return a person with all points at (x, 2 x)."""
    return {key: [x, 2 * x, confidence] * points}


def film(*frames: list[dict], **more) -> dict:
    return {"order": "openpose", "rate": 25, "image": [640, 480], **more, "frames": [{"people": people} for people in frames]}


def write_json(path, content):
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


def test_film_file_is_read(tmp_path):
    found = film_solver.read_keypoints(write_json(tmp_path / "a.json", film([person(3.0)], [person(4.0)])), SKELETON)
    assert (found.frame_count, found.rate_hz, found.image_size_px, found.detector.name) == (2, 25, (640, 480), "openpose")
    np.testing.assert_array_equal(found.position_px[1], [[4.0, 8.0]] * 25)
    np.testing.assert_array_equal(found.confidence, np.full((2, 25), 0.9))


def test_coco_people_have_seventeen_points_under_their_key(tmp_path):
    content = film([person(3.0, points=17, key="keypoints")], order="coco", rate=None, image=None)
    found = film_solver.read_keypoints(write_json(tmp_path / "a.json", content), SKELETON)
    assert (found.position_px.shape, found.rate_hz, found.image_size_px) == ((1, 17, 2), None, None)


def test_openpose_folder_is_read_in_order_of_names(tmp_path):
    for name, x in (("b_000002_keypoints.json", 2.0), ("b_000001_keypoints.json", 1.0)):
        write_json(tmp_path / name, {"version": 1.3, "people": [{**person(x), "face_keypoints_2d": []}]})
    found = film_solver.read_keypoints(tmp_path, SKELETON)
    np.testing.assert_array_equal(found.position_px[:, 0, 0], [1.0, 2.0])
    one = film_solver.read_keypoints(tmp_path / "b_000002_keypoints.json", SKELETON)
    assert (one.frame_count, one.rate_hz) == (1, None)
    np.testing.assert_array_equal(one.position_px[0, 0], [2.0, 4.0])


def test_a_note_says_that_hands_are_not_read(tmp_path):
    hands = {"hand_left_keypoints_2d": [1.0, 2.0, 0.5] * 21}
    assert film_solver.read_keypoints(write_json(tmp_path / "a.json", film([person(3.0)])), SKELETON).notes == []
    [note] = film_solver.read_keypoints(write_json(tmp_path / "b.json", film([person(3.0) | hands])), SKELETON).notes
    assert "hands are not read" in note


def test_one_person_is_tracked_among_several(tmp_path):
    frames = [[person(100.0, 0.3), person(10.0)], [person(11.0, 0.2), person(101.0)], [], [person(102.0), person(12.0)]]
    found = film_solver.read_keypoints(write_json(tmp_path / "a.json", film(*frames)), SKELETON)
    np.testing.assert_array_equal(found.position_px[:, 0, 0], [10.0, 11.0, 0.0, 12.0])
    np.testing.assert_array_equal(found.confidence[:, 0], [0.9, 0.2, 0.0, 0.9])


def test_tracking_continues_without_shared_points():
    last, other = np.zeros((25, 3)), np.zeros((25, 3))
    last[:5], other[5:] = 1.0, 2.0
    np.testing.assert_array_equal(film_solver.track_person([last[None], other[None]], 25)[1], other)


def test_confidence_is_clipped_to_one(tmp_path):
    found = film_solver.read_keypoints(write_json(tmp_path / "a.json", film([person(1.0, 1.3)])), SKELETON)
    assert found.confidence.max() == 1


def test_negative_confidence_is_clipped_to_zero(tmp_path):
    found = film_solver.read_keypoints(
        write_json(tmp_path / "a.json", film([person(1.0, 0.2)], [person(8.0, -1.0), person(2.0, 0.2)])), SKELETON
    )
    np.testing.assert_array_equal(found.position_px[:, 0, 0], [1.0, 2.0])
    np.testing.assert_array_equal(found.confidence[:, 0], [0.2, 0.2])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", r"bad\.json, line 1: is not valid JSON"),
        ("[]", r"bad\.json: contains neither frames nor people"),
        (film([person(1.0)], order="mpii"), r"bad\.json: order: .*'mpii'; choose one of: coco, openpose"),
        (film([person(1.0)], order=None), r"bad\.json: order: must be one of coco, openpose, not None"),
        (film([person(1.0)], rate=0), r"bad\.json: rate: must be frames a second, more than 0, not 0"),
        (film([person(1.0)], image=[640]), r"bad\.json: image: must be \[width, height\] in pixels, not \[640\]"),
        (film(), r"bad\.json: frames: must be a list of at least one frame"),
        (film([person(1.0)], [person(1.0, points=17)]), r"frames\.1: people\.0\.pose_keypoints_2d: .*25 points \(openpose\)"),
        (film([{"keypoints": []}]), r"frames\.0: people\.0\.pose_keypoints_2d: must contain"),
        (film([person(float("nan"))]), r"frames\.0: people: contains a number that is not finite"),
        ({"order": "openpose", "frames": [[]]}, r"frames\.0: people: must be a list"),
        (film([person(10**400)]), r"frames\.0: people\.0\.pose_keypoints_2d: must contain"),  # type: ignore[arg-type]
        (film([], []), r"bad\.json: no person was found in any frame"),
    ],
)
def test_errors_name_file_frame_and_key(tmp_path, content, message):
    with pytest.raises(ReadError, match=message):
        film_solver.read_keypoints(write_json(tmp_path / "bad.json", content), SKELETON)


def test_empty_folder_and_missing_file_are_refused(tmp_path):
    with pytest.raises(ReadError, match="contains no keypoints"):
        film_solver.read_keypoints(tmp_path, SKELETON)
    with pytest.raises(ReadError, match=r"gone\.json: cannot be read"):
        film_solver.read_keypoints(tmp_path / "gone.json", SKELETON)


BODY_25 = (
    "Nose", "Neck", "RShoulder", "RElbow", "RWrist", "LShoulder", "LElbow", "LWrist", "MidHip", "RHip", "RKnee", "RAnkle",
    "LHip", "LKnee", "LAnkle", "REye", "LEye", "REar", "LEar", "LBigToe", "LSmallToe", "LHeel", "RBigToe", "RSmallToe", "RHeel",
)  # fmt: skip
PAIRS = ("eye", "ear", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")


def load_on_rest_pose(name: str) -> tuple[film_solver.KeypointDetector, np.ndarray]:
    """Return a detector and its points (V, 3) on the average body in its T-pose."""
    skeleton = load_cmu31_body().skeleton
    joints = np.zeros((31, 3))
    for j in range(1, 31):
        joints[j] = joints[skeleton.parents[j]] + skeleton.offsets[j]
    detector = film_solver.load_detector(name, skeleton)
    return detector, joints[detector.joints] + detector.offsets


def test_points_are_in_the_detectors_order():
    skeleton = load_cmu31_body().skeleton
    assert film_solver.load_detector("openpose", skeleton).labels == BODY_25
    sided = [f"{side}_{name}" for name in PAIRS for side in ("left", "right")]
    assert film_solver.load_detector("coco", skeleton).labels == ("nose", *sided)


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
        film_solver.load_detector("mpii", load_cmu31_body().skeleton)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("sd: 0.02}", "sd: -1}", "points.Nose.sd"),
        ("joint: Head", "joint: Snout", "points.Nose.joint: .*Snout"),
        ("key:", "keys:", "key"),
    ],
)
def test_invalid_detector_file_error_names_the_key(tmp_path, monkeypatch, old, new, message):
    text = (film_solver.find_shipped_folder("scenes") / "keypoints" / "openpose.yaml").read_text(encoding="utf-8")
    (tmp_path / "keypoints").mkdir()
    (tmp_path / "keypoints" / "mine.yaml").write_text(text.replace(old, new), encoding="utf-8")
    monkeypatch.setattr(film_solver, "find_shipped_folder", lambda _: tmp_path)
    with pytest.raises(SceneError, match=message):
        film_solver.load_detector("mine", load_cmu31_body().skeleton)
