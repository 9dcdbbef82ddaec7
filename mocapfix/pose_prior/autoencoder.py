"""Autoencoder pose models (MNN-IK, section 3 and appendix A), and the naturalness measure of MNN-IK.

The scale of a network's code is arbitrary. Here the code is normalised by the covariance of the codes of training poses, so that
its cost is half its sum of squares. The residuals of decoded poses are correlated between joints, above all for subjects that the
network was not trained on; further code dimensions are amplitudes along the directions of these residuals.
"""

from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mocapfix.pose_prior.model import Header, PoseModel, Tensors, validate_tensors
from mocapfix.pose_prior.network import AutoencoderNetwork, NetworkArchitecture, build_network, propagate_slopes
from mocapfix.pose_prior.pose_features import (
    FEATURE_TYPES,
    PoseFeatures,
    compute_euler_tensor,
    compute_rotation_tensor,
    compute_tilt_tensor,
)

EVALUATION_BATCH_POSES = 512  # larger batches need more memory and are hardly faster
# The standard deviations of a model are inflated by this. In the fourth power that would leave g hardly any weight.
NATURALNESS_SD_INFLATION = 2.0
FIELD_OF_AUTOENCODER_TENSOR = {
    "middle": "reference_rotations",
    "sigma": "residual_sd_rad",
    "mean": "code_mean",
    "spread": "code_cholesky",
    "astray": "residual_directions",
}
ARCHITECTURE_FIELD_OF_KEY = {
    "features": "input_features",
    "gives": "output_features",
    "hidden": "hidden_widths",
    "code": "code_size",
    "astray": "residual_directions",
    "activation": "activation",
    "straight": "skip_connection",
}
NETWORK_PREFIX = "network."  # of the names of the network's weights in a file


