"""Benchmark of contacts on takes with known truth: their detection, and what holding the feet does to the motion.

Each take is cleaned whole, and with the markers of its feet lost while these stand, once for each way to hold feet.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.bench.composed_cleaning import clean_composed_take
from mocapfix.bench.contacts_damage import FootLoss, draw_foot_losses, find_all_true_contacts, lose_feet
from mocapfix.bench.sound_takes import iterate_sound_takes
from mocapfix.contacts.contacts import CONTACT_JOINTS
from mocapfix.contacts.rigid_feet import HORIZONTAL_AXES
from mocapfix.contacts.standing import compute_speed
from mocapfix.errors import TakeError
from mocapfix.files.option_choices import FEET_LOCK, FEET_OFF, FEET_SOFT
from mocapfix.options import CleanOptions
from mocapfix.stats.sequences import find_runs
from mocapfix.synthetic import SyntheticTake

if TYPE_CHECKING:
    from mocapfix.result import CleaningResult

CONTACT_TAKES = 6
WHOLE, LOST_FEET = "whole", "feet lost"
HELD_MODES = (FEET_OFF, FEET_SOFT, FEET_LOCK)
KNEES = ("LeftLeg", "RightLeg")
WORST_QUANTITIES = ("acceleration_ratio", "knee_ratio", "sink_mm")
"""quantities of which the largest value of all takes counts"""
MM = 1e3


@dataclass(frozen=True)
class HeldFeetErrors:
    """What one way to hold feet did to one take.

    take, damage, mode
    slide_mm_s           mean horizontal speed of heels and balls of the feet while these truly stand
    true_slide_mm_s      the same of the truth
    drift_mm             the largest horizontal distance in a true contact from its mean place, mean over contacts
    feet_mm              mean error of heels and balls of the feet
    other_joints_mm      mean error of all other joints
    acceleration_ratio   the largest acceleration of any joint, over that with the feet as they were solved
    knee_ratio           the same of the knees
    sink_mm              how much lower the lowest place of a heel or ball of a foot is than with the feet as they were solved
    lost_fill_mm         mean error of the filled markers of lost feet; NaN without a loss
    """

    take: str
    damage: str
    mode: str
    slide_mm_s: float
    true_slide_mm_s: float
    drift_mm: float
    feet_mm: float
    other_joints_mm: float
    acceleration_ratio: float
    knee_ratio: float
    sink_mm: float
    lost_fill_mm: float


@dataclass(frozen=True)
class ContactAgreement:
    """How many frames of the four joints of the feet are contacts in the truth, in the result, and in both."""

    take: str
    damage: str
    true_frames: int
    found_frames: int
    common_frames: int

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        return 2 * self.common_frames / max(self.true_frames + self.found_frames, 1)


def measure_contacts(
    motion_folder: Path | None = None, take_count: int = CONTACT_TAKES, report_progress: Callable[[str], None] = lambda _: None
) -> tuple[list[HeldFeetErrors], list[ContactAgreement]]:
    """Return the errors of each take, damage and way to hold feet, and the agreement of contacts with the truth.

    motion_folder  holds test.npz with recorded motion; None for composed motion

    Raises ReadError if there is no such motion.
    """
    errors, agreements = list[HeldFeetErrors](), list[ContactAgreement]()
    for number, (name, sound) in enumerate(iterate_sound_takes(motion_folder, take_count)):
        report_progress(name)
        of_take = measure_take(name, sound, draw_foot_losses(sound, np.random.default_rng(number)))
        errors += of_take[0]
        agreements += of_take[1]
    return errors, agreements


def measure_take(
    name: str, sound: SyntheticTake, losses: Sequence[FootLoss]
) -> tuple[list[HeldFeetErrors], list[ContactAgreement]]:
    """Return the errors and agreements of one take without faults, whole and with these losses."""
    errors, agreements = list[HeldFeetErrors](), list[ContactAgreement]()
    for damage, truth in ((WHOLE, sound), (LOST_FEET, lose_feet(sound, losses))):
        if damage == LOST_FEET and not losses:
            continue
        results = {mode: clean_composed_take(truth, CleanOptions().change(feet=mode)) for mode in HELD_MODES}
        agreements.append(compare_contacts(name, damage, truth, results[FEET_OFF]))
        errors += [compute_held_errors(name, damage, truth, results, mode) for mode in HELD_MODES]
    return errors, agreements


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


def average_errors(errors: Sequence[HeldFeetErrors], quantity: str) -> float:
    """Return the mean of a quantity over takes, of the largest ratios and of sinking the largest; NaN without any value."""
    values = np.array([getattr(each, quantity) for each in errors], float)
    if not np.isfinite(values).any():
        return np.nan
    return float(np.nanmax(values) if quantity in WORST_QUANTITIES else np.nanmean(values))
