import numpy as np

from mocapfix.show.states import DOUBTED, EMPTY, FILLED, MEASURED, REPLACED, faulty, mended, states


def test_each_sample_is_told_by_what_became_of_it(scene):
    state = states(scene.before, scene.after, scene.faults)
    expected = np.full((240, 31), MEASURED)
    expected[50:100, 3] = expected[60:70, 29] = FILLED
    expected[70:80, 29] = expected[:, 30] = expected[200] = EMPTY
    expected[70, 5] = REPLACED
    expected[120:140, 7] = DOUBTED
    np.testing.assert_array_equal(state, expected)


def test_what_was_put_there_and_what_was_not_trusted(scene):
    state = states(scene.before, scene.after, scene.faults)
    assert mended(state).sum() == 50 + 10 + 1
    np.testing.assert_array_equal(faulty(scene.before.seen, state), scene.faults.doubted(scene.before))
