"""The motion prior: rotations of lost joints, and the root position of a lost body, from the motion before and after a gap.

The network (Oreshkin et al. 2022, the delta-interpolator) is given the motion in `TOKEN_COUNT` moments: at increasing distances
before the gap, evenly inside it, and at increasing distances after it. Missing rotations are interpolated along the shortest arc
between the nearest known moments, the root position linearly; the network predicts the difference from this interpolation inside
the gap. Positions and directions are relative to the root in the middle of the gap, without its heading.

Rotations are unit quaternions (x, y, z, w) in single precision, for the free joints of the 31-joint skeleton with the root first.
The clavicles do not turn: the arms have their rotation as well.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from safetensors import SafetensorError
from safetensors.numpy import load_file

from mocapfix.errors import SceneError
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.kernels import lie
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.stats.rigid_alignment import multiply_quaternions, scale_rotations

MOTION_RATE_HZ = 30.0  # rate of the training data
CONTEXT_DISTANCES_S = np.array([0, 1, 2, 4, 7, 12, 19, 29]) / MOTION_RATE_HZ
"""Times from the last known frame before a gap, or the first one after it, to the moments in which the motion is given."""
INNER_COUNT = 16  # evenly spaced moments inside a gap
TOKEN_COUNT = INNER_COUNT + 2 * len(CONTEXT_DISTANCES_S)
INNER_TOKENS = slice(len(CONTEXT_DISTANCES_S), len(CONTEXT_DISTANCES_S) + INNER_COUNT)
EDGE_SOFTENING_S = 0.1  # harmonic distance from the edges of a gap at which an output has half of its scale
FIXED_JOINT_NAMES = ("LeftShoulder", "RightShoulder")
FEATURE_POINT_NAMES = ("Head", "ForeArm", "Hand", "FingerBase", "Leg", "Foot", "ToeBase")  # given, on both sides
SMALL_ANGLE_SINE = 1e-6


class MotionTree(NamedTuple):
    """The J joints of the motion prior, root first, and the points of the 31-joint skeleton that they carry."""

    joints: np.ndarray  # (J,) their indices among the 31 joints
    parents: np.ndarray  # (J,) the joint among the J that carries each, -1 for the root
    offsets: np.ndarray  # (J, 3) m: the joint in the axes of its parent among the J
    carriers: np.ndarray  # (31,) the joint among the J that carries each of the 31 joints
    points: np.ndarray  # (31, 3) m: the 31 joints in the axes of their carriers
    features: np.ndarray  # indices among the 31 of the joints whose positions are features


class InterpolatedWindows(NamedTuple):
    """B gaps with T moments each, without missing values."""

    quaternions: np.ndarray  # (B, T, J, 4) and position (B, T, 3) m of the root, interpolated where missing
    position: np.ndarray
    edge_s: np.ndarray  # (B, T, J) harmonic distance in time from the known moments on either side; 0 where known


@cache
def build_motion_tree() -> MotionTree:
    """Return the joints of the motion prior with the offsets of the average body."""
    body = load_cmu31_body()
    skeleton, count = body.skeleton, len(body.skeleton.names)
    is_used = body.free_joints & ~np.isin(skeleton.names, FIXED_JOINT_NAMES)
    joints = np.flatnonzero(is_used)
    own = np.cumsum(is_used) - 1
    carriers, points = np.zeros(count, int), np.zeros((count, 3))
    for j in range(1, count):
        parent = skeleton.parents[j]
        carriers[j] = own[parent] if is_used[parent] else carriers[parent]
        points[j] = skeleton.offsets[j] + (0.0 if is_used[parent] else points[parent])
    parents = np.where(joints == 0, -1, carriers[joints])
    is_feature = [name.endswith(FEATURE_POINT_NAMES) for name in skeleton.names]
    offsets = points[joints].astype(np.float32)
    return MotionTree(joints, parents, offsets, carriers, points.astype(np.float32), np.flatnonzero(is_feature))


def count_features() -> int:
    tree = build_motion_tree()
    joint_count = len(tree.joints)
    return 6 * joint_count + 3 + 3 * len(tree.features) + joint_count + 4


def count_outputs() -> int:
    """Return the network's outputs for a moment: rotation vectors, root displacement, and the logarithms of their deviations."""
    return 4 * len(build_motion_tree().joints) + 4


