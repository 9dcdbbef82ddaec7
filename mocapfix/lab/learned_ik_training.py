"""Training of learned inverse kinematics (Learnable SMPLify): one evaluation from a start pose and joints to a pose.

The scores are measured on people that the network was not trained on: one step from a frame nearby, and hard inputs. The poses
are a form of `mocapfix.kernels.pose_transfer.correct_pose_frames` that is differentiable with torch.
"""

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mocapfix.kernels.pose_transfer import FEATURES_PER_JOINT, TransferredPoses, TransferTree
from mocapfix.lab.cards import CardData, format_table, write_card, write_perceptron
from mocapfix.lab.frame_pairs import FrameSequences, IkBatch, PairSampler, gather_sequences
from mocapfix.lab.networks import build_layers, compute_rotation_tensor, extract_layers
from mocapfix.lab.settings import LearnedIkSettings, Stateful, compute_training_fingerprint, resume_training, write_checkpoint
from mocapfix.model.skeleton import BODY_SECTIONS, load_cmu31_skeleton
from mocapfix.solve.kinematics import build_kinematic_tree, compute_tree_poses
from mocapfix.solve.learned_ik import IK_KIND, Perceptron, build_transfer_tree, transfer_poses

VERTEX_DISTANCE_M = 0.1  # distance from each joint, along its axes, of the points that stand in for the vertices of a mesh
MIN_ANGLE_SQUARED = 1e-12  # keeps the derivative of an angle finite at 0
MIN_SWING_COSINE = -0.999  # swings of nearly half a turn are not exact, so that their derivative stays finite


@dataclass(frozen=True)
class TreeLevels:
    """The joints of a skeleton level by level: each level's joints and their parents."""

    levels: tuple[tuple[list[int], list[int]], ...]

    @classmethod
    def build(cls, parents: np.ndarray) -> "TreeLevels":
        """Return the levels below the root."""
        depth = np.zeros(len(parents), int)
        members: dict[int, list[int]] = defaultdict(list)
        for joint in range(1, len(parents)):
            depth[joint] = depth[parents[joint]] + 1
            members[int(depth[joint])].append(joint)
        return cls(tuple((joints, [int(parents[j]) for j in joints]) for _, joints in sorted(members.items())))


@dataclass(frozen=True)
class TransferTensors:
    """What the closed form gives the differentiable correction, for B poses."""

    start_local: Tensor  # start_local, rotation: (B, J, 3, 3)
    rotation: Tensor
    direction: Tensor  # (B, J, 3), 0 where unknown
    authority: Tensor  # (B, J)
    root: Tensor  # root, root_unit: (B, 3) and (B,) metres
    root_unit: Tensor


@dataclass(frozen=True)
class PoseTensors:
    """World positions (B, J, 3) in metres and world rotations (B, J, 3, 3) of B poses."""

    position: Tensor
    rotation: Tensor


def swing_rotations(
    rotation: Float[Tensor, "... 3 3"], bone: Float[Tensor, "... 3"], direction: Float[Tensor, "... 3"]
) -> Float[Tensor, "... 3 3"]:
    """Return rotations after the shortest rotation from the unit vector `bone` to `direction`; unchanged where that is 0."""
    cosine = torch.clamp((bone * direction).sum(-1), min=MIN_SWING_COSINE)
    axis = torch.linalg.cross(bone, direction)[..., None]
    once = torch.linalg.cross(axis.expand_as(rotation), rotation, dim=-2)
    twice = torch.linalg.cross(axis.expand_as(rotation), once, dim=-2)
    return rotation + once + twice / (1 + cosine)[..., None, None]


