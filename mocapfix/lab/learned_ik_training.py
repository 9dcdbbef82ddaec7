"""Training of learned inverse kinematics (Learnable SMPLify): one evaluation from a start pose and joints to a pose.

Scores of learned inverse kinematics on people that it was not trained on: one step from a frame nearby, and hard inputs.

The card of a network of learned inverse kinematics.
"""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mocapfix.errors import WriteError
from mocapfix.io.files import replace_atomically
from mocapfix.kernels.pose_transfer import FEATURES_PER_JOINT, TransferredPoses
from mocapfix.lab.cards import build_acknowledgement, format_frame_counts, format_sources
from mocapfix.lab.frame_pairs import FrameSequences, IkBatch, PairSampler, gather_sequences
from mocapfix.lab.graph_ik import GraphModel, PoseTensors, TransferTensors, TreeLevels, compute_ik_loss, correct_pose_tensors
from mocapfix.lab.networks import build_layers
from mocapfix.lab.settings import LearnedIkSettings, Stateful, compute_training_fingerprint, resume_training, write_checkpoint
from mocapfix.model.skeleton import BODY_SECTIONS, load_cmu31_skeleton
from mocapfix.solve.kinematics import build_kinematic_tree, compute_tree_poses
from mocapfix.solve.learned_ik import IkNetwork, build_transfer_tree, transfer_poses, write_ik_network, write_tensors

SCORED_OFFSETS = (1, 3, 5, 7, 9)  # frames between start and target
MAX_SCORED_PAIRS = 4000  # for each offset, evenly over all trials
SCORED_SD_M = 0.02  # noise of the joints of the second score, standard deviation per axis
KNOWN_JOINT_SD_M = 1e-3  # standard deviation that is given for joints without noise
LOST_SECTION = "left arm"  # of the third score; the shoulder itself stays


class IkScores(NamedTuple):
    """Mean errors over poses and joints.

    one_step_mm   by the number of frames between start and target
    rotation_deg  the same, of world rotations
    copied_mm     of the start itself
    noisy_mm      with noise of SCORED_SD_M, from the nearest start
    limb_mm       the same, an arm not given
    """

    one_step_mm: dict[int, float]
    rotation_deg: dict[int, float]
    copied_mm: dict[int, float]
    noisy_mm: float
    limb_mm: float


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


IK_CARD = """\
# {name}

{title}

Learnable SMPLify regresses a pose from a start pose and the joint positions of another frame, in one evaluation. Trained by
`mocapfix train ik` on {frame_count:,} frames at about 30 Hz of {subject_count} subjects, half of the batches mirrored.

| subjects | with their frames |
|---|---|
| trained on | {trained_on} |
| held out, for the scores | {held_out} |
| never read, for the benchmarks | {test} |

## Scores

Held-out people, all joints given without noise, one evaluation; means over frames and 31 joints.

| frames at 30 Hz from start to target | {offsets} |
|---|{rule}|
| the start itself, mm | {copied} |
| position, mm | {one_step} |
| world rotation, degrees | {rotation} |
{hard_inputs}
## Settings

{settings}

## Data

{sources}{acknowledgement}"""


