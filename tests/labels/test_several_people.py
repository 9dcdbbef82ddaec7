"""Two people without labels: both are found and labelled, and one person stays one."""

import numpy as np
import pytest

from mocapfix.lab.label_recovery import TwoPersonTake, UnlabelledKind, UnlabelledTake, place_two_people, remove_labels
from mocapfix.labels.labeller import assign_to_people, label_people, separate_people
from mocapfix.labels.tracklets import PointLabels, UnlabelledPoints, find_tracklets
from mocapfix.subject.library import load_marker_set
from mocapfix.synthetic import compose_take

RATE = 60.0
MARKER_SET = load_marker_set("cmu41")


@pytest.fixture(scope="module")
def people() -> TwoPersonTake:
    """The second person passes the first one, doing at another time what the first one does."""
    one, other = (compose_take(seed, 8.0, RATE, asymmetric=True) for seed in (5, 6))
    first, second = one.marker_positions[:-90], other.marker_positions[90:]
    return place_two_people(first, second, (one.labels, other.labels), 0.7, crossing=True)


def compute_f1(take: UnlabelledTake, people: TwoPersonTake, labels: PointLabels) -> float:
    """Return F1 of marker and person, whichever of both is called the first."""
    columns = [MARKER_SET.labels.index(label.split(":")[1]) for label in people.labels]
    marker, is_second = np.append(columns, -1)[take.marker_indices], take.marker_indices >= people.first_count
    is_marker, is_labelled = take.marker_indices >= 0, labels.marker_indices >= 0
    is_right = is_marker & (labels.marker_indices == marker)
    right = max((is_right & ((labels.subject_indices == 1) == (is_second ^ is_turned))).sum() for is_turned in (False, True))
    return 2 * right / (is_marker.sum() + is_labelled.sum())


@pytest.mark.parametrize("kind", ["ghosts", "cloud"])
def test_two_people_who_cross_are_labelled(people: TwoPersonTake, kind: UnlabelledKind) -> None:
    take = remove_labels(kind, people.markers, RATE, seed=1)
    labels = label_people(find_tracklets(take.points, RATE), MARKER_SET)
    assert compute_f1(take, people, labels) > 0.995


def test_one_person_with_ghosts_is_one_person(people: TwoPersonTake) -> None:
    take = remove_labels("ghosts", people.markers[:, : people.first_count], RATE, seed=2)
    assert not label_people(find_tracklets(take.points, RATE), MARKER_SET).subject_indices.size


def test_labels_of_several_people_have_their_names() -> None:
    alone = PointLabels(np.array([[1, 0]]), np.ones((1, 2)))
    assert separate_people(alone, ("A", "B")) == (alone, ("A", "B"))
    labels = PointLabels(np.array([[1, 0, -1, 1]]), np.ones((1, 4)), np.array([[1, 0, -1, 0]]))
    separated, names = separate_people(labels, ("A", "B"))
    assert names == ("P1:A", "P1:B", "P2:A", "P2:B")
    assert separated.marker_indices.tolist() == [[3, 0, -1, 1]]


def test_tracklets_without_a_label_belong_to_the_nearest_person() -> None:
    positions = np.zeros((4, 5, 3))
    positions[:, :, 0] = [0.0, 0.1, 0.3, 3.0, 3.1]
    points = UnlabelledPoints(positions, np.tile(np.arange(5), (4, 1)), RATE)
    masks = [np.tile([n == 0, n == 0, False, n == 1, False], (4, 1)) for n in range(2)]
    assert assign_to_people(points, masks)[0].tolist() == [0, 0, 0, 1, 1]
