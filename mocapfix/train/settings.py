"""How a prior, or the regressor of twists, is to be trained: what priors/NAME.yaml says."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, PositiveFloat, PositiveInt, TypeAdapter

from mocapfix.yaml_form import Stated, checked


class LinearSettings(Stated):
    """Probabilistic principal components.

    title       one line, for the card
    test        subjects that are never read: they are for the benchmarks
    unseen      subjects kept from the fit, by whom sigma and the scores are measured
    components  how many; "all" takes those above the noise floor, which makes it the full Gaussian
    """

    model: Literal["linear"]
    title: str
    test: frozenset[str]
    unseen: frozenset[str]
    components: PositiveInt | Literal["all"]


class AutoencoderSettings(Stated):
    """An autoencoder; title, test and unseen as in LinearSettings.

    seed        of weights, order and corruption
    features, gives, hidden, code, astray, activation, straight   the network, see mocapfix.prior.network.Shape
    initial     standard deviation of the weights at the start; null for torch's own
    epochs      times that every pose is seen
    batch       poses in a step
    rate        of learning, at the start
    falling     "cosine", to zero at the end; or a factor every 2,000 steps
    decay       AdamW's, of weights
    norm        times the norm of all weights is added to the loss (MNN-IK, Eq. 3.2)
    loss        "paper", squares and the norm (MNN-IK, Eq. 3.2); or "evidence", see mocapfix.train.evidence
    balance     0: poses are shown as they come; 1: those of every subject as often; between, between
    denoising   part of the poses that the network is shown corrupted, to learn the way back to people's
    """

    model: Literal["autoencoder"]
    title: str
    test: frozenset[str]
    unseen: frozenset[str]
    seed: int
    features: Literal["continuous", "euler", "vectors"]
    gives: Literal["euler", "vectors"]
    hidden: tuple[PositiveInt, ...]
    code: PositiveInt
    astray: Annotated[int, Field(ge=0)]
    activation: Literal["silu", "relu"]
    straight: bool
    initial: PositiveFloat | None
    epochs: PositiveInt
    batch: PositiveInt
    rate: PositiveFloat
    falling: Literal["cosine"] | Annotated[float, Field(gt=0, le=1)]
    decay: Annotated[float, Field(ge=0)]
    norm: Annotated[float, Field(ge=0)]
    loss: Literal["paper", "evidence"]
    balance: Annotated[float, Field(ge=0, le=1)]
    denoising: Annotated[float, Field(ge=0, le=1)]


class MixtureSettings(Stated):
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
    test: frozenset[str]
    unseen: frozenset[str]
    seed: int
    variance: Annotated[float, Field(gt=0, lt=1)]
    components: PositiveInt
    fits: PositiveInt
    tolerance: PositiveFloat
    most: PositiveInt


class TwistSettings(Stated):
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
    test: frozenset[str]
    unseen: frozenset[str]
    seed: int
    hidden: tuple[PositiveInt, ...]
    epochs: PositiveInt
    batch: PositiveInt
    rate: PositiveFloat
    decay: Annotated[float, Field(ge=0)]
    balance: Annotated[float, Field(ge=0, le=1)]


Settings = LinearSettings | AutoencoderSettings | MixtureSettings
READER: TypeAdapter[Settings] = TypeAdapter(Annotated[Settings, Field(discriminator="model")])


def read(path: Path) -> Settings:
    """-> a prior's settings. Raises SceneError naming the file and the key that is not as it must be."""
    return checked(READER, path)


def read_twist(path: Path) -> TwistSettings:
    """-> the settings of a regressor of twists. Raises SceneError likewise."""
    return checked(TwistSettings, path)
