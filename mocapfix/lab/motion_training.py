"""Training of the motion prior: what moves during a gap, given the motion on either side and the joints that are seen.

The network has layers that mix the moments of a gap and its features in turn. Its training windows are stretches of recorded
motion in which joints go missing, as in captures: whole limbs for 0.2 to 2 s, the lower part of a limb, several limbs, the head,
and the whole body; some windows have a second occlusion at another time. Half of the windows are mirrored.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from scipy.spatial.transform import Rotation
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from mocapfix.errors import ReadError
from mocapfix.lab.cards import CardData, format_table, write_card, write_weights
from mocapfix.lab.networks import compute_rotation_tensor
from mocapfix.lab.recordings import UNKNOWN_SOURCE, RecordingSource, read_recordings
from mocapfix.lab.settings import MotionSettings, Stateful, compute_training_fingerprint, resume_training, write_checkpoint
from mocapfix.lab.training_poses import detect_rotation_jumps, find_weakly_observed_joints, mirror_joint_name
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.system import count_cores
from mocapfix.solve.motion_prior import (
    INITIAL_LOG_SD,
    INNER_COUNT,
    INNER_TOKENS,
    MAX_LOG_SD,
    MIN_LOG_SD,
    MOTION_RATE_HZ,
    TOKEN_COUNT,
    MotionPrior,
    build_motion_tree,
    compute_carried_points,
    compute_output_scale,
    compute_quaternion_matrices,
    compute_token_times,
    compute_vector_quaternions,
    compute_window_features,
    count_features,
    count_outputs,
    interpolate_missing_values,
    remove_window_heading,
)
from mocapfix.stats.rigid_alignment import multiply_quaternions

MIN_STRETCH_FRAMES = 30  # shorter stretches between jumps of the solved motion are not used
MAX_RATE_DEVIATION = 0.02  # motion whose rate differs by a smaller share from that of the motion prior is not resampled
MIN_GAP_FRAMES, MAX_GAP_FRAMES = 5, 62  # durations of occlusions
MIN_KNOWN_FRAMES = 4  # known frames on either side of an occlusion
BODY_GAP_SHARE = 0.4  # share of windows in which the whole body is missing
SEVERAL_LIMBS_SHARE = 0.15
PARTIAL_LIMB_SHARE = 0.15
SECOND_GAP_SHARE = 0.2  # share of windows with another occlusion of a limb at another time
OCCLUDED_LIMBS = (
    ("LeftArm", "LeftForeArm", "LeftHand"),
    ("RightArm", "RightForeArm", "RightHand"),
    ("LeftUpLeg", "LeftLeg", "LeftFoot"),
    ("RightUpLeg", "RightLeg", "RightFoot"),
    ("Neck", "Neck1", "Head"),
)


class MotionStretches(NamedTuple):
    """Motion without jumps, joined: quaternions (N, J, 4), root positions (N, 3) m; S stretches from start to end, exclusive."""

    quaternions: np.ndarray
    position: np.ndarray
    starts: np.ndarray
    ends: np.ndarray
    subjects: np.ndarray  # (S,) the subject of each stretch
    sources: tuple[RecordingSource, ...]  # where each comes from

    def count_frames(self) -> Counter[str]:
        """Return the number of frames of each subject."""
        counts = Counter[str]()
        for subject, start, end in zip(self.subjects, self.starts, self.ends, strict=True):
            counts[str(subject)] += int(end - start)
        return counts

    def count_source_frames(self) -> Counter[RecordingSource]:
        """Return the number of frames of each source."""
        counts = Counter[RecordingSource]()
        for source, start, end in zip(self.sources, self.starts, self.ends, strict=True):
            counts[source] += int(end - start)
        return counts


class TrainingWindows(NamedTuple):
    """B gaps with T moments: quaternions (B, T, J, 4), root positions (B, T, 3) m, known joints (B, T, J), moments inside the
    take (B, T), times (B, T) s.
    """

    quaternions: np.ndarray
    position: np.ndarray
    is_known: np.ndarray
    is_inside: np.ndarray
    times_s: np.ndarray
    is_body_gap: np.ndarray  # (B,) whether the whole body is missing
    gap_s: np.ndarray  # (B,) duration


def gather_motion_stretches(
    folders: Sequence[Path], is_wanted: Callable[[str], bool], progress: Callable[[str], object]
) -> MotionStretches:
    """Return the motion of the wanted subjects. Raises ReadError if there is none."""
    tree, is_observed = build_motion_tree(), ~find_weakly_observed_joints(load_cmu31_body().skeleton.names)
    quaternions: list[np.ndarray] = []
    positions: list[np.ndarray] = []
    bounds: list[tuple[int, int]] = []
    subjects: list[str] = []
    sources: list[RecordingSource] = []
    count = 0
    for recording in read_recordings(folders):
        if not is_wanted(recording.subject):
            continue
        progress(f"reading {recording.name}")
        has_jump = detect_rotation_jumps(recording.rotations[:, is_observed], recording.rate_hz).any(axis=1)
        edges = np.r_[0, np.flatnonzero(has_jump) + 1, len(recording.rotations)]
        for first, end in pairwise(edges):
            if end - first < 2:
                continue
            rotations = recording.rotations[first:end, tree.joints].reshape(-1, 3, 3)
            stretch = Rotation.from_matrix(rotations).as_quat().astype(np.float32).reshape(end - first, -1, 4)
            root_position = recording.root_position[first:end].astype(np.float32)
            stretch, root_position = resample_stretch(stretch, root_position, recording.rate_hz)
            frame_count = len(stretch)
            if frame_count < MIN_STRETCH_FRAMES:
                continue
            quaternions.append(stretch)
            positions.append(root_position)
            bounds.append((count, count + frame_count))
            subjects.append(recording.subject)
            sources.append(recording.source)
            count += frame_count
    if not bounds:
        raise ReadError(f"{', '.join(map(str, folders))}: no motion of the required subjects.")
    starts, ends = np.array(bounds).T
    return MotionStretches(
        np.concatenate(quaternions), np.concatenate(positions), starts, ends, np.array(subjects), tuple(sources)
    )


def resample_stretch(
    quaternions: Float32[np.ndarray, "T J 4"], position: Float32[np.ndarray, "T 3"], rate_hz: float
) -> tuple[Float32[np.ndarray, "N J 4"], Float32[np.ndarray, "N 3"]]:
    """Return rotations and root positions at MOTION_RATE_HZ, of at least two frames."""
    if abs(rate_hz / MOTION_RATE_HZ - 1) < MAX_RATE_DEVIATION:
        return quaternions, position
    frames, ends = np.arange(0, len(position) - 1 + 1e-9, rate_hz / MOTION_RATE_HZ), np.array([len(position)])
    whole = MotionStretches(quaternions, position, np.zeros(1, int), ends, np.array([""]), (UNKNOWN_SOURCE,))
    resampled, moved = sample_stretches(whole, np.zeros(1, int), frames[None])
    return resampled[0], moved[0]


def compute_stretch_weights(
    stretches: MotionStretches, balance: float, retargeted_weight: float = 1.0
) -> Float[np.ndarray, " S"]:
    """Return the probability with which a window is drawn from each stretch.

    Args:
        balance: 0 draws from all frames equally often, 1 from all subjects.
        retargeted_weight: How often retargeted motion is drawn relative to other motion.
    """
    frames = (stretches.ends - stretches.starts).astype(float)
    _, number = np.unique(stretches.subjects, return_inverse=True)
    subject_frames = np.bincount(number, frames)
    weights = frames * subject_frames[number] ** -balance
    weights[np.array([source.is_retargeted for source in stretches.sources], bool)] *= retargeted_weight
    return weights / weights.sum()


def draw_training_windows(
    stretches: MotionStretches,
    weights: Float[np.ndarray, " S"],
    count: int,
    rng: np.random.Generator,
    speed_spread: float = 0.0,
    posture_sd_rad: float = 0.0,
) -> TrainingWindows:
    """Return windows with an occlusion in the middle.

    Args:
        speed_spread: Windows are up to this share faster or slower than recorded.
        posture_sd_rad: Standard deviation of the rotation vectors by which joints of a window are turned, as in other people.
    """
    chosen = rng.choice(len(weights), count, p=weights)
    lengths = (stretches.ends - stretches.starts)[chosen]
    longest = np.minimum(MAX_GAP_FRAMES, lengths - 2 * MIN_KNOWN_FRAMES)
    gap_frames = MIN_GAP_FRAMES + (rng.random(count) * (longest - MIN_GAP_FRAMES + 1)).astype(int)
    first = MIN_KNOWN_FRAMES + (rng.random(count) * (lengths - 2 * MIN_KNOWN_FRAMES - gap_frames + 1)).astype(int)
    faster = (1 + speed_spread) ** rng.uniform(-1, 1, count) if speed_spread else np.ones(count)
    rate_hz = MOTION_RATE_HZ * faster
    gap_s = (gap_frames + 1) / rate_hz
    times_s = compute_token_times(gap_s)
    frames = (first - 1)[:, None] + times_s * rate_hz[:, None]
    is_inside = (frames > -0.5) & (frames < lengths[:, None] - 0.5)
    quaternions, position = sample_stretches(stretches, chosen, np.clip(frames, 0, lengths[:, None] - 1))
    is_mirrored = rng.random(count) < 0.5
    quaternions[is_mirrored] = mirror_quaternions(quaternions[is_mirrored])
    position[is_mirrored] *= np.array([-1, 1, 1], np.float32)
    if posture_sd_rad:
        turn = rng.normal(0, posture_sd_rad, (count, 1, quaternions.shape[2], 3))
        turn[:, :, 0] = 0.0
        quaternions = multiply_quaternions(quaternions, compute_vector_quaternions(turn))
    is_known = np.broadcast_to(is_inside[..., None], (*is_inside.shape, quaternions.shape[2])).copy()
    is_body_gap = np.zeros(count, bool)
    for b in range(count):
        joints, is_body_gap[b] = draw_missing_joints(rng)
        is_known[b, INNER_TOKENS, joints] = False
        if not is_body_gap[b] and rng.random() < SECOND_GAP_SHARE:
            limb, duration = find_limb_joints()[rng.integers(len(OCCLUDED_LIMBS))], int(rng.integers(2, 12))
            start = int(rng.integers(0, TOKEN_COUNT - duration))
            hidden = is_known[b].copy()
            hidden[start : start + duration, limb] = False
            if hidden.any(axis=0).all():
                is_known[b] = hidden
    return TrainingWindows(quaternions, position, is_known, is_inside, times_s, is_body_gap, gap_s)


def sample_stretches(
    stretches: MotionStretches, chosen: Int[np.ndarray, " B"], frames: Float[np.ndarray, "B T"]
) -> tuple[Float32[np.ndarray, "B T J 4"], Float32[np.ndarray, "B T 3"]]:
    """Return rotations and root positions of stretches at fractional frames, interpolated linearly between frames."""
    lengths = (stretches.ends - stretches.starts)[chosen, None]
    lower = np.minimum(np.floor(frames).astype(int), lengths - 2)
    share, index = (frames - lower).astype(np.float32)[..., None], lower + stretches.starts[chosen, None]
    below, above = stretches.quaternions[index], stretches.quaternions[index + 1]
    above *= np.where((below * above).sum(-1, keepdims=True) < 0, np.float32(-1), np.float32(1))
    quaternions = below + share[..., None] * (above - below)
    quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
    position = (1 - share) * stretches.position[index] + share * stretches.position[index + 1]
    return quaternions, position


@cache
def find_limb_joints() -> list[Int[np.ndarray, " L"]]:
    """Return the joints of each limb among those of the motion prior, from the trunk outwards."""
    names = [load_cmu31_body().skeleton.names[j] for j in build_motion_tree().joints]
    return [np.array([names.index(name) for name in limb]) for limb in OCCLUDED_LIMBS]


def draw_missing_joints(rng: np.random.Generator) -> tuple[Int[np.ndarray, " L"], bool]:
    """Return the joints of an occlusion, and whether they are the whole body."""
    limbs, draw = find_limb_joints(), rng.random()
    if draw < BODY_GAP_SHARE:
        return np.arange(len(build_motion_tree().joints)), True
    if draw < BODY_GAP_SHARE + SEVERAL_LIMBS_SHARE:
        chosen = rng.choice(len(limbs), int(rng.integers(2, 4)), replace=False)
        return np.concatenate([limbs[i] for i in chosen]), False
    limb = limbs[rng.integers(len(limbs)) if rng.random() < 0.3 else rng.integers(4)]
    if draw < BODY_GAP_SHARE + SEVERAL_LIMBS_SHARE + PARTIAL_LIMB_SHARE:
        return limb[int(rng.integers(1, 3)) :], False
    return limb, False


def mirror_quaternions(quaternions: Float32[np.ndarray, "*batch J 4"]) -> Float32[np.ndarray, "*batch J 4"]:
    """Return mirrored local rotations: left becomes right, and rotations about y and z change sign."""
    names = [load_cmu31_body().skeleton.names[j] for j in build_motion_tree().joints]
    order = [names.index(mirror_joint_name(name)) for name in names]
    return quaternions[..., order, :] * np.array([1, -1, -1, 1], np.float32)


ROTATION_LOSS_M_RAD = 0.03  # weight of rotation errors compared with position errors
DEVIATION_LOSS_WEIGHT = 0.02  # weight of the likelihood from which the standard deviations are learned
SHORT_GAP_WEIGHT_S = 0.1  # gaps have a weight that is inverse to their duration plus this
MIN_MOTION_FEATURE_SD = 0.05  # least standard deviation of a feature
MIN_ERROR_M = 0.005  # position errors below this count by their square


class MixingBlock(nn.Module):
    """A residual block: normalisation, a linear layer over the moments and one over the channels."""

    def __init__(self, width: int):
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.time = nn.Linear(TOKEN_COUNT, TOKEN_COUNT)
        self.channel = nn.Linear(width, width)
        self.out = nn.Linear(width, width)

    def forward(self, hidden: Tensor) -> Tensor:
        mixed = self.time.weight @ self.norm(hidden) + self.time.bias[:, None]
        return hidden + self.out(nn.functional.silu(self.channel(mixed)))


class MotionNetwork(nn.Module):
    """From features (B, T, F) of all moments to outputs (B, I, O) of those inside the gap."""

    feature_mean: Tensor
    feature_sd: Tensor

    def __init__(self, width: int, block_count: int, feature_mean: Tensor, feature_sd: Tensor):
        super().__init__()
        self.register_buffer("feature_mean", feature_mean)
        self.register_buffer("feature_sd", feature_sd)
        self.input = nn.Linear(count_features(), width)
        self.position = nn.Parameter(0.1 * torch.randn(TOKEN_COUNT, width))
        self.blocks = nn.ModuleList(MixingBlock(width) for _ in range(block_count))
        self.norm = nn.LayerNorm(width)
        self.output = nn.Linear(width, count_outputs())
        with torch.no_grad():
            self.output.weight *= 0.1
            self.output.bias.zero_()

    def forward(self, features: Tensor) -> Tensor:
        hidden = self.input((features - self.feature_mean) / self.feature_sd) + self.position
        for block in self.blocks:
            hidden = block(hidden)
        return self.output(self.norm(hidden[:, INNER_TOKENS]))


class MotionExamples:
    """Gaps as tensors: features (B, T, F); and of the R = B I moments inside them the interpolated and true poses."""

    def __init__(self, windows: TrainingWindows):
        interpolated = interpolate_missing_values(windows.quaternions, windows.position, windows.is_known, windows.times_s)
        relative, heading, origin = remove_window_heading(interpolated)
        features = compute_window_features(relative, windows.is_known, windows.is_inside, windows.times_s)
        self.features = torch.from_numpy(features)
        turn = np.repeat(compute_quaternion_matrices(heading), INNER_COUNT, axis=0)
        true = compute_quaternion_matrices(select_inner_moments(windows.quaternions))
        true[:, 0] = np.swapaxes(turn, 1, 2) @ true[:, 0]
        shifted = select_inner_moments(windows.position - origin[:, None])
        position = (shifted[:, None] @ turn)[:, 0]
        self.true_points = torch.from_numpy(compute_carried_points(true, position, np.arange(31)))
        self.true_matrices, self.true_position = torch.from_numpy(true), torch.from_numpy(position)
        self.matrices = torch.from_numpy(compute_quaternion_matrices(select_inner_moments(relative.quaternions)))
        self.position = torch.from_numpy(select_inner_moments(relative.position))
        self.scale = torch.from_numpy(compute_output_scale(select_inner_moments(interpolated.edge_s)))
        self.is_missing = torch.from_numpy(~select_inner_moments(windows.is_known))
        weight = 1 / (SHORT_GAP_WEIGHT_S + windows.gap_s)
        self.row_weight = torch.from_numpy(np.repeat(weight / weight.sum() / INNER_COUNT, INNER_COUNT).astype(np.float32))

    def move_to(self, device: str) -> "MotionExamples":
        """Move all tensors to a device, and return these examples."""
        vars(self).update({name: values.to(device) for name, values in vars(self).items()})
        return self


class MotionBatches(Dataset[MotionExamples]):
    """The examples of each step of a training, which are drawn with the seed of the settings and the step."""

    def __init__(self, settings: MotionSettings, stretches: MotionStretches):
        self.settings, self.stretches = settings, stretches
        self.weights = compute_stretch_weights(stretches, settings.subject_balance, settings.retargeted_weight)

    def __getitem__(self, step: int) -> MotionExamples:
        drawn, rng = self.settings, np.random.default_rng([self.settings.seed, step])
        variation = drawn.speed_spread, drawn.posture_sd_rad
        return MotionExamples(draw_training_windows(self.stretches, self.weights, drawn.batch_windows, rng, *variation))


def select_inner_moments(values: np.ndarray) -> np.ndarray:
    """Return the values (B I, ...) of the moments inside each gap, given (B, T, ...)."""
    inner = values[:, INNER_TOKENS]
    return np.ascontiguousarray(inner.reshape(-1, *inner.shape[2:]))


def compute_points(matrices: Tensor, position: Tensor) -> Tensor:
    """Return the 31 joints (R, 31, 3) of poses: local rotations (R, J, 3, 3) and root positions (R, 3)."""
    tree, device = build_motion_tree(), matrices.device
    offsets, points, carriers = (torch.from_numpy(each).to(device) for each in (tree.offsets, tree.points, tree.carriers))
    world, origins = [matrices[:, 0]], [position]
    for j in range(1, len(tree.parents)):
        parent = int(tree.parents[j])
        origins.append(origins[parent] + world[parent] @ offsets[j])
        world.append(world[parent] @ matrices[:, j])
    rotations, carried = torch.stack(world, 1)[:, carriers], torch.stack(origins, 1)[:, carriers]
    return carried + (rotations @ points[..., None])[..., 0]


def predict_rows(outputs: Tensor, examples: MotionExamples) -> tuple[Tensor, Tensor, Tensor]:
    """Return the predicted local rotations (R, J, 3, 3), root positions (R, 3) and standard deviations (R, J + 1)."""
    count = examples.matrices.shape[1]
    rows = outputs.flatten(0, 1)
    vectors = rows[:, : 3 * count].unflatten(1, (count, 3)) * examples.scale[..., None]
    matrices = examples.matrices @ compute_rotation_tensor(vectors)
    position = examples.position + rows[:, 3 * count : 3 * count + 3] * examples.scale[:, :1]
    scale = torch.cat([examples.scale, examples.scale[:, :1]], 1)
    deviation = scale * (rows[:, 3 * count + 3 :] + INITIAL_LOG_SD).clamp(MIN_LOG_SD, MAX_LOG_SD).exp()
    return matrices, position, deviation


def compute_motion_loss(outputs: Tensor, examples: MotionExamples) -> tuple[Tensor, Tensor]:
    """Return the loss, and the mean position error (R,) in metres over the 31 joints of each frame."""
    matrices, position, deviation = predict_rows(outputs, examples)
    distance = ((compute_points(matrices, position) - examples.true_points) ** 2).sum(-1)
    distance = (distance + MIN_ERROR_M**2).sqrt() - MIN_ERROR_M
    relative = (matrices - examples.true_matrices).flatten(2)
    chordal = ((relative**2).sum(-1) / 2 + 1e-6).sqrt() - 1e-3  # close to the angle
    row_loss = distance.mean(1) + ROTATION_LOSS_M_RAD * chordal.mean(1)
    with torch.no_grad():
        square = (relative**2).sum(-1) / 6  # a small rotation's mean square per axis
        root_square = ((position - examples.true_position) ** 2).mean(1, keepdim=True)
        squares = torch.cat([square, root_square], 1)
        is_missing = torch.cat([examples.is_missing, examples.is_missing[:, :1]], 1)
    sd = torch.where(is_missing, deviation, 1.0)
    likelihood = torch.where(is_missing, sd.log() + squares / (2 * sd**2), 0.0).mean(1)
    weight = examples.row_weight
    loss = (weight * row_loss).sum() + DEVIATION_LOSS_WEIGHT * (weight * likelihood).sum()
    return loss, distance.mean(1).detach()


def draw_initial_network(width: int, block_count: int, seed: int, features: Tensor) -> MotionNetwork:
    """Return the untrained network, drawn with a seed; it normalises features as some examples (B, T, F) show them."""
    mean, sd = features.mean((0, 1)), features.std((0, 1)).clamp_min(MIN_MOTION_FEATURE_SD)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return MotionNetwork(width, block_count, mean, sd)


def average_moments(errors: Float[np.ndarray, " R"]) -> Float[np.ndarray, " B"]:
    """Return the mean of each gap's moments."""
    return errors.reshape(-1, INNER_COUNT).mean(axis=1)


