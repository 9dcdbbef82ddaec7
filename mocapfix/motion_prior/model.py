"""The motion prior: rotations of lost joints, and the root position of a lost body, from the motion before and after a gap.

The trained network (`mocapfix.train.motion_network`) is evaluated here without torch, in a few milliseconds for a gap.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from mocapfix.errors import SceneError
from mocapfix.files.output_files import replace_atomically
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.motion_prior.motion_features import (
    INNER_TOKENS,
    TOKEN_COUNT,
    InterpolatedWindows,
    build_motion_tree,
    compute_output_scale,
    compute_quaternion_matrices,
    compute_token_times,
    compute_vector_quaternions,
    compute_window_features,
    count_features,
    count_outputs,
    interpolate_missing_values,
    multiply_unit_quaternions,
    remove_window_heading,
)

MIN_LOG_SD, MAX_LOG_SD = -7.0, 2.0
"""Limits of the logarithms of standard deviations, relative to the initial one."""
INITIAL_LOG_SD = -1.5
"""Logarithm of the standard deviations in radians and metres, of an output of zero."""
NORMALISATION_EPSILON = 1e-5
"""Added to the variance of a moment's channels."""
MIN_PREDICTED_GAP_S, MAX_PREDICTED_GAP_S = 0.15, 2.3
"""Durations from the last known frame to the next; other gaps were not trained on."""


class PredictedGap(NamedTuple):
    """The motion in a gap of n frames, for the joints of `build_motion_tree`; known ones have their own rotations.

    local_rotations  (n, J, 3, 3);  rotation_sd_rad  (n, J) per axis
    root_position    (n, 3) m;      root_sd_m        (n,) per axis
    """

    local_rotations: np.ndarray
    rotation_sd_rad: np.ndarray
    root_position: np.ndarray
    root_sd_m: np.ndarray


@dataclass(frozen=True)
class MotionPrior:
    """A network of residual blocks, see `mocapfix.train.motion_network.MotionNetwork`; its tensors by their names there."""

    tensors: dict[str, np.ndarray]

    @property
    def block_count(self) -> int:
        """The number of residual blocks."""
        return sum(name.endswith(".time.weight") for name in self.tensors)

    def evaluate(self, features: Float32[np.ndarray, "B T F"]) -> Float32[np.ndarray, "B I O"]:
        """Return the network's outputs for the moments inside each gap."""
        each = self.tensors
        hidden = self._transform("input", (features - each["feature_mean"]) / each["feature_sd"]) + each["position"]
        for n in range(self.block_count):
            block = f"blocks.{n}"
            mixed = each[f"{block}.time.weight"] @ self._normalise(f"{block}.norm", hidden)
            channels = self._transform(f"{block}.channel", mixed + each[f"{block}.time.bias"][:, None])
            hidden = hidden + self._transform(f"{block}.out", channels / (1 + np.exp(-channels)))
        return self._transform("output", self._normalise("norm", hidden[:, INNER_TOKENS]))

    def _transform(self, layer: str, values: np.ndarray) -> np.ndarray:
        return values @ self.tensors[f"{layer}.weight"].T + self.tensors[f"{layer}.bias"]

    def _normalise(self, layer: str, values: np.ndarray) -> np.ndarray:
        centred = values - values.mean(axis=-1, keepdims=True)
        sd = np.sqrt((centred**2).mean(axis=-1, keepdims=True) + NORMALISATION_EPSILON)
        return centred / sd * self.tensors[f"{layer}.weight"] + self.tensors[f"{layer}.bias"]

    def predict_gap(
        self,
        root_position: Float[np.ndarray, "T 3"],
        local_rotations: Float[np.ndarray, "T 31 3 3"],
        is_known: Bool[np.ndarray, "T J"],
        first: int,
        last: int,
        rate_hz: float,
    ) -> PredictedGap | None:
        """Return the motion in frames first..last, inclusive; None if the network was not trained on such a gap.

        root_position    in metres, on a body of average size
        local_rotations  of the 31 joints; missing ones are finite
        is_known         which of the joints of `build_motion_tree` are known
        """
        gap_s = np.array([(last - first + 2) / rate_hz])
        if first == 0 or last == len(root_position) - 1 or not MIN_PREDICTED_GAP_S <= gap_s[0] <= MAX_PREDICTED_GAP_S:
            return None
        times_s = compute_token_times(gap_s)
        frames = first - 1 + times_s[0] * rate_hz
        is_inside = (frames > -0.5) & (frames < len(root_position) - 0.5)
        sampled = _sample_motion(root_position, local_rotations, is_known, np.clip(frames, 0, len(root_position) - 1))
        is_token_known = sampled[2] & is_inside[:, None]
        is_token_known[INNER_TOKENS] &= is_known[first : last + 1].all(axis=0)
        if not is_token_known.any(axis=0).all():
            return None
        filled = interpolate_missing_values(sampled[0][None], sampled[1][None], is_token_known[None], times_s)
        relative, heading, _ = remove_window_heading(filled)
        outputs = self.evaluate(compute_window_features(relative, is_token_known[None], is_inside[None], times_s))[0]
        corrected, sd = _apply_outputs(relative, outputs)
        corrected[:, 0] = multiply_unit_quaternions(np.broadcast_to(heading, (len(corrected), 4)), corrected[:, 0])
        position = filled.position[0].copy()
        scale = compute_output_scale(filled.edge_s[0, INNER_TOKENS, 0])
        joint_count = len(build_motion_tree().joints)
        shift = outputs[:, 3 * joint_count : 3 * joint_count + 3] * scale[:, None]
        position[INNER_TOKENS] += shift @ compute_quaternion_matrices(heading[0]).T
        quaternions = filled.quaternions[0].copy()
        quaternions[INNER_TOKENS] = corrected
        return _interpolate_tokens(quaternions, position, sd, frames, np.arange(first, last + 1))