@dataclass(frozen=True)
class AutoencoderModel(PoseModel):
    """A trained autoencoder whose code has N dimensions of the network and P - N amplitudes of residuals.

    code_mean            (N,) mean of the network's code over the training poses
    code_cholesky        (N, N) lower triangular: the network's code is code_mean + code_cholesky @ code[:N]
    residual_directions  (P - N, J, 3) radians: residual of the decoded pose for one standard deviation of each further code
                         dimension
    """

    architecture: NetworkArchitecture
    network: AutoencoderNetwork
    code_mean: np.ndarray
    code_cholesky: np.ndarray
    residual_directions: np.ndarray
    kind: ClassVar[str] = "autoencoder"

    @cached_property
    def input_features(self) -> PoseFeatures:
        return self._build_features(self.architecture.input_features)

    @cached_property
    def output_features(self) -> PoseFeatures:
        return self._build_features(self.architecture.output_features)

    @property
    def code_size(self) -> int:
        return len(self.code_mean) + len(self.residual_directions)

    @property
    def nonlinear_code_size(self) -> int:
        return len(self.code_mean)

    def encode(self, pose_vectors: Float[np.ndarray, "N J 3"]) -> Float[np.ndarray, "N P"]:
        """Return the codes of poses: the network's code, and the most probable residual amplitudes given the network's code."""
        network_code, decoded = evaluate_in_batches(self._encode_batch, pose_vectors)
        axis_count = 3 * len(self.joint_names)
        sd = self.residual_sd_rad[:, None]
        directions = (self.residual_directions / sd).reshape(len(self.residual_directions), axis_count)
        residuals = ((pose_vectors - decoded) / sd).reshape(len(pose_vectors), axis_count)
        amplitudes = np.linalg.solve(directions @ directions.T + np.eye(len(directions)), directions @ residuals.T).T
        normalised = np.linalg.solve(self.code_cholesky, (network_code - self.code_mean).T).T
        return np.concatenate([normalised, amplitudes], axis=1)

    def decode(self, codes: Float[np.ndarray, "N P"]) -> Float[np.ndarray, "N J 3"]:
        (decoded,) = evaluate_in_batches(self._decode_batch, self._compute_network_code(codes))
        return decoded + self._compute_residual(codes)

    def linearise(self, codes: Float[np.ndarray, "N P"]) -> tuple[Float[np.ndarray, "N J 3"], Float[np.ndarray, "N J 3 P"]]:
        decoded, jacobian = evaluate_in_batches(self._linearise_batch, self._compute_network_code(codes))
        directions = np.moveaxis(self.residual_directions, 0, -1)
        residual_jacobian = np.broadcast_to(directions, (*decoded.shape, len(self.residual_directions)))
        return decoded + self._compute_residual(codes), np.concatenate([jacobian, residual_jacobian], axis=-1)

    def serialise(self) -> tuple[Header, Tensors]:
        """Return header and tensors; the weights in half precision, for which standard deviations and code scale were
        estimated."""
        weights = {_name_file_weight(name): w.numpy().astype(np.float16) for name, w in self.network.state_dict().items()}
        tensors = {name: getattr(self, field).astype(np.float32) for name, field in FIELD_OF_AUTOENCODER_TENSOR.items()}
        shape = {key: getattr(self.architecture, field) for key, field in ARCHITECTURE_FIELD_OF_KEY.items()}
        return {"shape": shape}, tensors | weights

    @classmethod
    def deserialise(cls, joint_names: tuple[str, ...], header: Header, tensors: Tensors) -> "AutoencoderModel":
        shape = header["shape"] | {"hidden": tuple(header["shape"]["hidden"])}
        architecture = NetworkArchitecture(**{ARCHITECTURE_FIELD_OF_KEY[key]: value for key, value in shape.items()})
        weights = {name: tensors.pop(name) for name in list(tensors) if name.startswith(NETWORK_PREFIX)}
        joint_count, size = len(joint_names), architecture.code_size
        shapes = {
            "middle": (joint_count, 3, 3),
            "sigma": (joint_count,),
            "mean": (size,),
            "spread": (size, size),
            "astray": (architecture.residual_directions, joint_count, 3),
        }
        fields = {FIELD_OF_AUTOENCODER_TENSOR[name]: values for name, values in validate_tensors(tensors, **shapes).items()}
        network = build_network(architecture, fields["reference_rotations"])
        state = {_name_module_weight(name): torch.from_numpy(w.astype(np.float32)) for name, w in weights.items()}
        network.load_state_dict(state, strict=True)
        return cls(joint_names, architecture=architecture, network=network.eval(), **fields)

    def _build_features(self, kind: str) -> PoseFeatures:
        return FEATURE_TYPES[kind](torch.as_tensor(self.reference_rotations, dtype=torch.float32))

    def _compute_network_code(self, codes: np.ndarray) -> np.ndarray:
        return self.code_mean + codes[:, : len(self.code_mean)] @ self.code_cholesky.T

    def _compute_residual(self, codes: np.ndarray) -> np.ndarray:
        return np.tensordot(codes[:, len(self.code_mean) :], self.residual_directions, 1)

    def _encode_batch(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        network_code = self.network.encoder(self.input_features.compute_features(vectors))
        return network_code, *self._decode_batch(network_code)

    def _decode_batch(self, network_code: Tensor) -> tuple[Tensor]:
        return (self.output_features.compute_vectors(self.network.decoder(network_code)),)

    def _linearise_batch(self, network_code: Tensor) -> tuple[Tensor, Tensor]:
        directions = torch.as_tensor(self.code_cholesky.T, dtype=torch.float32)
        features, slopes = propagate_slopes(self.network.decoder, network_code, directions)
        return self.output_features.linearise_vectors(features, slopes)


@dataclass(frozen=True)
class NaturalnessModel:
    """MNN-IK's naturalness measure (Eq. 3.3): the change that an autoencoder of Euler angles makes to a pose.

        g(theta) = |theta - decoder(encoder(theta))|^2,   theta the 93 Euler angles

    It is small for poses like those of the training subjects. It has no code; in the solver it is one dense row
    (`kernels.terms.scalar`).
    """

    autoencoder: AutoencoderModel
    code_size: ClassVar[int] = 0
    is_linear: ClassVar[bool] = False

    def __post_init__(self):
        architecture = self.autoencoder.architecture
        if (architecture.input_features, architecture.output_features) != ("euler", "euler"):
            raise ValueError("naturalness needs a network with Euler angles as input and output features")

    @property
    def naturalness_sd(self) -> float:
        """Standard deviation of g in rad^2 over the poses of held-out subjects: that of a sum of squares of normal angles."""
        sd = self.autoencoder.residual_sd_rad / NATURALNESS_SD_INFLATION
        return float(np.sqrt(6 * (sd**4).sum()))

    def evaluate(self, local: Float[np.ndarray, "N J 3 3"]) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N J 3"]]:
        """Return g of poses in rad^2 and its gradient in rad, given local joint rotations.

        The gradient is with respect to rotation vectors of the joints in the axes of their parents, of the root in the world. The
        root's heading does not affect g.
        """
        with use_one_torch_thread():
            parts = [self._evaluate_batch(part) for part in torch.as_tensor(local).split(EVALUATION_BATCH_POSES)]
        values, gradients = (torch.cat(part).numpy().astype(float) for part in zip(*parts, strict=True))
        return values, gradients

    def _evaluate_batch(self, local: Tensor) -> tuple[Tensor, Tensor]:
        network = self.autoencoder.network
        local = local.to(next(network.parameters()).dtype)
        turn = torch.zeros_like(local[..., 0], requires_grad=True)
        turned = compute_rotation_tensor(turn) @ local
        tilt = compute_rotation_tensor(compute_tilt_tensor(turned[:, :1, 1]))
        theta = compute_euler_tensor(torch.cat([tilt, turned[:, 1:]], 1)).flatten(-2)
        value = ((theta - network(theta)) ** 2).sum(-1)
        return value.detach(), torch.autograd.grad(value.sum(), turn)[0]


@contextmanager
def use_one_torch_thread() -> Generator[None]:
    """Limit torch to one thread inside the context."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def evaluate_in_batches(function: Callable[[Tensor], tuple[Tensor, ...]], rows: np.ndarray) -> list[np.ndarray]:
    """Return the outputs (N, ...) of a torch function for rows (N, ...), as float64.

    Torch uses one thread. Callers run this in several threads instead, which avoids synchronisation after every layer.
    """
    with torch.no_grad(), use_one_torch_thread():
        parts = [function(part) for part in torch.as_tensor(np.asarray(rows, np.float32)).split(EVALUATION_BATCH_POSES)]
        return [torch.cat(outputs).double().numpy() for outputs in zip(*parts, strict=True)]


def _name_file_weight(name: str) -> str:
    """Return the name in a weights file of a weight of the network."""
    return NETWORK_PREFIX + name.replace("0.layers.", "0.bent.").replace("0.skip.", "0.straight.")


def _name_module_weight(name: str) -> str:
    """Return the name in the network of a weight in a weights file."""
    return name.removeprefix(NETWORK_PREFIX).replace("0.bent.", "0.layers.").replace("0.straight.", "0.skip.")
