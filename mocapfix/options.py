"""The options of cleaning a take: every option with its default, unit, range and help text, grouped by stage.

The Python interface, the command line and the job files are built from this. It imports no numerical library, because the command
line needs it to print its help. Example: `build_clean_options(prior="none", max_gap_s=2.0)`.

Define an option once: its default, unit, range and help text, and the check of its value.

`define_option` makes a dataclass field with an `Option` in its metadata; `StageOptions` checks the values of all its options.

The names from which options choose.

The options of reading a file; they are part of `mocapfix.options`.

The options of output files; they are part of `mocapfix.options`.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from functools import cache
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from mocapfix.errors import OptionError, format_name_list

if TYPE_CHECKING:
    from mocapfix.model.subject import Subject


T = TypeVar("T")


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
    lab_default   the default with the purpose "lab", which differs from the usual one; None if it does not
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
    lab_default: Any = None

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


DEFAULT_PRIOR_NAME = "autoencoder"
PRIOR_EVERY_FRAME, PRIOR_LOST_LIMBS, NO_TRAINED_PRIOR = "every-frame", "lost-limbs", "none"
PRIOR_SCOPES = (PRIOR_EVERY_FRAME, PRIOR_LOST_LIMBS, NO_TRAINED_PRIOR)
INIT_METHODS = ("hybrik-x", "hybrik-adaptive", "hybrik-naive", "learned", "registration", "previous")
DEFAULT_INIT_METHOD = "hybrik-x"
RIG_NAMES = ("3dsmax", "blender", "cmu", "motionbuilder")  # in scenes/rigs
CHARACTER_PRESETS = ("daz-g8", "daz-g9", "humanik", "metahuman", "mixamo", "rigify", "smpl", "unreal", "vrm")  # in scenes/rigs
EXTRA_FORMAT_NAMES = ("gltf", "amc", "npz", "c3d", "trc", "csv", "contacts", "events", "fbx")
"""formats that are written on request (io.output_formats)"""
REPAIRABLE_KINDS = (
    "gap", "spike", "pop", "flip", "jitter", "stuck", "ghost", "straight", "computed", "swap", "mislabelled", "fragment",
)  # fmt: skip
"""the kinds of fault that a repair can be restricted to; "gap" stands for every kind of missing samples (faults)"""
UNITS = ("mm", "cm", "m", "in", "ft")
UP_AXES = ("X", "-X", "Y", "-Y", "Z", "-Z")
FEET_OFF, FEET_SOFT, FEET_LOCK = "off", "soft", "lock"
FEET_MODES = (FEET_OFF, FEET_SOFT, FEET_LOCK)
PURPOSE_ANIMATION, PURPOSE_LAB = "animation", "lab"
PURPOSES = (PURPOSE_ANIMATION, PURPOSE_LAB)
"""what a cleaned take is for; some options have another default for a laboratory"""


@dataclass(frozen=True)
class ReadOptions(StageOptions):
    """Reading the file."""

    unit: str | None = define_option(
        None, "--unit", "mm|cm|m|in|ft", "unit of length of the file", job_key="volume.unit",
        default_text="from the file and its markers", choices=UNITS,
    )  # fmt: skip
    rate_hz: float | None = define_option(
        None, "--rate", "HZ", "frames per second of the file", job_key="volume.rate", unit="Hz",
        default_text="from the file", at_least=5.0, at_most=2000.0, is_finite=True,
    )  # fmt: skip
    up_axis: str | None = define_option(
        None, "--up", "X|-X|Y|-Y|Z|-Z", "up axis of the file", job_key="volume.up",
        default_text="from the file and its markers", choices=UP_AXES,
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
        default_text="that of the take", at_least=5.0, at_most=1000.0,
    )  # fmt: skip
    floor_height_m: float = define_option(
        0.0, "--floor", "METRES", "height of the floor in the file; motion files have their floor at 0",
        job_key="volume.floor", unit="m", is_finite=True,
    )  # fmt: skip
    characters: tuple[str | Path, ...] = define_option(
        (), "--character", "PRESET|FILE",
        f"also write the motion of a character: {', '.join(CHARACTER_PRESETS)}, or a .glb, .vrm, .bvh or .yaml file",
        job_key="write.character", default_text="none",
    )  # fmt: skip
    character_map: str | Path | None = define_option(
        None, "--character-map", "FILE", "YAML file with the bones of the character's body, as written beside its motion",
        job_key="write.character_map", default_text="by the names of the bones, or the shape of the skeleton",
    )  # fmt: skip


__all__ = [
    "DEFAULT_READ_OPTIONS", "PURPOSE_DEFAULTS", "PURPOSE_OPTIONS", "STAGE_OF_OPTION", "CleanOptions", "ContactOptions",
    "DetectOptions", "FillOptions", "InitialiseOptions", "OutputOptions", "PriorOptions", "PurposeOptions", "ReadOptions",
    "ReviewOptions", "SolveOptions", "SubjectOptions", "build_clean_options", "list_stages",
]  # fmt: skip


@dataclass(frozen=True)
class PurposeOptions(StageOptions):
    """What the cleaned take is for."""

    purpose: str = define_option(
        PURPOSE_ANIMATION, "--purpose", "animation|lab",
        "defaults of other options: complete takes for animation, or only what measurements in a laboratory can rely on",
        job_key="purpose", choices=PURPOSES,
    )  # fmt: skip
    given: tuple[str, ...] = field(default=(), compare=False)
    """the names of the options that were given, of the purpose and of those whose default depends on it"""


@dataclass(frozen=True)
class SubjectOptions(StageOptions):
    """The subject and its labels."""

    marker_set: str | Path | None = define_option(
        None, "--marker-set", "NAME|FILE", "marker set: the name of a shipped one, or a YAML file",
        job_key="marker_set", default_text="by the labels",
    )  # fmt: skip
    known_sets_only: bool = define_option(
        False, "--known-sets-only", "", "learn no marker set from a take that no known one fits: clean it without a skeleton",
        job_key="known_sets_only",
    )  # fmt: skip
    subject: "str | Path | Subject | tuple[tuple[str, Path], ...] | None" = define_option(
        None, "--subject", "FILE|NAME=FILE,...", "subject file, or one for each subject", default_text="calibrated from the take"
    )
    like: str | Path | None = define_option(
        None, "--like", "TAKE", "a labelled take of the same person, by which a take without labels is labelled",
        default_text="none",
    )  # fmt: skip
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
        3, "--detect-max-rounds", "N", "repeat detection on the trajectories at most this many times",
        job_key="detect.max_rounds", at_least=1, is_expert=True,
    )  # fmt: skip
    min_spike_m: float = define_option(
        0.02, "--detect-min-spike", "MM", "least distance of a spike from the marker's path",
        job_key="detect.min_spike_mm", unit="mm", per_unit=1e3, above=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip
    max_spike_duration_s: float = define_option(
        0.05, "--detect-max-spike-duration", "SECONDS", "greatest duration of a spike",
        job_key="detect.max_spike_duration_s", unit="s", above=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip
    min_jitter_m: float = define_option(
        0.005, "--detect-min-jitter", "MM", "least amplitude of jitter",
        job_key="detect.min_jitter_mm", unit="mm", per_unit=1e3, above=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip
    min_jitter_ratio: float = define_option(
        6.0, "--detect-min-jitter-ratio", "X", "least amplitude of jitter relative to the marker's usual noise",
        job_key="detect.min_jitter_ratio", above=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip
    min_jitter_duration_s: float = define_option(
        0.1, "--detect-min-jitter-duration", "SECONDS", "least duration of jitter",
        job_key="detect.min_jitter_duration_s", unit="s", above=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip


@dataclass(frozen=True)
class InitialiseOptions(StageOptions):
    """Initialisation."""

    init_method: str = define_option(
        DEFAULT_INIT_METHOD, "--init", "METHOD",
        f"how the first pose of each frame is found: {', '.join(INIT_METHODS)}",
        job_key="start", choices=INIT_METHODS,
    )  # fmt: skip
    is_fast: bool = define_option(
        False, "--fast", "", "preview: the first pose of each frame is the result, without iterations", job_key="fast",
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.is_fast and self.init_method == "previous":
            raise OptionError("is_fast", "--fast", "fast", "needs first poses, which the method previous does not compute")

    @property
    def method_used(self) -> str:
        """The method of initialisation, for previews the learned one in place of the default."""
        return "learned" if self.is_fast and self.init_method == DEFAULT_INIT_METHOD else self.init_method


@dataclass(frozen=True)
class PriorOptions(StageOptions):
    """Pose prior."""

    prior: str = define_option(DEFAULT_PRIOR_NAME, "--prior", "NAME|none", "trained pose prior", job_key="prior.name")
    prior_scope: str = define_option(
        PRIOR_LOST_LIMBS, "--prior-scope", "SCOPE", f"where the trained prior is used: {', '.join(PRIOR_SCOPES)}",
        job_key="prior.scope", choices=PRIOR_SCOPES,
    )  # fmt: skip

    @property
    def name_used(self) -> str:
        """The name of the prior, "none" if it is used nowhere."""
        return NO_TRAINED_PRIOR if self.prior_scope == NO_TRAINED_PRIOR else self.prior


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
        0.010, "--solve-marker-sd", "MM", "standard deviation per axis of a marker without faults about its position on the body",
        job_key="solve.marker_sd_mm", unit="mm", per_unit=1e3, above=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip
    robust_scales_m: tuple[float, ...] = define_option(
        (0.1, 0.05), "--solve-robust-scales", "MM,...",
        "Geman-McClure scales, used in turn: markers farther from the body than the last one get little weight",
        job_key="solve.robust_scales_mm", unit="mm", per_unit=1e3, above=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip
    pose_persistence_s: float = define_option(
        1.0, "--solve-pose-persistence", "SECONDS", "apply the prior once in this time instead of once a frame",
        job_key="solve.pose_persistence_s", unit="s", above=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip
    limit_sd_rad: float = define_option(
        0.1, "--solve-limit-sd", "RAD", "standard deviation of a rotation beyond its joint limits",
        job_key="solve.limit_sd_rad", unit="rad", above=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip
    gap_border_s: float = define_option(
        0.05, "--solve-gap-border", "SECONDS", "ignore a marker for this long before and after its gaps",
        job_key="solve.gap_border_s", unit="s", at_least=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip
    rotation_jitter_rad: float = define_option(
        0.01, "--solve-rotation-jitter", "RAD", "frame-to-frame noise of a joint's rotation, in addition to its motion",
        job_key="solve.rotation_jitter_rad", unit="rad", above=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip
    root_jitter_m: float = define_option(
        0.001, "--solve-root-jitter", "MM", "frame-to-frame noise of the root's position, in addition to its motion",
        job_key="solve.root_jitter_mm", unit="mm", per_unit=1e3, above=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip
    rotation_tracking_sd_rad: float = define_option(
        0.1, "--solve-rotation-tracking-sd", "RAD", "standard deviation of a joint's rotation about its smooth trajectory",
        job_key="solve.rotation_tracking_sd_rad", unit="rad", above=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip
    root_tracking_sd_m: float = define_option(
        0.03, "--solve-root-tracking-sd", "MM", "standard deviation of the root's position about its smooth trajectory",
        job_key="solve.root_tracking_sd_mm", unit="mm", per_unit=1e3, above=0.0, is_finite=True, is_expert=True,
    )  # fmt: skip


@dataclass(frozen=True)
class ContactOptions(StageOptions):
    """Contacts with the floor."""

    feet: str = define_option(
        FEET_SOFT, "--feet", "lock|soft|off", "standing feet: held at one place, smoothed, or left as solved",
        job_key="contacts.feet", choices=FEET_MODES, lab_default=FEET_OFF,
    )  # fmt: skip
    write_events: bool = define_option(
        False, "--events", "", "add foot strikes and foot offs to the EVENT group of the C3D", job_key="contacts.events",
    )  # fmt: skip


@dataclass(frozen=True)
class FillOptions(StageOptions):
    """Gap filling."""

    max_gap_s: float = define_option(
        600.0, "--max-gap", "SECONDS", "leave longer gaps empty", job_key="fill.max_gap", unit="s", above=0.0
    )
    max_sd_m: float = define_option(
        0.250, "--max-sd", "MM", "leave a sample empty if its predicted standard deviation (per axis) exceeds this",
        job_key="fill.limit_mm", unit="mm", per_unit=1e3, aliases=("--limit",), above=0.0, lab_default=0.020,
    )  # fmt: skip
    max_end_sd_m: float = define_option(
        0.060, "--max-end-sd", "MM",
        "the same before a marker is first measured and after it is last measured; 0 leaves all of these samples empty",
        job_key="fill.end_limit_mm", unit="mm", per_unit=1e3, at_least=0.0, lab_default=0.0,
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
    update_computed: bool = define_option(
        False, "--update-computed", "", "compute joint centres and other computed points again where their markers were changed",
        job_key="fill.update_computed",
    )  # fmt: skip
    smooth_keypoints: bool = define_option(
        False, "--smooth-keypoints", "", "write 3-D keypoints without their noise, as the body was fitted to them",
        job_key="fill.smooth_keypoints",
    )  # fmt: skip


@dataclass(frozen=True)
class ReviewOptions(StageOptions):
    """Review of earlier changes."""

    review_files: tuple[str | Path, ...] = define_option(
        (), "--changes", "FILE", "changes file of an earlier cleaning with your decisions; repeat for several subjects",
        default_text="none",
    )  # fmt: skip


@dataclass(frozen=True)
class CleanOptions:
    """The options of cleaning a take, by stage.

    An option that is not given has the default of the purpose. Given is what is passed to `change` or `build_clean_options`, on
    the command line or in a job file, and in a stage what differs from its usual default.
    """

    purpose: PurposeOptions = PurposeOptions()
    read: ReadOptions = ReadOptions()
    subject: SubjectOptions = SubjectOptions()
    detect: DetectOptions = DetectOptions()
    initialise: InitialiseOptions = InitialiseOptions()
    prior: PriorOptions = PriorOptions()
    solve: SolveOptions = SolveOptions()
    contacts: ContactOptions = ContactOptions()
    fill: FillOptions = FillOptions()
    review: ReviewOptions = ReviewOptions()
    output: OutputOptions = OutputOptions()

    def __post_init__(self) -> None:
        given = set(self.purpose.given)
        for name, usual in PURPOSE_DEFAULTS.items():
            options, default = getattr(self, STAGE_OF_OPTION[name]), self.get_default(name)
            if name in given or getattr(options, name) == default:
                continue
            if getattr(options, name) == usual:
                object.__setattr__(self, STAGE_OF_OPTION[name], replace(options, **{name: default}))
            else:
                given.add(name)
        object.__setattr__(self, "purpose", replace(self.purpose, given=tuple(sorted(given))))

    def change(self, **values: object) -> "CleanOptions":
        """Return the options with other values, given by the names of the stages' fields: `change(prior="none", max_gap_s=2.0)`.

        Raises OptionError if there is no such option or its value is not allowed.
        """
        given = {*self.purpose.given, *values.keys() & set(PURPOSE_OPTIONS)}
        values = {name: default for name, default in PURPOSE_DEFAULTS.items() if name not in given} | values
        stages: dict[str, dict[str, object]] = {"purpose": {"given": tuple(sorted(given))}}
        for name, value in values.items():
            if name not in STAGE_OF_OPTION:
                raise OptionError(name, name, name, f"is no option; the options are {format_name_list(list(STAGE_OF_OPTION))}")
            stages.setdefault(STAGE_OF_OPTION[name], {})[name] = value
        return replace(self, **{stage: replace(getattr(self, stage), **changed) for stage, changed in stages.items()})

    def get_default(self, name: str) -> object:
        """Return the default of an option for the purpose of these options."""
        stage = type(getattr(self, STAGE_OF_OPTION[name]))
        lab_default = dict(list_options(stage))[name].lab_default
        is_other = self.purpose.purpose == PURPOSE_LAB and lab_default is not None
        return lab_default if is_other else getattr(stage, name)


def list_stages() -> Iterator[tuple[str, type[StageOptions]]]:
    """Yield the names and classes of the stages in the order of the work."""
    for each in fields(CleanOptions):
        yield each.name, type(cast(StageOptions, each.default))


STAGE_OF_OPTION: dict[str, str] = {name: stage for stage, kind in list_stages() for name, _ in list_options(kind)}


PURPOSE_DEFAULTS: dict[str, object] = {
    name: getattr(stage, name)
    for _, stage in list_stages()
    for name, option in list_options(stage)
    if option.lab_default is not None
}
"""the usual default of each option whose default depends on the purpose, by the option's name"""
PURPOSE_OPTIONS = ("purpose", *PURPOSE_DEFAULTS)
"""the options of which it matters whether they were given"""


def build_clean_options(**values: object) -> CleanOptions:
    """Return the default options with other values, as `CleanOptions.change`."""
    return CleanOptions().change(**values)
