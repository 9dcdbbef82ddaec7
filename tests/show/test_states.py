from dataclasses import replace

import numpy as np

from mocapfix.show.states import DOUBTED, EMPTY, FILLED, MEASURED, RELABELLED, REPLACED, TAKEN, former, mended


def test_each_sample_is_told_by_what_became_of_it(scene):
    expected = np.full((240, 31), MEASURED)
    expected[50:100, 3] = expected[60:70, 29] = FILLED
    expected[70:80, 29] = expected[:, 30] = expected[200] = EMPTY
    expected[70, 5] = REPLACED
    expected[120:140, 7] = DOUBTED
    expected[150:170, [10, 11]] = expected[20:40, 12] = RELABELLED
    np.testing.assert_array_equal(scene.cleaning.state, expected)
    assert mended(expected).sum() == 50 + 10 + 1


def test_what_was_taken_over_by_another_label_is_told_from_what_is_empty(scene):
    before, after = scene.cleaning.before, scene.cleaning.after
    markers, sources = after.markers.copy(), after.sources.copy()
    markers[5:8, 4], sources[5:8, 4], markers[5:8, 2] = before.markers[5:8, 2], 2, np.nan
    state = scene.with_(after=replace(after, markers=markers, source=sources)).cleaning.state
    assert (state[5:8, 2] == TAKEN).all()
    assert (state[5:8, 4] == RELABELLED).all()
    assert (state[:5, [2, 4]] == MEASURED).all()


def test_a_sample_was_doubted_or_anothers_or_measured(scene):
    seen, faults = scene.cleaning.before.seen, scene.cleaning.faults
    was = former(seen, scene.cleaning.state)
    np.testing.assert_array_equal(was == DOUBTED, faults.doubted(scene.cleaning.before))
    np.testing.assert_array_equal(was == EMPTY, ~seen)
    assert [(each == RELABELLED).sum() for each in was.T if (each == RELABELLED).any()] == [20, 20]


def test_what_was_anothers_and_is_estimated_now_was_not_doubted(scene):
    labelled = scene.cleaning.labelled.markers.copy()
    labelled[150:155, 10] = np.nan  # M10 was hidden while its label was at the other marker
    sure = scene.cleaning.after.deviation.copy()
    sure[150:155, 10] = 0.01
    after = replace(scene.cleaning.after, deviation=sure)
    state = scene.with_(labelled=scene.cleaning.labelled.with_markers(labelled), after=after).cleaning.state
    assert (state[150:155, 10] == FILLED).all()
    assert (former(scene.cleaning.before.seen, state)[150:155, 10] == RELABELLED).all()
