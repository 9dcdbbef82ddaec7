"""The options of cleaning a take: every option with its default, unit, range and help text, grouped by stage.

An option is defined once, by `define_option` in the class of its stage. `OPTIONS` is the table of all of them, from which the
Python interface, the command line, job files and the arguments in a report are built. No numerical library is imported, because
the command line needs the options to print its help. Example: `build_clean_options(prior="none", max_gap_s=2.0)`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from mocapfix.errors import OptionError, TakeError, format_name_list
from mocapfix.option import StageOptions, define_option, format_frames, list_options

if TYPE_CHECKING:
    from mocapfix.model.subject import Subject
    from mocapfix.model.take import Take


DEFAULT_PRIOR_NAME = "autoencoder"
PRIOR_EVERY_FRAME, PRIOR_LOST_LIMBS, NO_TRAINED_PRIOR = "every-frame", "lost-limbs", "none"
PRIOR_SCOPES = (PRIOR_EVERY_FRAME, PRIOR_LOST_LIMBS, NO_TRAINED_PRIOR)
INIT_METHODS = ("hybrik-x", "hybrik-adaptive", "hybrik-naive", "learned", "registration")
DEFAULT_INIT_METHOD = "hybrik-x"
RIG_NAMES = ("3dsmax", "blender", "cmu", "motionbuilder")  # in scenes/rigs
# in scenes/rigs
CHARACTER_PRESETS = ("daz-g8", "daz-g9", "humanik", "metahuman", "mixamo", "rigify", "smpl", "smplx", "unreal", "vrm")
ROBOT_SUFFIXES = (".xml", ".mjcf", ".urdf")  # of files that hold robots
ROBOT_FORMAT_NAMES = ("robot-npz", "robot-csv", "robot-pkl")  # formats of a robot's motion; the first is always written
EXTRA_FORMAT_NAMES = (
    "gltf", "amc", "npz", "amass", "c3d", "trc", "csv", "contacts", "events", "fbx", "usd", "sheet", *ROBOT_FORMAT_NAMES,
)  # fmt: skip
"""formats that are written on request (`output_formats.OPTIONAL_FORMATS`)"""
REPAIRABLE_KINDS = (
    "gap", "spike", "pop", "flip", "jitter", "stuck", "ghost", "straight", "computed", "swap", "mislabelled", "fragment",
)  # fmt: skip
"""the kinds of fault that a repair can be restricted to; "gap" stands for every kind of missing samples (`model.faults`)"""
UNITS = ("mm", "cm", "m", "in", "ft")
UP_AXES = ("X", "-X", "Y", "-Y", "Z", "-Z")
FEET_OFF, FEET_SOFT, FEET_LOCK = "off", "soft", "lock"
FEET_MODES = (FEET_OFF, FEET_SOFT, FEET_LOCK)
ROOT_HIPS, ROOT_BONE, ROOT_IN_PLACE = "hips", "bone", "in-place"
PURPOSE_ANIMATION, PURPOSE_LAB = "animation", "lab"
PURPOSES = (PURPOSE_ANIMATION, PURPOSE_LAB)
"""what a cleaned take is for; some options have another default for a laboratory"""


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
class SubjectOptions(StageOptions):
    """The subject and its labels."""

    marker_set: str | Path | None = define_option(
        None, "--marker-set", "NAME|FILE", "marker set: the name of a shipped one, or a YAML file",
        job_key="marker_set", default_text="by the labels", is_file=True, for_markers=True,
    )  # fmt: skip
    known_sets_only: bool = define_option(
        False, "--known-sets-only", "", "learn no marker set from a take that no known one fits: clean it without a skeleton",
        job_key="known_sets_only",
    )  # fmt: skip
    subject: "str | Path | Subject | tuple[tuple[str, Path], ...] | None" = define_option(
        None, "--subject", "FILE|NAME=FILE,...", "subject file, or one for each subject",
        default_text="calibrated from the take", is_file=True, for_markers=True,
    )  # fmt: skip
    like: str | Path | None = define_option(
        None, "--like", "TAKE", "a labelled take of the same person, by which a take without labels is labelled",
        default_text="none", is_file=True,
    )  # fmt: skip
    subject_prefix: str | None = define_option(
        None, "--subject-prefix", "NAME", 'clean this one of several subjects: "Jim" of Jim:LFHD',
        job_key="subject_prefix", default_text="every subject in turn", for_markers=True,
    )  # fmt: skip
    hierarchy: str | Path | None = define_option(
        None, "--hierarchy", "STYLE|FILE", "naming convention of an animation's joints: a shipped one, or a YAML file",
        job_key="hierarchy", default_text="by the joint names", is_file=True,
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
        job_key="detect.max_rounds", at_least=1,
    )  # fmt: skip
    min_spike_m: float = define_option(
        0.02, "--detect-min-spike", "MM", "least distance of a spike from the marker's path",
        job_key="detect.min_spike_mm", unit="mm", per_unit=1e3, above=0.0, is_finite=True,
    )  # fmt: skip
    max_spike_duration_s: float = define_option(
        0.05, "--detect-max-spike-duration", "SECONDS", "greatest duration of a spike",
        job_key="detect.max_spike_duration_s", unit="s", above=0.0, is_finite=True,
    )  # fmt: skip
    min_jitter_m: float = define_option(
        0.005, "--detect-min-jitter", "MM", "least amplitude of jitter",
        job_key="detect.min_jitter_mm", unit="mm", per_unit=1e3, above=0.0, is_finite=True,
    )  # fmt: skip


@dataclass(frozen=True)
class InitialiseOptions(StageOptions):
    """Initialisation."""

    init_method: str = define_option(
        DEFAULT_INIT_METHOD, "--init", "METHOD",
        f"how the first pose of each frame is found: {', '.join(INIT_METHODS)}",
        job_key="start", choices=INIT_METHODS, for_markers=True,
    )  # fmt: skip
    is_fast: bool = define_option(
        False, "--fast", "", "preview: first poses and cheap fills, no recording; its error is in the notes", job_key="fast",
        for_markers=True,
    )  # fmt: skip

    @property
    def method_used(self) -> str:
        """The method of initialisation, for previews the learned one in place of the default."""
        return "learned" if self.is_fast and self.init_method == DEFAULT_INIT_METHOD else self.init_method


@dataclass(frozen=True)
class PriorOptions(StageOptions):
    """Pose prior."""

    prior: str = define_option(DEFAULT_PRIOR_NAME, "--prior", "NAME|none", "trained pose prior", job_key="prior.name")
    prior_scope: str = define_option(
        PRIOR_EVERY_FRAME, "--prior-scope", "SCOPE", f"where the trained prior is used: {', '.join(PRIOR_SCOPES)}",
        job_key="prior.scope", choices=PRIOR_SCOPES,
    )  # fmt: skip
    person_memory: str | Path | tuple[tuple[str, Path], ...] | None = define_option(
        None, "--person-memory", "FILE|NAME=FILE,...",
        "memory of how the person moved in other takes, for limbs that no marker shows, as calibrate and batch write it",
        default_text="none", is_file=True, for_markers=True,
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
        job_key="solve.max_rounds", at_least=1,
    )  # fmt: skip
    marker_sd_m: float = define_option(
        0.010, "--solve-marker-sd", "MM", "standard deviation per axis of a marker without faults about its position on the body",
        job_key="solve.marker_sd_mm", unit="mm", per_unit=1e3, above=0.0, is_finite=True,
    )  # fmt: skip
    robust_scales_m: tuple[float, ...] = define_option(
        (0.1, 0.05), "--solve-robust-scales", "MM,...",
        "Geman-McClure scales, used in turn: markers farther from the body than the last one get little weight",
        job_key="solve.robust_scales_mm", unit="mm", per_unit=1e3, above=0.0, is_finite=True,
    )  # fmt: skip
    limit_sd_rad: float = define_option(
        0.1, "--solve-limit-sd", "RAD",
        "standard deviation of a rotation beyond its joint limits in a pose that lasts 1 s (times sqrt(rate) in one frame)",
        job_key="solve.limit_sd_rad", unit="rad", above=0.0, is_finite=True,
    )  # fmt: skip


@dataclass(frozen=True)
class ContactOptions(StageOptions):
    """Contacts with the floor."""

    feet: str = define_option(
        FEET_SOFT, "--feet", "lock|soft|off", "standing feet: held at one place, smoothed, or left as solved",
        job_key="contacts.feet", choices=FEET_MODES, lab_default=FEET_OFF,
    )  # fmt: skip
    contacts_file: str | Path | None = define_option(
        None, "--contacts", "FILE", "your own contacts of an animation's feet, as --also contacts writes them",
        job_key="contacts.file", default_text="detected", is_file=True,
    )  # fmt: skip
    write_events: bool = define_option(
        False, "--events", "", "add foot strikes and foot offs to the EVENT group of the C3D", job_key="contacts.events",
        for_markers=True,
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
        job_key="fill.refill", for_markers=True,
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
class OutputOptions(StageOptions):
    """Output files."""

    extra_formats: tuple[str, ...] = define_option(
        (), "--also", "FORMAT,...", f"also write these formats: {', '.join(EXTRA_FORMAT_NAMES)}",
        job_key="write.also", default_text="none", choices=EXTRA_FORMAT_NAMES,
    )  # fmt: skip
    rigs: tuple[str, ...] = define_option(
        (), "--bvh-for", "PROGRAM,...", f"also write a BVH for each program: {', '.join(RIG_NAMES)}, or a rig's .yaml",
        job_key="write.bvh_for", default_text="none", is_file=True,
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
        f"also write the motion of a character: {', '.join(CHARACTER_PRESETS)}, or a .glb, .vrm, .fbx, .bvh or .yaml file; "
        "a robot: an MJCF (.xml) or a .urdf",
        job_key="write.character", default_text="none", is_file=True,
    )  # fmt: skip
    character_map: str | Path | None = define_option(
        None, "--character-map", "FILE", "YAML file with the bones of the character's body, as written beside its motion",
        job_key="write.character_map", default_text="by the names of the bones, or the shape of the skeleton",
        is_file=True,
    )  # fmt: skip
    rest_frame: int | None = define_option(
        None, "--rest-frame", "N", "frame of the character's file, counted from 1, that is its rest pose: a T- or A-pose",
        job_key="write.rest_frame", default_text="the bind pose, or the frame most like a T- or A-pose", at_least=1,
    )  # fmt: skip
    root_motion: str = define_option(
        ROOT_HIPS, "--root-motion", "hips|bone|in-place",
        "the path of a character on the floor: in its hips, in a root bone on the floor, or left out",
        job_key="write.root_motion", choices=(ROOT_HIPS, ROOT_BONE, ROOT_IN_PLACE),
    )  # fmt: skip
    trim: tuple[int, int] | None = define_option(
        None, "--trim", "FIRST:LAST", "write these frames of a character's motion only (frame numbers of the file)",
        job_key="write.trim", default_text="all",
    )  # fmt: skip
    loop: bool = define_option(
        False, "--loop", "", "let the last frame of a character's motion lead into the first", job_key="write.loop",
    )  # fmt: skip


CHARACTER_OPTIONS = ("character_map", "rest_frame", "root_motion", "trim", "loop")  # options that need a character


@dataclass(frozen=True)
class ReviewOptions(StageOptions):
    """Review of earlier changes."""

    review_files: tuple[str | Path, ...] = define_option(
        (), "--changes", "FILE", "changes file of an earlier cleaning with your decisions; repeat for several subjects",
        default_text="none", is_file=True,
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
            option, default = OPTION_BY_NAME[name], self.get_default(name)
            value = option.get_value(self)
            if name in given or value == default:
                continue
            if value == usual:
                object.__setattr__(self, option.stage, replace(getattr(self, option.stage), **{name: default}))
            else:
                given.add(name)
        object.__setattr__(self, "purpose", replace(self.purpose, given=tuple(sorted(given))))

    def change(self, **values: object) -> "CleanOptions":
        """Return the options with other values, given by the names of the stages' fields: `change(prior="none", max_gap_s=2.0)`.

        Raises:
            OptionError: If there is no such option or its value is not allowed.
        """
        given = {*self.purpose.given, *values.keys() & set(PURPOSE_OPTIONS)}
        values = {name: default for name, default in PURPOSE_DEFAULTS.items() if name not in given} | values
        stages: dict[str, dict[str, object]] = {"purpose": {"given": tuple(sorted(given))}}
        for name, value in values.items():
            if name not in OPTION_BY_NAME:
                raise OptionError(name, name, name, f"is no option; the options are {format_name_list(list(OPTION_BY_NAME))}")
            stages.setdefault(OPTION_BY_NAME[name].stage, {})[name] = value
        return replace(self, **{stage: replace(getattr(self, stage), **changed) for stage, changed in stages.items()})

    def get_default(self, name: str) -> object:
        """Return the default of an option for the purpose of these options."""
        option = OPTION_BY_NAME[name]
        return option.lab_default if self.purpose.purpose == PURPOSE_LAB and option.lab_default is not None else option.default

    def map_files(self, change: Callable[[str | Path], str | Path]) -> "CleanOptions":
        """Return the options with every name of a file, or of something shipped, changed by a function."""

        def map_value(value: Any) -> Any:
            if isinstance(value, tuple):
                return tuple(
                    (each[0], change(each[1])) if isinstance(each, tuple) else change(each)
                    for each in cast("tuple[Any, ...]", value)
                )
            return change(value) if isinstance(value, str | Path) else value

        values = {option.name: option.get_value(self) for option in OPTIONS if option.is_file}
        return self.change(**{name: map_value(value) for name, value in values.items() if value})


OPTIONS = tuple(
    replace(option, stage=stage.name)
    for stage in fields(CleanOptions)
    for option in list_options(type(cast(StageOptions, stage.default)))
)
"""all options, in the order of the work"""
OPTION_BY_NAME = {option.name: option for option in OPTIONS}
PURPOSE_DEFAULTS = {option.name: option.default for option in OPTIONS if option.lab_default is not None}
"""the usual default of each option whose default depends on the purpose, by the option's name"""
PURPOSE_OPTIONS = ("purpose", *PURPOSE_DEFAULTS)
"""the options of which it matters whether they were given"""