SCORED_DURATIONS_S = (0.2, 0.4, 0.75, 1.25, 2.1)  # limits of the durations that the card distinguishes
MOTION_TRAINING = """\
It is given a second of motion before and after a gap, with what is seen in the gap, and predicts the difference of what is lost
from its interpolation, with standard deviations. Trained by `mocapfix train motion` on"""
MOTION_USE = """,
in windows in which a limb, several limbs or the whole body is lost for 0.2 to 2 s."""


@dataclass(frozen=True)
class GapScores:
    """(N,) gaps of held-out people: whether the whole body is lost, the duration, and the mean joint errors in metres."""

    is_body_gap: Bool[np.ndarray, " N"]
    gap_s: Float[np.ndarray, " N"]
    interpolated_m: Float[np.ndarray, " N"]
    predicted_m: Float[np.ndarray, " N"]


def format_gap_scores(scores: GapScores) -> str:
    """Return the scores of a card."""
    rows: dict[str, list[float]] = {}
    for is_body_gap, lost in ((True, "whole body"), (False, "limbs")):
        for low, high in pairwise(SCORED_DURATIONS_S):
            is_row = (scores.is_body_gap == is_body_gap) & (scores.gap_s >= low) & (scores.gap_s < high)
            if is_row.any():
                before, after = (1e3 * float(each[is_row].mean()) for each in (scores.interpolated_m, scores.predicted_m))
                rows[f"{lost}, {low:g} to {high:g} s"] = [before, after, after / before]
    table = format_table(["lost", "interpolation", "prediction", "ratio"], rows, ".2f")
    return f"Mean error of the 31 joints in mm during gaps of held-out people, and the ratio of both.\n\n{table}"


