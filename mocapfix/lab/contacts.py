"""Benchmark of contacts: their detection, what holding the feet does to the motion, and gait events beside force plates.

Takes with known truth are cleaned whole, and with the markers of the feet lost while these stand, once for each way to hold feet.
Recorded motion of people on whom nothing was trained is cleaned whole, with gaps, and with feet lost at any time.
The plates and the events of captures are hidden from the cleaning. Only loads by one foot that stands on its plate with heel and
toes count.
"""

import csv
import re
import shutil
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy.signal
from jaxtyping import Bool, Float

from mocapfix import pipeline
from mocapfix.contacts.contacts import CONTACT_JOINTS, FOOT_JOINTS, BodyContacts
from mocapfix.contacts.find_contacts import compute_speed, find_foot_contacts, remove_short_runs
from mocapfix.contacts.foot_displacements import HORIZONTAL_AXES
from mocapfix.contacts.gait_events import FootPoints, build_foot_points
from mocapfix.contacts.plate_contacts import PlateContact, find_plate_contacts
from mocapfix.errors import MocapfixError, ReadError, TakeError
from mocapfix.io.c3d_events import HEADER_EVENT_COUNT
from mocapfix.io.capture import read_capture
from mocapfix.io.force_plates import read_force_plates
from mocapfix.lab import sound_takes
from mocapfix.lab.common_task import clean_composed_take
from mocapfix.model.animation import Animation
from mocapfix.model.stage_timer import ProgressCallback
from mocapfix.model.take import C3dLayout
from mocapfix.options import FEET_LOCK, FEET_OFF, FEET_SOFT, CleanOptions
from mocapfix.solve import kinematics
from mocapfix.stats.sequences import find_runs
from mocapfix.synthetic import SyntheticTake, draw_gaps

if TYPE_CHECKING:
    from mocapfix.result import CleaningResult


TRUE_STANDING_SPEED_M_S = 0.1  # speed of a true joint below which it stands
MAX_TRUE_HEIGHT_M = 0.06  # height above its lowest standing places up to which it stands on the floor
LOWEST_SHARE_PERCENT = 10.0
LOSS_DURATION_S = (0.5, 2.0)  # shortest and longest time for which the markers of a foot are lost
LOSSES_PER_FOOT = 3
MIN_SEEN_S = 0.1  # time before and after a loss in which the foot stands and its markers are visible
MAX_FOOT_MARKER_DISTANCE_M = 0.13
"""Mean distance of a marker from ankle or toes up to which it is lost with the foot; the ankle's marker is on the shin."""


class FootLoss(NamedTuple):
    """The frames `first` to `last` in which all markers of a foot are lost."""

    side: str
    first: int
    last: int


def find_true_contacts(joint_position: Float[np.ndarray, "T 3"], rate: float) -> Bool[np.ndarray, " T"]:
    """Return when a joint of a foot truly stands: slow, for a while, and about as low as it ever is while slow."""
    is_slow = compute_speed(joint_position, rate) < TRUE_STANDING_SPEED_M_S
    if not is_slow.any():
        return is_slow
    base = np.percentile(joint_position[is_slow, 1], LOWEST_SHARE_PERCENT)
    return remove_short_runs(is_slow & (joint_position[:, 1] < base + MAX_TRUE_HEIGHT_M), rate)


def find_all_true_contacts(truth: SyntheticTake) -> Bool[np.ndarray, "T C"]:
    """Return when each of CONTACT_JOINTS truly stands."""
    joints = [truth.subject.skeleton.find_joint(name) for name in CONTACT_JOINTS]
    return np.stack([find_true_contacts(truth.joint_positions[:, joint], truth.rate) for joint in joints], axis=1)


