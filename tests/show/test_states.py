from dataclasses import replace

import numpy as np

from mocapfix.report.sample_states import (
    SAMPLE_EMPTY,
    SAMPLE_FILLED,
    SAMPLE_MEASURED,
    SAMPLE_REASSIGNED,
    SAMPLE_RELABELLED,
    SAMPLE_REPLACED,
    SAMPLE_SUSPECT,
    classify_input_samples,
    find_estimated_samples,
)


def test_each_sample_is_told_by_what_became_of_it(scene):
    expected = np.full((240, 31), SAMPLE_MEASURED)
    expected[50:100, 3] = expected[60:70, 29] = SAMPLE_FILLED
    expected[70:80, 29] = expected[:, 30] = expected[200] = SAMPLE_EMPTY
    expected[70, 5] = SAMPLE_REPLACED
    expected[120:140, 7] = SAMPLE_SUSPECT
    expected[150:170, [10, 11]] = expected[20:40, 12] = SAMPLE_RELABELLED
    np.testing.assert_array_equal(scene.comparison.sample_states, expected)
    assert find_estimated_samples(expected).sum() == 50 + 10 + 1


def test_what_was_taken_over_by_another_label_is_told_from_what_is_empty(scene):
    before, after = scene.comparison.input_take, scene.comparison.cleaned_take
    markers, sources = after.markers.copy(), after.source_points.copy()
    markers[5:8, 4], sources[5:8, 4], markers[5:8, 2] = before.markers[5:8, 2], 2, np.nan
    state = scene.with_(cleaned_take=replace(after, markers=markers, source=sources)).comparison.sample_states
    assert (state[5:8, 2] == SAMPLE_REASSIGNED).all()
    assert (state[5:8, 4] == SAMPLE_RELABELLED).all()
    assert (state[:5, [2, 4]] == SAMPLE_MEASURED).all()


def test_a_sample_was_doubted_or_anothers_or_measured(scene):
    seen, faults = scene.comparison.input_take.visible, scene.comparison.faults
    was = classify_input_samples(seen, scene.comparison.sample_states)
    np.testing.assert_array_equal(was == SAMPLE_SUSPECT, faults.compute_faulty_mask(scene.comparison.input_take))
    np.testing.assert_array_equal(was == SAMPLE_EMPTY, ~seen)
    assert [(each == SAMPLE_RELABELLED).sum() for each in was.T if (each == SAMPLE_RELABELLED).any()] == [20, 20]


def test_what_was_anothers_and_is_estimated_now_was_not_doubted(scene):
    labelled = scene.comparison.relabelled_take.markers.copy()
    labelled[150:155, 10] = np.nan  # M10 was hidden while its label was at the other marker
    sure = scene.comparison.cleaned_take.deviation.copy()
    sure[150:155, 10] = 0.01
    after = replace(scene.comparison.cleaned_take, deviation=sure)
    state = scene.with_(
        relabelled_take=scene.comparison.relabelled_take.replace_markers(labelled), cleaned_take=after
    ).comparison.sample_states
    assert (state[150:155, 10] == SAMPLE_FILLED).all()
    assert (classify_input_samples(scene.comparison.input_take.visible, state)[150:155, 10] == SAMPLE_RELABELLED).all()