def compute_quaternion_vectors(quaternions: Float32[np.ndarray, "*batch 4"]) -> Float32[np.ndarray, "*batch 3"]:
    """Return the rotation vectors of quaternions, in radians, up to half a turn."""
    signed = np.where(quaternions[..., 3:] < 0, -quaternions, quaternions)
    sine = np.linalg.norm(signed[..., :3], axis=-1, keepdims=True)
    is_small = sine < SMALL_ANGLE_SINE
    factor = np.where(is_small, 2.0, 2 * np.arctan2(sine, signed[..., 3:]) / np.where(is_small, 1.0, sine))
    return (signed[..., :3] * factor).astype(np.float32)


def compute_vector_quaternions(vectors: Float32[np.ndarray, "*batch 3"]) -> Float32[np.ndarray, "*batch 4"]:
    """Return the quaternions of rotation vectors in radians."""
    half = np.linalg.norm(vectors, axis=-1, keepdims=True) / 2
    factor = np.where(half < SMALL_ANGLE_SINE, 0.5, np.sin(half) / np.where(half < SMALL_ANGLE_SINE, 1.0, 2 * half))
    return np.concatenate([vectors * factor, np.cos(half)], axis=-1).astype(np.float32)


def compute_quaternion_matrices(quaternions: Float32[np.ndarray, "*batch 4"]) -> Float32[np.ndarray, "*batch 3 3"]:
    x, y, z, w = (quaternions[..., i] for i in range(4))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def compute_token_times(gap_s: Float[np.ndarray, " B"]) -> Float[np.ndarray, "B T"]:
    """Return the moments given to the network, in seconds after the last frame before a gap; `gap_s` to the first after it."""
    inner = gap_s[:, None] * np.arange(1, INNER_COUNT + 1) / (INNER_COUNT + 1)
    before = np.broadcast_to(-CONTEXT_DISTANCES_S[::-1], (len(gap_s), len(CONTEXT_DISTANCES_S)))
    return np.concatenate([before, inner, gap_s[:, None] + CONTEXT_DISTANCES_S], axis=1)


def interpolate_missing_values(
    quaternions: Float32[np.ndarray, "B T J 4"],
    position: Float32[np.ndarray, "B T 3"],
    is_known: Bool[np.ndarray, "B T J"],
    times_s: Float[np.ndarray, "B T"],
) -> InterpolatedWindows:
    """Interpolate missing rotations, and the root position where the root is missing; at an end the nearest value is held.

    Each joint must be known in one moment of each gap. The values of missing joints do not matter, but must be finite.
    """
    token_count = is_known.shape[1]
    tokens = np.arange(token_count)[:, None]
    before = np.maximum.accumulate(np.where(is_known, tokens, -1), axis=1)
    after = np.minimum.accumulate(np.where(is_known, tokens, token_count)[:, ::-1], axis=1)[:, ::-1]
    b, t, j = np.nonzero(~is_known)
    first, last = before[b, t, j], after[b, t, j]
    has_start, has_end = first >= 0, last < token_count
    first, last = np.where(has_start, first, last), np.where(has_end, last, first)
    to_start, to_end = times_s[b, t] - times_s[b, first], times_s[b, last] - times_s[b, t]
    span = to_start + to_end
    share = np.where(span > 0, to_start / np.where(span > 0, span, 1), 0.0).astype(np.float32)[:, None]
    start = quaternions[b, first, j]
    turn = compute_quaternion_vectors(multiply_quaternions(start * INVERSE_SIGNS, quaternions[b, last, j]))
    filled = quaternions.copy()
    filled[b, t, j] = multiply_quaternions(start, compute_vector_quaternions(share * turn))
    edge_s = np.zeros(is_known.shape, np.float32)
    edge_s[b, t, j] = np.where(has_start & has_end, share[:, 0] * to_end, np.abs(to_start))
    filled_position, root = position.copy(), j == 0
    b, t, first, last, share = b[root], t[root], first[root], last[root], share[root]
    filled_position[b, t] = (1 - share) * position[b, first] + share * position[b, last]
    return InterpolatedWindows(filled, filled_position, edge_s)


INVERSE_SIGNS = np.array([-1, -1, -1, 1], np.float32)  # factors that turn a unit quaternion into that of the inverse rotation


