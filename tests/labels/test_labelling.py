"""Files of points without labels: which point gets which label, which gets none, what is said about it, and what is refused."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix import pipeline
from mocapfix.errors import TakeError
from mocapfix.io.c3d import write_c3d
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions, build_clean_options
from mocapfix.subject.library import load_marker_set
from mocapfix.synthetic import compose_motion, draw_subject, simulate_markers

RATE_HZ = 60.0
MIN_LABELLED_SHARE_OF_TWO = 0.85  # less is known of two people in two seconds than of one
OF_CMU41 = build_clean_options(marker_set="cmu41")


@dataclass(frozen=True)
class Person:
    """A person who walks: (T, M, 3) markers in metres, Y up, their labels, and the body."""

    markers: np.ndarray
    labels: tuple[str, ...]
    subject: Subject

    def select(self, labels: Sequence[str]) -> "Person":
        """Return the person with some of the markers."""
        return replace(self, markers=self.markers[:, [self.labels.index(label) for label in labels]], labels=tuple(labels))


def compose_person(seed: int, seconds: float = 2.0, marker_set: str = "cmu41", size: float = 1.0) -> Person:
    """Return a person with the markers of a set; `size` scales the body, and with it the places of the markers."""
    rng = np.random.default_rng(seed)
    subject = draw_subject(rng, asymmetric=True, marker_set_name=marker_set)
    skeleton = replace(subject.skeleton, offsets=size * subject.skeleton.offsets)
    subject = replace(subject, skeleton=skeleton, marker_offsets=size * subject.marker_offsets)
    motion = compose_motion(subject, seconds, RATE_HZ)
    return Person(simulate_markers(rng, subject, motion, RATE_HZ)[1], subject.labels, subject)


@pytest.fixture(scope="module")
def person() -> Person:
    return compose_person(5)


def write_points(folder: Path, points: np.ndarray, shuffled: bool = True) -> Path:
    """Write points (T, C, 3) without labels, in random columns."""
    order = np.random.default_rng(7).permutation(points.shape[1]) if shuffled else np.arange(points.shape[1])
    path = folder / "points.c3d"
    write_c3d(path, Take(points[:, order], tuple(f"*{column + 1}" for column in range(points.shape[1])), RATE_HZ))
    return path


def cut_trajectories(markers: np.ndarray, gap_frames: int) -> np.ndarray:
    """Return two columns for each marker: its trajectory before and after a gap, which is at any time of the take."""
    columns = np.repeat(markers, 2, axis=1)
    firsts = np.random.default_rng(1).integers(15, len(markers) - 15 - gap_frames, markers.shape[1])
    for m, first in enumerate(firsts):
        columns[first:, 2 * m] = columns[: first + gap_frames, 2 * m + 1] = np.nan
    return columns


def merge_parts(columns: np.ndarray) -> np.ndarray:
    """Return the markers whose parts `cut_trajectories` returned."""
    return np.where(np.isnan(columns[:, ::2]), columns[:, 1::2], columns[:, ::2])


def get_markers(take: Take, labels: Sequence[str]) -> np.ndarray:
    """Return (T, M, 3) the positions of labels that a take must have."""
    return take.markers[:, [take.labels.index(label) for label in labels]]


def check_labels(take: Take, person: Person) -> None:
    """Check that each label of a person, and no other, is where the person's marker is."""
    assert set(take.labels) == set(person.labels)
    np.testing.assert_allclose(get_markers(take, person.labels), person.markers, atol=1e-4)


def test_the_parts_of_a_trajectory_become_one_marker(person: Person, tmp_path: Path) -> None:
    parts = cut_trajectories(person.markers, gap_frames=6)
    labelled = pipeline.label(write_points(tmp_path, parts), OF_CMU41)
    check_labels(labelled, replace(person, markers=merge_parts(parts)))
    assert labelled.label_confidence is not None
    np.testing.assert_array_equal(np.isnan(labelled.label_confidence), ~labelled.visible)
    assert np.nanmin(labelled.label_confidence) > 0.95
    assert np.nanmax(labelled.label_confidence) <= 1.0
    assert labelled.notes[-1] == f"Labelled by mocapfix: {labelled.visible.sum()} samples of 41 markers."


def test_labels_do_not_depend_on_where_the_person_is_and_faces(person: Person, tmp_path: Path) -> None:
    turned = person.markers @ Rotation.from_euler("y", 2.4).as_matrix().T + [3.0, 0.0, -2.0]
    check_labels(pipeline.label(write_points(tmp_path, turned), OF_CMU41), replace(person, markers=turned))