def correct_pose_tensors(
    tree: TransferTree, levels: TreeLevels, transferred: TransferTensors, corrections: Float[Tensor, "B C"]
) -> PoseTensors:
    """Return the poses of `correct_pose_frames`, differentiable by the corrections."""
    joints = len(tree.parents)
    offsets = torch.as_tensor(tree.offsets, dtype=torch.float32)
    ends = torch.as_tensor(np.maximum(tree.bone_end, 0))
    bone = torch.nn.functional.normalize(offsets[ends], dim=-1)
    has_direction = (transferred.direction**2).sum(-1, keepdim=True) > 0.5
    vectors, authority = corrections[:, : 3 * joints].reshape(-1, joints, 3), transferred.authority[..., None]
    along = (1 - authority) * (vectors * bone).sum(-1, keepdim=True) * has_direction
    is_free = torch.as_tensor(~tree.is_held)[:, None]
    turn = compute_rotation_tensor((authority * vectors + along * bone) * is_free)
    is_registered = np.diff(tree.cloud_start) > 0
    rotations: list[Tensor] = [transferred.rotation[:, 0] @ turn[:, 0]] * joints
    shift = (transferred.rotation[:, 0] @ corrections[:, 3 * joints :, None])[..., 0]
    positions: list[Tensor] = [transferred.root + transferred.root_unit[:, None] * shift] * joints
    for members, parents in levels.levels:
        parent_rotation = torch.stack([rotations[p] for p in parents], 1)
        parent_position = torch.stack([positions[p] for p in parents], 1)
        position = parent_position + (parent_rotation @ offsets[members][..., None])[..., 0]
        inherited = parent_rotation @ transferred.start_local[:, members]
        current = swing_rotations(inherited, (inherited @ bone[members][..., None])[..., 0], transferred.direction[:, members])
        if is_registered[members].any():
            use = torch.as_tensor(is_registered[members]) & (transferred.authority[:, members] < 1)
            current = torch.where(use[..., None, None], transferred.rotation[:, members], current)
        current = current @ turn[:, members]
        for i, joint in enumerate(members):
            rotations[joint], positions[joint] = current[:, i], position[:, i]
    return PoseTensors(torch.stack(positions, 1), torch.stack(rotations, 1))


def compute_angles(a: Float[Tensor, "... 3 3"], b: Float[Tensor, "... 3 3"]) -> Float[Tensor, "..."]:
    """Return the angles between rotations in radians: the geodesic distance."""
    chord = torch.sqrt(((a - b) ** 2).sum((-1, -2)) + MIN_ANGLE_SQUARED) / 8**0.5
    return 2 * torch.asin(torch.clamp(chord, max=0.9999))


def compute_ik_loss(predicted: PoseTensors, true: PoseTensors, weights: tuple[float, float, float]) -> Tensor:
    """Return the loss (Eqs. 18-21), given the weights of joints, pose and vertices.

    The skeleton has no mesh: points VERTEX_DISTANCE_M from the joints along their axes stand in for the vertices.
    """
    difference = predicted.position - true.position
    joints = torch.sqrt((difference**2).sum(-1) + MIN_ANGLE_SQUARED).mean()
    pose = compute_angles(predicted.rotation, true.rotation).mean()
    points = difference[..., None] + VERTEX_DISTANCE_M * (predicted.rotation - true.rotation)
    vertices = torch.sqrt((points**2).sum(-2) + MIN_ANGLE_SQUARED).mean()
    return weights[0] * joints + weights[1] * pose + weights[2] * vertices


def compute_world_tensors(levels: TreeLevels, offsets: Tensor, root: Tensor, local: Tensor, to_world: Tensor) -> PoseTensors:
    """Return forward kinematics, differentiable, of local rotations (B, J, 3, 3); the root's axes are those of `to_world`."""
    rotations: list[Tensor] = [to_world @ local[:, 0]] * local.shape[1]
    positions: list[Tensor] = [root] * local.shape[1]
    for members, parents in levels.levels:
        parent_rotation = torch.stack([rotations[p] for p in parents], 1)
        position = torch.stack([positions[p] for p in parents], 1) + (parent_rotation @ offsets[members][..., None])[..., 0]
        current = parent_rotation @ local[:, members]
        for i, joint in enumerate(members):
            rotations[joint], positions[joint] = current[:, i], position[:, i]
    return PoseTensors(torch.stack(positions, 1), torch.stack(rotations, 1))


SCORED_OFFSETS = (1, 3, 5, 7, 9)  # frames between start and target
MAX_SCORED_PAIRS = 4000  # for each offset, evenly over all trials
SCORED_SD_M = 0.02  # noise of the joints of the second score, standard deviation per axis
KNOWN_JOINT_SD_M = 1e-3  # standard deviation that is given for joints without noise
LOST_SECTION = "left arm"  # of the third score; the shoulder itself stays


