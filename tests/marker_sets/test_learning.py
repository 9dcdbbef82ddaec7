"""Learning a set from a file: where the first guess comes from, whose markers they are, and cleaning with what was learnt."""

from pathlib import Path

import numpy as np
import pytest

from mocapfix import marker_sets, pipeline, synthetic
from mocapfix.errors import TakeError
from mocapfix.marker_sets import learning
from mocapfix.skeleton import load_cmu31_body
from mocapfix.take import Take
from tests.conftest import as_c3d

CAPTURES = Path(__file__).resolve().parents[3] / "shared" / "data" / "captures"
CMU = marker_sets.load_marker_set("cmu41")
WHOLE = synthetic.compose_take(seed=8, seconds=5.0, rate=25.0)
NAMES = {"KNE": "knee lat", "WRA": "wrist radius", "WRB": "wrist ulna", "HEE": "Ferse"}


def written(folder: Path, labels) -> Path:
    path = folder / "wave.c3d"
    path.write_bytes(as_c3d(WHOLE.damaged_positions, labels, rate=WHOLE.rate))
    return path


def renamed(label: str) -> str:
    return f"{label[0]}_{NAMES[label[1:]]}" if label[1:] in NAMES else f"{label}x" if label[1:] in ("UPA", "MT5") else label


def in_words(label: str) -> str:
    return renamed(label).replace("FWT", "ASIS").replace("BWT", "PSIS").replace("TOE", "Zeh").replace("SHO", "Schulter")


def test_a_take_in_words_is_learnt_and_cleaned_with_what_was_learnt(tmp_path):
    labels = [f"Ann:{renamed(label)}" for label in WHOLE.labels]
    path = written(tmp_path, labels)
    lesson = learning.learn_marker_set(path, "ann", like="cmu41")
    names, worn = load_cmu31_body().skeleton.names, lesson.marker_set
    rode = {renamed(label): names[j] for label, j in zip(WHOLE.labels, WHOLE.subject.joints, strict=True)}
    assert {label: names[j] for label, j in zip(worn.labels, worn.joints, strict=True)} == rode
    assert (worn.name, lesson.excluded_markers) == ("ann", {})
    assert lesson.guess_description.startswith("CMU 41: 29 of its 41 markers were found")
    assert lesson.guess_description.endswith(" The others are by how they move.")
    known = worn.labels.index("C7"), CMU.labels.index("C7")
    np.testing.assert_array_equal(worn.marker_offsets[known[0]], CMU.marker_offsets[known[1]])  # what is known stays
    marker_sets.write_marker_set(tmp_path / "ann.yaml", worn, lesson.file_comment)
    result = pipeline.clean(path, marker_set=tmp_path / "ann.yaml")
    shipped = pipeline.clean(written(tmp_path, WHOLE.labels))
    struck = WHOLE.missing_mask & result.take.visible & shipped.take.visible
    error, usual = (np.linalg.norm(each.take.markers - WHOLE.marker_positions, axis=-1)[struck] for each in (result, shipped))
    assert np.sqrt((error**2).mean()) < 1.25 * np.sqrt((usual**2).mean()) + 0.001


def test_a_set_that_is_no_beginning_is_told(tmp_path):
    path = written(tmp_path, WHOLE.labels)
    with pytest.raises(TakeError, match=r"wave\.c3d: qualisys-sports is no beginning: of its markers 0 are there; "):
        learning.learn_marker_set(path, "mine", like="qualisys-sports")


@pytest.mark.parametrize(
    ("labels", "begins"),
    [
        (WHOLE.labels, "CMU 41: 41 of its 41 markers were found."),
        ([in_words(label) for label in WHOLE.labels], "The labels of 39 markers told about where they are"),
    ],
    ids=["a known set", "words"],
)
def test_the_surest_beginning_is_taken(labels, begins):
    guess, _, how = learning.guess_marker_set(Take(WHOLE.damaged_positions, tuple(labels), WHOLE.rate), tuple(labels), None)
    assert how.startswith(begins)
    assert len(guess.labels) > 30
    assert set(guess.labels) <= set(labels)


def test_labels_that_tell_nothing_need_many_markers():
    labels = tuple(f"P{m}" for m in range(15))
    with pytest.raises(TakeError, match="shows fewer than 20 markers at once"):
        learning.guess_marker_set(Take(WHOLE.damaged_positions[:, :15], labels, WHOLE.rate), labels, None)


def test_the_subject_with_the_most_markers_is_learnt_of():
    labels = ("Ann:A", "Ann:B", "Ann:A", "Bob:A", "stick")
    take, names, others = learning.select_subject_markers(Take(np.zeros((3, 5, 3)), labels, 100.0))
    assert (names, take.markers.shape) == (("A", "B", "stick"), (3, 3, 3))
    assert others == {"Ann:A": "bears the same label as another", "Bob:A": "is Bob's, not Ann's"}


@pytest.mark.skipif(not CAPTURES.is_dir(), reason="no captures beside the repository")
def test_a_laboratory_of_its_own_labels_gets_a_set():
    lesson = learning.learn_marker_set(CAPTURES / "c3d" / "Qualisys.c3d", "laboratory")
    names, worn = load_cmu31_body().skeleton.names, lesson.marker_set
    rides = {label: names[j] for label, j in zip(worn.labels, worn.joints, strict=True)}
    wanted = {"L_FLE": "LeftUpLeg", "R_FAL": "RightLeg", "R_FCC": "RightFoot", "L_HLE": "LeftArm", "R_RSP": "RightForeArm"}
    wanted |= {"L_HM2": "LeftHand", "R_HDF": "Head", "SXS": "Spine1", "R_IPS": "Hips", "L_WAND2": "LeftLeg"}
    assert {label: rides[label] for label in wanted} == wanted
    assert (len(worn.labels), lesson.mean_residual_m < 0.005) == (55, True)