def write_ik_card(
    path: Path, settings: LearnedIkSettings, sequences: FrameSequences, held_out: FrameSequences, scores: IkScores
) -> None:
    """Write a card, replacing the file atomically. Raises WriteError if it cannot be written."""
    frame_counts, source_frames = sequences.frame_counts, Counter(sequences.source_frames + held_out.source_frames)
    text = IK_CARD.format(
        sources=format_sources(source_frames),
        name=path.stem,
        title=settings.title,
        frame_count=sum(frame_counts.values()),
        subject_count=len(frame_counts),
        trained_on=format_frame_counts(frame_counts),
        held_out=format_frame_counts(held_out.frame_counts),
        test=", ".join(sorted(settings.test_subjects)),
        offsets=" | ".join(map(str, scores.one_step_mm)),
        rule="|".join("---" for _ in scores.one_step_mm),
        copied=" | ".join(f"{value:.1f}" for value in scores.copied_mm.values()),
        one_step=" | ".join(f"{value:.2f}" for value in scores.one_step_mm.values()),
        rotation=" | ".join(f"{value:.1f}" for value in scores.rotation_deg.values()),
        hard_inputs=format_hard_inputs(scores) if settings.has_corruption else "",
        settings="\n".join(
            f"- {key}: {value}"
            for key, value in settings.model_dump(exclude={"title", "test_subjects", "held_out_subjects"}).items()
        ),
        acknowledgement=build_acknowledgement(source_frames, is_conformed=False),
    )
    with replace_atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def format_hard_inputs(scores: IkScores) -> str:
    """Return the sentence on noisy and missing joints."""
    return (
        f"\nWith noise of {1e3 * SCORED_SD_M:.0f} mm per axis and the frame before as the start: {scores.noisy_mm:.1f} mm.\n"
        f"With the joints of the {LOST_SECTION} missing too: {scores.limb_mm:.1f} mm.\n"
    )


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

    def extract_network(self) -> IkNetwork:
        """Return the network in the form that mocapfix evaluates, rounded to the precision of its file."""
        linear = [layer for layer in self.layers if isinstance(layer, nn.Linear)]
        weights = tuple(np.ascontiguousarray(each.weight.detach().half().float().numpy().T) for each in linear)
        biases = tuple(each.bias.detach().half().float().numpy() for each in linear)
        return IkNetwork(self.input_mean.numpy().copy(), self.input_scale.numpy().copy(), weights, biases)


def train_learned_ik(
    settings: LearnedIkSettings, folders: Sequence[Path], target: Path, progress: Callable[[str], object]
) -> IkScores:
    """Train a network, write it to `target` and its card to the same path with the suffix .md, and return its scores.

    After an interruption, the training continues. Raises ReadError if the folders hold no motion of the required subjects,
    WriteError if the files cannot be written.
    """
    if target.suffix != ".safetensors":
        raise WriteError(f"{target}: weights are written as safetensors; give a name that ends in .safetensors.")
    unused, checkpoint = settings.test_subjects | settings.held_out_subjects, target.with_suffix(CHECKPOINT_SUFFIX)
    sequences = gather_sequences(folders, lambda subject: subject not in unused, progress)
    held_out = gather_sequences(folders, lambda subject: subject in settings.held_out_subjects, progress)
    model = fit_ik_model(settings, sequences, checkpoint, progress)
    progress("measuring")
    scores = measure_ik_scores(build_predictor(model), held_out, settings.has_corruption)
    if isinstance(model, ClosedFormModel):
        write_ik_network(target, model.extract_network())
    else:
        write_tensors(target, {name: each.half().numpy() for name, each in model.state_dict().items()})
    write_ik_card(target.with_suffix(".md"), settings, sequences, held_out, scores)
    checkpoint.unlink(missing_ok=True)
    return scores


def fit_ik_model(
    settings: LearnedIkSettings, sequences: FrameSequences, checkpoint: Path, progress: Callable[[str], object]
) -> ClosedFormModel | GraphModel:
    """Return the trained model. Each step draws its pairs by its own number, so that an interrupted training can continue."""
    sampler = PairSampler(sequences, settings)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        model = ClosedFormModel(settings, sampler) if settings.network == "closed-form" else GraphModel(settings)
    optimise_model(model, sampler, settings, checkpoint, progress)
    return model.eval()


def build_predictor(model: ClosedFormModel | GraphModel) -> PosePredictor:
    """Return the function that the scores are measured of."""

    def predict(batch: IkBatch) -> tuple[np.ndarray, np.ndarray]:
        with torch.inference_mode():
            poses = model.predict(batch)
        return poses.position.numpy().astype(float), poses.rotation.numpy().astype(float)

    return predict


def optimise_model(
    model: ClosedFormModel | GraphModel,
    sampler: PairSampler,
    settings: LearnedIkSettings,
    checkpoint: Path,
    progress: Callable[[str], object],
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