@pytest.mark.parametrize("size", [0.6, 1.2], ids=["child", "tall"])
def test_people_of_any_size_are_labelled(size: float, tmp_path: Path) -> None:
    other = compose_person(11, size=size)
    check_labels(pipeline.label(write_points(tmp_path, other.markers), OF_CMU41), other)


@pytest.mark.parametrize("missing", [("LELB",), ("RANK", "STRN", "LFHD")], ids=["elbow", "three"])
def test_a_marker_that_is_missing_is_named_and_its_label_is_on_no_other_point(
    person: Person, missing: tuple[str, ...], tmp_path: Path
) -> None:
    rest = person.select([label for label in person.labels if label not in missing])
    labelled = pipeline.label(write_points(tmp_path, rest.markers), OF_CMU41)
    check_labels(labelled, rest)
    (note,) = [note for note in labelled.notes if note.startswith("Not found: ")]
    assert set(note.removeprefix("Not found: ").rstrip(".").split(", ")) == set(missing)


def test_points_that_are_no_markers_get_no_label_and_are_listed(person: Person, tmp_path: Path) -> None:
    """A reflection on the floor, one that accompanies the person for half a second, and a point that is seen once."""
    ghosts = np.full((len(person.markers), 3, 3), np.nan)
    ghosts[:, 0] = [0.8, 0.02, 0.4]
    ghosts[40:70, 1] = person.markers[40:70, person.labels.index("C7")] + [0.25, 0.3, 0.0]
    ghosts[90, 2] = person.markers[90, person.labels.index("LKNE")] + [0.0, 0.0, 0.5]
    path = write_points(tmp_path, np.concatenate([person.markers, ghosts], axis=1), shuffled=False)
    labelled = pipeline.label(path, OF_CMU41)
    np.testing.assert_allclose(get_markers(labelled, person.labels), person.markers, atol=1e-4)
    note = "Left without a label: *42 (frames 1-120), *43 (frames 41-70), *44 (frames 91-91)."
    assert note in labelled.notes


@pytest.fixture(scope="module")
def plug_in_gait() -> Person:
    return compose_person(3, 2.5, "plug-in-gait39")


@pytest.mark.parametrize("optional", [(), ("LKNM", "RKNM")], ids=["none", "knees"])
def test_only_optional_markers_that_are_there_get_their_labels(
    plug_in_gait: Person, optional: tuple[str, ...], tmp_path: Path
) -> None:
    shown = plug_in_gait.select([*load_marker_set("plug-in-gait39").required_labels, *optional])
    labelled = pipeline.label(write_points(tmp_path, shown.markers), build_clean_options(marker_set="plug-in-gait39"))
    check_labels(labelled, shown)
    assert not any(note.startswith("Not found") for note in labelled.notes)


def test_a_known_person_is_found_by_the_places_of_their_own_markers(tmp_path: Path) -> None:
    """The wrist's markers are exchanged on this person: the set would have each at the other's place."""
    other = compose_person(8)
    wrist = [other.labels.index(label) for label in ("LWRA", "LWRB")]
    markers = other.markers.copy()
    markers[:, wrist] = markers[:, wrist[::-1]]
    offsets = other.subject.marker_offsets.copy()
    offsets[wrist] = offsets[wrist[::-1]]
    exchanged = Person(markers, other.labels, replace(other.subject, marker_offsets=offsets))
    path = write_points(tmp_path, markers)
    check_labels(pipeline.label(path, build_clean_options(subject=exchanged.subject)), exchanged)
    check_labels(pipeline.label(path, OF_CMU41), other)


def place_points_at_random(frame_count: int) -> np.ndarray:
    """Return 41 points of a thing that does not move."""
    return np.random.default_rng(1).uniform(0.0, 1.5, (1, 41, 3)).repeat(frame_count, 0)


def test_a_named_set_is_refused_where_no_person_has_its_markers(tmp_path: Path) -> None:
    path = write_points(tmp_path, place_points_at_random(60))
    message = r"points\.c3d: no person with the markers of cmu41 was found in its 41 points; check the marker set, the unit"
    with pytest.raises(TakeError, match=message):
        pipeline.label(path, OF_CMU41)


