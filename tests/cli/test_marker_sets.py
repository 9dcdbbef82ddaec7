"""The commands marker-set list, show and learn."""

import numpy as np
import pytest

from mocapfix.subject.library import load_marker_set, load_shipped_marker_sets
from mocapfix.synthetic import compose_take
from tests.conftest import build_c3d


def test_list_names_the_shipped_sets(mocapfix):
    status, out, _ = mocapfix("marker-set", "list")
    assert status == 0
    assert all(each.name in out for each in load_shipped_marker_sets())


def test_show_lists_markers_by_segment(mocapfix):
    status, out, _ = mocapfix("marker-set", "show", "plug-in-gait39")
    assert status == 0
    assert "Plug-in Gait full body 39, 49 markers" in out
    assert "LTIB, LANK, LMED" in out
    assert "RBAK (RBAC)" in " ".join(out.split())
    status, _, err = mocapfix("marker-set", "show", "nobody's")
    assert (status, "no such marker set" in err) == (1, True)


@pytest.fixture(scope="module")
def wave(tmp_path_factory):
    truth, path = compose_take(seed=9, seconds=5.0, rate=25.0), tmp_path_factory.mktemp("wave") / "wave.c3d"
    floor = truth.damaged_positions[:, :1] * 0 + [0.3, 0.01, 0.2]
    labels = [f"{label}!" if label in ("LUPA", "RSHN") else label for label in truth.labels]
    path.write_bytes(build_c3d(np.concatenate([truth.damaged_positions, floor], axis=1), [*labels, "Floor"], rate=truth.rate))
    return path


def test_learn_writes_a_set_and_does_not_overwrite(mocapfix, wave, tmp_path):
    path = tmp_path / "mine.yaml"
    status, out, _ = mocapfix("marker-set", "learn", wave, "-o", path)
    output = " ".join(out.split())
    assert status == 0
    assert "41 markers" in output
    assert "not included: Floor names an object" in output
    learned = load_marker_set(path)
    assert (learned.name, len(learned.labels), "Floor" in learned.labels) == ("mine", 41, False)
    assert {"LUPA!", "RSHN!"} <= set(learned.labels)
    text = path.read_text(encoding="utf-8")
    assert text.startswith("# Learned from wave.c3d. ")
    assert "# Not included: Floor names an object" in text
    status, _, err = mocapfix("marker-set", "learn", wave, "-o", path)
    assert (status, "already exists" in " ".join(err.split())) == (1, True)
    assert path.read_text(encoding="utf-8") == text


def test_missing_take_writes_nothing(mocapfix, tmp_path):
    status, _, err = mocapfix("marker-set", "learn", tmp_path / "gone.c3d", "-o", tmp_path / "mine.yaml")
    assert (status, "there is no such file" in " ".join(err.split())) == (1, True)
    assert list(tmp_path.iterdir()) == []
