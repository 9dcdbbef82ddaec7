"""Training of the motion prior: what moves during a gap, given the motion on either side and the joints that are seen."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from mocapfix.errors import WriteError
from mocapfix.motion_prior.model import MotionPrior, write_motion_prior
from mocapfix.train.checkpoints import Stateful, compute_training_fingerprint, resume_training, write_checkpoint
from mocapfix.train.motion_card import GapScores, write_motion_card
from mocapfix.train.motion_network import (
    MotionExamples,
    MotionNetwork,
    average_moments,
    compute_motion_loss,
    draw_initial_network,
)
from mocapfix.train.motion_windows import MotionStretches, compute_stretch_weights, draw_training_windows, gather_motion_stretches
from mocapfix.train.settings import MotionSettings

CHECKPOINT_STEPS = 250
"""Steps between two checkpoints."""
RISE_STEPS = 100
"""Steps in which the learning rate rises."""
DECAY_SHARE = 0.3
"""Share of the steps, the last ones, in which the learning rate falls to zero."""
GRADIENT_NORM_LIMIT = 1.0
NORMALISATION_WINDOWS = 512
"""Windows that show the mean and standard deviation of the features."""
AVERAGED_STEPS = 100
"""Steps over which the reported loss is averaged."""


SCORE_BATCHES, SCORE_WINDOWS = 12, 128
"""Number of batches of held-out windows, and windows in each, on which the scores are measured."""


def train_motion_prior(
    settings: MotionSettings, folders: Sequence[Path], target: Path, progress: Callable[[str], object]
) -> GapScores:
    """Train a network, write it to `target` and its card to the same path with the suffix .md, and return its scores.

    Interrupted training continues from `target` with the suffix .checkpoint when it is started again.

    Raises ReadError if the folders hold no motion of the required subjects, WriteError if the files cannot be written.
    """
    if target.suffix != ".safetensors":
        raise WriteError(f"{target}: weights are written as safetensors; give a name that ends in .safetensors.")
    test, held_out = settings.test_subjects, settings.held_out_subjects
    stretches = gather_motion_stretches(folders, lambda subject: subject not in test | held_out, progress)
    held_out_stretches = gather_motion_stretches(folders, lambda subject: subject in held_out, progress)
    checkpoint = target.with_suffix(".checkpoint")
    network = fit_motion_network(settings, stretches, checkpoint, progress)
    progress("measuring")
    model = extract_motion_weights(network)
    scores = compute_gap_scores(model, held_out_stretches, settings)
    write_motion_prior(target, model)
    write_motion_card(target.with_suffix(".md"), settings, stretches, held_out_stretches, scores)
    checkpoint.unlink(missing_ok=True)
    return scores


def extract_motion_weights(network: MotionNetwork) -> MotionPrior:
    """Return the network in the form that inference evaluates, rounded to the precision of its file."""
    return MotionPrior({name: values.half().float().numpy() for name, values in network.state_dict().items()})


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
    """Return a trained network. An interrupted training continues from its checkpoint, with the same result.

    Raises ReadError if the checkpoint is not one.
    """
    weights = compute_stretch_weights(stretches, settings.subject_balance, settings.retargeted_weight)
    first = draw_training_windows(stretches, weights, NORMALISATION_WINDOWS, np.random.default_rng(settings.seed))
    network = draw_initial_network(settings.width, settings.blocks, settings.seed, MotionExamples(first).features)
    optimizer = torch.optim.AdamW(network.parameters(), settings.learning_rate, weight_decay=settings.weight_decay)
    states: dict[str, Stateful] = {"network": network, "optimizer": optimizer}
    fingerprint, mean_loss = compute_training_fingerprint(settings, stretches.quaternions), 0.0
    first_step = resume_training(checkpoint, fingerprint, states)
    for step in range(first_step, settings.steps):
        remaining = (settings.steps - step) / (DECAY_SHARE * settings.steps)
        rate = settings.learning_rate * min(1, (step + 1) / RISE_STEPS, remaining)
        for group in optimizer.param_groups:
            group["lr"] = rate
        rng = np.random.default_rng([settings.seed, step])
        examples = MotionExamples(draw_training_windows(stretches, weights, settings.batch_windows, rng))
        with torch.autocast("cpu", torch.bfloat16):
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
