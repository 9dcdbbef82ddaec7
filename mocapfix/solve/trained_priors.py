"""Trained pose models: their weights files, and autoencoders (MNN-IK, section 3 and appendix A).

A file is NAME.safetensors; its header holds the kind of the model and its joints.

The scale of a network's code is arbitrary. Here the code is normalised by the covariance of the codes of training poses, so that
its cost is half its sum of squares. The residuals of decoded poses are correlated between joints, above all for subjects that the
network was not trained on; further code dimensions are amplitudes along the directions of these residuals. The networks are
evaluated with numpy; only training needs torch.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

import numpy as np
import scipy
from jaxtyping import Float, Float32
from safetensors import SafetensorError, safe_open

from mocapfix.errors import SceneError
from mocapfix.io.shipped import find_shipped_folder, is_existing_file
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.solve.pose_prior import GaussianModel, Header, MixtureModel, PoseModel, Tensors, validate_tensors
from mocapfix.stats.rigid_alignment import compute_rotation_vectors, compute_rotations

ENCODER, DECODER = "encoder.", "decoder."  # how the names of the weights begin
SKIPPED_LAYERS, SKIP = "0.layers.", "0.skip."  # and how they go on in a decoder with a skip connection
FEATURE_STEP = 1e-3  # times the derivative of the features: the difference from which that of Euler angles' poses is computed


@dataclass(frozen=True)
class NetworkArchitecture:
    """The architecture of a network."""

    input_features: str  # features that the encoder takes: a key of FEATURE_COUNTS
    output_features: str  # features that the decoder returns: a key of FEATURE_COUNTS
    hidden_widths: tuple[int, ...]  # widths of the encoder's hidden layers; the decoder has the same in reverse order
    code_size: int  # dimensions of the network's code
    residual_directions: int  # number of further code dimensions, along the directions of the decoded poses' residuals
    activation: str  # activation of the hidden layers: a key of ACTIVATION_SLOPES
    skip_connection: bool  # whether a linear map from the code is added to the decoder's output

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
"""The number of features of a pose, by the kind of features and the number of joints.

continuous  two columns of each rotation matrix (Zhou et al., CVPR 2019), and the up vector in the axes of the root; they change
            continuously with the rotations, unlike Euler angles
euler       the Euler angles z, y, x of every joint, the root included, in radians (MNN-IK, 4.1: 93 numbers)
vectors     the rotation vectors from the reference pose
"""


def compute_pose_features(
    kind: str, pose_vectors: Float[np.ndarray, "N J 3"], reference_rotations: Float[np.ndarray, "J 3 3"]
) -> Float[np.ndarray, "N F"]:
    """Return the features of poses, given as rotation vectors from a reference pose in radians."""
    pose_count = len(pose_vectors)
    if kind == "vectors":
        return pose_vectors.reshape(pose_count, -1)
    local = compute_rotations(pose_vectors) @ reference_rotations
    if kind == "euler":
        return scipy.spatial.transform.Rotation.from_matrix(local.reshape(-1, 3, 3)).as_euler("ZYX").reshape(pose_count, -1)
    columns = np.swapaxes(local[:, 1:, :, :2], -1, -2).reshape(pose_count, -1)
    return np.concatenate([columns, local[:, 0, 1]], axis=1)


def compute_feature_vectors(
    kind: str, features: Float[np.ndarray, "... F"], reference_rotations: Float[np.ndarray, "J 3 3"]
) -> Float[np.ndarray, "... J 3"]:
    """Return the rotation vectors in radians from a reference pose that have these features, "euler" or "vectors"."""
    angles = features.reshape(*features.shape[:-1], -1, 3).astype(float)
    if kind == "vectors":
        return angles
    references = np.broadcast_to(np.swapaxes(reference_rotations, 1, 2), (*angles.shape, 3)).reshape(-1, 3, 3)
    turns = scipy.spatial.transform.Rotation.from_euler("ZYX", angles.reshape(-1, 3)).as_matrix() @ references
    return compute_rotation_vectors(turns).reshape(angles.shape)


def evaluate_silu(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return x / (1 + exp(-x)) and its derivative."""
    share = 1 / (1 + np.exp(-values))
    return values * share, share * (1 + values * (1 - share))


