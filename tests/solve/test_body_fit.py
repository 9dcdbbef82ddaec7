"""A take's body: which set is chosen, whose it is, and where it has the take's markers."""

import numpy as np
import pytest

from mocapfix import marker_sets, repair
from mocapfix.calibrate import subject_file
from mocapfix.errors import SceneError, TakeError
from mocapfix.faults import MarkerShift
from mocapfix.options import DEFAULT_INIT_METHOD, SolveOptions
from mocapfix.read import capture
from mocapfix.report.stage_timer import StageTimer
from mocapfix.solve import body_fit, kinematics
from mocapfix.state import BodyFit, FitSettings, select_subject
from mocapfix.take import Take

CMU41 = marker_sets.load_marker_set("cmu41")


def called(*labels) -> Take:
    return Take(np.zeros((2, len(labels), 3)), labels, 100.0)


def test_the_set_is_chosen_by_the_labels():
    known, worn_set, said = select_subject(called(*(f"Jim:{label}" for label in CMU41.labels)), None, None)
    assert known is None
    assert worn_set is not None
    assert (worn_set.name, said) == ("cmu41", [])


def test_where_no_set_fits_it_is_said_why_and_what_that_means():
    known, worn_set, (why, without) = select_subject(called("P1", "P2"), None, None)
    assert (known, worn_set) == (None, None)
    assert why.startswith("No marker set fits the labels P1, P2")
    assert without == "The take was cleaned without a skeleton: there is no BVH."


def test_a_subject_brings_its_own_set_as_a_file_or_itself(brief):
    subject = subject_file.read_subject(brief.subject)
    for given in (subject, brief.subject, str(brief.subject)):
        known, worn_set, said = select_subject(called(*CMU41.labels), None, given)
        assert known is not None
        assert worn_set is not None
        np.testing.assert_array_equal(known.marker_offsets, subject.marker_offsets)
        assert (worn_set.labels, said) == (subject.labels, [])


def test_what_is_named_must_fit_and_be_there(brief):
    with pytest.raises(TakeError, match=r"^the take: cmu41 does not fit: 1 of its 41 markers, .*not found: "):
        select_subject(called("LFHD", "P1"), "cmu41", None)
    with pytest.raises(TakeError, match=r"does not fit: 0 of its 41 markers"):
        select_subject(called("P1"), None, brief.subject)
    with pytest.raises(SceneError, match="cmu14"):
        select_subject(called(*CMU41.labels), "cmu14", None)


@pytest.fixture(scope="module")
def knocked(brief):
    """-> one second in which LSHN moves 50 mm in frame 60: the take's parts, the subject, and the body"""
    whole, subject = capture.read_capture(brief.path), subject_file.read_subject(brief.subject)
    m = whole.labels.index("LSHN")
    markers = whole.markers.copy()
    markers[60:, m] += [0.0, 0.05, 0.0]
    take = whole.replace_markers(markers)
    parts = repair.split_moved_markers(take, [MarkerShift("moved", m, 60, 119, 0.05, "", settled_frame=60)])
    worn_set = marker_sets.build_subject_marker_set(subject)
    how, clock = FitSettings(None, SolveOptions(), DEFAULT_INIT_METHOD), StageTimer()
    return parts, subject, body_fit.fit_body(parts, parts.split_mask(take.visible), worn_set, subject, how, clock), clock, m


def test_a_new_place_is_a_marker_more_of_what_is_worn_and_not_of_the_person(knocked):
    parts, subject, body, _, _ = knocked
    assert body.person is subject
    assert body.worn.labels == (*subject.labels, "LSHN")
    assert body.columns[-1] == parts.more[0] == 41
    assert body.motion.sample_sd.shape == (120, 42)
    old, new = body.worn.marker_offsets[subject.labels.index("LSHN")], body.worn.marker_offsets[-1]
    assert 0.03 < np.linalg.norm(new - old) < 0.07


def test_the_body_has_a_moved_marker_where_it_is_at_the_time(knocked):
    parts, _, body, _, m = knocked
    placed = body.expand_to_take(parts)
    take = parts.merge_columns(parts.take.markers)
    assert placed.shape == take.shape
    assert np.nanmedian(np.linalg.norm(placed - take, axis=-1)[:, m]) < 0.01
    np.testing.assert_array_equal(body.joints, kinematics.compute_joint_and_marker_positions(body.person, body.motion)[0])


def test_a_known_subject_is_not_calibrated(knocked):
    assert set(knocked[3].stage_seconds) == {"initialise", "solve", "total"}


def test_what_the_body_does_not_wear_it_has_nowhere():
    take = Take(np.ones((3, 4, 3)), tuple("ABCD"), 100.0)
    parts = repair.split_moved_markers(take, [])
    placed = np.arange(3 * 3 * 3, dtype=float).reshape(3, 3, 3)
    nothing: object = None
    body = BodyFit(nothing, nothing, nothing, np.array([2, -1, 0]), np.zeros((3, 1, 3)), placed)  # pyright: ignore
    found = body.expand_to_take(parts)
    np.testing.assert_array_equal(found[:, [2, 0]], placed[:, [0, 2]])
    assert np.isnan(found[:, [1, 3]]).all()
