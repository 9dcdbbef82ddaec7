from dataclasses import replace

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mocapfix.errors import SceneError, WriteError
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.subject import library
from mocapfix.subject.library import load_marker_set as load_marker_set

NOMINAL = load_marker_set("cmu41")
SUBJECT = Subject(
    load_cmu31_body().skeleton,
    "cmu41",
    NOMINAL.labels,
    NOMINAL.joints,
    NOMINAL.marker_offsets,
    NOMINAL.marker_spread,
    frame_count=120,
)
metres = st.floats(-2, 2)


@given(
    offsets=arrays(float, (31, 3), elements=metres),
    places=arrays(float, (41, 3), elements=metres),
    spread=arrays(float, 41, elements=st.floats(0, 0.1)),
    frames=st.integers(0, 10_000),
    joint_sd=arrays(float, 31, elements=st.floats(0, 0.1)),
    marker_sd=arrays(float, 41, elements=st.floats(0, 0.1)),
)
def test_round_trip(tmp_path_factory, offsets, places, spread, frames, joint_sd, marker_sd):
    average = load_cmu31_body().skeleton
    skeleton = Skeleton(average.names, average.parents, offsets, average.ends * 1.0123456)
    path = tmp_path_factory.getbasetemp() / "one.subject.yaml"
    marker_fields = ("cmu41", NOMINAL.labels, NOMINAL.joints, places, spread)
    library.write_subject(path, Subject(skeleton, *marker_fields, frames, joint_sd, marker_sd))
    back = library.read_subject(path)
    assert (back.skeleton.names, back.marker_set, back.labels, back.frame_count) == (
        average.names,
        "cmu41",
        NOMINAL.labels,
        frames,
    )
    np.testing.assert_array_equal(back.skeleton.parents, average.parents)
    np.testing.assert_array_equal(back.joints, NOMINAL.joints)
    for read_back, expected in (
        (back.skeleton.offsets, offsets),
        (back.skeleton.ends, skeleton.ends),
        (back.marker_offsets, places),
        (back.marker_spread, spread),
        (back.joint_sd, joint_sd),
        (back.marker_sd, marker_sd),
    ):
        np.testing.assert_allclose(read_back, expected, rtol=0, atol=1e-6)


def test_file_is_readable(tmp_path):
    path = tmp_path / "one.subject.yaml"
    library.write_subject(path, SUBJECT)
    lines = path.read_text(encoding="utf-8").splitlines()
    assert lines[0].startswith("# A subject of mocapfix")
    assert "metres" in lines[0]
    assert "  LeftLeg: {parent: LeftUpLeg, offset: [0.143, -0.3929, 0.0], sd: 0.0}" in lines
    assert "  LFHD: {joint: Head, place: [0.078, 0.164, 0.073], spread: 0.013, sd: 0.0}" in lines


def test_labels_that_look_like_yaml_values_round_trip(tmp_path):
    path = tmp_path / "one.subject.yaml"
    odd = ("No", "a: b", "12", "#7", "Möve")
    one = np.zeros(5, int)
    library.write_subject(path, Subject(load_cmu31_body().skeleton, "mine", odd, one, np.zeros((5, 3)), np.ones(5)))
    assert library.read_subject(path).labels == odd


def test_bone_order_is_irrelevant(tmp_path):
    path = tmp_path / "one.subject.yaml"
    library.write_subject(path, SUBJECT)
    data = yaml.safe_load(path.read_text(encoding="utf-8"))
    data["bones"] = dict(sorted(data["bones"].items()))
    path.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    np.testing.assert_array_equal(library.read_subject(path).skeleton.offsets, SUBJECT.skeleton.offsets)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("  Head: {parent: Neck1", "  Head: {parent: Neck", r"bones\.Head\.parent: must be Neck1, not Neck"),
        ("  Head: {parent", "  Skull: {parent", r"bones\.Skull: the skeleton has no such bone"),
        ("  Hips: {parent: null, offset: [0.0, 0.0, 0.0], sd: 0.0}\n", "", r"bones\.Hips: is missing"),
        (", end: [0.0, 0.1017, -0.0073]", "", r"bones\.Head\.end: is missing"),
        ("0.3929, 0.0], ", "0.3929, 0.0], end: [0, 0, 1], ", r"bones\.LeftLeg\.end: only the last bone"),
        ("[0.143, -0.3929, 0.0]", "[0.143, high, 0.0]", r"bones\.LeftLeg\.offset\.1: "),
        ("LFHD: {joint: Head", "LFHD: {joint: Skull", r"markers\.LFHD\.joint: there is no joint 'Skull'"),
        ("[0.078, 0.164, 0.073]", "[0.078, .inf, 0.073]", r"markers\.LFHD\.place\.1: "),
        ("0.3929, 0.0], sd: 0.0", "0.3929, 0.0], sd: -0.1", r"bones\.LeftLeg\.sd: Input should be greater than or equal to 0"),
        (", spread: 0.013, sd: 0.0}", ", spread: 0.013}", r"markers\.LFHD\.sd: is missing"),
        ("frames: 120", "frames: -1", "frames: "),
        ("marker_set: cmu41\n", "", "marker_set: "),
    ],
)
def test_invalid_file_names_the_key(tmp_path, old, new, message):
    path = tmp_path / "one.subject.yaml"
    library.write_subject(path, SUBJECT)
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(SceneError, match=rf"one\.subject\.yaml: {message}"):
        library.read_subject(path)


def test_missing_file_or_folder_is_reported(tmp_path):
    with pytest.raises(SceneError, match=r"nobody\.yaml.*No such file"):
        library.read_subject(tmp_path / "nobody.yaml")
    with pytest.raises(WriteError, match=r"nobody\.yaml"):
        library.write_subject(tmp_path / "nowhere" / "nobody.yaml", SUBJECT)


def test_failed_write_keeps_the_old_file(tmp_path):
    path = tmp_path / "one.subject.yaml"
    library.write_subject(path, SUBJECT)
    before = path.read_bytes()
    with pytest.raises(ValueError, match="argument"):
        library.write_subject(path, replace(SUBJECT, labels=("LFHD",)))
    assert path.read_bytes() == before