CHECKPOINT_STEPS = 250  # steps between two checkpoints
RISE_STEPS = 100  # steps in which the learning rate rises
DECAY_SHARE = 0.3  # share of the steps, the last ones, in which the learning rate falls to zero
GRADIENT_NORM_LIMIT = 1.0
NORMALISATION_WINDOWS = 512  # windows that show the mean and standard deviation of the features
AVERAGED_STEPS = 100  # steps over which the reported loss is averaged


SCORE_BATCHES, SCORE_WINDOWS = 12, 128
"""Number of batches of held-out windows, and windows in each, on which the scores are measured."""


def train_motion_prior(
    settings: MotionSettings, folders: Sequence[Path], target: Path, progress: Callable[[str], object]
) -> GapScores:
    """Train a network, write it to `target` and its card to the same path with the suffix .md, and return its scores.

    Interrupted training continues from `target` with the suffix .checkpoint when it is started again.

    Raises:
        ReadError: If the folders hold no motion of the required subjects.
        WriteError: If the files cannot be written.
    """
    test, held_out = settings.test_subjects, settings.held_out_subjects
    stretches = gather_motion_stretches(folders, lambda subject: subject not in test | held_out, progress)
    held_out_stretches = gather_motion_stretches(folders, lambda subject: subject in held_out, progress)
    checkpoint = target.with_suffix(".checkpoint")
    network = fit_motion_network(settings, stretches, checkpoint, progress)
    progress("measuring")
    model = extract_motion_weights(network)
    scores = compute_gap_scores(model, held_out_stretches, settings)
    write_weights(target, {name: values.astype(np.float16) for name, values in model.tensors.items()})
    source_frames = Counter(stretches.count_source_frames() + held_out_stretches.count_source_frames())
    data = CardData(stretches.count_frames(), held_out_stretches.count_frames(), source_frames)
    write_card(target.with_suffix(".md"), settings, data, MOTION_TRAINING, MOTION_USE, format_gap_scores(scores))
    checkpoint.unlink(missing_ok=True)
    return scores