def draw_foot_losses(truth: SyntheticTake, rng: np.random.Generator, *, at_any_time: bool = False) -> list[FootLoss]:
    """Return times in which a foot stands with heel and toes, or any times; never both feet at once."""
    is_contact, losses = find_all_true_contacts(truth), list[FootLoss]()
    is_free = np.ones(len(is_contact), bool)
    margin, shortest = round(MIN_SEEN_S * truth.rate), round(LOSS_DURATION_S[0] * truth.rate)
    for _ in range(LOSSES_PER_FOOT):
        for side, joints in FOOT_JOINTS.items():
            is_flat = is_contact[:, [CONTACT_JOINTS.index(joint) for joint in joints]].all(axis=1) | at_any_time
            runs = [run for run in find_runs(is_flat & is_free) if run[1] + 1 - run[0] >= shortest + 2 * margin]
            if not runs:
                continue
            first, last = runs[int(rng.integers(len(runs)))]
            longest = min(last + 1 - first - 2 * margin, round(LOSS_DURATION_S[1] * truth.rate))
            length = int(rng.integers(shortest, longest + 1))
            start = int(rng.integers(first + margin, last + 2 - margin - length))
            losses.append(FootLoss(side, start, start + length - 1))
            is_free[max(0, start - margin) : start + length + margin] = False
    return losses


def find_foot_markers(truth: SyntheticTake, side: str) -> Bool[np.ndarray, " M"]:
    """Return the markers on and about a foot."""
    joints = [truth.subject.skeleton.find_joint(name) for name in FOOT_JOINTS[side]]
    offsets = truth.marker_positions[:, :, None] - truth.joint_positions[:, None, joints]
    return np.linalg.norm(offsets, axis=-1).mean(0).min(1) <= MAX_FOOT_MARKER_DISTANCE_M


def lose_feet(truth: SyntheticTake, losses: Sequence[FootLoss]) -> SyntheticTake:
    """Return the take without the markers of feet in some frames."""
    missing = truth.missing_mask.copy()
    for side, first, last in losses:
        missing[first : last + 1, find_foot_markers(truth, side)] = True
    damaged = np.where(missing[..., None], np.nan, truth.damaged_positions)
    return replace(truth, missing_mask=missing, damaged_positions=damaged)


def lose_markers(truth: SyntheticTake, rng: np.random.Generator) -> SyntheticTake:
    """Return the take with gaps in all markers, and once in all markers of a leg together."""
    side = str(rng.choice(("Left", "Right")))
    leg = [truth.subject.skeleton.find_joint(side + joint) for joint in ("UpLeg", "Leg", "Foot", "ToeBase")]
    missing = draw_gaps(rng, len(truth.marker_positions), truth.rate, np.isin(truth.subject.joints, leg))
    missing = np.roll(missing, int(rng.integers(len(missing))), axis=0)
    return replace(truth, missing_mask=missing, damaged_positions=np.where(missing[..., None], np.nan, truth.damaged_positions))


MOTION_KINDS = {
    "uneven": r"climb|slope|uneven|stairs|step ?stool",
    "floor": r"roll|\bdog\b|snake|floor|\bfall|whale|fish|\bcrawl|lie",
    "acrobatics": r"acrobat|cartwheel|flip|leap|hang|handspring",
    "backwards": r"backward|back\b|retreat",
    "sideways": r"sideways|sidestep|side[ _]step|\bside\b|cross walk m?(90|45)",
    "hop": r"\bhop|jump|tongtong",
    "duck": r"duck|squat|pick|bend|crouch|scoop|lift",
    "sit": r"\bsit|stool|chair",
    "martial arts": r"martial|kick|boxing|fighter|karate|punch|sword|box\b",
    "dance": r"dance|salsa|sync",
    "turn": r"turn|spiral|245d|135d|180d|veer",
    "run": r"\brun|jog",
    "walk": r"walk|march|stride",
    "play": r"basketball|tennis|\btt\b|serve|game",
}
"""What the description of a recording of each kind of motion contains; the first kind counts."""
OTHER_KIND, COMPOSED_KIND = "stand", "composed"
MIN_KIND_S = 1.5  # shortest recording by kind: runs are short


def iterate_takes_by_kind(motion_folders: Sequence[Path], takes_of_kind: int) -> Iterator[tuple[str, str, SyntheticTake]]:
    """Yield the kind and the name of takes, and the takes, of people with their own bones: the longest of each subject first.

    Args:
        motion_folders: Each holds test.npz, and manifest.csv with the columns trial and description.
    """
    by_kind: dict[str, list[sound_takes.PerformedMotion]] = defaultdict(list)
    for folder in motion_folders:
        kinds = read_motion_kinds(folder / "manifest.csv")
        for performance in sound_takes.read_performed_motions(folder / "test.npz"):
            by_kind[kinds.get(performance.name, OTHER_KIND)].append(performance)
    for kind in sorted(by_kind):
        for number, chosen in enumerate(sound_takes.choose_performances(by_kind[kind], takes_of_kind, MIN_KIND_S)):
            yield kind, chosen.name, sound_takes.perform_take(chosen, np.random.default_rng(number), has_own_bones=True)


