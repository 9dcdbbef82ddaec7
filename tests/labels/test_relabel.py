import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.labels.fragments import relabel_samples
from mocapfix.labels.label_swaps import undo_label_exchanges
from mocapfix.model.faults import Fault, Fragment
from mocapfix.model.take import Take

RNG = np.random.default_rng(0)
TAKE = Take(RNG.normal(size=(30, 4, 3)), tuple("ABCD"), 100.0)

swaps = st.builds(
    lambda order, size, a, b, confidence: Fault(
        "swap", order[0], min(a, b), max(a, b), 0.1, "", confidence, tuple(order[1:size])
    ),
    st.permutations(range(4)),
    st.sampled_from([2, 3]),
    st.integers(0, 29),
    st.integers(0, 29),
    st.sampled_from([0.3, 0.9]),
)


def test_uncertain_and_other_faults_are_ignored():
    faults = [
        Fault("swap", 0, 5, 9, 0.1, "", 0.59, (1,)),
        Fault("spike", 0, 5, 9, 0.1, ""),
        Fragment("fragment", 0, 0, 29, 0.1, "", donor=1),
    ]
    assert undo_label_exchanges(TAKE, faults) is TAKE


def test_exchanges_are_undone_in_the_given_order():
    """A's samples are under B's label, then what is under B's is exchanged with C's: undone the other way round."""
    wrong = TAKE.exchange_labels((0, 1), 0, 19).exchange_labels((1, 2), 10, 29)
    late, early = Fault("swap", 1, 10, 29, 0.1, "", 1.0, (2,)), Fault("mislabelled", 0, 0, 19, 0.1, "", 1.0, (1,))
    np.testing.assert_array_equal(undo_label_exchanges(wrong, [late, early]).markers, TAKE.markers)
    assert (undo_label_exchanges(wrong, [early, late]).markers != TAKE.markers).any()


@given(st.lists(swaps, max_size=5))
def test_samples_are_permuted(faults):
    right = undo_label_exchanges(TAKE, faults)
    np.testing.assert_array_equal(np.sort(right.markers[..., 0]), np.sort(TAKE.markers[..., 0]))
    order = np.argsort(right.source_points, axis=1)
    np.testing.assert_array_equal(
        np.take_along_axis(right.markers, order[..., None], 1), TAKE.markers
    )  # each says whence it came


@given(st.lists(swaps, max_size=5))
def test_undoing_one_by_one_equals_undoing_all(faults):
    np.testing.assert_array_equal(relabel_samples(TAKE, faults).markers, undo_label_exchanges(TAKE, faults).markers)


def test_fragment_is_joined_before_a_later_swap():
    markers = TAKE.markers.copy()
    markers[10:20, 3] = markers[10:20, 0]
    markers[10:20, 0] = np.nan
    wrong = TAKE.replace_markers(markers).exchange_labels((0, 1), 5, 24)
    fragment = Fragment(
        "fragment", 1, 10, 19, 0.0, "", donor=3, relation="continues"
    )  # what is missing of A is so under B's label
    right = relabel_samples(wrong, [fragment, Fault("swap", 0, 5, 24, 0.1, "", 1.0, (1,))])
    np.testing.assert_array_equal(right.markers[:, :3], TAKE.markers[:, :3])
    assert np.isnan(right.markers[10:20, 3]).all()
