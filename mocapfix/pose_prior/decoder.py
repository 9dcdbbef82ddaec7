"""The decoder of an autoencoder and its derivative, computed with numpy.

A cleaning needs nothing else of a network, and importing torch takes longer than decoding the poses of a minute.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32

ENCODER, DECODER = "encoder.", "decoder."  # how the names of the weights begin
SKIPPED_LAYERS, SKIP = "0.layers.", "0.skip."  # and how they go on in a decoder with a skip connection


@dataclass(frozen=True)
class NetworkArchitecture:
    """The architecture of a network.

    input_features       features that the encoder takes: a key of FEATURE_COUNTS
    output_features      features that the decoder returns: a key of FEATURE_COUNTS
    hidden_widths        widths of the encoder's hidden layers; the decoder has the same in reverse order
    code_size            dimensions of the network's code
    residual_directions  number of further code dimensions, along the directions of the decoded poses' residuals
    activation           activation of the hidden layers: a key of ACTIVATION_SLOPES
    skip_connection      whether a linear map from the code is added to the decoder's output
    """

    input_features: str
    output_features: str
    hidden_widths: tuple[int, ...]
    code_size: int
    residual_directions: int
    activation: str
    skip_connection: bool

    def list_weight_shapes(self, joint_count: int) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the network's weights for a skeleton, by their names in the network."""
        inputs, outputs = (FEATURE_COUNTS[kind](joint_count) for kind in (self.input_features, self.output_features))
        decoder = DECODER + (SKIPPED_LAYERS if self.skip_connection else "")
        shapes: dict[str, tuple[int, ...]] = {}
        for prefix, widths in (
            (ENCODER, (inputs, *self.hidden_widths, self.code_size)),
            (decoder, (self.code_size, *self.hidden_widths[::-1], outputs)),
        ):
            for n, (before, after) in enumerate(pairwise(widths)):  # between two layers there is an activation
                shapes |= {f"{prefix}{2 * n}.weight": (after, before), f"{prefix}{2 * n}.bias": (after,)}
        if self.skip_connection:
            shapes[f"{DECODER}{SKIP}weight"] = (outputs, self.code_size)
        return shapes


FEATURE_COUNTS: dict[str, Callable[[int], int]] = {
    "continuous": lambda joint_count: 6 * (joint_count - 1) + 3,
    "euler": lambda joint_count: 3 * joint_count,
    "vectors": lambda joint_count: 3 * joint_count,
}
"""The number of features of a pose, by the kind of features (see `pose_features`) and the number of joints."""


class LayerOutput(NamedTuple):
    """The output of layers for N rows, and its derivatives along P directions."""

    rows: Float32[np.ndarray, "N B"]
    slopes: Float32[np.ndarray, "N P B"]


def evaluate_silu(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return x / (1 + exp(-x)) and its derivative."""
    share = 1 / (1 + np.exp(-values))
    return values * share, share * (1 + values * (1 - share))


def evaluate_relu(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the positive part and its derivative."""
    return np.maximum(values, 0), (values > 0).astype(values.dtype)


ACTIVATION_SLOPES: dict[str, Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]] = {
    "silu": evaluate_silu,
    "relu": evaluate_relu,
}
"""Functions that return the values of an activation and its derivatives, element by element."""


class Decoder:
    """The decoder of a network."""

    def __init__(self, architecture: NetworkArchitecture, weights: Mapping[str, Float32[np.ndarray, "..."]]):
        """Select the decoder's weights among those of the network, by their names there."""
        prefix = DECODER + (SKIPPED_LAYERS if architecture.skip_connection else "")
        numbers = range(0, 2 * len(architecture.hidden_widths) + 1, 2)
        self.layers = [(weights[f"{prefix}{n}.weight"].T, weights[f"{prefix}{n}.bias"]) for n in numbers]
        self.skip_weight = weights[f"{DECODER}{SKIP}weight"].T if architecture.skip_connection else None
        self.evaluate_activation = ACTIVATION_SLOPES[architecture.activation]

    def linearise(self, codes: Float[np.ndarray, "N A"], directions: Float[np.ndarray, "P A"]) -> LayerOutput:
        """Return the features of codes and their derivatives along some directions of the code.

        The matrix products span all rows, and the first derivatives, which are equal for all rows, are computed once.
        """
        start = np.asarray(codes, np.float32)
        steps = np.asarray(directions, np.float32)[None]
        rows, slopes = start, steps
        for n, (weight, bias) in enumerate(self.layers):
            if n:
                rows, derivative = self.evaluate_activation(rows)
                slopes = slopes * derivative[:, None]
            rows, slopes = rows @ weight + bias, slopes @ weight
        if self.skip_weight is not None:
            rows, slopes = rows + start @ self.skip_weight, slopes + steps @ self.skip_weight
        return LayerOutput(rows, np.broadcast_to(slopes, (len(rows), *slopes.shape[1:])))

    def evaluate(self, codes: Float[np.ndarray, "N A"]) -> Float32[np.ndarray, "N B"]:
        """Return the features of codes."""
        return self.linearise(codes, np.zeros((0, codes.shape[1]))).rows
