"""Benchmark of lost limbs: the error of an arm or a leg that is reconstructed after its markers were missing for a while.

Recordings of subjects that no model was trained on are performed by the average body, which has the markers of its marker set and
one on every joint. An arm or a leg, without shoulder or hip, is hidden in a gap, and the take is solved: under the trained prior,
with the motion prior besides, and with neither.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mocapfix.lab.sound_takes import PerformedMotion, read_performed_motions, solve_motion
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.stage_timer import ProgressCallback
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.options import SolveOptions
from mocapfix.solve import initial_motion, kinematics
from mocapfix.solve.mean_pose import load_joint_limits, load_mean_pose_prior
from mocapfix.solve.motion_prior import predict_shipped_gap
from mocapfix.solve.pose_prior import PoseModel
from mocapfix.solve.prior_conditioner import PriorConditioner
from mocapfix.subject.library import load_marker_set

LIMB_GAP_DURATIONS_S = (0.5, 1.0, 2.0)
MIN_CONTEXT_S = 0.4  # frames that are visible before and after a gap
LIMB_JOINTS = {  # joints whose rotations are lost, and joints whose positions are scored
    "arm": (("Arm", "ForeArm", "Hand"), ("ForeArm", "Hand", "FingerBase")),
    "leg": (("UpLeg", "Leg", "Foot"), ("Leg", "Foot", "ToeBase")),
}


class LimbGap(NamedTuple):
    """Frames `first` to `last` of a performance, in which the limb of one side is lost."""

    performance: PerformedMotion
    side: str
    first: int
    last: int


def measure_lost_limbs(
    motion_folder: Path, model: PoseModel | None, gap_count: int = 20, seed: int = 0, progress: ProgressCallback = lambda _: None
) -> dict[str, Any]:
    """Return the mean error in mm of the lost joints by limb and gap duration ("0.5", "1", "2").

    The entry `ways` has the same by each method of filling the gap alone.

    Args:
        motion_folder: Holds test.npz and skeletons.json: motion of subjects that the model was not trained on.
        model: The trained prior of the solve; None for the take and temporal smoothness only.
        gap_count: Number of gaps of each limb and duration, uniformly distributed over all frames.

    Raises:
        ReadError: If there is no such motion.
    """
    performances, rng = list(read_performed_motions(motion_folder / "test.npz")), np.random.default_rng(seed)
    table: dict[str, dict[str, Any]] = {}
    for limb in LIMB_JOINTS:
        for duration_s in LIMB_GAP_DURATIONS_S:
            errors: dict[str, list[float]] = {}
            for n, gap in enumerate(draw_limb_gaps(performances, duration_s, gap_count, rng)):
                progress(f"{limb} lost for {duration_s:g} s, {n + 1} of {gap_count}")
                for method, motion in solve_limb_gap(gap, limb, model):
                    errors.setdefault(method, []).append(compute_limb_error(gap, limb, motion))
            for method, values in errors.items():
                table.setdefault(method, {}).setdefault(limb, {})[f"{duration_s:g}"] = 1e3 * float(np.mean(values))
    return table.pop("mocapfix") | {"ways": table}


def draw_limb_gaps(motions: list[PerformedMotion], duration_s: float, count: int, rng: np.random.Generator) -> list[LimbGap]:
    """Return gaps whose first frame is uniformly distributed over all frames where a gap fits."""
    room = [each.motion.frame_count - round((duration_s + 2 * MIN_CONTEXT_S) * each.rate_hz) for each in motions]
    start_counts = np.maximum(room, 0)
    gaps: list[LimbGap] = []
    for start in rng.integers(start_counts.sum(), size=count):
        n = int(np.searchsorted(np.cumsum(start_counts), start, side="right"))
        performance = motions[n]
        first = int(start - start_counts[:n].sum()) + round(MIN_CONTEXT_S * performance.rate_hz)
        side = ("Left", "Right")[rng.integers(2)]
        gaps.append(LimbGap(performance, side, first, first + round(duration_s * performance.rate_hz) - 1))
    return gaps


def solve_limb_gap(gap: LimbGap, limb: str, model: PoseModel | None) -> Iterator[tuple[str, Motion]]:
    """Yield the names of methods and the solved motions of the take with the gap."""
    body, subject = load_cmu31_body(), build_full_marker_subject()
    prior, limits = load_mean_pose_prior("mean-pose", body.skeleton), load_joint_limits(body.skeleton)
    take = remove_limb_markers(gap, limb, subject)
    start = initial_motion.initialise_motion(take, subject, body, prior)
    conditioner = PriorConditioner(lambda: model, 1.0) if model else None
    solution = solve_motion(take, subject, body, prior, limits, start, SolveOptions(), conditioner=conditioner)
    yield "mocapfix", solution
    if model is not None:
        with_motion_prior = PriorConditioner(lambda: model, 1.0, predict_shipped_gap)
        yield (
            "with the motion prior",
            solve_motion(take, subject, body, prior, limits, start, SolveOptions(), conditioner=with_motion_prior),
        )
        yield "the take and time", solve_motion(take, subject, body, prior, limits, start, SolveOptions())


def build_full_marker_subject() -> Subject:
    """Return the average body with the markers of the CMU marker set and one on every joint, attached to the joint's parent."""
    skeleton, marker_set = load_cmu31_body().skeleton, load_marker_set("cmu41")
    joints = np.r_[marker_set.joints, np.maximum(skeleton.parents, 0)]
    offsets = np.r_[marker_set.marker_offsets, skeleton.offsets * (skeleton.parents >= 0)[:, None]]
    labels = marker_set.labels + skeleton.names
    return Subject(skeleton, marker_set.name, labels, joints, np.ascontiguousarray(offsets), np.zeros(len(labels)))


def remove_limb_markers(gap: LimbGap, limb: str, subject: Subject) -> Take:
    """Return the performance's markers, with those on the limb missing in the gap."""
    parents, names = subject.skeleton.parents, subject.skeleton.names
    is_lost = np.isin(names, [gap.side + name for name in LIMB_JOINTS[limb][0]])
    for j in range(1, len(names)):
        is_lost[j] |= is_lost[parents[j]]
    markers = kinematics.compute_joint_and_marker_positions(subject, gap.performance.motion)[1]
    markers[gap.first : gap.last + 1, is_lost[subject.joints]] = np.nan
    return Take(markers, subject.labels, gap.performance.rate_hz)


def compute_limb_error(gap: LimbGap, limb: str, solution: Motion) -> float:
    """Return the mean distance in metres of the limb's joints from the true ones over the gap."""
    skeleton, frames = load_cmu31_body().skeleton, np.arange(gap.first, gap.last + 1)
    joints = [skeleton.find_joint(gap.side + name) for name in LIMB_JOINTS[limb][1]]
    true, solved = (
        kinematics.compute_world_poses(skeleton, motion.select_frames(frames))[0][:, joints]
        for motion in (gap.performance.motion, solution)
    )
    return float(np.linalg.norm(solved - true, axis=-1).mean())