def read_motion_kinds(path: Path) -> dict[str, str]:
    """Return the kind of each trial of a table of trials. Raises ReadError if it cannot be read."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            descriptions = {row["trial"]: row["description"] for row in csv.DictReader(file)}
    except (OSError, ValueError, KeyError) as error:
        raise ReadError(f"{path}: is not a table of trials with the columns trial and description ({error}).") from error
    return {
        trial: next((kind for kind, pattern in MOTION_KINDS.items() if re.search(pattern, text, re.IGNORECASE)), OTHER_KIND)
        for trial, text in descriptions.items()
    }


CONTACT_TAKES = 6
WHOLE, GAPS, LOST_FEET = "whole", "gaps", "feet lost"
HELD_MODES = (FEET_OFF, FEET_SOFT, FEET_LOCK)
KNEES = ("LeftLeg", "RightLeg")
WORST_QUANTITIES = ("acceleration_ratio", "knee_ratio", "sink_mm")  # quantities of which the largest value of all takes counts
MM = 1e3


@dataclass(frozen=True)
class HeldFeetErrors:
    """What one way to hold feet did to one take."""

    take: str
    damage: str
    mode: str
    slide_mm_s: float  # mean horizontal speed of heels and balls of the feet while these truly stand
    true_slide_mm_s: float  # the same of the truth
    drift_mm: float  # the largest horizontal distance in a true contact from its mean place, mean over contacts
    feet_mm: float  # mean error of heels and balls of the feet
    other_joints_mm: float  # mean error of all other joints
    acceleration_ratio: float  # the largest acceleration of any joint, over that with the feet as they were solved
    knee_ratio: float  # the same of the knees
    sink_mm: float  # how much lower the lowest place of a heel or ball of a foot is than with the feet as they were solved
    lost_fill_mm: float  # mean error of the filled markers of lost feet; NaN without a loss


@dataclass(frozen=True)
class ContactAgreement:
    """How many frames of the four joints of the feet are contacts in the truth, in the result, and in both."""

    take: str
    damage: str
    true_frames: int
    found_frames: int
    common_frames: int
    kind: str = COMPOSED_KIND  # of the motion

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        return 2 * self.common_frames / max(self.true_frames + self.found_frames, 1)


def measure_contacts(
    motion_folders: Sequence[Path] = (), take_count: int = CONTACT_TAKES, report_progress: ProgressCallback = lambda _: None
) -> tuple[list[HeldFeetErrors], list[ContactAgreement]]:
    """Return the errors of each take, damage and way to hold feet, and the agreement of contacts with the truth.

    Args:
        motion_folders: Hold test.npz with recorded motion, of which `take_count` takes of each kind are used, with feet that are
            as they were solved or locked; without folders motion is composed.

    Raises:
        ReadError: If there is no such motion.
    """
    errors, agreements = list[HeldFeetErrors](), list[ContactAgreement]()
    composed = ((COMPOSED_KIND, *each) for each in sound_takes.iterate_sound_takes(None, take_count))
    takes = iterate_takes_by_kind(motion_folders, take_count) if motion_folders else composed
    for number, (kind, name, sound) in enumerate(takes):
        report_progress(f"{kind}, {name}")
        losses = draw_foot_losses(sound, np.random.default_rng(number), at_any_time=bool(motion_folders))
        damaged = {WHOLE: sound} | ({LOST_FEET: lose_feet(sound, losses)} if losses else {})
        if motion_folders:
            damaged[GAPS] = lose_markers(sound, np.random.default_rng(number))
        of_take = measure_take(name, damaged, (FEET_OFF, FEET_LOCK) if motion_folders else HELD_MODES)
        errors += of_take[0]
        mats = [] if motion_folders else measure_soft_mats(name, sound)
        agreements += [replace(each, kind=kind) for each in (*of_take[1], *mats)]
    return errors, agreements


def measure_take(
    name: str, damaged: Mapping[str, SyntheticTake], modes: Sequence[str] = HELD_MODES
) -> tuple[list[HeldFeetErrors], list[ContactAgreement]]:
    """Return the errors and agreements of one take, by damage, with the feet held in each way."""
    errors, agreements = list[HeldFeetErrors](), list[ContactAgreement]()
    for damage, truth in damaged.items():
        results = {mode: clean_composed_take(truth, CleanOptions().change(feet=mode)) for mode in modes}
        agreements.append(compare_contacts(name, damage, truth, results[FEET_OFF]))
        errors += [compute_held_errors(name, damage, truth, results, mode) for mode in modes]
    return errors, agreements


MAT_DEPTHS_M, MAT_DELAY_S = (0.01, 0.03, 0.05), 0.1  # by which a soft mat yields to the whole weight, and how late


def measure_soft_mats(name: str, truth: SyntheticTake) -> list[ContactAgreement]:
    """Return the agreement of the contacts that are found in the true paths of feet, on mats that yield to their load."""
    is_true = find_all_true_contacts(truth)
    path = truth.joint_positions[:, [truth.subject.skeleton.find_joint(joint) for joint in CONTACT_JOINTS]]
    is_loaded, share = is_true.reshape(len(path), len(FOOT_JOINTS), -1).any(2), 1 / (MAT_DELAY_S * truth.rate)
    load = is_loaded / np.maximum(is_loaded.sum(1, keepdims=True), 1)
    sunk = np.repeat(scipy.signal.lfilter([share], [1, share - 1], load, axis=0), 2, axis=1)[..., None] * [0, 1, 0]
    rows: list[ContactAgreement] = []
    for depth_m in MAT_DEPTHS_M:
        is_found = find_foot_contacts(path - depth_m * sunk, np.zeros(is_true.shape), truth.rate).is_contact
        counts = int(is_true.sum()), int(is_found.sum()), int((is_true & is_found).sum())
        rows.append(ContactAgreement(name, f"mat that yields by {MM * depth_m:.0f} mm", *counts))
    return rows


def compare_contacts(name: str, damage: str, truth: SyntheticTake, result: "CleaningResult") -> ContactAgreement:
    """Return how the contacts of a result agree with the truth."""
    assert result.contacts is not None
    is_true = find_all_true_contacts(truth)
    is_found = result.contacts.is_contact[:, : len(CONTACT_JOINTS)]
    return ContactAgreement(name, damage, int(is_true.sum()), int(is_found.sum()), int((is_true & is_found).sum()))


def compute_held_errors(
    name: str, damage: str, truth: SyntheticTake, results: "dict[str, CleaningResult]", mode: str
) -> HeldFeetErrors:
    """Return what one way to hold feet did to a take, beside the result in which they are as they were solved."""
    position, unheld = get_joint_positions(results[mode]), get_joint_positions(results[FEET_OFF])
    names = list(truth.subject.skeleton.names)
    feet = [names.index(joint) for joint in CONTACT_JOINTS]
    knees = [names.index(joint) for joint in KNEES]
    others = [j for j in range(len(names)) if j not in feet]
    is_contact = find_all_true_contacts(truth)
    error = MM * np.linalg.norm(position - truth.joint_positions, axis=-1)
    acceleration, before = compute_largest_accelerations(position), compute_largest_accelerations(unheld)
    return HeldFeetErrors(
        name,
        damage,
        mode,
        compute_slide(position[:, feet], is_contact, truth.rate),
        compute_slide(truth.joint_positions[:, feet], is_contact, truth.rate),
        compute_drift(position[:, feet], is_contact),
        float(error[:, feet].mean()),
        float(error[:, others].mean()),
        float(acceleration.max() / before.max()),
        float(acceleration[knees].max() / before[knees].max()),
        float(MM * (unheld[:, feet, 1].min(0) - position[:, feet, 1].min(0)).max()),
        compute_fill_error(truth, results[mode]),
    )


def get_joint_positions(result: "CleaningResult") -> Float[np.ndarray, "T J 3"]:
    """Return the joints' positions in metres. Raises TakeError where the take was cleaned without a body."""
    if result.joint_position_world is None:
        raise TakeError("The take was cleaned without a body; there are no feet to hold.")
    return result.joint_position_world