class IkScores(NamedTuple):
    """Mean errors over poses and joints."""

    one_step_mm: dict[int, float]  # by the number of frames between start and target
    rotation_deg: dict[int, float]  # the same, of world rotations
    copied_mm: dict[int, float]  # of the start itself
    noisy_mm: float  # with noise of SCORED_SD_M, from the nearest start
    limb_mm: float  # the same, an arm not given


PosePredictor = Callable[[IkBatch], tuple[Float[np.ndarray, "B J 3"], Float[np.ndarray, "B J 3 3"]]]
"""A function that returns world positions in metres and rotations for a batch of pairs."""


def measure_ik_scores(predict: PosePredictor, sequences: FrameSequences, has_corruption: bool) -> IkScores:
    """Return the scores; those of hard inputs are NaN if the network was not trained for them."""
    one_step, rotation, copied = {}, {}, {}
    for offset in SCORED_OFFSETS:
        batch = build_scored_pairs(sequences, offset)
        one_step[offset], rotation[offset] = compute_errors(predict, batch)
        copied[offset], _ = compute_errors(lambda each: place_poses(each, each.start[1]), batch)
    if not has_corruption:
        return IkScores(one_step, rotation, copied, np.nan, np.nan)
    batch = add_scored_noise(build_scored_pairs(sequences, SCORED_OFFSETS[0]))
    noisy_mm, _ = compute_errors(predict, batch)
    positions = batch.positions.copy()
    positions[:, find_lost_joints(LOST_SECTION)] = np.nan
    limb_mm, _ = compute_errors(predict, batch._replace(positions=positions))
    return IkScores(one_step, rotation, copied, noisy_mm, limb_mm)


def compute_errors(predict: PosePredictor, batch: IkBatch) -> tuple[float, float]:
    """Return the mean errors of joint positions in mm and of world rotations in degrees."""
    (positions, rotations), (true_positions, true_rotations) = predict(batch), place_poses(batch, batch.target[1])
    cosine = (np.einsum("bjxy,bjxy->bj", rotations, true_rotations) - 1) / 2
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return 1e3 * float(np.linalg.norm(positions - true_positions, axis=-1).mean()), float(angle.mean())


def place_poses(
    batch: IkBatch, rotations: Float[np.ndarray, "B J 3 3"]
) -> tuple[Float[np.ndarray, "B J 3"], Float[np.ndarray, "B J 3 3"]]:
    """Return world positions and rotations of local rotations at the true root positions."""
    return compute_tree_poses(build_kinematic_tree(batch.body), batch.target[0], rotations)


def build_scored_pairs(sequences: FrameSequences, offset: int) -> IkBatch:
    """Return pairs `offset` frames apart, evenly over all trials, on the average body with all joints given."""
    frames = find_targets(sequences, offset)
    target, start = (sequences.rotations[each].astype(float) for each in (frames, frames - offset))
    body, root = load_cmu31_skeleton(), np.zeros((len(frames), 3))
    positions, _ = compute_tree_poses(build_kinematic_tree(body), root, target)
    return IkBatch(body, (root, start), (root, target), positions, np.full(positions.shape[:2], KNOWN_JOINT_SD_M))


