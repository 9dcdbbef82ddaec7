"""The page and the recording of a film of keypoints."""

import re
from dataclasses import replace

import numpy as np
import pytest

from mocapfix.report import keypoint_report
from mocapfix.skeleton import load_cmu31_body

FRAMES = 6
RECORD = {"order": "coco", "camera": {"pixels_per_metre": 123.4}, "reprojection_px": {"mean": 2.5, "p95": 6.0}}


@pytest.fixture
def shown() -> keypoint_report.KeypointFilm:
    rng = np.random.default_rng(0)
    joints = rng.normal(size=(FRAMES, 31, 3))
    confidence = np.full((FRAMES, 17), 0.5)
    confidence[:, 3] = 0.0
    images = 100 * joints[..., :2]
    pixels = rng.normal(0, 100, (FRAMES, 17, 2))
    return keypoint_report.KeypointFilm(
        "A <film>", 25.0, (640, 480), pixels, confidence, load_cmu31_body().skeleton, joints, images
    )


def test_the_page_shows_every_found_keypoint_of_some_moments_and_all_bones_twice(shown, tmp_path):
    keypoint_report.write_keypoint_page(tmp_path / "a.html", shown, RECORD)
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    pictures = re.findall(r"<svg.*?</svg>", text, re.S)
    assert len(pictures) == 2 * keypoint_report.KEYPOINT_FIGURE_COUNT
    assert [picture.count("<circle") for picture in pictures] == [16, 0] * keypoint_report.KEYPOINT_FIGURE_COUNT
    assert {picture.count("M") for picture in pictures} == {30}
    assert "123.4" in text
    assert "A &lt;film&gt;" in text
    assert not re.search(r"https?://|\bnan\b", text)


def test_both_views_of_a_moment_show_the_body_as_high(shown, tmp_path):
    keypoint_report.write_keypoint_page(tmp_path / "a.html", shown, RECORD)
    boxes = re.findall(r'viewBox="[\d.-]+ [\d.-]+ [\d.-]+ ([\d.-]+)"', (tmp_path / "a.html").read_text(encoding="utf-8"))
    assert boxes[::2] == boxes[1::2]


def test_a_film_of_one_frame_has_a_page(shown, tmp_path):
    first = {name: getattr(shown, name)[:1] for name in ("pixels", "confidence", "joints", "images")}
    one = replace(shown, image_size_px=None, **first)
    keypoint_report.write_keypoint_page(tmp_path / "a.html", one, RECORD)
    assert (tmp_path / "a.html").read_text(encoding="utf-8").count("<svg") == 2


def test_the_recording_is_a_file_that_rerun_knows(shown, tmp_path):
    keypoint_report.write_keypoint_recording(tmp_path / "a.rrd", shown)
    assert (tmp_path / "a.rrd").read_bytes()[:3] == b"RRF"
    assert not list(tmp_path.glob(".*"))
