"""Props in takes and in marker sets."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.errors import SceneError
from mocapfix.model.take import Take
from mocapfix.subject.library import load_marker_set, write_marker_set
from mocapfix.subject.props import find_props

FRAMES = 200


def move(shape: np.ndarray, seed: int) -> np.ndarray:
    rng, time = np.random.default_rng(seed), np.linspace(0, 6, FRAMES)
    rotation = Rotation.from_rotvec(np.outer(np.sin(time), rng.normal(size=3)))
    return np.stack([rotation.apply(place) for place in shape], axis=1) + np.outer(np.cos(time), rng.normal(size=3))[:, None]


@pytest.fixture
def take() -> Take:
    """Return a take of a bat, a box whose labels are numbers, and three single markers."""
    rng = np.random.default_rng(0)
    groups = [move(rng.normal(0, 0.2, (count, 3)), seed) for seed, count in enumerate((3, 4, 1, 1, 1))]
    return Take(np.concatenate(groups, axis=1), ("Bat1", "Bat2", "Bat3", "M1", "M2", "M3", "M4", "A", "B", "C"), 100.0)


def test_groups_outside_the_body_are_named_by_their_labels(take):
    groups = find_props(take, np.zeros(10, bool), {})
    assert {group.name: [take.labels[m] for m in group.markers] for group in groups} == {
        "group 1": ["M1", "M2", "M3", "M4"],
        "Bat": ["Bat1", "Bat2", "Bat3"],
    }


def test_a_group_with_a_marker_of_the_body_is_no_prop(take):
    is_on_body = np.arange(10) == 1
    assert [group.name for group in find_props(take, is_on_body, {})] == ["group 1"]


def test_a_prop_of_the_set_need_not_move_but_must_be_rigid(take):
    at_rest = take.replace_markers(np.tile(take.markers[:1], (FRAMES, 1, 1)))
    assert find_props(at_rest, np.zeros(10, bool), {}) == ()
    assert [group.name for group in find_props(at_rest, np.zeros(10, bool), {"crate": ("m1", "M2", "M3")})] == ["crate"]
    assert "crate" not in [group.name for group in find_props(take, np.zeros(10, bool), {"crate": ("A", "B", "C")})]


def test_props_of_a_set_are_written_and_read(tmp_path: Path):
    path = tmp_path / "mine.yaml"
    write_marker_set(path, replace(load_marker_set("cmu41"), props={"Bat": ("Bat1", "Bat2", "Bat3")}))
    assert load_marker_set(path).props == {"Bat": ("Bat1", "Bat2", "Bat3")}


@pytest.mark.parametrize(
    ("labels", "message"),
    [(("LFHD", "B2", "B3"), "on more than one prop, or also on the body"), (("B1", "B2"), "fewer than 3 markers")],
)
def test_impossible_props_are_refused(tmp_path: Path, labels, message):
    path = tmp_path / "mine.yaml"
    write_marker_set(path, replace(load_marker_set("cmu41"), props={"Bat": labels}))
    with pytest.raises(SceneError, match=message):
        load_marker_set(path)
