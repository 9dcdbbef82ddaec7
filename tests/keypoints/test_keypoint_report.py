"""The HTML page and the recording of a motion fitted to keypoints."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mocapfix.keypoints.keypoint_scene import KEYPOINT_FIGURE_COUNT, KeypointFilm, write_keypoint_page, write_keypoint_recording
from mocapfix.model.skeleton import load_cmu31_body

FRAMES = 6
REPORT: Any = {"order": "coco", "camera": {"pixels_per_metre": 123.4}, "reprojection_px": {"mean": 2.5, "p95": 6.0}}


@pytest.fixture
def film() -> KeypointFilm:
    rng = np.random.default_rng(0)
    joint_position_world = rng.normal(size=(FRAMES, 31, 3))
    confidence = np.full((FRAMES, 17), 0.5)
    confidence[:, 3] = 0.0
    joint_px = 100 * joint_position_world[..., :2]
    keypoint_px = rng.normal(0, 100, (FRAMES, 17, 2))
    skeleton = load_cmu31_body().skeleton
    return KeypointFilm(
        title="A <film>",
        rate_hz=25.0,
        image_size_px=(640.0, 480.0),
        keypoint_px=keypoint_px,
        confidence=confidence,
        skeleton=skeleton,
        joint_position_world=joint_position_world,
        joint_px=joint_px,
    )


def test_the_page_shows_all_found_keypoints_and_all_bones_in_two_views(film, tmp_path):
    write_keypoint_page(tmp_path / "a.html", film, REPORT)
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    figures = re.findall(r"<svg.*?</svg>", text, re.DOTALL)
    assert len(figures) == 2 * KEYPOINT_FIGURE_COUNT
    assert [figure.count("<circle") for figure in figures] == [16, 0] * KEYPOINT_FIGURE_COUNT
    assert {figure.count("M") for figure in figures} == {30}
    assert "123.4" in text
    assert "A &lt;film&gt;" in text
    assert not re.search(r"https?://|\bnan\b", text)


def test_both_views_of_a_frame_have_the_same_height(film, tmp_path):
    write_keypoint_page(tmp_path / "a.html", film, REPORT)
    heights = re.findall(r'viewBox="[\d.-]+ [\d.-]+ [\d.-]+ ([\d.-]+)"', (tmp_path / "a.html").read_text(encoding="utf-8"))
    assert heights[::2] == heights[1::2]


def test_a_film_of_one_frame_has_a_page(film, tmp_path):
    first = {name: getattr(film, name)[:1] for name in ("keypoint_px", "confidence", "joint_position_world", "joint_px")}
    write_keypoint_page(tmp_path / "a.html", replace(film, image_size_px=None, **first), REPORT)
    assert (tmp_path / "a.html").read_text(encoding="utf-8").count("<svg") == 2


def test_the_recording_is_a_rerun_file(film, tmp_path):
    write_keypoint_recording(tmp_path / "a.rrd", film)
    assert (tmp_path / "a.rrd").read_bytes()[:3] == b"RRF"
    assert not list(tmp_path.glob(".*"))
