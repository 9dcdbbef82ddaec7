"""The options of reading a file; they are part of `mocapfix.options`."""

from dataclasses import dataclass

from mocapfix.files import option_choices as choices
from mocapfix.files.option_definitions import StageOptions, define_option


@dataclass(frozen=True)
class ReadOptions(StageOptions):
    """Reading the file."""

    unit: str | None = define_option(
        None, "--unit", "mm|cm|m|in|ft", "unit of length of the file", job_key="volume.unit",
        default_text="from the file and its markers", choices=choices.UNITS,
    )  # fmt: skip
    rate_hz: float | None = define_option(
        None, "--rate", "HZ", "frames per second of the file", job_key="volume.rate", unit="Hz",
        default_text="from the file", at_least=5.0, at_most=2000.0, is_finite=True,
    )  # fmt: skip
    up_axis: str | None = define_option(
        None, "--up", "X|-X|Y|-Y|Z|-Z", "up axis of the file", job_key="volume.up",
        default_text="from the file and its markers", choices=choices.UP_AXES,
    )  # fmt: skip
    mirror: bool = define_option(
        False, "--mirror", "", "the file is mirrored: its axes are left-handed", job_key="volume.mirror",
    )  # fmt: skip
    accept_contradictions: bool = define_option(
        False, "--accept-contradictions", "", "clean a take even if its unit, axes, labels or rate contradict its body",
        job_key="accept_contradictions",
    )  # fmt: skip

    def __post_init__(self) -> None:
        if self.up_axis is not None:
            object.__setattr__(self, "up_axis", self.up_axis.upper().removeprefix("+"))
        super().__post_init__()


DEFAULT_READ_OPTIONS = ReadOptions()
