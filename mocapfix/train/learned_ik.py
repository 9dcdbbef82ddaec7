"""Training of learned inverse kinematics (Learnable SMPLify): one evaluation from a start pose and joints to a pose."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from mocapfix.errors import WriteError
from mocapfix.kernels.pose_transfer import FEATURES_PER_JOINT, TransferredPoses
from mocapfix.learned_ik.network import IkNetwork, write_ik_network, write_tensors
from mocapfix.learned_ik.pose_transfer import build_transfer_tree, transfer_poses
from mocapfix.pose_prior.network import build_layers
from mocapfix.skeleton import load_cmu31_skeleton
from mocapfix.solve.kinematics import build_kinematic_tree, compute_tree_poses
from mocapfix.train.checkpoints import Stateful, compute_training_fingerprint, resume_training, write_checkpoint
from mocapfix.train.frame_pairs import FrameSequences, IkBatch, PairSampler, gather_sequences
from mocapfix.train.graph_ik import GraphModel
from mocapfix.train.ik_card import write_ik_card
from mocapfix.train.ik_losses import PoseTensors, TransferTensors, TreeLevels, compute_ik_loss, correct_pose_tensors
from mocapfix.train.ik_scores import IkScores, PosePredictor, measure_ik_scores
from mocapfix.train.settings import LearnedIkSettings

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