def compute_slide(position: Float[np.ndarray, "T C 3"], is_contact: Bool[np.ndarray, "T C"], rate: float) -> float:
    """Return the mean horizontal speed in mm/s of joints in contact."""
    flat = position * [1.0, 0.0, 1.0]
    speeds = np.stack([compute_speed(flat[:, c], rate) for c in range(flat.shape[1])], axis=1)
    return float(MM * speeds[is_contact].mean()) if is_contact.any() else np.nan


def compute_drift(position: Float[np.ndarray, "T C 3"], is_contact: Bool[np.ndarray, "T C"]) -> float:
    """Return the largest horizontal distance in mm from the mean place of a contact, mean over contacts."""
    drifts: list[float] = []
    for c in range(position.shape[1]):
        for first, last in find_runs(is_contact[:, c]):
            flat = position[first : last + 1, c][:, HORIZONTAL_AXES]
            drifts.append(float(np.linalg.norm(flat - flat.mean(0), axis=1).max()))
    return MM * float(np.mean(drifts)) if drifts else np.nan


def compute_largest_accelerations(position: Float[np.ndarray, "T J 3"]) -> Float[np.ndarray, " J"]:
    """Return the largest second difference of each joint's path, in metres per squared frame."""
    return np.linalg.norm(np.diff(position, 2, axis=0), axis=-1).max(0)