def compute_output_scale(edge_s: Float32[np.ndarray, "*shape"]) -> Float32[np.ndarray, "*shape"]:
    """Return the factor of the network's outputs, which makes them continuous at the edges of a gap."""
    return edge_s / (edge_s + np.float32(EDGE_SOFTENING_S))


def remove_window_heading(
    windows: InterpolatedWindows,
) -> tuple[InterpolatedWindows, Float32[np.ndarray, "B 4"], Float32[np.ndarray, "B 3"]]:
    """Return windows relative to the root in their middle moment, and the heading and position that were removed."""
    middle = windows.quaternions.shape[1] // 2
    forward = compute_quaternion_matrices(windows.quaternions[:, middle, 0])[..., 2]
    half = np.arctan2(forward[:, 0], forward[:, 2]) / 2
    heading = np.stack([0 * half, np.sin(half), 0 * half, np.cos(half)], axis=-1).astype(np.float32)
    origin = windows.position[:, middle]
    quaternions = windows.quaternions.copy()
    quaternions[:, :, 0] = multiply_quaternions(
        np.broadcast_to((heading * INVERSE_SIGNS)[:, None], quaternions[:, :, 0].shape), quaternions[:, :, 0]
    )
    position = (windows.position - origin[:, None]) @ compute_quaternion_matrices(heading)
    return InterpolatedWindows(quaternions, position, windows.edge_s), heading, origin


def compute_carried_points(
    local_matrices: Float32[np.ndarray, "N J 3 3"], position: Float32[np.ndarray, "N 3"], points: Int[np.ndarray, " P"]
) -> Float32[np.ndarray, "N P 3"]:
    """Return the positions in metres of some of the 31 joints of the average body, by forward kinematics."""
    tree = build_motion_tree()
    world, origins = local_matrices.copy(), np.empty((*local_matrices.shape[:2], 3), np.float32)
    origins[:, 0] = position
    for j, parent in enumerate(tree.parents[1:], 1):
        origins[:, j] = origins[:, parent] + world[:, parent] @ tree.offsets[j]
        world[:, j] = world[:, parent] @ local_matrices[:, j]
    carriers = tree.carriers[points]
    return origins[:, carriers] + (world[:, carriers] @ tree.points[points][..., None])[..., 0]


def compute_window_features(
    windows: InterpolatedWindows,
    is_known: Bool[np.ndarray, "B T J"],
    is_inside: Bool[np.ndarray, "B T"],
    times_s: Float[np.ndarray, "B T"],
) -> Float32[np.ndarray, "B T F"]:
    """Return the features of gaps without heading; `is_inside` are moments not beyond the ends of the take."""
    batch, token_count, joint_count = is_known.shape
    tree, matrices = build_motion_tree(), compute_quaternion_matrices(windows.quaternions)
    points = compute_carried_points(
        matrices.reshape(-1, joint_count, 3, 3), windows.position.reshape(-1, 3), tree.features
    ).reshape(batch, token_count, -1)
    gap_s = times_s[:, [INNER_TOKENS.stop]] - times_s[:, [INNER_TOKENS.start - 1]]
    parts = [
        matrices[..., :2].reshape(batch, token_count, -1),
        windows.position,
        points - np.tile(windows.position, len(tree.features)),
        ~is_known & is_inside[..., None],
        is_inside[..., None],
        windows.edge_s.max(axis=2, keepdims=True),
        times_s[..., None],
        np.broadcast_to(np.sqrt(gap_s)[..., None], (batch, token_count, 1)),
    ]
    return np.concatenate([part.astype(np.float32) for part in parts], axis=-1)


MIN_LOG_SD, MAX_LOG_SD = -7.0, 2.0  # limits of the logarithms of standard deviations, relative to the initial one
INITIAL_LOG_SD = -1.5  # logarithm of the standard deviations in radians and metres, of an output of zero
NORMALISATION_EPSILON = 1e-5  # added to the variance of a moment's channels
MIN_PREDICTED_GAP_S, MAX_PREDICTED_GAP_S = 0.15, 2.3  # from the last known frame to the next, as in training


class PredictedGap(NamedTuple):
    """The motion in a gap of n frames, for the joints of `build_motion_tree`; known ones have their own rotations."""

    local_rotations: np.ndarray  # (n, J, 3, 3)
    rotation_sd_rad: np.ndarray  # (n, J) per axis
    root_position: np.ndarray  # (n, 3) m
    root_sd_m: np.ndarray  # (n,) per axis


