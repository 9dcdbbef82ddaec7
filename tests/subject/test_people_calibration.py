"""People calibrated from a list of takes."""

from pathlib import Path

import numpy as np
import pytest

from mocapfix.errors import TakeError
from mocapfix.options import CleanOptions
from mocapfix.subject.people import calibrate_one_person, calibrate_people, name_takes
from mocapfix.synthetic import compose_take
from tests.conftest import build_c3d

PEOPLE = {name: compose_take(seed=seed, seconds=2.0, rate=60.0) for seed, name in enumerate(("Jim", "Ann"))}
DISTANCE_M = np.array([2.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def takes(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two takes of both people, the second in the opposite order of labels and without the first quarter."""
    folder = tmp_path_factory.mktemp("takes")
    paths = [folder / "both.c3d", folder / "again.c3d"]
    for path, names, first in zip(paths, (("Jim", "Ann"), ("Ann", "Jim")), (0, 30), strict=True):
        positions = [PEOPLE[name].damaged_positions[first:] + number * DISTANCE_M for number, name in enumerate(names)]
        labels = [f"{name}:{label}" for name in names for label in PEOPLE[name].labels]
        path.write_bytes(build_c3d(np.concatenate(positions, axis=1), labels, rate=60.0))
    return paths


def test_each_person_of_several_takes_is_calibrated(takes: list[Path]) -> None:
    people = calibrate_people(takes, CleanOptions(), "mean-pose")
    assert {person.name: person.calibration.takes for person in people} == {
        "Jim": ("both.c3d", "again.c3d"),
        "Ann": ("both.c3d", "again.c3d"),
    }
    for person in people:
        truth = PEOPLE[person.name].subject.skeleton
        other = PEOPLE["Ann" if person.name == "Jim" else "Jim"].subject.skeleton
        found = person.calibration.subject.skeleton.total_length_m
        assert abs(found - truth.total_length_m) < abs(found - other.total_length_m)
        assert not person.describe()


def test_one_person_of_several_needs_a_name(takes: list[Path]) -> None:
    with pytest.raises(TakeError, match=r"both\.c3d: shows Jim and Ann; name the subject .* --subject-prefix"):
        calibrate_one_person(takes, CleanOptions(), "mean-pose")
    (person,) = calibrate_one_person(takes, CleanOptions().change(subject_prefix="Jim"), "mean-pose")
    assert person.calibration.takes == ("both.c3d", "again.c3d")


def test_takes_are_named_relative_to_their_common_folder(tmp_path: Path) -> None:
    assert name_takes([tmp_path / "a" / "x.c3d", tmp_path / "b" / "x.c3d"]) == ["a/x.c3d", "b/x.c3d"]
    assert name_takes([tmp_path / "a" / "x.c3d"]) == ["x.c3d"]