def compute_fill_error(truth: SyntheticTake, result: "CleaningResult") -> float:
    """Return the mean error in mm of the filled samples of lost markers; NaN without any."""
    columns = [result.take.bare_labels.index(label) for label in truth.labels]
    error = np.linalg.norm(result.take.markers[:, columns] - truth.marker_positions, axis=-1)[truth.missing_mask]
    return float(MM * np.nanmean(error)) if len(error) and np.isfinite(error).any() else np.nan


HELD_QUANTITIES = (
    "slide_mm_s", "true_slide_mm_s", "drift_mm", "feet_mm", "other_joints_mm", "acceleration_ratio", "knee_ratio", "sink_mm",
    "lost_fill_mm",
)  # fmt: skip


def average_errors(errors: Sequence[HeldFeetErrors]) -> dict[str, float]:
    """Return the mean of each quantity over takes, of the largest ratios and of sinking the largest; NaN without any value."""
    means: dict[str, float] = {}
    for name in HELD_QUANTITIES:
        values = np.array([getattr(each, name) for each in errors], float)
        values = values[np.isfinite(values)]
        average = np.max if name in WORST_QUANTITIES else np.mean
        means[name] = float(average(values)) if len(values) else np.nan
    return means


HIDDEN_GROUPS = {b"FORCE_PLATFORM": b"HIDDEN_PLATFOR", b"EVENT": b"HIDEV"}
"""names of the groups of the plates and of events, and others of the same length"""
MAX_EVENT_ERROR_S = 0.15  # time from an event of a plate up to which an event of markers is the same
JUDGED_MARGIN_S = 0.3  # time before and after a load in which frames are compared
RULE_HEIGHT_M, RULE_SPEED_M_S = 0.114, 0.93
"""The height-and-speed rule: below both an ankle or a toe base is in contact (UnderPressure, 2022, baseline)."""


@dataclass(frozen=True)
class PlateEventError:
    """An event of a plate, and how much later that of the markers is; NaN where the markers have none."""

    capture: str
    side: str
    kind: str
    error_ms: float


@dataclass(frozen=True)
class PlateAgreement:
    """Frames about loads in which a foot is in contact: by the plate, by a method, and by both."""

    capture: str
    method: str
    true_frames: int
    found_frames: int
    common_frames: int


def measure_plate_events(
    captures: Path, report_progress: ProgressCallback = lambda _: None
) -> tuple[list[PlateEventError], list[PlateAgreement]]:
    """Return the errors of events and the agreement of frames, for every C3D file in a folder that has usable loads.

    Args:
        captures: A folder, or a file; files that cannot be cleaned with a body are left out.
    """
    errors, agreements = list[PlateEventError](), list[PlateAgreement]()
    for path in sorted(captures.glob("*.c3d")) if captures.is_dir() else [captures]:
        report_progress(path.name)
        try:
            result = clean_without_plates(path)
        except MocapfixError:
            continue
        if result is None or result.contacts is None or result.subject is None or not result.contacts.has_feet:
            continue
        loads = find_loads(path, result)
        errors += [each for load in loads for each in compare_events(path.stem, load, result.contacts)]
        agreements += [each for load in loads for each in compare_frames(path.stem, load, result)]
    return errors, agreements


