"""The options of cleaning a take: every option with its default, unit, range and help text, grouped by stage.

This is the only place where an option is defined. The Python interface, the command line and the job files are built from it, so
that an option is added by adding one field here::

    options = CleanOptions(prior=PriorOptions(prior="none"), fill=FillOptions(max_gap_s=2.0))
    options = build_clean_options(prior="none", max_gap_s=2.0)  # the same, by the names of the fields alone

The module imports no numerical library, because the command line needs it to print its help.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from functools import cache
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, cast

from mocapfix.errors import OptionError

if TYPE_CHECKING:
    from mocapfix.subject import Subject

T = TypeVar("T")

DEFAULT_PRIOR_NAME = "autoencoder"
INIT_METHODS = ("hybrik-x", "hybrik-adaptive", "hybrik-naive", "registration", "previous")
DEFAULT_INIT_METHOD = "hybrik-x"
RIG_NAMES = ("3dsmax", "blender", "cmu", "motionbuilder")
"""the rigs in scenes/rigs"""
EXTRA_FORMAT_NAMES = ("gltf", "amc", "npz", "c3d", "trc", "csv")
"""the formats that are written on request (write.output_formats)"""
REPAIRABLE_KINDS = (
    "gap", "spike", "pop", "flip", "jitter", "stuck", "ghost", "straight", "computed", "swap", "mislabelled", "fragment",
)  # fmt: skip
"""the kinds of fault that a repair can be restricted to; "gap" stands for every kind of missing samples (faults)"""
MAX_OUTPUT_RATE_HZ = 1000.0


@dataclass(frozen=True)
class Option:
    """How one option is presented and checked. Limits are in the unit of the field.

    flag          the flag on the command line
    metavar       the placeholder of its value in help texts
    help          one line for help texts and documentation
    job_key       the dotted key in a job file; "" if a job cannot set it
    unit          the unit of the value on the command line and in job files
    per_unit      how many of `unit` make one of the field's unit: 1000 for a field in metres that users give in millimetres
    aliases       other flags of the same meaning
    default_text  the default in help texts where None or an empty list does not explain itself
    choices       the allowed values, of a tuple the allowed elements; empty if any value is allowed
    above         lower limit, exclusive
    at_least      lower limit, inclusive
    at_most       upper limit, inclusive
    is_finite     whether the value must be finite
    is_expert     whether the option is hidden from the short help and the example job
    """

    flag: str
    metavar: str
    help: str
    job_key: str = ""
    unit: str = ""
    per_unit: float = 1.0
    aliases: tuple[str, ...] = ()
    default_text: str = ""
    choices: tuple[str, ...] = ()
    above: float | None = None
    at_least: float | None = None
    at_most: float | None = None
    is_finite: bool = False
    is_expert: bool = False

    def to_display(self, value: Any) -> Any:
        """Return a value with its numbers in the unit that users see."""
        if isinstance(value, tuple):
            return tuple(self.to_display(each) for each in cast("tuple[Any, ...]", value))
        return round(value * self.per_unit, 9) if isinstance(value, float) and self.per_unit != 1.0 else value

    def from_display(self, value: Any) -> Any:
        """Return a value that a user gave with its numbers in the unit of the field."""
        if isinstance(value, tuple):
            return tuple(self.from_display(each) for each in cast("tuple[Any, ...]", value))
        return value / self.per_unit if isinstance(value, float) and self.per_unit != 1.0 else value

    def find_problem(self, value: object) -> str:
        """Return what is wrong with a value as the end of a sentence, "" if it is allowed."""
        elements = cast("tuple[object, ...]", value) if isinstance(value, tuple) else (value,)
        return next((problem for each in elements if (problem := self._find_element_problem(each))), "")

    def _find_element_problem(self, value: object) -> str:
        if isinstance(value, str) and self.choices and value not in self.choices:
            return f"must be one of {', '.join(self.choices)}, not {value!r}"
        if not isinstance(value, int | float) or isinstance(value, bool):
            return ""
        is_allowed = (
            (self.above is None or value > self.above)
            and (self.at_least is None or value >= self.at_least)
            and (self.at_most is None or value <= self.at_most)
            and (isfinite(value) or not self.is_finite)
        )
        return "" if is_allowed else f"must be {self._describe_range()}, not {self.to_display(value):g}"

    def _describe_range(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        limits = (("greater than", self.above), ("at least", self.at_least), ("at most", self.at_most))
        parts = [f"{words} {self.to_display(limit):g}{unit}" for words, limit in limits if limit is not None]
        return " and ".join([*parts, *(["finite"] if self.is_finite else [])])


def define_option(default: T, flag: str, metavar: str, help: str, **details: Any) -> T:
    """Return a dataclass field with its default and an `Option`, which has the same arguments, in its metadata."""
    return field(default=default, metadata={"option": Option(flag, metavar, help, **details)})


class StageOptions:
    """The options of one stage. A list, or a single text for an option that takes several, becomes a tuple.

    Raises OptionError for the first value that is not allowed.
    """

    def __post_init__(self) -> None:
        for name, option in list_options(type(self)):
            value = getattr(self, name)
            if isinstance(value, list):
                object.__setattr__(self, name, tuple(cast("list[object]", value)))
            elif isinstance(value, str | Path) and isinstance(getattr(type(self), name), tuple):
                object.__setattr__(self, name, (value,))
            if problem := option.find_problem(getattr(self, name)):
                raise OptionError(name, option.flag, option.job_key, problem)


@cache
def list_options(stage: type[StageOptions]) -> tuple[tuple[str, Option], ...]:
    """Return the field names of a stage's options and the options."""
    named = ((each.name, each.metadata.get("option")) for each in fields(cast(Any, stage)))
    return tuple((name, option) for name, option in named if isinstance(option, Option))


