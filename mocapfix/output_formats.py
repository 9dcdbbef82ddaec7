"""The formats of output files, one entry each, and which of them the options select.

`DEFAULT_FORMATS` are always written, `OPTIONAL_FORMATS` on request; `list_output_formats` selects.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from mocapfix.contacts.contacts import BodyContacts
from mocapfix.errors import OptionError, WriteError
from mocapfix.hands.finger_markers import SIDES
from mocapfix.hands.solve_hands import BodyWithHands, HandMotion, attach_hands
from mocapfix.io.asf_amc import write_asf_amc
from mocapfix.io.bvh import write_bvh, write_bvh_tree
from mocapfix.io.c3d import write_c3d
from mocapfix.io.changes_file import CHANGES_SUFFIX, Review, write_changes_file
from mocapfix.io.contact_files import write_contacts, write_gait_events
from mocapfix.io.files import get_source_suffixes
from mocapfix.io.gltf import write_gltf
from mocapfix.io.npz import write_npz
from mocapfix.io.patches import patch_c3d, patch_table
from mocapfix.io.source_file import append_computed_points
from mocapfix.io.text_tables import write_csv, write_trc
from mocapfix.model.animation import Animation
from mocapfix.model.changes import Change
from mocapfix.model.motion import Motion, resample_motion
from mocapfix.model.skeleton import Skeleton
from mocapfix.model.subject import Subject
from mocapfix.model.take import TableLayout, Take
from mocapfix.options import (
    CHARACTER_OPTIONS,
    OPTION_BY_NAME,
    ROBOT_FORMAT_NAMES,
    ROBOT_SUFFIXES,
    ROOT_IN_PLACE,
    OutputOptions,
)
from mocapfix.report.report import Report
from mocapfix.report.sample_states import CleaningComparison
from mocapfix.solve.parallel import Computation
from mocapfix.subject import library

if TYPE_CHECKING:
    from mocapfix.characters.character_yaml import Rig
    from mocapfix.characters.fingers import HandPoses
    from mocapfix.report.contact_sheet import ContactSheet, Performer, ShownFigure

RECORDING_SUFFIX, HTML_SUFFIX = "rrd", "report.html"
SHEET_SUFFIX = "sheet.png"
RIG_UNIT_NAMES = {1.0: "metres", 0.01: "centimetres"}


@dataclass(frozen=True)
class ExportedMotion:
    """A motion as it is written."""

    subject: Subject  # the subject that moves
    motion: Motion  # the motion at the output rate, with the floor at height 0
    rate: float  # frames per second
    floor_height_m: float = 0.0  # height of the floor in the take

    @property
    def parts(self) -> tuple[Skeleton, Motion, float]:
        """Skeleton, motion and rate."""
        return self.subject.skeleton, self.motion, self.rate


@dataclass(frozen=True)
class OutputContent:
    """What the files of one subject are written from."""

    input_take: Take  # the take as read
    points: Take  # the cleaned markers; of an animation its joints
    exported: ExportedMotion | None  # the motion as it is written; None without a body
    contacts: BodyContacts | None  # when joints of the body are in contact with the floor; None without a body
    changes: tuple[Change, ...]  # the changes that were applied or declined
    review: Review  # what a reviewer decided after an earlier cleaning
    report: Report  # contents of the JSON report
    comparison: CleaningComparison  # the take before and after cleaning
    hands: tuple[HandMotion, ...] = ()  # the hands whose fingers markers show
    animation: Animation | None = None  # the cleaned animation, of an animation
    recorded: Computation[None] | None = None  # the recording, written by the second process; None in a preview
    # those of the characters, for the HTML report; the writer of each character adds its own
    sheets: "list[ContactSheet]" = field(default_factory=list)

    @property
    def motion(self) -> ExportedMotion:
        """The motion. Raises ValueError without a body."""
        if self.exported is None:
            raise ValueError("this format is written only for a take with a body")
        return self.exported

    def build_performer(self, frames: slice = slice(None)) -> "Performer":
        """Return what a contact sheet shows of the body in some frames of the motion."""
        from mocapfix.report.contact_sheet import Performer

        skeleton, motion, rate = self.motion.parts
        selected = np.arange(motion.frame_count)[frames]
        start_s = float(selected[0] / rate)
        return Performer(skeleton, motion.select_frames(selected), rate, start_s, self.motion.floor_height_m, self.points)

    @property
    def exported_hands(self) -> tuple[HandMotion, ...]:
        """The hands with the floor at height 0, at the rate of the take."""
        return tuple(each.lower_floor(self.motion.floor_height_m) for each in self.hands)

    @property
    def body_with_hands(self) -> BodyWithHands:
        """The motion as it is written, with its hands."""
        skeleton, motion, rate = self.motion.parts
        if not self.hands:
            return BodyWithHands(skeleton, {0: motion.root_position}, motion.local_rotations)
        return attach_hands(skeleton, motion, rate, self.exported_hands, self.input_take.rate)

    def measure_hands(self) -> "tuple[dict[str, HandPoses], list[str]]":
        """Return the poses of the hands by side, as the motion is written, and sentences for the report."""
        from mocapfix.characters.character_files import convert_hand_motion, measure_animation_hands

        rates = self.input_take.rate, self.motion.rate
        hands, notes = {each.hand.model.side.lower(): convert_hand_motion(each, *rates) for each in self.hands}, list[str]()
        if self.animation is not None:
            hands, notes = measure_animation_hands(self.animation, self.motion.rate)
        down = np.array([0.0, self.motion.floor_height_m, 0.0])
        return {side: hand._replace(position=hand.position - down) for side, hand in hands.items()}, notes

    @property
    def exported_contacts(self) -> BodyContacts | None:
        """The contacts with the floor at the height that it has in motion files."""
        return self.contacts.lower_floor(self.motion.floor_height_m) if self.contacts else None


@dataclass(frozen=True)
class OutputFormat:
    """A format that is written.

    Attributes:
        write_file: Writes content to a path and returns sentences for the report.
    """

    suffix: str  # suffix of the file, which follows the stem of the input
    write_file: Callable[[Path, OutputContent], Sequence[str] | None]
    companion_suffixes: tuple[str, ...] = ()  # suffixes of files that `write_file` writes beside it
    needs_body: bool = False  # whether the format is written only if the take has a body
    needs_markers: bool = False  # whether the format is written only if the subject has markers
    is_in_preview: bool = True  # whether a preview has the file
    timer_stage: str = "write"  # stage in which its time is counted
    usage_note: str = ""  # what users of the file must know, as a predicate of the file name

    @property
    def all_suffixes(self) -> tuple[str, ...]:
        """Suffixes of all files that are written."""
        return (self.suffix, *self.companion_suffixes)


def write_cleaned_copy(target: Path, before: Take, after: Take) -> list[tuple[int, int]]:
    """Write a copy of the source file in which only the changed samples differ.

    A file without a field for every sample is written as a plain CSV instead.

    Returns:
        Frame and marker index of the samples that could not be stored.
    """
    if isinstance(before.layout, TableLayout) and not before.layout.has_field_per_sample:
        write_csv(target, after)
        return []
    patch = patch_table if isinstance(before.layout, TableLayout) else patch_c3d
    unstorable = patch(target, append_computed_points(before), append_computed_points(after))
    return [(frame, marker) for frame, marker in unstorable if marker < len(before.labels)]


def write_rig_bvh(
    target: Path,
    rig: "Rig",
    skeleton: Skeleton,
    motion: Motion,
    rate: float,
    hands: Sequence[HandMotion] = (),
    hand_rate: float = 1.0,
) -> None:
    """Write a motion on the rig of another program. Raises WriteError as `write_bvh` and `retarget_to_rig` do.

    Args:
        hands: Hands with fingers, at `hand_rate` frames per second; left out if the rig has none.
    """
    from mocapfix.characters.alignment import pose_skeleton, retarget_to_rig  # few cleanings need it

    rig_skeleton, rig_motion = retarget_to_rig(rig, skeleton, motion)
    if not hands or rig.fingers == "none":
        write_bvh(target, rig_skeleton, rig_motion, rate, rig.unit_m, rig.rotations)
        return
    rest = pose_skeleton(skeleton, rig.rest).compute_rest_pose()[1]
    rest_axes = {side: rest[skeleton.find_joint(f"{side}Hand")] for side in SIDES}
    joints = {side: [joint.joint for joint in rig.joints].index(f"{side}Hand") for side in SIDES}
    moving = rig_motion.select_frames(np.arange(rig_motion.frame_count)[-motion.frame_count :])
    is_numbered = rig.fingers == "numbers"
    attached = attach_hands(
        rig_skeleton, moving, rate, hands, hand_rate, joints=joints, rest_axes=rest_axes, is_numbered=is_numbered
    )
    tree, positions, local_rotations = attached
    if taken := [name for name in rig_skeleton.names if tree.names.count(name) > 1]:
        raise WriteError(f"A BVH for {rig.program} cannot be written: {taken[0]} is a finger too; rename this joint of the rig.")
    if rig.first_frame == "t-pose":  # with hands at rest
        pose = np.tile(np.eye(3), (1, len(tree.names), 1, 1))
        pose[0, : len(rig_skeleton.names)] = rig_motion.local_rotations[0]
        local_rotations = np.concatenate([pose, local_rotations])
        first = {joint: tree.offsets[[joint]] for joint in positions} | {0: rig_motion.root_position[:1]}
        positions = {joint: np.concatenate([first[joint], each]) for joint, each in positions.items()}
    write_bvh_tree(target, tree, positions, local_rotations, rate, rig.unit_m, rig.rotations)


def build_rig_format(name_or_path: str | Path) -> OutputFormat:
    """Return the format of a BVH for the rig of a program. Raises SceneError if there is no such rig."""
    from mocapfix.characters.character_yaml import load_rig  # few cleanings need it

    rig = load_rig(name_or_path)
    unit = RIG_UNIT_NAMES.get(rig.unit_m, f"units of {rig.unit_m * 1e3:.3f} mm")

    def write_file(target: Path, content: OutputContent) -> None:
        write_rig_bvh(target, rig, *content.motion.parts, content.exported_hands, content.input_take.rate)

    usage_note = f"is for {rig.program}: {unit}, Y up; {rig.note}."
    return OutputFormat(f"{rig.name}.bvh", write_file, needs_body=True, usage_note=usage_note)


def build_character_format(name_or_path: str | Path, options: OutputOptions) -> OutputFormat:
    """Return the format of a character's or robot's files. Raises ReadError, SceneError or OptionError if it cannot be used."""
    from mocapfix.characters.body_frames import build_body_frame  # few cleanings need it
    from mocapfix.characters.character import build_cmu31_character
    from mocapfix.characters.character_files import CharacterFiles, write_character_glb
    from mocapfix.characters.clips import find_trimmed_frames
    from mocapfix.characters.load_character import load_character

    path, usage_note = Path(name_or_path), ""
    if path.suffix.lower() in ROBOT_SUFFIXES:
        from mocapfix.robots.robot_files import load_robot_files

        for option in (OPTION_BY_NAME[name] for name in ("rest_frame", "root_motion", "loop")):
            if getattr(options, option.name) != option.default:
                raise OptionError(option.name, option.flag, option.job_key, f"is not for robots; {path.name} is one")
        files, usage_note = load_robot_files(path, options), "is the motion of the robot: metres, radians, Z up."
    else:
        files = CharacterFiles(load_character(name_or_path, options.character_map, options.rest_frame), options)

    def write_file(target: Path, content: OutputContent) -> list[str]:
        from mocapfix.report.contact_sheet import ContactSheet, ShownFigure, draw_contact_sheet

        frames = find_trimmed_frames(options.trim, content.input_take, content.motion.rate)
        motion = *content.motion.parts, content.exported_contacts, frames
        if isinstance(files, CharacterFiles):
            hands, notes = content.measure_hands()
            glb, body, notes = target, build_body_frame(files.character), notes + files.write(target, *motion, hands)
        else:
            glb, body = target.with_suffix(".glb"), files.body
            notes, moved = files.write(target, *motion, content.motion.subject.solved_joints)
            write_character_glb(glb, files.character, moved, target.stem)
        performer = content.build_performer(frames)
        sheet = draw_contact_sheet(performer, files.character, glb, turns=options.root_motion != ROOT_IN_PLACE)
        scale = build_body_frame(build_cmu31_character(performer.skeleton)).leg_length_m / body.leg_length_m
        end_s = performer.start_s + (performer.motion.frame_count - 1) / performer.rate
        figure = ShownFigure(files.character, glb, scale, performer.start_s, end_s, performer.floor_height_m)
        content.sheets.append(ContactSheet(target.name, sheet, figure))
        if is_sheet_written:
            target.with_suffix(f".{SHEET_SUFFIX}").write_bytes(sheet)
        return notes

    is_sheet_written = "sheet" in options.extra_formats
    first, *others = *files.suffixes, *([f"{files.character.name}.{SHEET_SUFFIX}"] * is_sheet_written)
    return OutputFormat(first, write_file, tuple(others), needs_body=True, usage_note=usage_note)


def _write_sheet(target: Path, content: OutputContent) -> None:
    from mocapfix.report.contact_sheet import draw_contact_sheet

    target.write_bytes(draw_contact_sheet(content.build_performer()))


def _write_skeleton(target: Path, content: OutputContent) -> list[str]:
    from mocapfix.characters.character_files import write_skeleton

    return write_skeleton(target, content.body_with_hands, content.motion.rate)


def _write_amc(target: Path, content: OutputContent) -> None:
    first_frame = content.input_take.first_frame if content.motion.rate == content.input_take.rate else 1
    write_asf_amc(target.with_suffix(".asf"), target, *content.motion.parts, first_frame)


def _write_npz(target: Path, content: OutputContent) -> None:
    take = content.points
    if content.exported is None:
        write_npz(target, take)
        return
    motion = content.exported
    lowered = take.replace_markers(take.markers - [0.0, motion.floor_height_m, 0.0], take.sample_sd)
    contacts, hands = content.exported_contacts, content.exported_hands
    write_npz(target, lowered, *motion.parts, motion.subject.solved_joints, contacts, hands=hands)


def _write_amass(target: Path, content: OutputContent) -> list[str]:
    from mocapfix.characters.amass import pose_smpl, write_amass  # few cleanings need it

    hands, notes = content.measure_hands()
    write_amass(target, pose_smpl(*content.motion.parts, content.motion.subject.solved_joints, hands), content.motion.rate)
    return notes


def record_cleaning(folder: Path, comparison: CleaningComparison, figures: "Sequence[ShownFigure]") -> None:
    """Write the recording of a cleaning, with the characters that it moves, into a folder."""
    from mocapfix.report.recording import write_recording  # slow to import

    write_recording(folder / f"{comparison.input_take.output_stem}.{RECORDING_SUFFIX}", comparison, figures)


def _write_html_report(target: Path, content: OutputContent) -> None:
    from mocapfix.report.html_report import write_html_report

    write_html_report(target, content.report, content.comparison, [each[:2] for each in content.sheets])


def _write_json_report(target: Path, content: OutputContent) -> None:
    target.write_text(json.dumps(content.report, indent=1) + "\n", encoding="utf-8")


def _write_contacts(target: Path, content: OutputContent) -> None:
    if content.contacts is not None:
        is_source_bvh = BVH_FORMAT.suffix in get_source_suffixes(content.input_take.path)  # it keeps its rate
        write_contacts(target, content.contacts, content.contacts.rate if is_source_bvh else content.motion.rate)


def _write_events(target: Path, content: OutputContent) -> None:
    if content.contacts is not None:
        write_gait_events(target, content.contacts, content.input_take.first_frame)


BVH_FORMAT = OutputFormat(
    "bvh", lambda target, content: write_bvh_tree(target, *content.body_with_hands, content.motion.rate), needs_body=True
)
DEFAULT_FORMATS = (
    OutputFormat(
        "subject.yaml",
        lambda target, content: library.write_subject(target, content.motion.subject),
        needs_body=True,
        needs_markers=True,
    ),
    OutputFormat(
        CHANGES_SUFFIX, lambda target, content: write_changes_file(target, content.input_take, content.changes, content.review)
    ),
    OutputFormat(HTML_SUFFIX, _write_html_report, is_in_preview=False, timer_stage="show"),
    OutputFormat(RECORDING_SUFFIX, lambda _, each: each.recorded and each.recorded.finish(), is_in_preview=False),
    OutputFormat("report.json", _write_json_report),  # the last, so that it has the seconds of all others
)
OPTIONAL_FORMATS = {
    "gltf": OutputFormat(
        "glb",
        lambda target, content: write_gltf(target, *content.body_with_hands, content.motion.rate),
        needs_body=True,
        usage_note="is binary glTF: metres, Y up.",
    ),
    "amc": OutputFormat(
        "amc", _write_amc, ("asf",), needs_body=True, usage_note="goes with the asf: CMU's layout, units of 56.444 mm, Y up."
    ),
    "npz": OutputFormat("npz", _write_npz),
    "amass": OutputFormat(
        "amass.npz",
        _write_amass,
        needs_body=True,
        usage_note="is for readers of AMASS: SMPL-X, metres, Z up; the shape is that of the mean body, not this person's.",
    ),
    "c3d": OutputFormat(
        "c3d",
        lambda target, content: write_c3d(target, content.points),
        usage_note="is a new file with positions only and the predicted standard deviation of each filled sample.",
    ),
    "trc": OutputFormat("trc", lambda target, content: write_trc(target, content.points)),
    "csv": OutputFormat("csv", lambda target, content: write_csv(target, content.points)),
    "contacts": OutputFormat("contacts.json", _write_contacts, needs_body=True),
    "events": OutputFormat("events.csv", _write_events, needs_body=True),
    "fbx": OutputFormat("fbx", _write_skeleton, needs_body=True),
    "usd": OutputFormat("usd", _write_skeleton, needs_body=True, usage_note="is UsdSkel: metres, Y up."),
    "sheet": OutputFormat(SHEET_SUFFIX, _write_sheet, needs_body=True, timer_stage="show"),
}


MAX_KEPT_FORMAT_LISTS = 4  # each may hold a character with its mesh
FileVersion: TypeAlias = tuple[int, int]  # time of the last change in nanoseconds, and size in bytes


def list_output_formats(options: OutputOptions) -> tuple[OutputFormat, ...]:
    """Return the formats of all files that are to be written, in this order.

    The files of rigs and characters are read when they are first named, and when they have been changed.

    Raises:
        OptionError: If an option for characters is given without one.
        WriteError: If two formats would write the same file.
    """
    files = (*options.rigs, *options.characters, *([options.character_map] if options.character_map else []))
    return _read_output_formats(options, tuple(get_file_version(Path(each)) for each in files))


def get_file_version(path: Path) -> FileVersion | None:
    try:
        stat = path.stat()
    except OSError:
        return None
    return stat.st_mtime_ns, stat.st_size


@lru_cache(MAX_KEPT_FORMAT_LISTS)
def _read_output_formats(options: OutputOptions, _versions: tuple[FileVersion | None, ...]) -> tuple[OutputFormat, ...]:
    """Return the formats, with the rigs and characters as they are in these versions of their files."""
    unused = [] if options.characters else [OPTION_BY_NAME[name] for name in CHARACTER_OPTIONS]
    for option in unused:
        if getattr(options, option.name) != option.default:
            problem = "is for the motion of a character; name a character too"
            raise OptionError(option.name, option.flag, option.job_key, problem)
    is_robot = [Path(each).suffix.lower() in ROBOT_SUFFIXES for each in options.characters]
    if (named := [name for name in options.extra_formats if name in ROBOT_FORMAT_NAMES]) and not any(is_robot):
        option = OPTION_BY_NAME["extra_formats"]
        raise OptionError(
            option.name, option.flag, option.job_key, f"{named[0]} is the motion of a robot; name it as --character"
        )
    characters = [build_character_format(each, options) for each in dict.fromkeys(options.characters)]
    rigs = [build_rig_format(name) for name in dict.fromkeys(options.rigs)]
    extra = [OPTIONAL_FORMATS[name] for name in dict.fromkeys(options.extra_formats) if name not in ROBOT_FORMAT_NAMES]
    formats = (BVH_FORMAT, *rigs, *extra, *characters, *DEFAULT_FORMATS)
    suffixes = [suffix for each in formats for suffix in each.all_suffixes]
    if repeated := [suffix for suffix in suffixes if suffixes.count(suffix) > 1]:
        raise WriteError(
            f"Two of the requested files would both have the suffix .{repeated[0]}; request one, or rename its source."
        )
    return formats


def build_exported_motion(
    options: OutputOptions, subject: Subject | None, motion: Motion | None, rate: float
) -> ExportedMotion | None:
    """Return the motion at the output rate and with the floor at height 0; None if there is no body.

    Args:
        options: Output rate and floor height.
        rate: Frames per second of the motion.
    """
    if not (subject and motion):
        return None
    output_rate, floor_height_m = options.output_rate_hz or rate, options.floor_height_m
    if floor_height_m:
        motion = replace(motion, root_position=motion.root_position - [0.0, floor_height_m, 0.0])
    resampled = resample_motion(motion, rate, output_rate)
    return ExportedMotion(subject, resampled, output_rate, floor_height_m)
