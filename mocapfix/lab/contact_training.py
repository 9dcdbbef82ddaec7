"""Training of the network that tells whether a foot that no marker shows stands: from what the solver made of its motion.

Recordings are made to takes of people with their own bones and cleaned, with gaps and with feet lost. The network learns whether
the true joints stand (`lab/contacts.py`) in the frames whose markers do not show them, also at a lower rate and with wild joints.
True paths are smoothed first, so that noise of the truth does not decide whether a joint is slow.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from scipy.ndimage import gaussian_filter1d
from torch import Tensor, nn

from mocapfix.contacts.contacts import CONTACT_JOINTS, estimate_floor
from mocapfix.contacts.find_contacts import (
    CONTACT_NETWORK,
    FEATURE_RATE_HZ,
    compute_contact_features,
    compute_speed,
    find_shown_standing,
)
from mocapfix.errors import TakeError
from mocapfix.lab.cards import CardData, format_table, write_card, write_perceptron
from mocapfix.lab.contacts import TRUE_STANDING_SPEED_M_S, draw_foot_losses, find_true_contacts, lose_feet, lose_markers
from mocapfix.lab.networks import extract_layers, fit_perceptron, initialise_perceptron
from mocapfix.lab.recordings import Recording, RecordingSource, read_recordings
from mocapfix.lab.settings import ContactSettings
from mocapfix.lab.sound_takes import PerformedMotion, cut_performance, perform_take
from mocapfix.options import FEET_OFF, CleanOptions
from mocapfix.pipeline import plan_subject
from mocapfix.solve.kinematics import compute_world_poses
from mocapfix.solve.learned_ik import Perceptron
from mocapfix.synthetic import SyntheticTake, write_synthetic_take

PIECE_S, MIN_PIECE_S = 8.0, 1.5  # longest and shortest duration of a piece of a recording
TRUTH_SMOOTHING_S = 1 / 60  # standard deviation of the kernel that smooths true paths
WILD_M = (0.003, 0.01, 0.05)  # noise of joints that no marker shows, in a copy of each take: it may not hide a contact
DECIMATION, COPY_WEIGHT = 4, 0.3  # of the copy at a lower rate; weight of a copy
ADDED_FEATURE_SD = 0.01
CONTACT_TRAINING = """\
The probability that ankle and toes of a foot are in contact in frames in which no marker shows them, from the solved motion of
both feet. Trained by `mocapfix train contacts` on takes that were composed of"""
CONTACT_USE = ", in pieces of up to 8 s, and cleaned with gaps and with feet lost."
CONTACT_SCORES = """\
Joints of held-out people in frames that no marker shows: precision and recall where those of a higher probability are contacts;
and which share stands of those whose probability is up to 0.1 higher. mocapfix takes a probability over 0.6 for a contact.

