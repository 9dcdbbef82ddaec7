"""The command run: cleaning jobs and keypoint scenes."""

import json
from dataclasses import replace

import pytest

from mocapfix.io import shipped
from mocapfix.subject import library
from mocapfix.synthetic import compose_take, write_synthetic_take
from tests.keypoints.example_film import compose_example_film


def test_keypoint_scene_is_run_into_a_folder_of_its_name(mocapfix, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    keypoints, _, _ = compose_example_film("coco", 0.3, 10.0)
    (tmp_path / "film.json").write_text(json.dumps(keypoints), encoding="utf-8")
    (tmp_path / "mine.yaml").write_text("kind: keypoints-2d\ntitle: Mine\nkeypoints: film.json\nprior: pca\n", encoding="utf-8")
    status, out, _ = mocapfix("run", "mine.yaml")
    assert status == 0
    assert "Mine: 3 frames" in out
    assert "pixels per metre" in out
    assert {path.suffix for path in (tmp_path / "mine.mocapfix").iterdir()} == {".bvh", ".html", ".json", ".rrd"}
    status, _, err = mocapfix("run", "mine.yaml")
    assert (status, "already exists; give --overwrite" in " ".join(err.split())) == (1, True)


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        ("kind: opera\n", "kind: must be one of clean, keypoints-2d, not 'opera'"),
        ("kind: [a]\n", "not ['a']"),
        ("title: a\n", "not None"),
        (None, "cannot be read"),
    ],
)
def test_invalid_scene_is_an_error(mocapfix, tmp_path, scene, message):
    if scene:
        (tmp_path / "mine.yaml").write_text(scene, encoding="utf-8")
    status, _, err = mocapfix("run", tmp_path / "mine.yaml")
    assert (status, message in " ".join(err.split())) == (1, True)


def test_unknown_scene_lists_the_shipped_ones(mocapfix):
    status, _, err = mocapfix("run", "opera")
    assert status == 1
    choices = "choose one of: demo, keypoints-2d, session; or name a .yaml file."
    assert f"There is no scene named 'opera'; {choices}" in " ".join(err.split())


def test_shipped_demo_is_composed_and_cleaned(mocapfix, tmp_path):
    status, out, _ = mocapfix("run", "demo", "-o", tmp_path / "here")
    assert status == 0
    assert "A person walks, reaches, crouches and turns: 1 take." in out
    written = {path.name for path in (tmp_path / "here").iterdir()}
    assert {"composed", "walk.c3d", "walk.bvh", "walk.blender.bvh", "walk.glb", "walk.npz", "walk.report.html"} <= written
    assert json.loads((tmp_path / "here" / "walk.report.json").read_text(encoding="utf-8"))["take"]["marker_set"] == "cmu41"
    status, _, err = mocapfix("run", "demo", "-o", tmp_path / "here")
    assert (status, "already exists; give --overwrite" in " ".join(err.split())) == (1, True)


def test_shipped_session_calibrates_once_for_all_takes(mocapfix, tmp_path):
    scene = tmp_path / "session.yaml"
    scene.write_bytes((shipped.find_shipped_folder("scenes") / "session.yaml").read_bytes())
    for name, start in (("rom", 0), ("walk1", 120), ("walk2", 240), ("other", 0)):
        truth = compose_take(seed=1, seconds=3.0)
        some = slice(start, start + 120)
        cut = replace(
            truth,
            marker_positions=truth.marker_positions[some],
            damaged_positions=truth.damaged_positions[some],
            missing_mask=truth.missing_mask[some],
        )
        write_synthetic_take(tmp_path / f"{name}.c3d", cut)
    status, out, err = mocapfix("run", scene, "-o", tmp_path / "out")
    assert (status, err) == (0, "")
    assert "Jim's session: 3 takes." in out
    subjects = [library.read_subject(tmp_path / "out" / f"{name}.subject.yaml") for name in ("rom", "walk1", "walk2")]
    assert len({each.skeleton.offsets.tobytes() for each in subjects}) == 1
    assert not (tmp_path / "out" / "other.c3d").exists()


def test_missing_take_does_not_stop_the_job(mocapfix, tmp_path, brief):
    (tmp_path / "there.c3d").write_bytes(brief.path.read_bytes())
    (tmp_path / "mine.yaml").write_text(
        f"kind: clean\ntitle: Mine\ntakes: [gone.c3d, there.c3d]\nsubject: {brief.subject}\nvolume: {{floor: 0.5}}\n",
        encoding="utf-8",
    )
    status, out, err = mocapfix("run", tmp_path / "mine.yaml", "-o", tmp_path / "out")
    assert status == 1
    assert "gone.c3d: there is no such file" in " ".join(err.split())
    assert "Motion files are 0.5 m lower" in " ".join(out.split())
