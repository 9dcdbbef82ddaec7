"""Refuse a take that contradicts its body as a whole: what is then wrong is its unit, axes, rate, marker set or subject.

Single faults are repaired. Where a third of the samples would be, or where the body is no person's, a repair would be written
without any evidence that it is one.
"""

from dataclasses import dataclass

import numpy as np

from mocapfix.errors import TakeError
from mocapfix.options import CleanOptions
from mocapfix.state import CleaningState

MAX_FAULTY_SHARE = 1 / 3  # of the measured samples; at most 0.006 in 35 captures
MAX_MEDIAN_RESIDUAL_M = 0.1  # of the measured samples from the body; at most 0.005 m in 35 captures
LEG_LENGTH_RANGE_M = (0.3, 2.5)  # from hip to ankle, of children and giants; 0.76 to 0.93 m in 35 captures
LEGS = (("LeftLeg", "LeftFoot"), ("RightLeg", "RightFoot"))  # the joints at the end of thigh and shank
MAX_MEDIAN_SPEED_M_PER_S = 15.0  # faster than a sprinter, whose markers move at 9.5 m/s


@dataclass(frozen=True)
class WholeTakeFigures:
    """What shows whether a take fits its body.

    Attributes:
        faulty_share: Share of the measured samples that are judged faulty.
        median_residual_m: Median distance of the measured samples from their places on the body; 0 without a body.
        leg_m: Mean length of the legs that have markers; None if none has.
        median_speed_m_per_s: Median speed of the measured samples.
    """

    faulty_share: float
    median_residual_m: float
    leg_m: float | None
    median_speed_m_per_s: float


def measure_whole_take(state: CleaningState) -> WholeTakeFigures:
    """Return how well a take fits its body after detection and solve."""
    detection, body = state.detection, state.body
    take = detection.take
    measured = take.measured
    judged = np.delete(measured, detection.donor_markers, axis=1)
    sound = np.delete(detection.inlier_mask & measured, detection.donor_markers, axis=1)
    residual_m, leg_m = 0.0, None
    if body is not None:
        distances = np.linalg.norm(take.markers - body.expand_to_take(detection.epochs), axis=-1)[measured]
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


def check_contradictions(state: CleaningState, options: CleanOptions) -> None:
    """Raise TakeError if a take contradicts its body as a whole, and the options do not accept that."""
    if options.read.accept_contradictions:
        return
    figures = measure_whole_take(state)
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
    others = " --subject-prefix cleans another subject alone." if state.original_take.subject_name else ""
    raise TakeError(f"{state.original_take.name}: {problem}; {cause}. --accept-contradictions cleans it all the same.{others}")


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
