"""Learning a marker set: the initial guess, the choice of a subject, and cleaning with the learned set."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mocapfix import pipeline
from mocapfix.errors import TakeError
from mocapfix.io.capture import read_take
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.subject import learning
from mocapfix.subject.library import SubjectChoice, load_marker_set, write_marker_set
from mocapfix.synthetic import compose_take
from tests.captures import CAPTURES, needs_captures
from tests.conftest import build_c3d

CMU = load_marker_set("cmu41")
WHOLE = compose_take(seed=8, seconds=8.0, rate=25.0)
SKELETON = load_cmu31_body().skeleton
SIDES = {"L": "Left", "R": "Right"}
NAMES = {"KNE": "knee lat", "WRA": "wrist radius", "WRB": "wrist ulna", "HEE": "Ferse"}


def write_take(folder: Path, labels) -> Path:
    path = folder / "wave.c3d"
    path.write_bytes(build_c3d(WHOLE.damaged_positions, labels, rate=WHOLE.rate))
    return path


def rename_label(label: str) -> str:
    return f"{label[0]}_{NAMES[label[1:]]}" if label[1:] in NAMES else f"{label}x" if label[1:] in ("UPA", "MT5") else label


def rename_with_words(label: str) -> str:
    return rename_label(label).replace("FWT", "ASIS").replace("BWT", "PSIS").replace("TOE", "Zeh").replace("SHO", "Schulter")


def test_learned_set_cleans_the_take(tmp_path):
    labels = [f"Ann:{rename_label(label)}" for label in WHOLE.labels]
    path = write_take(tmp_path, labels)
    learned = learning.learn_marker_set(path, "ann", like="cmu41")
    names, marker_set = load_cmu31_body().skeleton.names, learned.marker_set
    expected = {rename_label(label): names[j] for label, j in zip(WHOLE.labels, WHOLE.subject.joints, strict=True)}
    found = {label: names[j] for label, j in zip(marker_set.labels, marker_set.joints, strict=True)}
    assert list(found) == list(expected)
    # A wrist marker is next to the joint between forearm and hand: the motion of a short take may attach it to either.
    wrong = {label: (found[label], expected[label]) for label in found if found[label] != expected[label]}
    assert all("wrist" in label and joints == (f"{SIDES[label[0]]}Hand", f"{SIDES[label[0]]}ForeArm")
               for label, joints in wrong.items())  # fmt: skip
    assert len(wrong) <= 1
    assert (marker_set.name, learned.excluded_markers) == ("ann", {})
    assert learned.guess_description.startswith("CMU 41: 29 of its 41 markers were found")
    assert learned.guess_description.endswith(" The segments of the others are learned from their motion.")
    known = marker_set.labels.index("C7"), CMU.labels.index("C7")
    np.testing.assert_array_equal(marker_set.marker_offsets[known[0]], CMU.marker_offsets[known[1]])  # known offsets are kept
    write_marker_set(tmp_path / "ann.yaml", marker_set, learned.file_comment)
    result = pipeline.clean(path, marker_set=tmp_path / "ann.yaml")
    shipped = pipeline.clean(write_take(tmp_path, WHOLE.labels))
    missing = WHOLE.missing_mask & result.take.visible & shipped.take.visible
    error, reference = (
        np.linalg.norm(each.take.markers - WHOLE.marker_positions, axis=-1)[missing] for each in (result, shipped)
    )
    assert np.sqrt((error**2).mean()) < 1.25 * np.sqrt((reference**2).mean()) + 0.001


def test_set_with_too_few_markers_cannot_start_learning(tmp_path):
    path = write_take(tmp_path, WHOLE.labels)
    with pytest.raises(TakeError, match=r"wave\.c3d: qualisys-sports cannot be used to learn a marker set: only 0 of its "):
        learning.learn_marker_set(path, "mine", like="qualisys-sports")


@pytest.mark.parametrize(
    ("labels", "description"),
    [
        (WHOLE.labels, "CMU 41: 41 of its 41 markers were found."),
        ([rename_with_words(label) for label in WHOLE.labels], "39 markers were located by words in their labels"),
    ],
    ids=["a known set", "words"],
)
def test_most_certain_guess_is_used(labels, description):
    guess = learning.guess_marker_set(Take(WHOLE.damaged_positions, tuple(labels), WHOLE.rate), tuple(labels))
    assert guess.description.startswith(description)
    assert len(guess.marker_set.labels) > 30
    assert set(guess.marker_set.labels) <= set(labels)


def test_unknown_labels_need_many_markers():
    labels = tuple(f"P{m}" for m in range(15))
    with pytest.raises(TakeError, match="shows fewer than 20 markers at once"):
        learning.guess_marker_set(Take(WHOLE.damaged_positions[:, :15], labels, WHOLE.rate), labels)


def test_subject_with_the_most_markers_is_selected():
    labels = ("Ann:A", "Ann:B", "Ann:A", "Bob:A", "extra")
    selected = learning.select_subject_markers(Take(np.zeros((3, 5, 3)), labels, 100.0))
    assert (selected.labels, selected.take.markers.shape) == (("A", "B", "extra"), (3, 3, 3))
    excluded = {"Ann:A": "has the same label as another marker", "Bob:A": "belongs to Bob, not to Ann"}
    assert selected.excluded_markers == excluded


@needs_captures
def test_unknown_labels_of_a_real_capture():
    learned = learning.learn_marker_set(CAPTURES / "c3d" / "Qualisys.c3d", "laboratory")
    names, marker_set = load_cmu31_body().skeleton.names, learned.marker_set
    joint_of_label = {label: names[j] for label, j in zip(marker_set.labels, marker_set.joints, strict=True)}
    expected = {"L_FLE": "LeftUpLeg", "R_FAL": "RightLeg", "R_FCC": "RightFoot", "L_HLE": "LeftArm", "R_RSP": "RightForeArm"}
    expected |= {"L_HM2": "LeftHand", "R_HDF": "Head", "SXS": "Spine1", "R_IPS": "Hips", "L_WAND2": "LeftLeg"}
    assert {label: joint_of_label[label] for label in expected} == expected
    assert (len(marker_set.labels), learned.mean_residual_m < 0.005) == (55, True)


@needs_captures
def test_clusters_with_numbers_as_labels_are_found_on_the_legs():
    take = read_take(CAPTURES / "c3d" / "dec_real.c3d")
    order = np.random.default_rng(0).permutation(len(take.labels))
    numbered = replace(take.select(order, take.visible[:, order]), labels=tuple(f"M{k}" for k in range(len(order))))
    learned = learning.learn_from_markers(learning.select_subject_markers(numbered), "own")
    segments = {"TH": "UpLeg", "SK": "Leg", "FT": "Foot", "PV": "Hips"}
    true_labels = [take.labels[column] for column in order]
    found = zip(learned.marker_set.labels, learned.marker_set.joints, strict=True)
    joint_of_label = {true_labels[int(label[1:])]: SKELETON.names[joint] for label, joint in found}
    expected = {label: segments[label[1:3]] for label in true_labels if label[1:3] in segments}
    sides = {label: SIDES[label[0]] if joint != "Hips" else "" for label, joint in expected.items()}
    assert joint_of_label == {label: sides[label] + joint for label, joint in expected.items()}
    assert learned.mean_residual_m < 0.005


def test_props_are_written_to_the_learned_set(tmp_path):
    box = WHOLE.joint_positions[:, [SKELETON.find_joint("RightHand")]]
    moved = box + 0.3 * np.sin(np.arange(len(box)) / 9)[:, None, None] + [[0, 0, 0], [0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3]]
    labels = [*map(rename_label, WHOLE.labels), *(f"Box{k}" for k in range(4))]
    path = tmp_path / "wave.c3d"
    path.write_bytes(build_c3d(np.concatenate([WHOLE.damaged_positions, moved], axis=1), labels, rate=WHOLE.rate))
    learned = learning.learn_marker_set(path, "ann", like="cmu41")
    assert learned.marker_set.props == {"Box": ("Box0", "Box1", "Box2", "Box3")}


def test_more_markers_than_one_body_has_are_no_set_of_their_own(monkeypatch):
    monkeypatch.setattr(learning, "learn_from_markers", lambda *arguments: pytest.fail("a set is learned"))
    count = learning.MAX_OWN_SET_MARKERS + 1
    markers = np.random.default_rng(0).normal(size=(4, count, 3))
    take = Take(markers, tuple(f"Q{n}A" for n in range(count)), 120.0)
    choice = learning.find_own_marker_set(take, SubjectChoice(None, None, ("No set fits.", "Other.")))
    assert choice.marker_set is None
    assert choice.notes == ("No set fits.", "401 markers with unknown labels are more than those of one body.", "Other.")