def find_targets(sequences: FrameSequences, offset: int) -> Int[np.ndarray, " B"]:
    """Return frames that have a start in their trial, at most MAX_SCORED_PAIRS."""
    frames = np.arange(len(sequences.rotations))
    frames = frames[frames - offset >= sequences.first]
    return frames[:: max(1, -(-len(frames) // MAX_SCORED_PAIRS))]


def add_scored_noise(batch: IkBatch) -> IkBatch:
    """Return the pairs with noise of SCORED_SD_M, always the same."""
    noise = SCORED_SD_M * np.random.default_rng(0).normal(size=batch.positions.shape)
    return batch._replace(positions=batch.positions + noise, joint_sd=np.full(batch.joint_sd.shape, SCORED_SD_M))


def find_lost_joints(section: str) -> list[int]:
    """Return the joints beyond the first one of a limb."""
    skeleton = load_cmu31_skeleton()
    return [skeleton.find_joint(name) for name in BODY_SECTIONS[section][1:]]


IK_TRAINING = """\
Learnable SMPLify regresses a pose from a start pose and the joint positions of another frame, in one evaluation. Trained by
`mocapfix train ik` on"""


def format_ik_scores(scores: IkScores) -> str:
    """Return the scores of a card."""
    rows = {
        "the start itself, mm": list(scores.copied_mm.values()),
        "position, mm": list(scores.one_step_mm.values()),
        "world rotation, degrees": list(scores.rotation_deg.values()),
    }
    table = format_table(["frames at 30 Hz from start to target", *map(str, scores.one_step_mm)], rows, ".2f")
    text = f"Held-out people, all joints given without noise, one evaluation; means over frames and 31 joints.\n\n{table}\n"
    if np.isnan(scores.noisy_mm):
        return text
    noise = f"With noise of {1e3 * SCORED_SD_M:.0f} mm per axis and the frame before as the start"
    lost = f"With the joints of the {LOST_SECTION} missing too"
    return f"{text}\n{noise}: {scores.noisy_mm:.1f} mm.\n{lost}: {scores.limb_mm:.1f} mm.\n"


STEPS_PER_CHECKPOINT = 250
WARM_UP_STEPS = 200  # in which the learning rate rises
SCALE_BATCHES = 8  # from which the scales of the inputs are computed
MIN_INPUT_SD = 1e-3  # inputs that vary less are not scaled up further
MAX_GRADIENT_NORM = 1.0
CHECKPOINT_SUFFIX = ".checkpoint"
TRANSFERRED_FIELDS = (
    "rotation",
    "direction",
    "authority",
    "root",
    "root_unit",
)  # of the closed form, in the order of the tensors
PREDICTION_SCALE = 0.1  # of the output of the untrained last layer


class ClosedFormModel(nn.Module):
    """The network that corrects the closed form."""

    input_mean: Tensor
    input_scale: Tensor

    def __init__(self, settings: LearnedIkSettings, sampler: PairSampler) -> None:
        super().__init__()
        joints = len(load_cmu31_skeleton().names)
        features = np.concatenate([self._compute_inputs(sampler.draw_batch(i))[1] for i in range(SCALE_BATCHES)])
        self.register_buffer("input_mean", torch.as_tensor(features.mean(0)))
        self.register_buffer("input_scale", torch.as_tensor(1 / np.maximum(features.std(0), MIN_INPUT_SD)))
        self.layers = build_layers((FEATURES_PER_JOINT * joints, *settings.hidden_widths, 3 * joints + 3), "relu")
        last = self.layers[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():
            last.weight *= PREDICTION_SCALE
            last.bias.zero_()
        self.levels = TreeLevels.build(load_cmu31_skeleton().parents)

    @staticmethod
    def _compute_inputs(batch: IkBatch) -> tuple[TransferredPoses, np.ndarray]:
        tree = build_transfer_tree(batch.body)
        return transfer_poses(tree, batch.start, batch.positions, batch.joint_sd)

    def predict(self, batch: IkBatch) -> PoseTensors:
        """Return the poses of a batch."""
        transferred, features = self._compute_inputs(batch)
        values = (batch.start[1], *(getattr(transferred, name) for name in TRANSFERRED_FIELDS))
        tensors = TransferTensors(*(torch.as_tensor(each, dtype=torch.float32) for each in values))
        corrections = self.layers((torch.as_tensor(features) - self.input_mean) * self.input_scale)
        return correct_pose_tensors(build_transfer_tree(batch.body), self.levels, tensors, corrections)

    def extract_network(self) -> Perceptron:
        """Return the network in the form that mocapfix evaluates."""
        return Perceptron(self.input_mean.numpy().copy(), self.input_scale.numpy().copy(), *extract_layers(self.layers))


def train_learned_ik(
    settings: LearnedIkSettings, folders: Sequence[Path], target: Path, progress: Callable[[str], object]
) -> IkScores:
    """Train a network, write it to `target` and its card to the same path with the suffix .md, and return its scores.

    After an interruption, the training continues. Raises ReadError if the folders hold no motion of the required subjects,
    WriteError if the files cannot be written.
    """
    unused, checkpoint = settings.test_subjects | settings.held_out_subjects, target.with_suffix(CHECKPOINT_SUFFIX)
    sequences = gather_sequences(folders, lambda subject: subject not in unused, progress)
    held_out = gather_sequences(folders, lambda subject: subject in settings.held_out_subjects, progress)
    model = fit_ik_model(settings, sequences, checkpoint, progress)
    progress("measuring")
    scores = measure_ik_scores(build_predictor(model), held_out, settings.has_corruption)
    write_perceptron(target, model.extract_network(), IK_KIND)
    source_frames = Counter(sequences.source_frames + held_out.source_frames)
    data = CardData(sequences.frame_counts, held_out.frame_counts, source_frames)
    use = ", half of the batches\nmirrored."
    write_card(target.with_suffix(".md"), settings, data, IK_TRAINING, use, format_ik_scores(scores))
    checkpoint.unlink(missing_ok=True)
    return scores


def fit_ik_model(
    settings: LearnedIkSettings, sequences: FrameSequences, checkpoint: Path, progress: Callable[[str], object]
) -> ClosedFormModel:
    """Return the trained model. Each step draws its pairs by its own number, so that an interrupted training can continue."""
    sampler = PairSampler(sequences, settings)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        model = ClosedFormModel(settings, sampler)
    optimise_model(model, sampler, settings, checkpoint, progress)
    return model.eval()


def build_predictor(model: ClosedFormModel) -> PosePredictor:
    """Return the function that the scores are measured of."""

    def predict(batch: IkBatch) -> tuple[np.ndarray, np.ndarray]:
        with torch.inference_mode():
            poses = model.predict(batch)
        return poses.position.numpy().astype(float), poses.rotation.numpy().astype(float)

    return predict


def optimise_model(
    model: ClosedFormModel, sampler: PairSampler, settings: LearnedIkSettings, checkpoint: Path, progress: Callable[[str], object]
) -> None:
    """Train a model whose `predict` returns the poses of a batch, in place.

    Training continues from the checkpoint if that has the same settings and motion. Raises ReadError if it is not a checkpoint.
    """
    optimizer = torch.optim.AdamW(model.parameters(), settings.learning_rate, weight_decay=settings.weight_decay)
    states: dict[str, Stateful] = {"model": model, "optimizer": optimizer}
    fingerprint, mean_loss = compute_training_fingerprint(settings, sampler.sequences.rotations), math.nan
    for step in range(resume_training(checkpoint, fingerprint, states), settings.steps):
        for group in optimizer.param_groups:
            group["lr"] = compute_learning_rate(settings, step)
        batch = sampler.draw_batch(step)
        loss = compute_ik_loss(model.predict(batch), build_true_tensors(batch), settings.loss_weights)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), MAX_GRADIENT_NORM)
        optimizer.step()
        value = float(loss.detach())
        mean_loss = value if math.isnan(mean_loss) else 0.99 * mean_loss + 0.01 * value
        if (step + 1) % STEPS_PER_CHECKPOINT == 0 or step + 1 == settings.steps:
            write_checkpoint(checkpoint, fingerprint, step + 1, states)
            progress(f"step {step + 1} of {settings.steps}, loss {mean_loss:.4f}")


def compute_learning_rate(settings: LearnedIkSettings, step: int) -> float:
    """Return the learning rate of a step: it rises, and falls to zero along a cosine."""
    return settings.learning_rate * min(1, (step + 1) / WARM_UP_STEPS) * 0.5 * (1 + math.cos(math.pi * step / settings.steps))


def build_true_tensors(batch: IkBatch) -> PoseTensors:
    """Return the true poses of a batch."""
    position, rotation = compute_tree_poses(build_kinematic_tree(batch.body), *batch.target)
    tensors: list[Tensor] = [torch.as_tensor(each, dtype=torch.float32) for each in (position, rotation)]
    return PoseTensors(*tensors)