ACTIVATION_SLOPES: dict[str, Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]] = {
    "silu": evaluate_silu,
    "relu": lambda values: (np.maximum(values, 0), (values > 0).astype(values.dtype)),
}
"""Functions that return the values of an activation and its derivatives, element by element."""


class Layers:
    """The fully connected layers of an encoder or decoder, in single precision."""

    def __init__(self, architecture: NetworkArchitecture, weights: Mapping[str, Float32[np.ndarray, "..."]], part: str):
        """Select the weights of a part, ENCODER or DECODER, among those of the network, by their names there."""
        has_skip = architecture.skip_connection and part == DECODER
        prefix = part + (SKIPPED_LAYERS if has_skip else "")
        numbers = range(0, 2 * len(architecture.hidden_widths) + 1, 2)
        self.layers = [(weights[f"{prefix}{n}.weight"].T, weights[f"{prefix}{n}.bias"]) for n in numbers]
        self.skip_weight = weights[f"{part}{SKIP}weight"].T if has_skip else None
        self.evaluate_activation = ACTIVATION_SLOPES[architecture.activation]

    def linearise(self, inputs: Float[np.ndarray, "N A"], directions: Float[np.ndarray, "P A"]) -> tuple[np.ndarray, np.ndarray]:
        """Return the output (N, B) for inputs and its derivatives (N, P, B) along some directions of the input.

        The matrix products span all rows, and the first derivatives, which are equal for all rows, are computed once.
        """
        start = np.asarray(inputs, np.float32)
        steps = np.asarray(directions, np.float32)[None]
        rows, slopes = start, steps
        for n, (weight, bias) in enumerate(self.layers):
            if n:
                rows, derivative = self.evaluate_activation(rows)
                slopes = slopes * derivative[:, None]
            flat = slopes.reshape(-1, len(weight))  # one product of matrices is much faster than one for each row
            rows, slopes = rows @ weight + bias, (flat @ weight).reshape(*slopes.shape[:2], len(bias))
        if self.skip_weight is not None:
            rows, slopes = rows + start @ self.skip_weight, slopes + steps @ self.skip_weight
        return rows, np.broadcast_to(slopes, (len(rows), *slopes.shape[1:]))

    def evaluate(self, inputs: Float[np.ndarray, "N A"]) -> Float32[np.ndarray, "N B"]:
        return self.linearise(inputs, np.zeros((0, inputs.shape[1])))[0]


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
    """A trained autoencoder whose code has N dimensions of the network and P - N amplitudes of residuals."""

    architecture: NetworkArchitecture
    weights: Mapping[str, np.ndarray]  # the network's weights in single precision, by their names in the network
    code_mean: np.ndarray  # (N,) mean of the network's code over the training poses
    code_cholesky: np.ndarray  # (N, N) lower triangular: the network's code is code_mean + code_cholesky @ code[:N]
    # (P - N, J, 3) radians: residual of the decoded pose for one standard deviation of each further code dimension
    residual_directions: np.ndarray
    kind: ClassVar[str] = "autoencoder"

    @cached_property
    def encoder(self) -> Layers:
        return Layers(self.architecture, self.weights, ENCODER)

    @cached_property
    def decoder(self) -> Layers:
        return Layers(self.architecture, self.weights, DECODER)

    @property
    def code_size(self) -> int:
        return len(self.code_mean) + len(self.residual_directions)

    @property
    def nonlinear_code_size(self) -> int:
        return len(self.code_mean)

    def encode(self, pose_vectors: Float[np.ndarray, "N J 3"]) -> Float[np.ndarray, "N P"]:
        """Return the codes of poses: the network's code, and the most probable residual amplitudes given the network's code."""
        features = compute_pose_features(self.architecture.input_features, pose_vectors, self.reference_rotations)
        network_code = self.encoder.evaluate(features).astype(float)
        decoded = self._decode_network_code(network_code)
        axis_count = 3 * len(self.joint_names)
        sd = self.residual_sd_rad[:, None]
        directions = (self.residual_directions / sd).reshape(len(self.residual_directions), axis_count)
        residuals = ((pose_vectors - decoded) / sd).reshape(len(pose_vectors), axis_count)
        amplitudes = np.linalg.solve(directions @ directions.T + np.eye(len(directions)), directions @ residuals.T).T
        normalised = np.linalg.solve(self.code_cholesky, (network_code - self.code_mean).T).T
        return np.concatenate([normalised, amplitudes], axis=1)

    def decode(self, codes: Float[np.ndarray, "N P"]) -> Float[np.ndarray, "N J 3"]:
        return self._decode_network_code(self._compute_network_code(codes)) + self._compute_residual(codes)

    def linearise(self, codes: Float[np.ndarray, "N P"]) -> tuple[Float[np.ndarray, "N J 3"], Float[np.ndarray, "N J 3 P"]]:
        decoded, jacobian = self._linearise_network_code(self._compute_network_code(codes))
        directions = np.moveaxis(self.residual_directions, 0, -1)
        residual_jacobian = np.broadcast_to(directions, (*decoded.shape, len(self.residual_directions)))
        return decoded + self._compute_residual(codes), np.concatenate([jacobian, residual_jacobian], axis=-1)

    def serialise(self) -> tuple[Header, Tensors]:
        """Return header and tensors, in half precision, for which standard deviations and code scale were estimated."""
        names = (name.replace("0.layers.", "0.bent.").replace("0.skip.", "0.straight.") for name in self.weights)
        weights = {
            NETWORK_PREFIX + name: values.astype(np.float16) for name, values in zip(names, self.weights.values(), strict=True)
        }
        tensors = {name: getattr(self, field).astype(np.float32) for name, field in FIELD_OF_AUTOENCODER_TENSOR.items()}
        shape = {key: getattr(self.architecture, field) for key, field in ARCHITECTURE_FIELD_OF_KEY.items()}
        return {"shape": shape}, tensors | weights

    @classmethod
    def deserialise(cls, joint_names: tuple[str, ...], header: Header, tensors: Tensors) -> "AutoencoderModel":
        shape = header["shape"] | {"hidden": tuple(header["shape"]["hidden"])}
        architecture = NetworkArchitecture(**{ARCHITECTURE_FIELD_OF_KEY[key]: value for key, value in shape.items()})
        if architecture.output_features == "continuous":
            raise ValueError("its network returns columns of rotations, not rotation vectors or Euler angles")
        of_network = {name: tensors.pop(name) for name in list(tensors) if name.startswith(NETWORK_PREFIX)}
        weights = {
            name.removeprefix(NETWORK_PREFIX).replace("0.bent.", "0.layers.").replace("0.straight.", "0.skip."): values
            for name, values in of_network.items()
        }
        joint_count, size = len(joint_names), architecture.code_size
        shapes = {
            "middle": (joint_count, 3, 3),
            "sigma": (joint_count,),
            "mean": (size,),
            "spread": (size, size),
            "astray": (architecture.residual_directions, joint_count, 3),
        }
        fields = {FIELD_OF_AUTOENCODER_TENSOR[name]: values for name, values in validate_tensors(tensors, **shapes).items()}
        checked = validate_tensors(weights, **architecture.list_weight_shapes(joint_count))
        single = {name: values.astype(np.float32) for name, values in checked.items()}
        return cls(joint_names, architecture=architecture, weights=single, **fields)

    def _compute_network_code(self, codes: np.ndarray) -> np.ndarray:
        return self.code_mean + codes[:, : len(self.code_mean)] @ self.code_cholesky.T

    def _compute_residual(self, codes: np.ndarray) -> np.ndarray:
        return np.tensordot(codes[:, len(self.code_mean) :], self.residual_directions, 1)

    def _decode_network_code(self, network_codes: np.ndarray) -> np.ndarray:
        """Return the rotation vectors (N, J, 3) of codes of the network."""
        return self._compute_vectors(self.decoder.evaluate(network_codes))

    def _linearise_network_code(self, network_codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the rotation vectors (N, J, 3) of network codes and their derivatives (N, J, 3, P) in the model's code."""
        features, slopes = self.decoder.linearise(network_codes, self.code_cholesky.T)
        vectors = self._compute_vectors(features)
        if self.architecture.output_features == "vectors":
            derivatives = self._compute_vectors(slopes)
        else:
            steps, middle = FEATURE_STEP * slopes.astype(float), features[:, None]
            derivatives = (self._compute_vectors(middle + steps) - self._compute_vectors(middle - steps)) / (2 * FEATURE_STEP)
        return vectors, np.moveaxis(derivatives, 1, -1)

    def _compute_vectors(self, features: np.ndarray) -> np.ndarray:
        return compute_feature_vectors(self.architecture.output_features, features, self.reference_rotations)


OTHER_WEIGHT_FILES = ("twist", "ik", "motion", "contacts")  # weights in priors/ that are not pose models
MNN_IK = "mnn-ik"  # enters the solver as one scalar, unlike the other models; used by the benchmarks only


def find_pose_model(name: str) -> Path:
    """Return the path of the model shipped as priors/NAME.safetensors, or `name` itself if it ends in .safetensors.

    Raises SceneError that lists the available models if there is none; also for MNN-IK, which is available by its path only.
    """
    path = Path(name) if name.endswith(".safetensors") else find_shipped_folder("priors") / f"{Path(name).name}.safetensors"
    shipped = {each.stem for each in find_shipped_folder("priors").glob("*.safetensors")}
    available = ", ".join(sorted(shipped - {MNN_IK, *OTHER_WEIGHT_FILES}))
    if name == MNN_IK:
        raise SceneError(f"The prior {name!r} is available in mocapfix bench prior only; choose one of: {available}.")
    if not is_existing_file(path) or name in OTHER_WEIGHT_FILES:
        raise SceneError(f"There is no trained prior {name!r}; choose one of: {available}; or give a .safetensors file.")
    return path


def load_pose_model(name: str, skeleton: Skeleton) -> PoseModel:
    """Return the model that `find_pose_model` finds.

    Raises SceneError that lists the available models if there is none, or names the file if it is invalid or was trained for
    another skeleton.
    """
    path = find_pose_model(name)
    try:
        with safe_open(path, "numpy") as file:
            header = json.loads((file.metadata() or {}).get("mocapfix", "null"))
            if header is None:
                raise ValueError("the header does not give the kind of the model")
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (safe_open is not a mapping)
        joint_names = tuple(header.pop("joints"))
        if joint_names == skeleton.names:
            kind = header.pop("kind")
            if kind not in MODEL_CLASSES:
                raise ValueError(f"the kind {kind!r} is unknown")
            return MODEL_CLASSES[kind].deserialise(joint_names, header, tensors)
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise SceneError(f"{path}: is not a prior trained by mocapfix ({' '.join(str(error).split())}).") from error
    joints = ", ".join(joint_names)
    raise SceneError(f"{path}: was trained for the joints {joints}, in this order; the joints of the skeleton differ.")


MODEL_CLASSES: dict[str, type[PoseModel]] = {each.kind: each for each in (GaussianModel, MixtureModel, AutoencoderModel)}


@cache
def build_pose_model_loader(name: str) -> Callable[[], PoseModel] | None:
    """Return a function that loads a trained prior once, when it is first needed; None for the name "none"."""
    if name == "none":
        return None
    find_pose_model(name)
    return cache(lambda: load_pose_model(name, load_cmu31_body().skeleton))
