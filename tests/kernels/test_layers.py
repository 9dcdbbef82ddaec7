from itertools import pairwise

import numpy as np
import pytest

from mocapfix.kernels.twist_network import evaluate_layer_frames


@pytest.mark.parametrize("sizes", [(5, 7, 4, 6), (3, 2, 9, 2)])
def test_layers_are_matrix_products_and_bend_what_is_negative_but_for_the_last(sizes):
    rng = np.random.default_rng(0)
    weights = tuple(rng.normal(size=shape).astype(np.float32) for shape in pairwise(sizes))
    offsets = tuple(rng.normal(size=size).astype(np.float32) for size in sizes[1:])
    inputs = rng.normal(size=(20, sizes[0])).astype(np.float32)
    outputs = np.full((20, sizes[-1]), 9, np.float32)
    evaluate_layer_frames(weights, offsets, inputs, outputs, 3, 18)
    a, b, c = weights
    expected = np.maximum(np.maximum(inputs @ a + offsets[0], 0) @ b + offsets[1], 0) @ c + offsets[2]
    np.testing.assert_allclose(outputs[3:18], expected[3:18], atol=1e-5)
    assert (expected < 0).any()
    assert (outputs[[0, 1, 2, 18, 19]] == 9).all()