def clean_without_plates(path: Path) -> "CleaningResult | None":
    """Return the result for a copy of a C3D file that hides its plates and events; None for a file without plates."""
    data = path.read_bytes()
    capture = read_capture(path)
    layout = None if isinstance(capture, Animation) else capture.layout
    if not isinstance(layout, C3dLayout) or not read_force_plates(data, layout, capture.rate):
        return None
    with TemporaryDirectory() as folder:
        hidden = Path(folder) / path.name
        shutil.copyfile(path, hidden)
        head = data[:HEADER_EVENT_COUNT] + bytes(2) + data[HEADER_EVENT_COUNT + 2 : layout.data_start_byte]
        for name, other in HIDDEN_GROUPS.items():
            head = head.replace(name, other)
        hidden.write_bytes(head + data[layout.data_start_byte :])
        return pipeline.clean(hidden, CleanOptions().change(feet=FEET_OFF))


def find_loads(path: Path, result: "CleaningResult") -> list[PlateContact]:
    """Return the loads of the plates of a capture by single feet that stand on them."""
    assert result.contacts is not None
    layout = result.input_take.layout
    assert isinstance(layout, C3dLayout)
    plates = read_force_plates(path.read_bytes(), layout, result.input_take.rate)
    return find_plate_contacts(plates, get_foot_points(result), result.contacts.floor, result.contacts.rate)


def get_foot_points(result: "CleaningResult") -> dict[str, FootPoints]:
    """Return the heel and the toes of each foot of a result."""
    subject, motion, take = result.subject, result.motion, result.relabelled_take
    assert subject is not None
    assert motion is not None
    assert result.contacts is not None
    _, body_markers = kinematics.compute_joint_and_marker_positions(subject, motion)
    markers = np.full(body_markers.shape, np.nan)
    for k, label in enumerate(subject.labels):
        if label in take.bare_labels:
            markers[:, k] = take.markers[:, take.bare_labels.index(label)]
    return dict(build_foot_points(subject, motion, markers, body_markers, result.contacts.is_known))


def compare_events(capture: str, load: PlateContact, contacts: BodyContacts) -> list[PlateEventError]:
    """Return how far the events from markers are from those of a load."""
    errors: list[PlateEventError] = []
    for kind, time_s in (("foot strike", load.strike_s), ("foot off", load.off_s)):
        if np.isnan(time_s):
            continue
        late_s = [each.time_s - time_s for each in contacts.events if (each.side, each.kind) == (load.side, kind)]
        nearest_s = min((each for each in late_s if abs(each) <= MAX_EVENT_ERROR_S), key=abs, default=np.nan)
        errors.append(PlateEventError(capture, load.side, kind, 1e3 * nearest_s))
    return errors


def compare_frames(capture: str, load: PlateContact, result: "CleaningResult") -> list[PlateAgreement]:
    """Return in how many frames about a load the foot is in contact by the plate, by the events, and by a simple rule."""
    contacts = result.contacts
    assert contacts is not None
    frame_s = np.arange(len(contacts.is_contact)) / contacts.rate
    strike_s, off_s = np.nan_to_num(load.strike_s, nan=-np.inf), np.nan_to_num(load.off_s, nan=np.inf)
    is_judged = (frame_s >= strike_s - JUDGED_MARGIN_S) & (frame_s <= off_s + JUDGED_MARGIN_S)
    is_loaded = (frame_s >= strike_s) & (frame_s <= off_s)
    found = {"events": find_contact_between_events(contacts, load.side), "height and speed": apply_simple_rule(result, load.side)}
    counts = {
        method: [int(each[is_judged].sum()) for each in (is_loaded, is_found, is_loaded & is_found)]
        for method, is_found in found.items()
    }
    return [PlateAgreement(capture, method, *each) for method, each in counts.items()]


def find_contact_between_events(contacts: BodyContacts, side: str) -> Bool[np.ndarray, " T"]:
    """Return the frames from each strike of a foot to its next off; the take may begin and end in contact."""
    frame_s = np.arange(len(contacts.is_contact)) / contacts.rate
    own = [event for event in contacts.events if event.side == side]
    if not own:
        return contacts.find_foot_contact(side)
    is_contact = np.zeros(len(frame_s), bool)
    start_s = -np.inf if own[0].kind == "foot off" else np.nan
    for event in own:
        if event.kind == "foot strike":
            start_s = event.time_s
        else:
            is_contact |= (frame_s >= start_s) & (frame_s <= event.time_s)
            start_s = np.nan
    return is_contact | (frame_s >= start_s)


