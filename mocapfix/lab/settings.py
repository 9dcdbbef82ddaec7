"""The settings of training: the form of priors/NAME.yaml.

Checkpoints of trainings, from which an interrupted training continues.
"""

from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import Annotated, Any, Literal, Protocol, runtime_checkable

import numpy as np
import torch
from pydantic import Field, PositiveFloat, PositiveInt, TypeAdapter

from mocapfix.errors import ReadError
from mocapfix.io.files import replace_atomically
from mocapfix.io.yaml_files import StrictModel, read_validated_yaml

NonNegativeFloat = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]


class SubjectSettings(StrictModel):
    """Settings that all training has."""

    title: str  # one line for the card
    test_subjects: frozenset[str]  # subjects that training never reads; the benchmarks use them
    held_out_subjects: frozenset[str]  # subjects that are not trained on; standard deviations and scores are measured on them
    subject_balance: Fraction  # 0 samples every pose equally often, 1 every subject equally often; values between interpolate
    # how often a pose of a retargeted subject is sampled relative to one of the others
    retargeted_weight: Annotated[float, Field(gt=0, le=1)]


class GaussianSettings(SubjectSettings):
    """Probabilistic principal component analysis."""

    model: Literal["linear"]
    # number of components; "all" keeps those above the noise floor, which gives the full Gaussian
    components: PositiveInt | Literal["all"]


class AutoencoderSettings(SubjectSettings):
    """An autoencoder.

    input_features, output_features, hidden_widths, code_size, residual_directions, activation, skip_connection
                       the architecture, see mocapfix.solve.trained_priors.NetworkArchitecture
    """

    model: Literal["autoencoder"]
    seed: int  # of weights, order and corruption
    input_features: Literal["continuous", "euler", "vectors"]
    output_features: Literal["euler", "vectors"]
    hidden_widths: tuple[PositiveInt, ...]
    code_size: PositiveInt
    residual_directions: Annotated[int, Field(ge=0)]
    activation: Literal["silu", "relu"]
    skip_connection: bool
    initial_weight_sd: PositiveFloat | None  # standard deviation of the initial weights; null for torch's default
    epochs: PositiveInt  # passes over all poses
    batch_poses: PositiveInt  # poses per step
    learning_rate: PositiveFloat  # at the start
    # "cosine", down to zero at the end; or a factor that is applied every 2,000 steps
    rate_schedule: Literal["cosine"] | Annotated[float, Field(gt=0, le=1)]
    weight_decay: NonNegativeFloat  # of AdamW
    norm_weight: NonNegativeFloat  # weight of the norm of all weights in the loss (MNN-IK, Eq. 3.2)
    # "paper" for squared errors and the norm (MNN-IK, Eq. 3.2); "evidence" for the evidence lower bound, see
    # mocapfix.lab.autoencoder_training.compute_evidence_loss
    loss: Literal["paper", "evidence"]
    corrupted_share: Fraction  # fraction of the poses that are corrupted, from which a denoising autoencoder learns


class MixtureSettings(SubjectSettings):
    """A Gaussian mixture."""

    model: Literal["mixture"]
    seed: int  # of the initial values of the fits
    variance_share: Annotated[float, Field(gt=0, lt=1)]  # fraction of the poses' variance that the principal axes keep
    components: PositiveInt  # number of Gaussians
    restarts: PositiveInt  # number of fits from different initial values; the one of greatest likelihood is used
    tolerance: PositiveFloat  # EM has converged when an iteration raises the mean log-likelihood of a pose by less
    max_iterations: PositiveInt  # of EM


class PerceptronSettings(SubjectSettings):
    """A multilayer perceptron."""

    model: Any  # the literal of each kind
    seed: int  # of weights, order and examples
    hidden_widths: tuple[PositiveInt, ...]  # widths of the hidden layers
    epochs: PositiveInt  # passes over all poses
    batch_poses: PositiveInt  # poses per step
    learning_rate: PositiveFloat  # at the start; it falls to zero along a cosine
    weight_decay: NonNegativeFloat  # of AdamW


class TwistSettings(PerceptronSettings):
    """The twist regressor, which is not a pose prior."""

    model: Literal["twist"]


