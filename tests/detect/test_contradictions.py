"""A take that contradicts its body as a whole is refused, with the option that corrects it."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix import pipeline
from mocapfix.detect import contradictions
from mocapfix.detect.contradictions import WholeTakeFigures, check_contradictions, measure_whole_take
from mocapfix.errors import TakeError
from mocapfix.model.detected import Detected
from mocapfix.model.faults import Fault, Faults
from mocapfix.model.take import Take
from mocapfix.options import build_clean_options
from mocapfix.synthetic import compose_take, write_synthetic_take

SOUND = WholeTakeFigures(0.01, 0.004, 0.85, 1.0)


def build_detected(faulty_frames: int, speed_m: float = 0.0) -> Detected:
    """Return what is detected in 90 frames of two markers, whose first marker is judged faulty in some frames."""
    markers = np.ones((90, 2, 3)) + speed_m * np.arange(90)[:, None, None] * [1.0, 0.0, 0.0]
    take = Take(markers, ("A", "B"), 60.0)
    faults = Faults((Fault("spike", 0, 0, faulty_frames - 1, 1.0, "leaps"),))
    return Detected(take, sample_faults=faults)


def test_the_share_of_faulty_samples_and_the_speed_are_measured():
    figures = measure_whole_take(build_detected(45, 0.1), None)
    assert figures.faulty_share == pytest.approx(45 / 180)
    assert figures.median_speed_m_per_s == pytest.approx(6.0)
    assert (figures.median_residual_m, figures.leg_m) == (0.0, None)


def test_more_than_a_third_of_faulty_samples_is_refused():
    check_contradictions(build_detected(59), None, build_clean_options())
    with pytest.raises(TakeError, match=r"^the take: 34% of its measured samples .*--accept-contradictions"):
        check_contradictions(build_detected(62), None, build_clean_options())
    check_contradictions(build_detected(62), None, build_clean_options(accept_contradictions=True))


def test_the_other_subjects_of_a_file_can_be_cleaned_alone():
    detected = build_detected(62)
    detected = replace(detected, take=replace(detected.take, subject_name="Jim"))
    with pytest.raises(TakeError, match=r"^the take \(Jim\): .* --subject-prefix cleans another subject alone\.$"):
        check_contradictions(detected, None, build_clean_options())


@pytest.mark.parametrize(
    ("figures", "options", "sentence"),
    [
        (replace(SOUND, leg_m=0.2), {}, r"legs of 0\.2 m; check the unit \(--unit\)"),
        (replace(SOUND, leg_m=3.0), {}, r"legs of 3 m; check the unit \(--unit\)"),
        (
            replace(SOUND, median_residual_m=0.15),
            {"subject": "jim.yaml"},
            r"from the body; check that --subject is of this",
        ),
        (replace(SOUND, median_residual_m=0.15), {"marker_set": "cmu41"}, r"check that --marker-set is that of its markers"),
        (replace(SOUND, faulty_share=0.5), {"up_axis": "X"}, r"50% of .*check --up, --mirror, --unit and --rate"),
        (replace(SOUND, faulty_share=0.5, median_speed_m_per_s=90.0), {}, r"90 m/s: check the rate \(--rate\)"),
        (replace(SOUND, median_residual_m=0.2), {}, r"check its labels and the marker set \(--marker-set\)"),
    ],
)
def test_the_sentence_names_the_cause_and_the_option(monkeypatch, figures, options, sentence):
    monkeypatch.setattr(contradictions, "measure_whole_take", lambda *_: figures)
    with pytest.raises(TakeError, match=sentence) as raised:
        check_contradictions(build_detected(1), None, build_clean_options(**options))
    assert len(str(raised.value)) < 220
    check_contradictions(build_detected(1), None, build_clean_options(**options, accept_contradictions=True))


def test_the_subject_of_a_far_smaller_person_is_refused_and_without_it_the_take_is_right(tmp_path):
    path, truth = tmp_path / "walk.c3d", compose_take(seconds=1.0, rate=60.0)
    write_synthetic_take(path, truth)
    subject = truth.subject
    skeleton = replace(subject.skeleton, offsets=subject.skeleton.offsets * 0.3, ends=subject.skeleton.ends * 0.3)
    small = replace(subject, skeleton=skeleton, marker_offsets=subject.marker_offsets * 0.3)
    with pytest.raises(TakeError, match="--subject"):
        pipeline.clean(path, subject=small, prior="none")
    residual_m = pipeline.clean(path, prior="none").residual_m
    assert residual_m is not None
    assert np.nanmedian(residual_m) < 0.01