def apply_simple_rule(result: "CleaningResult", side: str) -> Bool[np.ndarray, " T"]:
    """Return the frames in which the height-and-speed rule finds the ankle or the toe base of a foot in contact."""
    position, contacts, subject = result.joint_position_world, result.contacts, result.subject
    assert position is not None
    assert contacts is not None
    assert subject is not None
    is_contact = np.zeros(len(position), bool)
    for joint in FOOT_JOINTS[side]:
        path: Float[np.ndarray, "T 3"] = position[:, subject.skeleton.find_joint(joint)]
        is_low = contacts.floor.compute_height_above(path) < RULE_HEIGHT_M
        is_contact |= is_low & (compute_speed(path, contacts.rate) < RULE_SPEED_M_S)
    return is_contact


def summarise_contacts(
    errors: Sequence[HeldFeetErrors],
    agreements: Sequence[ContactAgreement],
    events: Sequence[PlateEventError],
    frames: Sequence[PlateAgreement],
) -> dict[str, Any]:
    """Return the tables of the benchmark: means over takes by damage and way to hold feet, and the agreement of contacts.

    Of plate events: how many were found, and the medians of their errors in ms; and the F1 by frame of each method.
    """
    held: dict[str, list[HeldFeetErrors]] = defaultdict(list)
    for each in errors:
        held[f"{each.damage}, {each.mode}"].append(each)
    tables: dict[str, Any] = {"held feet": {name: average_errors(rows) for name, rows in held.items()}}
    by_damage: dict[str, list[ContactAgreement]] = defaultdict(list)
    for each in agreements:
        by_damage[each.damage].append(each)
    tables["contacts"] = {
        damage: compute_agreement(rows) | {"mean f1 of takes": float(np.mean([row.f1 for row in rows]))}
        for damage, rows in by_damage.items()
    }
    kinds = sorted({each.kind for each in agreements} - {COMPOSED_KIND})
    for damage, rows in by_damage.items() if kinds else ():
        by_kind = {kind: summarise_kind([each for each in rows if each.kind == kind], errors) for kind in kinds}
        tables[f"{damage}, feet locked"] = by_kind
    tables["plate events"] = {}
    for kind in dict.fromkeys(each.kind for each in events):
        late_ms = np.array([each.error_ms for each in events if each.kind == kind])
        found = late_ms[np.isfinite(late_ms)]
        tables["plate events"][kind] = {"events": len(late_ms), "found": len(found)} | (
            {"median_error_ms": float(np.median(np.abs(found))), "median_delay_ms": float(np.median(found))} if len(found) else {}
        )
    methods = dict.fromkeys(each.method for each in frames)
    tables["plate frames"] = {name: compute_agreement([each for each in frames if each.method == name]) for name in methods}
    return {name: table for name, table in tables.items() if table}


def summarise_kind(rows: Sequence[ContactAgreement], errors: Sequence[HeldFeetErrors]) -> dict[str, Any]:
    """Return how the contacts of takes of one kind and damage agree with the truth, and how feet slide that are locked."""
    takes = {(each.take, each.damage) for each in rows}
    locked = average_errors([each for each in errors if (each.take, each.damage) in takes and each.mode == FEET_LOCK])
    worst = min((each for each in rows if each.true_frames), key=lambda each: each.f1, default=rows[0])
    slides = {name: locked[name] for name in ("slide_mm_s", "true_slide_mm_s", "drift_mm")}
    return {"takes": len(rows), "f1": compute_agreement(rows)["f1"], "worst_f1": worst.f1, "worst_take": worst.take} | slides


def compute_agreement(rows: Sequence[ContactAgreement | PlateAgreement]) -> dict[str, float]:
    """Return precision, recall and F1 by frame."""
    common, found, true = (sum(getattr(each, f"{name}_frames") for each in rows) for name in ("common", "found", "true"))
    return {"precision": common / max(found, 1), "recall": common / max(true, 1), "f1": 2 * common / max(found + true, 1)}