class ContactSettings(PerceptronSettings):
    """The network that tells the contacts of feet that no marker shows; its poses are those of a foot."""

    model: Literal["contacts"]
    piece_share: Fraction  # of the pieces of recordings that are cleaned for training, each in about two seconds


class MotionSettings(SubjectSettings):
    """The motion prior."""

    model: Literal["motion"]
    seed: int  # of weights and windows
    width: PositiveInt  # channels of the network
    blocks: PositiveInt  # number of its residual blocks
    steps: PositiveInt  # number of steps
    batch_windows: PositiveInt  # windows per step
    speed_spread: NonNegativeFloat  # windows are up to this share faster or slower than recorded
    posture_sd_rad: NonNegativeFloat  # by which each joint of a window is turned, as in another person
    learning_rate: PositiveFloat  # in most steps; in the last ones it falls to zero
    weight_decay: NonNegativeFloat  # of AdamW


PriorSettings = GaussianSettings | AutoencoderSettings | MixtureSettings
PRIOR_SETTINGS_ADAPTER: TypeAdapter[PriorSettings] = TypeAdapter(Annotated[PriorSettings, Field(discriminator="model")])


def read_prior_settings(path: Path) -> PriorSettings:
    """Return the training settings of a pose prior. Raises SceneError that names the file and the first invalid key."""
    return read_validated_yaml(PRIOR_SETTINGS_ADAPTER.validate_python, path)


class LearnedIkSettings(SubjectSettings):
    """Learned inverse kinematics (Learnable SMPLify), which is not a pose prior."""

    model: Literal["ik"]
    seed: int  # of weights and pairs
    hidden_widths: tuple[PositiveInt, ...]  # widths of the hidden layers
    has_corruption: bool  # whether joints are noisy and missing, and some starts are not frames nearby
    frame_offsets: Annotated[tuple[PositiveInt, ...], Field(min_length=1)]  # numbers of frames between start and target (Eq. 17)
    loss_weights: tuple[NonNegativeFloat, NonNegativeFloat, NonNegativeFloat]  # of joints, pose and vertices (Eq. 21)
    steps: PositiveInt  # of the optimiser
    batch_poses: PositiveInt  # pairs per step
    learning_rate: PositiveFloat  # at the start; it falls to zero along a cosine
    weight_decay: NonNegativeFloat  # of AdamW


@runtime_checkable
class Stateful(Protocol):
    """A part of the training whose state a checkpoint holds."""

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state_dict: dict[str, Any]) -> object: ...


def compute_training_fingerprint(settings: SubjectSettings, motion: np.ndarray) -> str:
    """Return a string that identifies settings and motion, for the comparison with those of a checkpoint."""
    # The sets of subjects have no defined order; the motion depends on them.
    values = settings.model_dump(exclude={"test_subjects", "held_out_subjects"})
    sums = f"{motion.sum(dtype=float):.9g} {np.abs(motion).sum(dtype=float):.9g}"
    return f"{values} {motion.shape} {sums}"


def write_checkpoint(checkpoint: Path, fingerprint: str, finished: int, states: Mapping[str, Stateful]) -> None:
    """Write a checkpoint, replacing the file atomically.

    Args:
        finished: Number of epochs or steps that are done.

    Raises:
        WriteError: If it cannot be written.
    """
    state_dicts = {name: each.state_dict() for name, each in states.items()}
    with replace_atomically(checkpoint) as temporary:
        torch.save({"fingerprint": fingerprint, "finished": finished} | state_dicts, temporary)


def resume_training(checkpoint: Path, fingerprint: str, states: Mapping[str, Stateful]) -> int:
    """Return how many epochs or steps are done. If the checkpoint has the same fingerprint, its states are restored; else 0.

    Raises:
        ReadError: If a file of this name is not a checkpoint.
    """
    if not checkpoint.is_file():
        return 0
    try:
        content = torch.load(checkpoint, map_location="cpu", weights_only=True)
        if content["fingerprint"] != fingerprint:
            return 0
        for name, state in states.items():
            state.load_state_dict(content[name])
        return int(content["finished"])
    except (OSError, EOFError, RuntimeError, UnpicklingError, KeyError, TypeError, ValueError) as error:
        raise ReadError(f"{checkpoint}: is not a training checkpoint; move it away.") from error
