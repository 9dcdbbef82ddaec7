"""Scene files of keypoints, and the files that running them writes."""

import json

import numpy as np
import pytest

from mocapfix.errors import ReadError, SceneError, TakeError, WriteError
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.keypoints import film_solver, keypoint_scene
from mocapfix.model.skeleton import load_cmu31_body
from tests.keypoints import example_film
from tests.keypoints.example_film import compose_example_film

TEXT = "kind: keypoints-2d\ntitle: <Mine>\nkeypoints: film.json\nprior: pca\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a scene of half a second."""
    folder = tmp_path_factory.mktemp("scene")
    film, _, _ = compose_example_film("coco", 0.5, 10.0)
    (folder / "film.json").write_text(json.dumps(film), encoding="utf-8")
    (folder / "mine.yaml").write_text(TEXT, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def result(folder):
    return keypoint_scene.run_keypoint_scene(folder / "mine.yaml")


def test_shipped_scene_is_valid_and_matches_the_example_film():
    path = find_shipped_folder("scenes") / "keypoints-2d.yaml"
    film = keypoint_scene.read_keypoint_scene(path)
    found = film_solver.read_keypoints(path.parent / film.keypoints, load_cmu31_body().skeleton)
    composed, _, _ = compose_example_film("openpose", 6.0, 30.0)
    people = [frame["people"][0]["pose_keypoints_2d"] for frame in composed["frames"]]
    points = np.array(people).reshape(180, 25, 3)
    np.testing.assert_allclose(found.position_px, points[..., :2], atol=0.11)  # rounding differs between processors
    assert (found.rate_hz, found.image_size_px) == (30.0, (example_film.IMAGE_WIDTH_PX, example_film.IMAGE_HEIGHT_PX))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("title: <Mine>\n", "", r"mine\.yaml: title: is missing"),
        ("prior: pca", "prior: pca\nprior_scale: 0", r"mine\.yaml: prior_scale: .*greater than 0"),
        ("prior: pca", "prior: pca\nprior_scale: .inf", r"mine\.yaml: prior_scale: .*finite"),
        ("prior: pca", "prior: pca\nlooks_down: 95", r"mine\.yaml: looks_down: .*less than 90"),
        ("prior: pca", "prior: pca\ncamera: 3", r"mine\.yaml: camera: there is no such key"),
        ("kind: keypoints-2d", "kind: keypoints-3d", r"mine\.yaml: kind: "),
        ("prior: pca", "prior: oracle", r"no trained prior 'oracle'"),
    ],
)
def test_invalid_scene_error_names_file_and_key(folder, tmp_path, old, new, message):
    (tmp_path / "film.json").write_bytes((folder / "film.json").read_bytes())
    (tmp_path / "mine.yaml").write_text(TEXT.replace(old, new), encoding="utf-8")
    with pytest.raises(SceneError, match=message):
        keypoint_scene.run_keypoint_scene(tmp_path / "mine.yaml")


def test_film_without_rate_needs_the_scenes_rate(folder, tmp_path):
    film = json.loads((folder / "film.json").read_text(encoding="utf-8"))
    del film["rate"]
    (tmp_path / "film.json").write_text(json.dumps(film), encoding="utf-8")
    (tmp_path / "mine.yaml").write_text(TEXT, encoding="utf-8")
    with pytest.raises(SceneError, match=r"mine\.yaml: rate: give the frames per second of film\.json"):
        keypoint_scene.run_keypoint_scene(tmp_path / "mine.yaml")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda points: points * [1, 1, 0.05], "No frame has 4 keypoints with a confidence of 0.1 or more"),
        (lambda points: points * [0, 0, 1], "The keypoints do not determine the size of a body"),
        (lambda points: points * [1, -1, 1], "The keypoints do not determine the size of a body"),
    ],
)
def test_keypoints_that_determine_no_body_are_refused(folder, tmp_path, damage, message):
    film = json.loads((folder / "film.json").read_text(encoding="utf-8"))
    for frame in film["frames"]:
        for person in frame["people"]:
            person["keypoints"] = damage(np.reshape(person["keypoints"], (-1, 3))).ravel().tolist()
    (tmp_path / "film.json").write_text(json.dumps(film), encoding="utf-8")
    (tmp_path / "mine.yaml").write_text(TEXT, encoding="utf-8")
    with pytest.raises(TakeError, match=message):
        keypoint_scene.run_keypoint_scene(tmp_path / "mine.yaml")


def test_missing_keypoints_file_is_refused(tmp_path):
    (tmp_path / "mine.yaml").write_text(TEXT, encoding="utf-8")
    with pytest.raises(ReadError, match=r"film\.json: cannot be read"):
        keypoint_scene.run_keypoint_scene(tmp_path / "mine.yaml")


def test_result_writes_motion_page_report_and_recording(result, tmp_path):
    outputs = result.write(tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(f"mine.{kind}" for kind in outputs)
    assert "Frames: 5" in outputs["bvh"].read_text(encoding="ascii")
    page = outputs["report.html"].read_text(encoding="utf-8")
    assert "&lt;Mine&gt;" in page
    assert "<Mine>" not in page
    report = json.loads(outputs["report.json"].read_text(encoding="utf-8"))
    assert report["camera"]["pixels_per_metre"] == round(result.camera.scale, 3)
    assert sum(report["status"].values()) == report["frames"] == 5
    assert outputs["rrd"].stat().st_size > 1000
    with pytest.raises(WriteError, match=r"mine\.bvh: already exists"):
        result.write(tmp_path / "out")
    result.write(tmp_path / "out", overwrite=True)


def test_report_contains_reprojection_errors(result):
    pixels, is_found = result.keypoints.position_px, result.keypoints.confidence > 0
    assert np.isnan(result.reprojection_error_px[~is_found]).all()
    images = result.camera.project(result.joint_positions)
    wrist, elbow = (result.keypoints.detector.labels.index(f"left_{name}") for name in ("wrist", "elbow"))
    joint = result.skeleton.find_joint("LeftForeArm")
    distance = np.linalg.norm(images[:, joint] - pixels[:, elbow], axis=-1)  # whose folder is the joint itself
    np.testing.assert_allclose(result.reprojection_error_px[is_found[:, elbow], elbow], distance[is_found[:, elbow]])
    assert result.report["reprojection_px"]["by_keypoint"]["left_wrist"] == round(
        float(np.nanmean(result.reprojection_error_px[:, wrist])), 2
    )