def build_clean_options(**values: object) -> CleanOptions:
    """Return the default options with other values, as `CleanOptions.change`."""
    return CleanOptions().change(**values)


def check_take_options(take: "Take", options: CleanOptions, noun: str = "marker") -> None:
    """Raise TakeError if `keep`, `frames` or `trim` name what the take does not have; of an animation the noun is "joint"."""
    known = set(take.labels) | set(take.bare_labels)
    if unknown := [label for label in options.fill.keep if label not in known]:
        known_labels = format_name_list(take.labels)
        raise TakeError(f"{take.name}: has no {noun} {format_name_list(unknown)} to keep; its {noun}s are {known_labels}.")
    first, last = take.first_frame, take.get_frame_number(take.frame_count - 1)
    for option in (OPTION_BY_NAME["frames"], OPTION_BY_NAME["trim"]):
        if (frames := option.get_value(options)) and (frames[1] < first or frames[0] > last):
            given = f"{option.flag} {format_frames(*frames)}"
            raise TakeError(f"{take.name}: {given} is not in the take, which has frames {first} to {last}.")


def format_arguments(options: CleanOptions) -> list[str]:
    """Return the arguments of `mocapfix clean` that are read as these options; changes files are left out."""
    arguments: list[str] = []
    for option in OPTIONS:
        value = option.get_value(options)
        if option.name != "review_files" and value != options.get_default(option.name):
            arguments += option.format(value)
    return arguments


def parse_arguments(arguments: Sequence[str]) -> tuple[CleanOptions, list[str]]:
    """Return the options in the arguments of `mocapfix clean`, and the other arguments. Raises OptionError."""
    by_flag, texts = {flag: option for option in OPTIONS for flag in (option.flag, *option.aliases)}, dict[str, list[str]]()
    rest, others = list(arguments), list[str]()
    while rest:
        argument = rest.pop(0)
        flag, equals, text = argument.partition("=")
        option, has_next = by_flag.get(flag), bool(rest) and not rest[0].startswith("-")
        if option is not None and isinstance(option.default, bool) and not equals:
            texts[option.name] = []
        elif option is not None and not isinstance(option.default, bool) and (equals or has_next):
            texts.setdefault(option.name, []).append(text if equals else rest.pop(0))
        else:
            others.append(argument)
    values = {name: OPTION_BY_NAME[name].parse(each) if each else True for name, each in texts.items()}
    return build_clean_options(**values), others