@dataclass(frozen=True)
class ReadOptions(StageOptions):
    """Reading the file."""

    up_axis: Literal["X", "Y", "Z"] | None = define_option(
        None, "--up", "X|Y|Z", "up axis of the file", job_key="volume.up", default_text="from the file or its markers"
    )


@dataclass(frozen=True)
class SubjectOptions(StageOptions):
    """The subject and its labels."""

    marker_set: str | Path | None = define_option(
        None, "--marker-set", "NAME|FILE", "marker set: the name of a shipped one, or a YAML file",
        job_key="marker_set", default_text="by the labels",
    )  # fmt: skip
    subject: "str | Path | Subject | None" = define_option(
        None, "--subject", "FILE", "subject file of a calibration", default_text="calibrated from the take"
    )
    subject_prefix: str | None = define_option(
        None, "--subject-prefix", "NAME", 'clean this one of several subjects: "Jim" of Jim:LFHD',
        job_key="subject_prefix", default_text="every subject in turn",
    )  # fmt: skip
    hierarchy: str | Path | None = define_option(
        None, "--hierarchy", "STYLE|FILE", "naming convention of an animation's joints: a shipped one, or a YAML file",
        job_key="hierarchy", default_text="by the joint names",
    )  # fmt: skip


@dataclass(frozen=True)
class DetectOptions(StageOptions):
    """Fault detection."""

    repair_kinds: tuple[str, ...] = define_option(
        (), "--only", "KIND,...", f"repair these kinds of fault only: {', '.join(REPAIRABLE_KINDS)}",
        job_key="fill.only", default_text="all", choices=REPAIRABLE_KINDS,
    )  # fmt: skip
    max_rounds: int = define_option(
        3, "--detect-max-rounds", "N", "search the trajectories for label errors at most this many times",
        job_key="detect.max_rounds", at_least=1, is_expert=True,
    )  # fmt: skip