def _sample_motion(
    root_position: Float[np.ndarray, "T 3"],
    local_rotations: Float[np.ndarray, "T 31 3 3"],
    is_known: Bool[np.ndarray, "T J"],
    frames: Float[np.ndarray, " N"],
) -> tuple[Float32[np.ndarray, "N J 4"], Float32[np.ndarray, "N 3"], Bool[np.ndarray, "N J"]]:
    """Return rotations, root position and what is known at fractional frames, interpolated linearly."""
    joints = build_motion_tree().joints
    nearest = np.round(frames)
    frames = np.where(np.abs(frames - nearest) < 1e-6, nearest, frames)  # exact frames need no neighbour
    lower = np.floor(frames).astype(int)
    upper = np.ceil(frames).astype(int)
    share = (frames - lower)[:, None]
    below, above = (
        Rotation.from_matrix(local_rotations[each][:, joints].reshape(-1, 3, 3)).as_quat().reshape(len(frames), -1, 4)
        for each in (lower, upper)
    )
    above = np.where((below * above).sum(-1, keepdims=True) < 0, -above, above)
    quaternions = below + share[..., None] * (above - below)
    quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
    position = (1 - share) * root_position[lower] + share * root_position[upper]
    return quaternions.astype(np.float32), position.astype(np.float32), is_known[lower] & is_known[upper]


def _apply_outputs(
    windows: InterpolatedWindows, outputs: Float32[np.ndarray, "I O"]
) -> tuple[Float32[np.ndarray, "I J 4"], Float32[np.ndarray, "I D"]]:
    """Return the predicted quaternions inside a gap, and the standard deviations of the rotations and of the root position."""
    edge_s = windows.edge_s[0, INNER_TOKENS]
    count, scale = edge_s.shape[1], compute_output_scale(edge_s)
    vectors = outputs[:, : 3 * count].reshape(len(outputs), count, 3) * scale[..., None]
    quaternions = multiply_unit_quaternions(windows.quaternions[0, INNER_TOKENS], compute_vector_quaternions(vectors))
    log_sd = np.clip(outputs[:, 3 * count + 3 :] + INITIAL_LOG_SD, MIN_LOG_SD, MAX_LOG_SD)
    return quaternions, np.concatenate([scale, scale[:, :1]], axis=1) * np.exp(log_sd)


def _interpolate_tokens(
    quaternions: Float32[np.ndarray, "T J 4"],
    position: Float32[np.ndarray, "T 3"],
    sd: Float32[np.ndarray, "I D"],
    token_frames: Float[np.ndarray, " T"],
    frames: Int[np.ndarray, " n"],
) -> PredictedGap:
    """Return the motion in all frames of a gap, given the moments at its edges and inside it."""
    used = slice(INNER_TOKENS.start - 1, INNER_TOKENS.stop + 1)
    knots, known = token_frames[used], quaternions[used].astype(float)
    products = (known[1:] * known[:-1]).sum(axis=-1, keepdims=True)
    known[1:] *= np.cumprod(np.where(products < 0, -1.0, 1.0), axis=0)
    rotations = Rotation.from_quat(CubicSpline(knots, known)(frames).reshape(-1, 4)).as_matrix()
    edge = np.zeros((1, sd.shape[1]))
    all_sd = np.concatenate([edge, sd, edge])
    frame_sd = np.stack([np.interp(frames, knots, values) for values in all_sd.T], axis=1)
    root_position = CubicSpline(knots, position[used].astype(float))(frames)
    return PredictedGap(rotations.reshape(len(frames), -1, 3, 3), frame_sd[:, :-1], root_position, frame_sd[:, -1])


@cache
def load_shipped_motion_prior() -> MotionPrior:
    """Return the motion prior shipped with mocapfix."""
    return read_motion_prior(find_shipped_folder("priors") / "motion.safetensors")


def read_motion_prior(path: Path) -> MotionPrior:
    """Read a motion prior. Raises SceneError, naming the file, if it is not one."""
    try:
        model = MotionPrior({name: values.astype(np.float32) for name, values in load_file(path).items()})
        outputs = model.evaluate(np.zeros((1, TOKEN_COUNT, count_features()), np.float32))
        if outputs.shape[2] != count_outputs() or not np.isfinite(outputs).all():
            raise ValueError("its outputs do not fit the joints")
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise SceneError(f"{path}: is not a motion prior trained by mocapfix ({' '.join(str(error).split())}).") from error
    return model


def write_motion_prior(path: Path, model: MotionPrior) -> None:
    """Write a motion prior in half precision, atomically. Raises WriteError if the folder cannot be written."""
    with replace_atomically(path) as temporary:
        save_file({name: values.astype(np.float16) for name, values in model.tensors.items()}, temporary)