def extract_motion_weights(network: MotionNetwork) -> MotionPrior:
    """Return the network in the form that inference evaluates, rounded to the precision of its file."""
    return MotionPrior({name: values.half().float().cpu().numpy() for name, values in network.state_dict().items()})


def compute_gap_scores(model: MotionPrior, stretches: MotionStretches, settings: MotionSettings) -> GapScores:
    """Return the errors in windows of people that were not trained on."""
    weights, rng = (
        compute_stretch_weights(stretches, settings.subject_balance, settings.retargeted_weight),
        np.random.default_rng([settings.seed, 1]),
    )
    parts: list[np.ndarray] = []
    for _ in range(SCORE_BATCHES):
        windows = draw_training_windows(stretches, weights, SCORE_WINDOWS, rng)
        examples = MotionExamples(windows)
        with torch.inference_mode():
            outputs = torch.from_numpy(model.evaluate(examples.features.numpy()))
            errors = [compute_motion_loss(each, examples)[1].numpy() for each in (torch.zeros_like(outputs), outputs)]
        parts.append(np.stack([windows.is_body_gap, windows.gap_s, *map(average_moments, errors)]))
    is_body_gap, gap_s, interpolated_m, predicted_m = np.concatenate(parts, axis=1)
    return GapScores(is_body_gap > 0, gap_s, interpolated_m, predicted_m)


