"""An animation cleaned, from file to file: what is damaged is mended, and every other byte stays."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from mocapfix import write
from mocapfix.animated import clean_animation
from mocapfix.errors import SceneError, WriteError
from mocapfix.fill import FillOptions
from mocapfix.read import bvh
from mocapfix.synthetic import motions
from mocapfix.synthetic.truth import person
from mocapfix.write.patched import patched

RATE = 60.0
SPAN = slice(200, 224)


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    path, subject = tmp_path_factory.mktemp("sound") / "walk.bvh", person(np.random.default_rng(2), crooked=True)
    write.bvh(path, subject.skeleton, motions.compose(subject, 7.0, RATE), RATE)
    return path


@pytest.fixture(scope="module")
def flipped(sound, tmp_path_factory) -> Path:
    """-> the walk with a forearm turned over for a while."""
    read = bvh.animation(sound)
    joint = read.index("LeftForeArm")
    local = read.rotations()[SPAN, joint] @ Rotation.from_euler("X", 180, degrees=True).as_matrix()
    values = read.with_rotations(np.array([joint]), np.arange(200, 224), local[:, None])
    path = tmp_path_factory.mktemp("flipped") / "walk.bvh"
    patched(path, read, values)
    return path


def test_a_sound_animation_comes_back_byte_for_byte(sound, tmp_path):
    result = clean_animation(bvh.animation(sound))
    outputs = result.write(tmp_path)
    assert outputs["bvh"].read_bytes() == sound.read_bytes()
    assert result.changes == ()
    assert result.report["fill"]["mended"] == 0


def test_a_flip_is_undone_and_all_other_lines_stay(sound, flipped, tmp_path):
    result = clean_animation(bvh.animation(flipped))
    assert [(each.kind, each.markers, each.first, each.last) for each in result.changes] == [("flip", ("LeftForeArm",), 201, 224)]
    outputs = result.write(tmp_path)
    true, wrong, ours = (path.read_text().splitlines() for path in (sound, flipped, outputs["bvh"]))
    head = len(true) - bvh.animation(sound).frames
    same = [n for n, (a, b) in enumerate(zip(wrong, ours, strict=True)) if a == b]
    assert same == [*range(head + 200), *range(head + 224, len(true))]
    after, truth = bvh.animation(outputs["bvh"]).world()[0], bvh.animation(sound).world()[0]
    assert np.linalg.norm(after - truth, axis=-1).max() < 0.005
    report = json.loads(outputs["report.json"].read_text())
    assert [fault["kind"] for fault in report["faults"]] == ["flip"]
    assert report["fill"]["mended"] == 24
    assert result.take.deviation is not None
    unsure = result.take.deviation[:, result.before.index("LeftForeArm")]
    assert np.flatnonzero(unsure > 0).tolist() == list(range(200, 224))
    assert min(outputs[kind].stat().st_size for kind in ("report.html", "rrd")) > 1000


def test_what_is_decided_against_stays_as_it_was(flipped, tmp_path):
    first = clean_animation(bvh.animation(flipped)).write(tmp_path)
    said = yaml.safe_load(first["changes.yaml"].read_text())
    for decision in ("reject", "keep"):
        said["changes"][0]["decision"] = decision
        first["changes.yaml"].write_text(yaml.safe_dump(said))
        again = clean_animation(bvh.animation(flipped), decisions=first["changes.yaml"])
        assert (again.after.values == again.before.values).all()
        assert [change.decision for change in again.changes] == [decision]


def test_only_what_may_be_touched_is(flipped):
    read = bvh.animation(flipped)
    for options in (FillOptions(keep=("LeftForeArm",)), FillOptions(frames=(1, 150))):
        assert (clean_animation(read, options=options).after.values == read.values).all()
    assert (clean_animation(read, only=("pop",)).after.values == read.values).all()
    part = clean_animation(read, options=FillOptions(frames=(1, 210)))
    assert np.flatnonzero((part.after.values != read.values).any(1)).tolist() == list(range(200, 210))


def test_missing_numbers_are_filled(sound):
    read = bvh.animation(sound)
    values = read.values.copy()
    values[100:120, read.columns[read.index("RightArm")]] = np.nan
    result = clean_animation(replace(read, values=values))
    assert np.isfinite(result.after.values).all()
    true, found = (each.world()[0] for each in (read, result.after))
    assert np.linalg.norm(found - true, axis=-1).max() < 0.15
    assert result.report["fill"]["filled"] == 20


def test_wrong_wishes_are_refused_in_a_sentence(sound):
    with pytest.raises(SceneError, match="no kind of fault 'wobble'"):
        clean_animation(bvh.animation(sound), only=("wobble",))


def test_the_input_is_never_replaced(flipped):
    result = clean_animation(bvh.animation(flipped))
    before = flipped.read_bytes()
    with pytest.raises(WriteError, match="is the input itself"):
        result.write(flipped.parent, overwrite=True)
    assert flipped.read_bytes() == before