@dataclass(frozen=True)
class MotionPrior:
    """A network of residual blocks, see `mocapfix.lab.motion_training.MotionNetwork`; its tensors by their names there."""

    tensors: dict[str, np.ndarray]

    @property
    def block_count(self) -> int:
        return sum(name.endswith(".time.weight") for name in self.tensors)

    def evaluate(self, features: Float32[np.ndarray, "B T F"]) -> Float32[np.ndarray, "B I O"]:
        """Return the network's outputs for the moments inside each gap."""
        each = self.tensors
        hidden = self._transform("input", (features - each["feature_mean"]) / each["feature_sd"]) + each["position"]
        for n in range(self.block_count):
            block = f"blocks.{n}"
            mixed = each[f"{block}.time.weight"] @ self._normalise(f"{block}.norm", hidden)
            channels = self._transform(f"{block}.channel", mixed + each[f"{block}.time.bias"][:, None])
            hidden = hidden + self._transform(f"{block}.out", channels * (0.5 + 0.5 * np.tanh(0.5 * channels)))
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

        Args:
            root_position: In metres, on a body of average size.
            local_rotations: Of the 31 joints; missing ones are finite.
            is_known: Which of the joints of `build_motion_tree` are known.
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
        corrected[:, 0] = multiply_quaternions(np.broadcast_to(heading, (len(corrected), 4)), corrected[:, 0])
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
    both, known = local_rotations[np.r_[lower, upper]], np.ones(2 * len(lower), bool)
    below, above = np.split(np.stack([lie.extract_joint_quaternions(both, j, known) for j in joints], axis=1), 2)
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
    quaternions = multiply_quaternions(windows.quaternions[0, INNER_TOKENS], compute_vector_quaternions(vectors))
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
    at = (frames - knots[0]) / (knots[1] - knots[0])
    between = interpolate_evenly(known.reshape(len(knots), -1), at).reshape(len(at), -1, 4)
    between /= np.linalg.norm(between, axis=-1, keepdims=True)
    edge = np.zeros((1, sd.shape[1]))
    all_sd = np.concatenate([edge, sd, edge])
    frame_sd = np.stack([np.interp(frames, knots, values) for values in all_sd.T], axis=1)
    root_position = interpolate_evenly(position[used].astype(float), at)
    return PredictedGap(compute_quaternion_matrices(between), frame_sd[:, :-1], root_position, frame_sd[:, -1])


