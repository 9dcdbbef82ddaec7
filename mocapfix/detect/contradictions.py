"""Takes, and learned marker sets, that contradict their body as a whole.

Single faults are repaired. Where a third of the samples would be, or where the body is no person's, a repair has no evidence:
`check_contradictions` refuses the take, whose unit, axes, rate, marker set or subject is wrong. A marker set that was learned
from the take is tried on it: `select_consistent_set` withdraws it, or some of its markers, where its body contradicts labels and
samples that are consistent without a skeleton.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from mocapfix.errors import TakeError
from mocapfix.model.body_fit import BodyFit
from mocapfix.model.detected import Detected
from mocapfix.model.marker_set import MarkerSet
from mocapfix.options import CleanOptions

MAX_FAULTY_SHARE = 1 / 3  # of the measured samples; at most 0.006 in 35 captures
MAX_MEDIAN_RESIDUAL_M = 0.1  # of the measured samples from the body; at most 0.005 m in 35 captures
LEG_LENGTH_RANGE_M = (0.3, 2.5)  # from hip to ankle, of children and giants; 0.76 to 0.93 m in 35 captures
LEGS = (("LeftLeg", "LeftFoot"), ("RightLeg", "RightFoot"))  # the joints at the end of thigh and shank
MAX_MEDIAN_SPEED_M_PER_S = 15.0  # faster than a sprinter, whose markers move at 9.5 m/s


@dataclass(frozen=True)
class WholeTakeFigures:
    """What shows whether a take fits its body."""

    faulty_share: float  # share of the measured samples that are judged faulty
    median_residual_m: float  # median distance of the measured samples from their places on the body; 0 without a body
    leg_m: float | None  # mean length of the legs that have markers; None if none has
    median_speed_m_per_s: float  # median speed of the measured samples


def measure_whole_take(detected: Detected, body: BodyFit | None) -> WholeTakeFigures:
    """Return how well a take fits its body after detection and solve."""
    take = detected.take
    measured = take.measured
    judged = np.delete(measured, detected.donor_markers, axis=1)
    sound = np.delete(detected.inlier_mask & measured, detected.donor_markers, axis=1)
    residual_m, leg_m = 0.0, None
    if body is not None:
        distances = np.linalg.norm(take.markers - detected.place_on_body(body), axis=-1)[measured]
        residual_m = float(np.median(distances[np.isfinite(distances)])) if np.isfinite(distances).any() else 0.0
        skeleton = body.subject.skeleton
        shown = [[skeleton.find_joint(name) for name in leg] for leg in LEGS]
        lengths = [np.linalg.norm(skeleton.offsets[leg], axis=1).sum() for leg in shown if body.subject.solved_joints[leg].all()]
        leg_m = float(np.mean(lengths)) if lengths else None
    steps = np.linalg.norm(np.diff(take.markers, axis=0), axis=-1)
    steps = steps[measured[1:] & measured[:-1]]
    return WholeTakeFigures(
        faulty_share=1.0 - float(sound.sum()) / max(int(judged.sum()), 1),
        median_residual_m=residual_m,
        leg_m=leg_m,
        median_speed_m_per_s=float(np.median(steps)) * take.rate if len(steps) else 0.0,
    )


def check_contradictions(detected: Detected, body: BodyFit | None, options: CleanOptions) -> None:
    """Raise TakeError if a take contradicts its body as a whole, and the options do not accept that."""
    if options.read.accept_contradictions:
        return
    figures = measure_whole_take(detected, body)
    if figures.leg_m is not None and not LEG_LENGTH_RANGE_M[0] <= figures.leg_m <= LEG_LENGTH_RANGE_M[1]:
        problem = f"its person would have legs of {figures.leg_m:.2g} m"
        cause = "check the unit (--unit)" if options.subject.subject is None else _find_cause(figures, options)
    elif figures.faulty_share > MAX_FAULTY_SHARE:
        problem = f"{figures.faulty_share:.0%} of its measured samples would be replaced as faulty"
        cause = _find_cause(figures, options)
    elif figures.median_residual_m > MAX_MEDIAN_RESIDUAL_M:
        problem = f"half of its samples are more than {figures.median_residual_m * 1e3:.0f} mm from the body"
        cause = _find_cause(figures, options)
    else:
        return
    others = " --subject-prefix cleans another subject alone." if detected.take.subject_name else ""
    raise TakeError(f"{detected.take.name}: {problem}; {cause}. --accept-contradictions cleans it all the same.{others}")


def _find_cause(figures: WholeTakeFigures, options: CleanOptions) -> str:
    """Return the most likely cause as a request, with the option that corrects it."""
    if figures.median_speed_m_per_s > MAX_MEDIAN_SPEED_M_PER_S:
        return f"its markers move at {figures.median_speed_m_per_s:.0f} m/s: check the rate (--rate) and the unit (--unit)"
    if options.subject.subject is not None:
        return "check that --subject is of this person and this marker set, or leave it out"
    if options.subject.marker_set is not None:
        return "check that --marker-set is that of its markers, or leave it out"
    if options.read.up_axis or options.read.mirror or options.read.unit or options.read.rate_hz:
        return "check --up, --mirror, --unit and --rate, or leave them out"
    return "check its labels and the marker set (--marker-set)"


MAX_CONTRADICTED_SAMPLE_SHARE = 2e-4
MIN_CONTRADICTED_SAMPLES = 6  # number of samples that it may reject or relabel in a take of any length
MAX_LEFT_OUT_SHARE = 0.1  # share of the set's markers that are left out after the trial because most contradictions concern them


@dataclass(frozen=True)
class SetTrial:
    """What a body contradicts in a take that is consistent without it."""

    contradicted_counts: Int[np.ndarray, " K"]  # samples of each marker that are rejected or relabelled
    sample_count: int  # visible samples of the markers

    @property
    def is_passed(self) -> bool:
        """Whether the contradicted samples are few."""
        return int(self.contradicted_counts.sum()) <= self._max_count

    @property
    def _max_count(self) -> float:
        return max(MIN_CONTRADICTED_SAMPLES, MAX_CONTRADICTED_SAMPLE_SHARE * self.sample_count)

    def select_kept_markers(self) -> Int[np.ndarray, " kept"]:
        """Return the markers that remain without those that cause most contradictions; none if these are too many."""
        order = np.argsort(-self.contradicted_counts, kind="stable")
        remaining = self.contradicted_counts.sum() - np.cumsum(self.contradicted_counts[order])
        left_out_count = int(np.argmax(remaining <= self._max_count)) + 1
        if left_out_count > MAX_LEFT_OUT_SHARE * len(order):
            return order[:0]
        return np.sort(order[left_out_count:])


def select_consistent_set(marker_set: MarkerSet, without_set: Detected, with_set: Detected) -> MarkerSet | None:
    """Return a learned set if its body contradicts hardly any sample, else a part of it that may not; None if there is none."""
    trial = compare_detections(without_set, with_set, marker_set.find_columns(without_set.take.labels))
    if trial.is_passed:
        return marker_set
    kept = trial.select_kept_markers()
    narrowed = marker_set.select_markers([marker_set.labels[k] for k in kept])
    return None if not len(kept) or narrowed.describe_missing_body(narrowed.labels) else narrowed


def compare_detections(without_set: Detected, with_set: Detected, columns: Int[np.ndarray, " K"]) -> SetTrial:
    """Return what the detection with a learned set contradicts in the take as detected without it.

    Args:
        columns: The take's columns of the K markers of the set, -1 for one that it does not have.
    """
    before, after = without_set.take.markers, with_set.take.markers
    is_relabelled = ((before != after) & ~(np.isnan(before) & np.isnan(after))).any(-1) & without_set.take.visible
    is_rejected = without_set.inlier_mask & ~with_set.inlier_mask
    is_contradicted = (is_relabelled | is_rejected)[:, columns] & (columns >= 0)
    return SetTrial(is_contradicted.sum(0), int(without_set.take.visible[:, columns[columns >= 0]].sum()))
