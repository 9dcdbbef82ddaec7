"""What a technician meets who runs a scene."""

import json

import pytest

from mocapfix.keypoints import example


def test_a_scene_is_run_into_a_folder_of_its_name_and_told_in_a_line(mocapfix, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said, _, _ = example.film("coco", 0.3, 10.0)
    (tmp_path / "film.json").write_text(json.dumps(said), encoding="utf-8")
    (tmp_path / "mine.yaml").write_text("kind: keypoints-2d\ntitle: Mine\nkeypoints: film.json\nprior: pca\n")
    status, out, _ = mocapfix("run", "mine.yaml")
    assert status == 0
    assert "Mine: 3 frames" in out
    assert "pixels per metre" in out
    assert {path.suffix for path in (tmp_path / "mine.mocapfix").iterdir()} == {".bvh", ".html", ".json", ".rrd"}
    status, _, err = mocapfix("run", "mine.yaml")
    assert (status, "is there already; give --overwrite" in " ".join(err.split())) == (1, True)


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        ("kind: opera\n", "kind: must be one of keypoints-2d, not 'opera'"),
        ("kind: [a]\n", "not ['a']"),
        ("title: a\n", "not None"),
        (None, "cannot be read"),
    ],
)
def test_a_scene_that_is_none_is_told(mocapfix, tmp_path, scene, message):
    if scene:
        (tmp_path / "mine.yaml").write_text(scene)
    status, _, err = mocapfix("run", tmp_path / "mine.yaml")
    assert (status, message in " ".join(err.split())) == (1, True)


def test_the_scenes_that_ship_are_told_where_there_is_none_of_a_name(mocapfix):
    status, _, err = mocapfix("run", "opera")
    assert status == 1
    assert "There is no scene named 'opera'; choose one of: keypoints-2d; or give a .yaml file." in " ".join(err.split())