{table}"""


class ContactExamples(NamedTuple):
    """What the network sees of a foot, and what is true."""

    features: Float32[np.ndarray, "N F"]
    is_standing: Bool[np.ndarray, "N 2"]
    weight: Float[np.ndarray, "N 2"]  # 0 where markers show the joint


def train_contact_network(
    settings: ContactSettings, folders: Sequence[Path], target: Path, progress: Callable[[str], object]
) -> Float[np.ndarray, "10 5"]:
    """Train a network, write it to `target` and its card to the same path with the suffix .md, and return its scores.

    Raises:
        ReadError: If the folders hold no motion.
        WriteError: If the files cannot be written.
    """
    rng, counts, sources = np.random.default_rng(settings.seed), (Counter[str](), Counter[str]()), Counter[RecordingSource]()
    examples: tuple[list[ContactExamples], list[ContactExamples]] = ([], [])
    for recording in read_recordings(folders):
        if recording.subject in settings.test_subjects or recording.bones is None:
            continue
        is_held_out, weight = recording.subject in settings.held_out_subjects, settings.retargeted_weight
        share = (1.0 if is_held_out else settings.piece_share) * (weight if recording.source.is_retargeted else 1)
        for piece in iterate_pieces(recording):
            if rng.random() < share:
                progress(f"cleaning {piece.name}")
                examples[is_held_out].extend(generate_examples(perform_take(piece, rng, has_own_bones=True), rng))
                counts[is_held_out][recording.subject] += piece.motion.frame_count
                sources[recording.source] += piece.motion.frame_count
    network = fit_contact_network(examples[0], settings, progress)
    scores = compute_contact_scores(network, examples[1])
    write_perceptron(target, network, CONTACT_NETWORK)
    rows = {f"{n / 10:.1f}": row for n, row in enumerate(scores.tolist())}
    table = format_table(["probability", "precision", "recall", "F1", "share that stands", "share of the frames"], rows, ".3f")
    card = CONTACT_TRAINING, CONTACT_USE, CONTACT_SCORES.format(table=table)
    write_card(target.with_suffix(".md"), settings, CardData(*counts, sources), *card)
    return scores


def iterate_pieces(recording: Recording) -> Iterator[PerformedMotion]:
    """Yield pieces of at most PIECE_S of a recording without jumps."""
    whole, length = cut_performance(recording), round(PIECE_S * recording.rate_hz)
    for frames in np.split(np.arange(whole.motion.frame_count), np.arange(length, whole.motion.frame_count, length)):
        if len(frames) >= MIN_PIECE_S * recording.rate_hz:
            yield whole._replace(motion=whole.motion.select_frames(frames))


def generate_examples(sound: SyntheticTake, rng: np.random.Generator) -> Iterator[ContactExamples]:
    """Yield the examples of each foot of a take with losses: as it is solved, at a lower rate, and with wild hidden joints.

    The truth knows one level of the floor. A take with several has no examples, and a frame has no weight in which a joint is
    slow above it while the other foot does not stand there: it may stand on another.
    """
    joints, sd_frames = [sound.subject.skeleton.find_joint(joint) for joint in CONTACT_JOINTS], TRUTH_SMOOTHING_S * sound.rate
    smooth: Float[np.ndarray, "T C 3"] = gaussian_filter1d(sound.joint_positions[:, joints], sd_frames, axis=0, mode="nearest")
    is_true = np.stack([find_true_contacts(path, sound.rate) for path in smooth.swapaxes(0, 1)], axis=1)
    floor = estimate_floor(smooth[:, 1::2], is_true[:, 1::2], sound.rate)
    if len(floor.level_heights_m) != 1 or floor.tilt_deg > 0:
        return
    is_slow = np.stack([compute_speed(path, sound.rate) for path in smooth.swapaxes(0, 1)], axis=1) < TRUE_STANDING_SPEED_M_S
    other_stands = np.repeat(np.any(is_true.reshape(-1, 2, 2), axis=2)[:, ::-1], 2, axis=1)
    is_unclear = is_slow & ~is_true & ~other_stands
    damaged = lose_feet(lose_markers(sound, rng), draw_foot_losses(sound, rng, at_any_time=True))
    standing = None
    with TemporaryDirectory() as folder, suppress(TakeError):
        write_synthetic_take(path := Path(folder) / "take.c3d", damaged)
        standing = plan_subject(path, CleanOptions().change(feet=FEET_OFF), path.name)[0].fit().standing
    if standing is None or not standing.fit.subject.solved_joints[joints].all():
        return
    motion = standing.filling_motion  # with feet off that in which contacts are found, before priors are added for the outputs
    solved, sd = compute_world_poses(standing.fit.subject.skeleton, motion)[0][:, joints], motion.joint_sd[:, joints]
    is_shown = find_shown_standing(solved, sd, sound.rate)[1]
    wild = solved + rng.normal(0, rng.choice(WILD_M), solved.shape) * ~is_shown[..., None]
    for position, step, weight in ((solved, 1, 1.0), (solved, DECIMATION, COPY_WEIGHT), (wild, 1, COPY_WEIGHT)):
        rate = sound.rate / step
        is_standing, is_known, _ = find_shown_standing(position[::step], sd[::step], rate)
        if not (is_standing & is_known).any() or np.isnan(position).any():
            continue
        features = compute_contact_features(position[::step], sd[::step], is_standing & is_known, rate)
        times_s = np.arange(features.shape[1]) / FEATURE_RATE_HZ
        frames = np.minimum(np.rint(times_s * sound.rate).astype(int), len(is_true) - 1)
        is_hidden = ~is_known[np.minimum(np.rint(times_s * rate).astype(int), len(is_known) - 1)] & ~is_unclear[frames]
        for each, foot in zip(features, (slice(0, 2), slice(2, 4)), strict=True):
            rows = is_hidden[:, foot].any(axis=1)
            yield ContactExamples(each[rows], is_true[frames][rows, foot], weight * is_hidden[rows, foot])


def fit_contact_network(
    examples: Sequence[ContactExamples], settings: ContactSettings, progress: Callable[[str], object]
) -> Perceptron:
    """Return a network trained on examples; the loss is the cross-entropy, so that its probabilities are calibrated."""
    features, *truth = (torch.as_tensor(np.concatenate(each)).float() for each in zip(*examples, strict=True))
    mean, scale = features.mean(0), 1 / (features.std(0) + ADDED_FEATURE_SD)
    inputs, network = (features - mean) * scale, initialise_perceptron(features.shape[1], 2, settings)
    fit_perceptron(network, settings, len(inputs), lambda _: [inputs, *truth], compute_contact_loss, progress)
    return Perceptron(mean.numpy(), scale.numpy(), *extract_layers(network))


def compute_contact_loss(predicted: Tensor, true: Tensor, weight: Tensor) -> Tensor:
    """Return the mean cross-entropy of logits (N, 2), by weights (N, 2)."""
    return nn.functional.binary_cross_entropy_with_logits(predicted, true, weight, reduction="sum") / weight.sum()


def compute_contact_scores(network: Perceptron, examples: Sequence[ContactExamples]) -> Float[np.ndarray, "10 5"]:
    """Return scores on the examples of full weight, by tenths of the probability.

    Precision, recall and F1 of contacts above it; share that stands of the frames up to the next tenth, and their share of all.
    """
    features, true, weight = (np.concatenate(each) for each in zip(*examples, strict=True))
    probability, true = 0.5 + 0.5 * np.tanh(0.5 * network.evaluate(features)[weight == 1]), true[weight == 1]
    tenth = np.minimum((10 * probability).astype(int), 9)
    frames, standing = np.bincount(tenth, minlength=10), np.bincount(tenth, true, 10)
    found, common = (each[::-1].cumsum()[::-1] for each in (frames, standing))
    f1 = 2 * common / np.maximum(found + true.sum(), 1)
    shares = standing / np.maximum(frames, 1), frames / max(len(true), 1)
    return np.stack([common / np.maximum(found, 1), common / max(true.sum(), 1), f1, *shares], axis=1)