def interpolate_evenly(values: Float[np.ndarray, "K Q"], at: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n Q"]:
    """Return the cubic spline through values at 0 to K - 1, as scipy's CubicSpline, which takes long to import."""
    count = len(values)
    system = 4 * np.eye(count) + np.eye(count, k=1) + np.eye(count, k=-1)
    system[[0, -1]] = 0.0
    system[0, :3] = system[-1, -3:] = 1.0, -2.0, 1.0  # the third derivative is continuous at the second and last but one value
    bend = np.linalg.solve(system, 6 * np.pad(np.diff(values, 2, axis=0), ((1, 1), (0, 0))))
    first = np.clip(np.floor(at).astype(int), 0, count - 2)
    share = (at - first)[:, None]
    terms = ((1 - share) ** 3 - (1 - share)) * bend[first] + (share**3 - share) * bend[first + 1]
    return (1 - share) * values[first] + share * values[first + 1] + terms / 6


@cache
def load_shipped_motion_prior() -> MotionPrior:
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


MOTION_VARIANCE_FACTOR = 2.0  # of the predicted variance: new people and captures differ from the training data
PREDICTION_CORRELATION = 0.4  # correlation of the errors of the prediction with those of other estimates
CROPPED_CONTEXT_S = 1.1  # time on either side of a gap that a prediction is given; more than the network uses


class GapPrediction(NamedTuple):
    """The motion prior's prediction of L joints in n frames."""

    rotations: np.ndarray  # (n, L, 3, 3) local
    variance: np.ndarray  # (n, L) rad^2 per axis, infinite for joints that it does not predict
    root_position: np.ndarray  # (n, 3) m
    root_variance: np.ndarray  # (n,) m^2 per axis

    def select_joints(self, joints: Int[np.ndarray, " N"]) -> "GapPrediction":
        return self._replace(rotations=self.rotations[:, joints], variance=self.variance[:, joints])


class GapContext(NamedTuple):
    """The motion around a gap: root (T, 3) m, local rotations (T, J, 3, 3) and what is known (T, J) of a body's joints.

    The missing rotations hold other estimates. The gap has the frames first..last, inclusive.
    """

    root_position: np.ndarray
    local_rotations: np.ndarray
    is_known: np.ndarray
    first: int
    last: int
    rate_hz: float

    def crop(self) -> "GapContext":
        """Return the frames that the network needs."""
        margin = int(np.ceil(CROPPED_CONTEXT_S * self.rate_hz))
        start = max(0, self.first - margin)
        frames = slice(start, self.last + 1 + margin)
        parts = self.root_position[frames], self.local_rotations[frames], self.is_known[frames]
        return GapContext(*parts, self.first - start, self.last - start, self.rate_hz)

    @property
    def frames(self) -> slice:
        return slice(self.first, self.last + 1)


def combine_rotations(
    rotations: Float[np.ndarray, "n L 3 3"], variance: Float[np.ndarray, "n L"], prediction: GapPrediction
) -> tuple[Float[np.ndarray, "n L 3 3"], Float[np.ndarray, "n L"]]:
    """Return an estimate of rotations combined with the prediction of the same joints, and its variance in rad^2."""
    weight = compute_prediction_weight(variance, prediction.variance)
    difference = np.swapaxes(rotations, -1, -2) @ prediction.rotations
    return rotations @ scale_rotations(difference, weight[..., None]), compute_combined_variance(
        variance, prediction.variance, weight
    )


def compute_prediction_weight(
    variance: Float[np.ndarray, "*shape"], predicted_variance: Float[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape"]:
    """Return the weight of the prediction against an estimate; zero where the prediction's variance is infinite."""
    total = variance + MOTION_VARIANCE_FACTOR * predicted_variance
    return np.divide(variance, total, out=np.zeros_like(variance), where=(total > 0) & np.isfinite(total))


def compute_combined_variance(
    variance: Float[np.ndarray, "*shape"], predicted_variance: Float[np.ndarray, "*shape"], weight: Float[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape"]:
    """Return the variance of the weighted mean of two estimates with correlated errors."""
    finite = np.where(np.isfinite(predicted_variance), predicted_variance, 0.0)
    shared = 2 * PREDICTION_CORRELATION * weight * (1 - weight) * np.sqrt(variance * finite)
    return (1 - weight) ** 2 * variance + weight**2 * finite + shared


def predict_model_gap(prior: MotionPrior, context: GapContext, size_ratio: float = 1.0) -> GapPrediction | None:
    """Return the prediction of the 31 joints in a gap, None if there is none; `size_ratio` relative to the average body."""
    tree, names = build_motion_tree(), load_cmu31_body().skeleton.names
    folded, is_known = context.local_rotations.copy(), context.is_known[:, tree.joints].copy()
    for i, j in enumerate(tree.joints):
        if names[j].endswith("Arm") and not names[j].endswith("ForeArm"):
            folded[:, j] = folded[:, j - 1] @ folded[:, j]
            is_known[:, i] &= context.is_known[:, j - 1] | ~context.is_known[:, j - 1].any()
    gap = prior.predict_gap(context.root_position / size_ratio, folded, is_known, context.first, context.last, context.rate_hz)
    if gap is None:
        return None
    rotations = context.local_rotations[context.frames].copy()
    variance = np.full(rotations.shape[:2], np.inf)
    for i, j in enumerate(tree.joints):
        rotations[:, j] = gap.local_rotations[:, i]
        if names[j].endswith("Arm") and not names[j].endswith("ForeArm"):
            rotations[:, j] = np.swapaxes(rotations[:, j - 1], -1, -2) @ rotations[:, j]
    variance[:, tree.joints] = gap.rotation_sd_rad**2
    return GapPrediction(rotations, variance, size_ratio * gap.root_position, (size_ratio * gap.root_sd_m) ** 2)


def predict_shipped_gap(context: GapContext, size_ratio: float = 1.0) -> GapPrediction | None:
    """Return the prediction of `predict_model_gap` by the shipped motion prior, which is read when it is first needed."""
    return predict_model_gap(load_shipped_motion_prior(), context, size_ratio)
