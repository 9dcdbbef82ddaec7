"""3-D keypoints in JSON."""

import json

import numpy as np
import pytest

from mocapfix.errors import ReadError
from mocapfix.io.capture import read_take
from mocapfix.options import ReadOptions

LABELS = ["nose", "left_hip", "right_hip", "left_knee", "right_knee"]
POINTS = np.random.default_rng(0).normal(0, 0.3, (6, len(LABELS), 3)) + [0.0, 1.0, 0.0]


def write(tmp_path, content):
    path = tmp_path / "film.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


@pytest.mark.parametrize(("unit", "factor"), [("m", 1.0), ("mm", 1000.0), (None, 1.0), (None, 100000.0)])
@pytest.mark.parametrize("is_mapping", [False, True])
def test_labelled_points(tmp_path, unit, factor, is_mapping):
    frames = (POINTS * factor).tolist()
    frames[2][1] = None
    if is_mapping:
        frames = [dict(zip(LABELS, frame, strict=True)) for frame in frames]
        del frames[2]["left_hip"]
    content = {"rate": 60, "labels": LABELS, "frames": frames, **({"unit": unit} if unit else {})}
    take = read_take(write(tmp_path, content), ReadOptions(up_axis="Y"))
    assert (take.labels, take.rate) == (tuple(LABELS), 60.0)
    expected = POINTS * (factor if factor == 1.0 else factor / 1000)
    expected[2, 1] = np.nan
    np.testing.assert_allclose(take.markers, expected)
    assert any("no unit" in note for note in take.notes) == (unit is None)


def test_openpose_people(tmp_path):
    points = np.random.default_rng(1).normal(0, 1, (3, 25, 4))
    points[..., 3] = 0.9
    points[1, 4, 3] = 0.0
    hands = {"hand_right_keypoints_3d": [0.1] * 84}
    frames = [{"people": [hands | {"pose_keypoints_3d": frame.ravel().tolist()}]} for frame in points] + [{"people": []}]
    take = read_take(write(tmp_path, {"rate": 30, "unit": "m", "frames": frames}), ReadOptions(up_axis="Y"))
    assert take.labels[:3] == ("Nose", "Neck", "RShoulder")
    assert take.markers.shape == (4, 25, 3)
    np.testing.assert_allclose(take.markers[0], points[0, :, :3])
    assert np.isnan(take.markers[1, 4]).all()
    assert np.isnan(take.markers[3]).all()
    assert any("hands are not read" in note for note in take.notes)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"rate": 30,', "line 1: is not valid JSON"),
        ({"rate": 30}, "frames: must be a list of at least one frame"),
        ({"rate": 30, "frames": []}, "frames: must be a list"),
        ({"frames": [[[0, 1, 2]]], "labels": ["a"]}, "rate: must be frames a second"),
        ({"rate": True, "frames": [[[0, 1, 2]]], "labels": ["a"]}, "rate: must be"),
        ({"rate": 30, "frames": [[[0, 1, 2]]], "labels": "a"}, "labels: must be a list of names"),
        ({"rate": 30, "frames": [[[0, 1, 2]]], "labels": ["a"], "unit": "px"}, "unit: .* give it with --unit, one of mm, cm, m"),
        ({"rate": 30, "frames": [[[0, 1, 2]], []], "labels": ["a"]}, r"frames\.1: must have 1 points"),
        ({"rate": 30, "frames": [[[0, 1]]], "labels": ["a"]}, r"frames\.0: each point must be null or three numbers"),
        ({"rate": 30, "frames": [{"b": [0, 1, 2]}], "labels": ["a"]}, r"frames\.0: b: is not among the labels"),
        (
            {"rate": 30, "frames": [{"people": [{"pose_keypoints_2d": [1, 2, 3]}]}]},
            r"frames\.0: people\.0\.pose_keypoints_3d: must",
        ),
        ({"rate": 30, "frames": [{"people": [{"pose_keypoints_3d": [1, 2, 3, 1]}]}]}, "has 1 points, not 25"),
        ({"rate": 30, "frames": [3]}, r"frames\.0: must have people, or the file must have labels"),
    ],
)
def test_errors_name_the_place(tmp_path, content, message):
    with pytest.raises(ReadError, match=rf"film\.json.*{message}"):
        read_take(write(tmp_path, content))


@pytest.mark.parametrize("text", ['{"frames": ' + "[" * 50_000, '{"rate": ' + "9" * 5000 + "}", '{"a":' * 50_000])
def test_json_that_cannot_be_parsed_is_refused(tmp_path, text):
    with pytest.raises(ReadError, match="is not valid JSON"):
        read_take(write(tmp_path, text))


def test_unit_that_is_no_name_is_refused(tmp_path):
    with pytest.raises(ReadError, match=r"unit: .*--unit"):
        read_take(write(tmp_path, {"rate": 60, "labels": LABELS, "frames": POINTS.tolist(), "unit": ["m"]}))
