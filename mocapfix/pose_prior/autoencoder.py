"""An autoencoder of poses (MNN-IK, section 3 and appendix A): a network that squeezes a pose through a few numbers.

The network's own code is of no particular size; here it is measured in the deviations that encoded poses have, so that a code
costs half its square. What a network misses it misses in many joints at once, most of all of people it has not seen; so further
numbers of the code are deviations along the directions in which poses stray from the network's.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from mocapfix.pose_prior.model import PoseModel, validate_tensors
from mocapfix.pose_prior.network import AutoencoderNetwork, NetworkArchitecture, build_network, propagate_slopes
from mocapfix.pose_prior.pose_features import (
    FEATURE_TYPES,
    PoseFeatures,
    compute_euler_tensor,
    compute_rotation_tensor,
    compute_tilt_tensor,
)

# MERGED: mocapfix.prior.autoencoder
EVALUATION_BATCH_POSES = 512  # poses at once: memory stays small, and a larger batch is hardly faster


@dataclass(frozen=True)
class AutoencoderModel(PoseModel):
    """A trained network.

    shape   what it is made of: kind of features, hidden layers, code, activation
    mean    (N,) of the network's own code of people's poses; that is mean + spread code, of the code's first N numbers
    spread  (N, N) lower triangular
    astray  (P - N, J, 3) radians: how poses stray from the network's, each row for one deviation of another number of the code
    """

    architecture: NetworkArchitecture
    network: AutoencoderNetwork
    code_mean: np.ndarray
    code_cholesky: np.ndarray
    residual_directions: np.ndarray

    @cached_property
    def input_features(self) -> PoseFeatures:
        return FEATURE_TYPES[self.architecture.input_features](torch.as_tensor(self.reference_rotations, dtype=torch.float32))

    @cached_property
    def output_features(self) -> PoseFeatures:
        return FEATURE_TYPES[self.architecture.output_features](torch.as_tensor(self.reference_rotations, dtype=torch.float32))

    @property
    def code_size(self) -> int:
        return len(self.code_mean) + len(self.residual_directions)

    @property
    def nonlinear_code_size(self) -> int:
        return len(self.code_mean)

    def encode(self, pose_vectors: np.ndarray) -> np.ndarray:
        """-> (N, P): the network's numbers, and the likeliest of the others beside these."""
        own, decoded = evaluate_in_batches(self._encode_batch, pose_vectors)
        axes = 3 * len(self.joint_names)
        weights = (self.residual_directions / self.residual_sd_rad[:, None]).reshape(len(self.residual_directions), axes)
        away = ((pose_vectors - decoded) / self.residual_sd_rad[:, None]).reshape(len(pose_vectors), axes)
        others = np.linalg.solve(weights @ weights.T + np.eye(len(weights)), weights @ away.T).T
        return np.concatenate([np.linalg.solve(self.code_cholesky, (own - self.code_mean).T).T, others], axis=1)

    def decode(self, codes: np.ndarray) -> np.ndarray:
        (decoded,) = evaluate_in_batches(self._decode_batch, self._compute_network_code(codes))
        return decoded + self._compute_residual(codes)

    def linearise(self, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        decoded, slopes = evaluate_in_batches(self._linearise_batch, self._compute_network_code(codes))
        others = np.broadcast_to(np.moveaxis(self.residual_directions, 0, -1), (*decoded.shape, len(self.residual_directions)))
        return decoded + self._compute_residual(codes), np.concatenate([slopes, others], axis=-1)

    def serialise(self) -> tuple[dict, dict[str, np.ndarray]]:
        """Half precision for the weights: sigma, mean and spread were measured after rounding them."""
        weights = {f"network.{name}": w.numpy().astype(np.float16) for name, w in self.network.state_dict().items()}
        tensors = {name: getattr(self, name).astype(np.float32) for name in ("middle", "sigma", "mean", "spread", "astray")}
        return {"shape": asdict(self.architecture)}, tensors | weights

    @classmethod
    def deserialise(cls, joint_names: tuple[str, ...], header: dict, tensors: dict[str, np.ndarray]) -> "AutoencoderModel":
        shape = NetworkArchitecture(**header["shape"] | {"hidden": tuple(header["shape"]["hidden"])})
        weights = {name: tensors.pop(name) for name in list(tensors) if name.startswith("network.")}
        count, size = len(joint_names), shape.code_size
        shapes = {"middle": (count, 3, 3), "sigma": (count,), "mean": (size,), "spread": (size, size)}
        known = validate_tensors(tensors, **shapes, astray=(shape.residual_directions, count, 3))
        network = build_network(shape, known["middle"])
        state = {name.removeprefix("network."): torch.from_numpy(w.astype(np.float32)) for name, w in weights.items()}
        network.load_state_dict(state, strict=True)
        return cls(joint_names, known.pop("middle"), known.pop("sigma"), shape, network.eval(), **known)

    def _compute_network_code(self, codes: np.ndarray) -> np.ndarray:
        return self.code_mean + codes[:, : len(self.code_mean)] @ self.code_cholesky.T

    def _compute_residual(self, codes: np.ndarray) -> np.ndarray:
        return np.tensordot(codes[:, len(self.code_mean) :], self.residual_directions, 1)

    def _encode_batch(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        own = self.network.encoder(self.input_features.compute_features(vectors))
        return own, *self._decode_batch(own)

    def _decode_batch(self, own: Tensor) -> tuple[Tensor]:
        return (self.output_features.compute_vectors(self.network.decoder(own)),)

    def _linearise_batch(self, own: Tensor) -> tuple[Tensor, Tensor]:
        features, slopes = propagate_slopes(self.network.decoder, own, torch.as_tensor(self.code_cholesky.T, dtype=torch.float32))
        return self.output_features.linearise_vectors(features, slopes)


@contextmanager
def use_one_torch_thread() -> Iterator[None]:
    """Let torch use one core for what this thread asks of it."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def evaluate_in_batches(function: Callable[[Tensor], tuple[Tensor, ...]], rows: np.ndarray) -> list[np.ndarray]:
    """-> float64, what a function of torch says of the rows, a batch at a time.

    On one core: those who want more call it from several threads, which then need not wait for each other after every layer.
    """
    with torch.no_grad(), use_one_torch_thread():
        parts = [function(part) for part in torch.as_tensor(np.asarray(rows, np.float32)).split(EVALUATION_BATCH_POSES)]
        return [torch.cat(said).double().numpy() for said in zip(*parts, strict=True)]


# MERGED: mocapfix.prior.naturalness
# MNN-IK's own way to use its network (Eq. 3.3): one number, g, by how much the network changes a pose.
#
#     g(theta) = |theta - decoder(encoder(theta))|^2,   theta the 93 Euler angles
#
# Small for people's poses, of which the network has seen many. It stands in the solve as one dense row (kernels.terms.whole).
SIGMA_INFLATION = 2.0  # of sigma, over what unseen people stray: to the fourth power it would leave g without a say


@dataclass(frozen=True)
class NaturalnessModel:
    """How far from people's a pose is, by an autoencoder on Euler angles; in the solve it has no code."""

    autoencoder: AutoencoderModel
    code_size: ClassVar[int] = 0
    is_linear: ClassVar[bool] = False

    def __post_init__(self):
        if (self.autoencoder.architecture.input_features, self.autoencoder.architecture.output_features) != ("euler", "euler"):
            raise ValueError("naturalness is measured in Euler angles; this network is told or gives others")

    @property
    def naturalness_sd(self) -> float:
        """-> rad^2, by how much g differs among people whom the network has not seen: a sum of squares of normal angles."""
        return float(np.sqrt(6 * ((self.autoencoder.residual_sd_rad / SIGMA_INFLATION) ** 4).sum()))

    def evaluate(self, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """-> (N,) rad^2, g of poses, local rotations (N, J, 3, 3), and how it changes as each joint turns, (N, J, 3) rad.

        The turns are rotation vectors in the parents' axes, the root's in the world's. Its heading makes no difference.
        """
        with use_one_torch_thread():
            parts = [self._evaluate_batch(part) for part in torch.as_tensor(local).split(EVALUATION_BATCH_POSES)]
        value, gradient = (torch.cat(part).numpy().astype(float) for part in zip(*parts, strict=True))
        return value, gradient

    def _evaluate_batch(self, local: Tensor) -> tuple[Tensor, Tensor]:
        network = self.autoencoder.network
        local = local.to(next(network.parameters()).dtype)
        turn = torch.zeros_like(local[..., 0], requires_grad=True)
        turned = compute_rotation_tensor(turn) @ local
        tilt = compute_rotation_tensor(compute_tilt_tensor(turned[:, :1, 1]))
        theta = compute_euler_tensor(torch.cat([tilt, turned[:, 1:]], 1)).flatten(-2)
        value = ((theta - network(theta)) ** 2).sum(-1)
        return value.detach(), torch.autograd.grad(value.sum(), turn)[0]
