"""The stages of the body fit: the choice of subject and marker set, and a marker that is moved during the take."""

from pathlib import Path

import numpy as np
import pytest

from mocapfix import pipeline
from mocapfix.errors import SceneError, TakeError
from mocapfix.io import capture
from mocapfix.model.body_fit import BodyFit
from mocapfix.model.detected import Detected
from mocapfix.model.faults import Faults, MarkerShift
from mocapfix.model.motion import Motion
from mocapfix.model.stage_timer import StageTimer
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions, SubjectOptions
from mocapfix.solve import kinematics
from mocapfix.subject import library
from mocapfix.subject.library import build_subject_marker_set, load_marker_set, resolve_subject

CMU41 = load_marker_set("cmu41")


def build_take(*labels: str) -> Take:
    return Take(np.zeros((2, len(labels), 3)), labels, 100.0)


def test_marker_set_is_chosen_by_labels():
    choice = resolve_subject(build_take(*(f"Jim:{label}" for label in CMU41.labels)), SubjectOptions())
    assert choice.subject is None
    assert choice.marker_set is not None
    assert (choice.marker_set.name, list(choice.notes)) == ("cmu41", [])


def test_notes_explain_why_no_set_fits():
    choice = resolve_subject(build_take("P1", "P2"), SubjectOptions())
    assert (choice.subject, choice.marker_set) == (None, None)
    reason, consequence = choice.notes
    assert reason.startswith("No marker set fits the labels P1, P2")
    assert consequence == "The take was cleaned without a skeleton: there is no BVH."


def test_subject_brings_its_own_marker_set(brief):
    subject = library.read_subject(brief.subject)
    for given in (subject, brief.subject, str(brief.subject)):
        choice = resolve_subject(build_take(*CMU41.labels), SubjectOptions(subject=given))
        assert choice.subject is not None
        assert choice.marker_set is not None
        np.testing.assert_array_equal(choice.subject.marker_offsets, subject.marker_offsets)
        assert (choice.marker_set.labels, list(choice.notes)) == (subject.labels, [])


def test_named_set_or_subject_must_exist_and_fit(brief):
    with pytest.raises(TakeError, match=r"^the take: cmu41 does not fit: 1 of its 41 markers, "):
        resolve_subject(build_take("LFHD", "P1"), SubjectOptions(marker_set="cmu41"))
    with pytest.raises(TakeError, match=r"does not fit: 0 of its 41 markers"):
        resolve_subject(build_take("P1"), SubjectOptions(subject=brief.subject))
    with pytest.raises(SceneError, match="cmu14"):
        resolve_subject(build_take(*CMU41.labels), SubjectOptions(marker_set="cmu14"))


@pytest.fixture(scope="module")
def moved(brief) -> tuple[Detected, Subject, BodyFit, StageTimer, int]:
    """Return what is detected in a second in which LSHN moves by 50 mm, the subject, the solved body, the timer, the marker."""
    whole, subject = capture.read_take(Path(brief.path)), library.read_subject(brief.subject)
    marker = whole.labels.index("LSHN")
    markers = whole.markers.copy()
    markers[60:, marker] += [0.0, 0.05, 0.0]
    take = whole.replace_markers(markers)
    shift = MarkerShift("moved", marker, 60, 119, 0.05, "", settled_frame=60)
    detected, timer = Detected(take, sample_faults=Faults((shift,))), StageTimer()
    _, body = pipeline.fit_body(detected, build_subject_marker_set(subject), subject, None, CleanOptions(), timer)
    return detected, subject, body, timer, marker


def test_moved_marker_extends_the_solved_subject_only(moved):
    detected, known, body, _, _ = moved
    assert body.subject is known
    assert body.extended_subject.labels == (*known.labels, "LSHN")
    assert body.marker_columns[-1] == detected.epochs.added_columns[0] == 41
    assert body.motion.marker_sd.shape == (120, 42)
    before, after = body.extended_subject.marker_offsets[known.labels.index("LSHN")], body.extended_subject.marker_offsets[-1]
    assert 0.03 < np.linalg.norm(after - before) < 0.07


def test_body_markers_follow_the_moved_marker(moved):
    detected, _, body, _, marker = moved
    take, predicted = detected.take, detected.place_on_body(body)
    assert predicted.shape == take.markers.shape
    assert np.nanmedian(np.linalg.norm(predicted - take.markers, axis=-1)[:, marker]) < 0.01
    expected = kinematics.compute_joint_and_marker_positions(body.subject, body.motion)[0]
    np.testing.assert_array_equal(body.joint_positions, expected)


def test_known_subject_is_not_calibrated(moved):
    assert set(moved[3].stage_seconds) == {"initialise", "solve", "total"}


def test_markers_without_a_column_have_no_body_position():
    take = Take(np.ones((3, 4, 3)), tuple("ABCD"), 100.0)
    positions = np.arange(3 * 3 * 3, dtype=float).reshape(3, 3, 3)
    subject, motion = object.__new__(Subject), object.__new__(Motion)
    body = BodyFit(subject, subject, np.array([2, -1, 0]), take, motion, np.zeros((3, 1, 3)), positions, None)
    expanded = Detected(take).place_on_body(body)
    np.testing.assert_array_equal(expanded[:, [2, 0]], positions[:, [0, 2]])
    assert np.isnan(expanded[:, [1, 3]]).all()