def fit_motion_network(
    settings: MotionSettings, stretches: MotionStretches, checkpoint: Path, progress: Callable[[str], object]
) -> MotionNetwork:
    """Return a trained network. An interrupted training continues from its checkpoint, on a processor with the same result.

    Where there is a GPU it has the network, and all cores draw windows.

    Raises:
        ReadError: If the checkpoint is not one.
    """
    batches, device = MotionBatches(settings, stretches), "cuda" if torch.cuda.is_available() else "cpu"
    first = draw_training_windows(stretches, batches.weights, NORMALISATION_WINDOWS, np.random.default_rng(settings.seed))
    network = draw_initial_network(settings.width, settings.blocks, settings.seed, MotionExamples(first).features).to(device)
    optimizer = torch.optim.AdamW(network.parameters(), settings.learning_rate, weight_decay=settings.weight_decay)
    states: dict[str, Stateful] = {"network": network, "optimizer": optimizer}
    fingerprint, mean_loss = compute_training_fingerprint(settings, stretches.quaternions), 0.0
    first_step = resume_training(checkpoint, fingerprint, states)
    steps, workers = range(first_step, settings.steps), count_cores() if device == "cuda" else 0
    loader = DataLoader(batches, batch_size=None, sampler=steps, num_workers=workers)
    for step, examples in zip(steps, loader, strict=True):
        examples.move_to(device)
        remaining = (settings.steps - step) / (DECAY_SHARE * settings.steps)
        rate = settings.learning_rate * min(1, (step + 1) / RISE_STEPS, remaining)
        for group in optimizer.param_groups:
            group["lr"] = rate
        with torch.autocast(device, torch.bfloat16):
            outputs = network(examples.features)
        loss, _ = compute_motion_loss(outputs.float(), examples)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), GRADIENT_NORM_LIMIT)
        optimizer.step()
        share = 1 / min(step + 1 - first_step, AVERAGED_STEPS)
        mean_loss += share * (float(loss.detach()) - mean_loss)
        if (step + 1) % CHECKPOINT_STEPS == 0 or step + 1 == settings.steps:
            write_checkpoint(checkpoint, fingerprint, step + 1, states)
            progress(f"step {step + 1} of {settings.steps}, loss {mean_loss:.5f}")
    return network
