"""How a prior, or the regressor of twists, is to be trained: what priors/NAME.yaml says."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, PositiveFloat, PositiveInt, TypeAdapter

from mocapfix.files.yaml_models import StrictModel, read_yaml_model


class GaussianSettings(StrictModel):
    """Probabilistic principal components.

    title       one line, for the card
    test        subjects that are never read: they are for the benchmarks
    unseen      subjects kept from the fit, by whom sigma and the scores are measured
    components  how many; "all" takes those above the noise floor, which makes it the full Gaussian
    """

    model: Literal["linear"]
    title: str
    test_subjects: frozenset[str]
    held_out_subjects: frozenset[str]
    components: PositiveInt | Literal["all"]


class AutoencoderSettings(StrictModel):
    """An autoencoder; title, test and unseen as in LinearSettings.

    seed        of weights, order and corruption
    features, gives, hidden, code, astray, activation, straight   the network, see mocapfix.pose_prior.network.NetworkArchitecture
    initial     standard deviation of the weights at the start; null for torch's own
    epochs      times that every pose is seen
    batch       poses in a step
    rate        of learning, at the start
    falling     "cosine", to zero at the end; or a factor every 2,000 steps
    decay       AdamW's, of weights
    norm        times the norm of all weights is added to the loss (MNN-IK, Eq. 3.2)
    loss        "paper", squares and the norm (MNN-IK, Eq. 3.2); or "evidence", see mocapfix.train.autoencoder
    balance     0: poses are shown as they come; 1: those of every subject as often; between, between
    denoising   part of the poses that the network is shown corrupted, to learn the way back to people's
    """

    model: Literal["autoencoder"]
    title: str
    test_subjects: frozenset[str]
    held_out_subjects: frozenset[str]
    seed: int
    input_features: Literal["continuous", "euler", "vectors"]
    output_features: Literal["euler", "vectors"]
    hidden_widths: tuple[PositiveInt, ...]
    code_size: PositiveInt
    residual_directions: Annotated[int, Field(ge=0)]
    activation: Literal["silu", "relu"]
    skip_connection: bool
    initial_weight_sd: PositiveFloat | None
    epochs: PositiveInt
    batch_poses: PositiveInt
    learning_rate: PositiveFloat
    rate_schedule: Literal["cosine"] | Annotated[float, Field(gt=0, le=1)]
    weight_decay: Annotated[float, Field(ge=0)]
    norm_weight: Annotated[float, Field(ge=0)]
    loss: Literal["paper", "evidence"]
    subject_balance: Annotated[float, Field(ge=0, le=1)]
    corrupted_share: Annotated[float, Field(ge=0, le=1)]


class MixtureSettings(StrictModel):
    """A mixture of Gaussians; title, test and unseen as in LinearSettings.

    seed        of where the fits begin
    variance    part of the poses' variance that the reduced space keeps
    components  how many Gaussians
    fits        from so many beginnings; the likeliest is taken
    tolerance   expectation maximisation ends where an iteration raises the mean log-likelihood of a pose by less
    most        iterations, in which it must have ended
    """

    model: Literal["mixture"]
    title: str
    test_subjects: frozenset[str]
    held_out_subjects: frozenset[str]
    seed: int
    variance_share: Annotated[float, Field(gt=0, lt=1)]
    components: PositiveInt
    restarts: PositiveInt
    tolerance: PositiveFloat
    max_iterations: PositiveInt


class TwistSettings(StrictModel):
    """The regressor of twists, which is no prior; title, test and unseen as in LinearSettings.

    seed     of weights, order, bodies and displacements
    hidden   widths of the layers
    epochs   times that every pose is seen
    batch    poses in a step
    rate     of learning, at the start; it falls to zero as a cosine does
    decay    AdamW's, of weights
    balance  0: poses are shown as they come; 1: those of every subject as often; between, between
    """

    model: Literal["twist"]
    title: str
    test_subjects: frozenset[str]
    held_out_subjects: frozenset[str]
    seed: int
    hidden_widths: tuple[PositiveInt, ...]
    epochs: PositiveInt
    batch_poses: PositiveInt
    learning_rate: PositiveFloat
    weight_decay: Annotated[float, Field(ge=0)]
    subject_balance: Annotated[float, Field(ge=0, le=1)]


PriorSettings = GaussianSettings | AutoencoderSettings | MixtureSettings
PRIOR_SETTINGS_ADAPTER: TypeAdapter[PriorSettings] = TypeAdapter(Annotated[PriorSettings, Field(discriminator="model")])


def read_prior_settings(path: Path) -> PriorSettings:
    """-> a prior's settings. Raises SceneError naming the file and the key that is not as it must be."""
    return read_yaml_model(PRIOR_SETTINGS_ADAPTER, path)


def read_twist_settings(path: Path) -> TwistSettings:
    """-> the settings of a regressor of twists. Raises SceneError likewise."""
    return read_yaml_model(TwistSettings, path)