@dataclass(frozen=True)
class InitialiseOptions(StageOptions):
    """Initialisation."""

    method: str = define_option(
        DEFAULT_INIT_METHOD, "--init", "METHOD", f"how the first pose of each frame is found: {', '.join(INIT_METHODS)}",
        job_key="start", choices=INIT_METHODS,
    )  # fmt: skip


@dataclass(frozen=True)
class PriorOptions(StageOptions):
    """Pose prior."""

    prior: str = define_option(
        DEFAULT_PRIOR_NAME, "--prior", "NAME|none", "trained pose prior, used where a limb is missing", job_key="prior.name"
    )


@dataclass(frozen=True)
class SolveOptions(StageOptions):
    """Body solve."""

    prior_scale: float = define_option(
        1.0, "--prior-scale", "X", "multiply the prior's standard deviations by X (2 = weaker prior)",
        job_key="prior.scale", above=0.0, is_finite=True,
    )  # fmt: skip
    max_solve_rounds: int = define_option(
        3, "--solve-max-rounds", "N", "solve the body at most this many times, with fault detection on it in between",
        job_key="solve.max_rounds", at_least=1, is_expert=True,
    )  # fmt: skip
    marker_sd_m: float = define_option(
        0.010, "--solve-marker-sd", "MM", "standard deviation per axis of a sound marker about its position on the body",
        job_key="solve.marker_sd_mm", unit="mm", per_unit=1e3, above=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip
    robust_scales_m: tuple[float, ...] = define_option(
        (0.1, 0.05), "--solve-robust-scales", "MM,...",
        "Geman-McClure scales, one after the other: a marker farther off than the last hardly counts",
        job_key="solve.robust_scales_mm", unit="mm", per_unit=1e3, above=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip
    pose_persistence_s: float = define_option(
        1.0, "--solve-pose-persistence", "SECONDS", "the prior counts once in this time, not once a frame",
        job_key="solve.pose_persistence_s", unit="s", above=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip
    limit_sd_rad: float = define_option(
        0.1, "--solve-limit-sd", "RAD", "standard deviation of a rotation beyond its joint limits",
        job_key="solve.limit_sd_rad", unit="rad", above=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip
    gap_border_s: float = define_option(
        0.05, "--solve-gap-border", "SECONDS", "give a marker no weight for this long beside its gaps",
        job_key="solve.gap_border_s", unit="s", at_least=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip
    rotation_jitter_rad: float = define_option(
        0.01, "--solve-rotation-jitter", "RAD", "frame-to-frame noise of a joint's rotation beyond its motion",
        job_key="solve.rotation_jitter_rad", unit="rad", above=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip
    root_jitter_m: float = define_option(
        0.001, "--solve-root-jitter", "MM", "frame-to-frame noise of the root's position beyond its motion",
        job_key="solve.root_jitter_mm", unit="mm", per_unit=1e3, above=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip
    rotation_tracking_sd_rad: float = define_option(
        0.1, "--solve-rotation-tracking-sd", "RAD", "standard deviation of a joint's rotation about its smooth course",
        job_key="solve.rotation_tracking_sd_rad", unit="rad", above=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip
    root_tracking_sd_m: float = define_option(
        0.03, "--solve-root-tracking-sd", "MM", "standard deviation of the root's position about its smooth course",
        job_key="solve.root_tracking_sd_mm", unit="mm", per_unit=1e3, above=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip


@dataclass(frozen=True)
class FillOptions(StageOptions):
    """Gap filling."""

    max_gap_s: float = define_option(
        600.0, "--max-gap", "SECONDS", "leave longer gaps empty", job_key="fill.max_gap", unit="s", above=0.0
    )
    max_sd_m: float = define_option(
        0.250, "--limit", "MM", "leave a sample empty if its predicted standard deviation (per axis) exceeds this",
        job_key="fill.limit_mm", unit="mm", per_unit=1e3, aliases=("--max-sd",), above=0.0,
    )  # fmt: skip
    keep: tuple[str, ...] = define_option(
        (), "--keep", "LABEL,...", "leave these markers, or joints of an animation, exactly as they are",
        job_key="fill.keep", default_text="none",
    )  # fmt: skip
    frames: tuple[int, int] | None = define_option(
        None, "--frames", "FIRST:LAST", "change these frames only (frame numbers of the file)",
        job_key="fill.frames", default_text="all",
    )  # fmt: skip
    refill: bool = define_option(
        False, "--refill", "", "replace samples that another program filled if the measured ones contradict them",
        job_key="fill.refill",
    )  # fmt: skip


@dataclass(frozen=True)
class ReviewOptions(StageOptions):
    """Review of earlier changes."""

    review_files: tuple[str | Path, ...] = define_option(
        (), "--changes", "FILE", "changes file of an earlier cleaning with your decisions; repeat for several subjects",
        default_text="none",
    )  # fmt: skip


@dataclass(frozen=True)
class OutputOptions(StageOptions):
    """Output files."""

    extra_formats: tuple[str, ...] = define_option(
        (), "--also", "FORMAT,...", f"also write these formats: {', '.join(EXTRA_FORMAT_NAMES)}",
        job_key="write.also", default_text="none", choices=EXTRA_FORMAT_NAMES,
    )  # fmt: skip
    rigs: tuple[str, ...] = define_option(
        (), "--bvh-for", "PROGRAM,...", f"also write a BVH for each program: {', '.join(RIG_NAMES)}, or a rig's .yaml",
        job_key="write.bvh_for", default_text="none",
    )  # fmt: skip
    output_rate_hz: float | None = define_option(
        None, "--fps", "N", "frame rate of the BVH and the other motion files", job_key="write.fps", unit="Hz",
        default_text="that of the take", above=0.0, at_most=MAX_OUTPUT_RATE_HZ,
    )  # fmt: skip
    floor_height_m: float = define_option(
        0.0, "--floor", "METRES", "height of the floor in the file; motion files have their floor at 0",
        job_key="volume.floor", unit="m", is_finite=True,
    )  # fmt: skip


@dataclass(frozen=True)
class CleanOptions:
    """The options of cleaning a take, by stage."""

    read: ReadOptions = ReadOptions()
    subject: SubjectOptions = SubjectOptions()
    detect: DetectOptions = DetectOptions()
    initialise: InitialiseOptions = InitialiseOptions()
    prior: PriorOptions = PriorOptions()
    solve: SolveOptions = SolveOptions()
    fill: FillOptions = FillOptions()
    review: ReviewOptions = ReviewOptions()
    output: OutputOptions = OutputOptions()

    def change(self, **values: object) -> "CleanOptions":
        """Return the options with other values, given by the names of the stages' fields: `change(prior="none", max_gap_s=2.0)`.

        Raises OptionError if there is no such option or its value is not allowed.
        """
        stages: dict[str, dict[str, object]] = {}
        for name, value in values.items():
            if name not in STAGE_OF_OPTION:
                raise OptionError(name, name, name, f"is no option; the options are {', '.join(STAGE_OF_OPTION)}")
            stages.setdefault(STAGE_OF_OPTION[name], {})[name] = value
        return replace(self, **{stage: replace(getattr(self, stage), **changed) for stage, changed in stages.items()})


def list_stages() -> Iterator[tuple[str, type[StageOptions]]]:
    """Yield the names and classes of the stages in the order of the work."""
    for each in fields(CleanOptions):
        yield each.name, type(cast(StageOptions, each.default))


STAGE_OF_OPTION: dict[str, str] = {name: stage for stage, kind in list_stages() for name, _ in list_options(kind)}


def build_clean_options(**values: object) -> CleanOptions:
    """Return the default options with other values, as `CleanOptions.change`."""
    return CleanOptions().change(**values)