def test_a_body_of_three_times_the_size_is_no_person(person: Person, tmp_path: Path) -> None:
    with pytest.raises(TakeError, match="check the marker set, the unit and the up axis"):
        pipeline.label(write_points(tmp_path, 3.0 * person.markers), OF_CMU41)


def check_two_people(labelled: Take, people: Sequence[Person]) -> None:
    """Check that each label is on its marker of one and the same person, and that few markers have none.

    Either person may be called the first.
    """
    names = [label.split(":") for label in labelled.labels]
    assert {name for name, _ in names} == {"P1", "P2"}
    assert len(names) >= MIN_LABELLED_SHARE_OF_TWO * sum(len(each.labels) for each in people)
    truth = [np.stack([each.markers[:, each.labels.index(label)] for _, label in names], axis=1) for each in people]
    is_first = np.array([name == "P1" for name, _ in names])[:, None]
    expected = [np.where(is_first, *order) for order in (truth, truth[::-1])]
    assert any(np.allclose(labelled.markers, each, atol=1e-4, equal_nan=True) for each in expected)


def test_two_people_side_by_side_are_two_subjects(person: Person, tmp_path: Path) -> None:
    other = compose_person(6)
    other = replace(other, markers=other.markers + [0.9, 0.0, 0.2])
    points = np.concatenate([person.markers, other.markers], axis=1)
    check_two_people(pipeline.label(write_points(tmp_path, points), OF_CMU41), (person, other))


def test_a_person_who_leaves_keeps_the_name_until_then(person: Person, tmp_path: Path) -> None:
    other = compose_person(6)
    left = other.markers + [1.2, 0.0, 0.0]
    left[70:] = np.nan
    points = np.concatenate([person.markers, left], axis=1)
    check_two_people(pipeline.label(write_points(tmp_path, points), OF_CMU41), (person, replace(other, markers=left)))


@pytest.fixture
def like(person: Person, tmp_path: Path) -> CleanOptions:
    """Return options that name a labelled take of the person, whose labels are of no known set."""
    path = tmp_path / "labelled.c3d"
    write_c3d(path, Take(person.markers, tuple(f"K{m}" for m in range(len(person.labels))), RATE_HZ))
    return build_clean_options(like=path)


def test_a_labelled_take_gives_its_labels_to_the_markers_that_are_there(like: CleanOptions, tmp_path: Path) -> None:
    """In the other take of the person a marker of the thigh has fallen off, and a reflection lies on the floor."""
    again = compose_person(5, seconds=3.0).markers[60:] @ Rotation.from_euler("y", -1.0).as_matrix().T
    kept = [m for m in range(again.shape[1]) if m != 20]
    reflection = np.tile([2.0, 0.01, 2.0], (len(again), 1, 1))
    path = write_points(tmp_path, np.concatenate([again[:, kept], reflection], axis=1), shuffled=False)
    labelled = pipeline.label(path, like)
    labels = [f"K{m}" for m in kept]
    np.testing.assert_allclose(get_markers(labelled, labels), again[:, kept], atol=1e-4)
    assert "K20" not in labelled.labels
    assert "Not found: K20." in labelled.notes
    assert any("No shipped marker set fits labelled.c3d" in note for note in labelled.notes)
    assert f"Left without a label: *41 (frames 1-{len(again)})." in labelled.notes


def test_a_labelled_take_of_something_else_is_refused(like: CleanOptions, tmp_path: Path) -> None:
    with pytest.raises(TakeError, match=r"only \d+ of the 41 markers of labelled\.c3d were found in its points"):
        pipeline.label(write_points(tmp_path, place_points_at_random(60)), like)


def test_without_a_set_the_parts_of_each_marker_are_joined_and_numbered(person: Person, tmp_path: Path) -> None:
    """The markers of the arms and the trunk are those of no set."""
    upper = person.select(person.labels[:22])
    labelled = pipeline.label(write_points(tmp_path, cut_trajectories(upper.markers, gap_frames=4)))
    names = [f"M{n:02d}" for n in range(1, 23)]
    assert set(labelled.labels) == set(names)
    assert labelled.notes[0].endswith("joined by how markers move together: M01 to M22.")
    joined = get_markers(labelled, names)
    distance = np.nanmax(np.linalg.norm(joined[:, :, None] - upper.markers[:, None], axis=-1), axis=0)
    assert (np.sort(distance.min(axis=1)) < 1e-4).all()
    assert sorted(distance.argmin(axis=1)) == list(range(22))
