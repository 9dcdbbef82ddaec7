"""What each way of filling a lost limb's gap is worth alone: what the solve weighs against one another."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from mocapfix import marker_sets
from mocapfix.errors import ReadError
from mocapfix.initialise import initial_motion
from mocapfix.motion import Motion
from mocapfix.options import SolveOptions
from mocapfix.pose_prior import mean_pose
from mocapfix.pose_prior.joint_limits import load_joint_limits
from mocapfix.pose_prior.model import PoseModel
from mocapfix.report.stage_timer import ProgressCallback
from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve import kinematics, motion_solver
from mocapfix.solve.prior_conditioner import PriorConditioner
from mocapfix.subject import Subject
from mocapfix.take import Take
from mocapfix.train import shard_recordings
from mocapfix.train.training_poses import find_longest_jump_free_slice, find_weakly_observed_joints

# MERGED: mocapfix.bench.limb_ways
EDGE_SPEED_WINDOW_S = 0.067  # seconds over which the speed at an edge is measured


def fill_limb_gap(
    solution: Motion, lost_joints: np.ndarray, first_frame: int, last_frame: int, rate_hz: float, model: PoseModel | None
) -> Iterator[tuple[str, Motion]]:
    """Yield ways and the motion each makes of a solved one, in which the joints `lost` lack in the frames first to last."""
    gap, ends = np.arange(first_frame, last_frame + 1), np.array([first_frame - 1, last_frame + 1])
    turns = {j: solution.local_rotations[:, j] for j in lost_joints}
    yield "slerp", replace_rotations(solution, gap, {j: Slerp(ends, convert_rotation(turns[j][ends]))(gap) for j in lost_joints})
    yield "cubic", replace_rotations(solution, gap, {j: interpolate_hermite(turns[j], ends, gap, rate_hz) for j in lost_joints})
    if model is not None:
        said = infer_lost_joints(solution, lost_joints, np.arange(first_frame - 1, last_frame + 2), model)
        yield (
            "model, each frame alone",
            replace_rotations(solution, gap, {j: convert_rotation(said[j][1:-1]) for j in lost_joints}),
        )
        yield (
            "model, corrected at both edges",
            replace_rotations(solution, gap, {j: blend_edge_errors(said[j], turns[j][ends]) for j in lost_joints}),
        )


def convert_rotation(matrices: np.ndarray) -> Rotation:
    return Rotation.from_matrix(matrices)


def replace_rotations(solution: Motion, gap: np.ndarray, turns: dict[int, Rotation]) -> Motion:
    """-> the motion with these joints' rotations in the frames of the gap."""
    rotations = solution.local_rotations.copy()
    for j, turn in turns.items():
        rotations[gap, j] = turn.as_matrix()
    return replace(solution, local_rotations=rotations)


def interpolate_hermite(turns: np.ndarray, ends: np.ndarray, gap: np.ndarray, rate: float) -> Rotation:
    """-> the cubic Hermite curve of a joint's (T, 3, 3) rotation vectors from the one end, with the speed it has at either."""
    span, (a, b) = max(1, round(EDGE_SPEED_WINDOW_S * rate)), ends
    before, after = max(a - span, 0), min(b + span, len(turns) - 1)
    from_end = convert_rotation(turns[[before, a, b, after]]) * convert_rotation(turns[a]).inv()
    away = from_end.as_rotvec()
    leaving, coming = -away[0] / max(a - before, 1), (away[3] - away[2]) / max(after - b, 1)
    return Rotation.from_rotvec(CubicHermiteSpline(ends, away[1:3], [leaving, coming])(gap)) * convert_rotation(turns[a])


def infer_lost_joints(solution: Motion, lost_joints: np.ndarray, frames: np.ndarray, model: PoseModel) -> dict[int, np.ndarray]:
    """-> joint: (N, 3, 3) what the model makes of it in each of the frames, given the joints that are not lost."""
    body = load_cmu31_body()
    told = np.array([j for j in np.flatnonzero(body.free_joints)[1:] if j not in lost_joints])
    either = np.ones((len(frames), 4 * len(lost_joints)))
    turns = PriorConditioner(lambda: model, 1.0).predict_rotations(solution.local_rotations, told, lost_joints, frames, either)
    return {j: Rotation.from_quat(turns[:, 4 * i : 4 * i + 4]).as_matrix() for i, j in enumerate(lost_joints)}


def blend_edge_errors(inferred: np.ndarray, edges: np.ndarray) -> Rotation:
    """-> what was said (N, 3, 3) of a gap between its edges, its first and last, with the error there blended across."""
    share = np.linspace(0, 1, len(inferred))[1:-1, None]
    missed = (convert_rotation(edges) * convert_rotation(inferred[[0, -1]]).inv()).as_rotvec()
    return Rotation.from_rotvec((1 - share) * missed[0] + share * missed[1]) * convert_rotation(inferred[1:-1])


# MERGED: mocapfix.bench.limb
# A limb lost for a while: how far its joints, as they are put back, lie from where they were.
#
# Recordings of people that no model was trained on are performed by the average body, which wears the markers of its set and one
# on every joint. Somewhere an arm (from the elbow out) or a leg (from the knee out) is hidden, and the take is solved as any
# other is. Beside that stands what each way of filling the gap is worth on its own (see `limb_ways`).
LIMB_GAP_DURATIONS_S = (0.5, 1.0, 2.0)  # how long a limb is lost
MIN_CONTEXT_S = 0.4  # seconds that are seen before and after at the least
CMU_UNIT_M = 0.0254 / 0.45  # metres: the unit of the places in CMU's own releases
LIMB_JOINTS = {  # the joints whose rotations are lost; and those whose places are, which are scored
    "arm": (("Arm", "ForeArm", "Hand"), ("ForeArm", "Hand", "FingerBase")),
    "leg": (("UpLeg", "Leg", "Foot"), ("Leg", "Foot", "ToeBase")),
}


class PerformedMotion(NamedTuple):
    """A recording without flips, by its name, as somebody performs it who has the average body."""

    motion: Motion
    rate_hz: float
    name: str


class LimbGap(NamedTuple):
    """Frames `first` to `last` of a performance, in which the limb of one side is lost."""

    performance: PerformedMotion
    side: str
    first: int
    last: int


def measure_lost_limbs(
    motion_folder: Path, model: PoseModel | None, gap_count: int = 20, seed: int = 0, progress: ProgressCallback = lambda _: None
) -> dict[str, dict]:
    """-> limb -> seconds ("0.5", "1", "2") -> mean error in mm over the lost joints and the gap's frames, and under `ways` the
    same of each way of filling it alone: way -> limb -> seconds.

    data   the folder that holds test.npz, with skeletons.json beside it: motion of people whom the model has not seen
    model  the trained model that is in the solve; None for the take and time alone
    count  how many gaps there are of each limb and length, at places drawn alike from all frames by `seed`

    Raises ReadError where there is no such motion.
    """
    performances, rng = list(read_performed_motions(motion_folder / "test.npz")), np.random.default_rng(seed)
    table: dict[str, dict] = {}
    for limb in LIMB_JOINTS:
        for seconds in LIMB_GAP_DURATIONS_S:
            errors: dict[str, list[float]] = {}
            for n, gap in enumerate(draw_limb_gaps(performances, seconds, gap_count, rng)):
                progress(f"{limb} lost for {seconds:g} s, {n + 1} of {gap_count}")
                for way, motion in solve_limb_gap(gap, limb, model):
                    errors.setdefault(way, []).append(compute_limb_error(gap, limb, motion))
            for way, found in errors.items():
                table.setdefault(way, {}).setdefault(limb, {})[f"{seconds:g}"] = 1e3 * float(np.mean(found))
    return table.pop("mocapfix") | {"ways": table}


def read_performed_motions(path: Path) -> Iterator[PerformedMotion]:
    """Yield the recordings of a shard, between flips, with their places. Raises ReadError where it is none."""
    names = load_cmu31_body().skeleton.names
    try:
        with np.load(path) as shard:
            places = np.split(CMU_UNIT_M * shard["root"].astype(float), shard["start"][1:])
        json.loads((path.parent / "skeletons.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, KeyError) as error:
        raise ReadError(f"{path}: is no shard of motion with its skeletons.json beside it ({error}).") from error
    firm = ~find_weakly_observed_joints(names)
    for recording, place in zip(shard_recordings.read_shard_recordings(path), places, strict=True):
        kept = find_longest_jump_free_slice(recording.rotations[:, firm], recording.rate_hz)
        yield PerformedMotion(build_known_motion(place[kept], recording.rotations[kept]), recording.rate_hz, recording.name)


def build_known_motion(root_position: np.ndarray, rotations: np.ndarray) -> Motion:
    """-> a motion that nobody had to solve: root (T, 3) metres, rotations (T, J, 3, 3)."""
    none = np.zeros(len(root_position), int)
    sure = np.zeros(rotations.shape[:2])
    return Motion(np.ascontiguousarray(root_position), np.ascontiguousarray(rotations), none, none, sure[:, :0], sure)


def draw_limb_gaps(motions: list[PerformedMotion], duration_s: float, count: int, rng: np.random.Generator) -> list[LimbGap]:
    """-> gaps, each frame at which one can begin as likely as any other."""
    room = [each.motion.frame_count - round((duration_s + 2 * MIN_CONTEXT_S) * each.rate_hz) for each in motions]
    begins = np.maximum(room, 0)
    gaps = []
    for place in rng.integers(begins.sum(), size=count):
        n = int(np.searchsorted(np.cumsum(begins), place, side="right"))
        each = motions[n]
        first = int(place - begins[:n].sum()) + round(MIN_CONTEXT_S * each.rate_hz)
        side = ("Left", "Right")[rng.integers(2)]
        gaps.append(LimbGap(each, side, first, first + round(duration_s * each.rate_hz) - 1))
    return gaps


def solve_limb_gap(gap: LimbGap, limb: str, model: PoseModel | None) -> Iterator[tuple[str, Motion]]:
    """Yield what the solve makes of the take with the gap, and each other way alone of the same solve, by name."""
    body, subject = load_cmu31_body(), build_full_marker_subject()
    habits, limits = mean_pose.load_mean_pose_prior("mean-pose", body.skeleton), load_joint_limits(body.skeleton)
    worn = remove_limb_markers(gap, limb, subject)
    start = initial_motion.initialise_motion(worn, subject, body, habits)
    found = motion_solver.solve_motion(
        worn, subject, body, habits, limits, start, SolveOptions(), (lambda: model) if model else None
    )
    yield "mocapfix", found
    turned = np.array([body.skeleton.find_joint(gap.side + name) for name in LIMB_JOINTS[limb][0]])
    yield from fill_limb_gap(found, turned, gap.first, gap.last, gap.performance.rate_hz, model)
    if model is not None:
        yield "the take and time", motion_solver.solve_motion(worn, subject, body, habits, limits, start, SolveOptions())


def build_full_marker_subject() -> Subject:
    """-> the average body with the markers of its set and one on every joint, which the joint's parent carries."""
    skeleton, worn = load_cmu31_body().skeleton, marker_sets.load_marker_set("cmu41")
    carriers = np.maximum(skeleton.parents, 0)
    joints, places = np.r_[worn.joints, carriers], np.r_[worn.marker_offsets, skeleton.offsets * (skeleton.parents >= 0)[:, None]]
    labels = worn.labels + skeleton.names
    return Subject(skeleton, worn.name, labels, joints, np.ascontiguousarray(places), np.zeros(len(labels)))


def remove_limb_markers(gap: LimbGap, limb: str, subject: Subject) -> Take:
    """-> the performance's markers, those that the limb carries missing in the gap."""
    parents, names = subject.skeleton.parents, subject.skeleton.names
    lost = np.isin(names, [gap.side + name for name in LIMB_JOINTS[limb][0]])
    for j in range(1, len(names)):
        lost[j] |= lost[parents[j]]
    markers = kinematics.compute_joint_and_marker_positions(subject, gap.performance.motion)[1]
    markers[gap.first : gap.last + 1, lost[subject.joints]] = np.nan
    return Take(markers, subject.labels, gap.performance.rate_hz)


def compute_limb_error(gap: LimbGap, limb: str, solution: Motion) -> float:
    """-> metres: the mean distance of the lost joints from the true ones over the gap."""
    skeleton, frames = load_cmu31_body().skeleton, np.arange(gap.first, gap.last + 1)
    joints = [skeleton.find_joint(gap.side + name) for name in LIMB_JOINTS[limb][1]]
    truth, there = (
        kinematics.compute_world_poses(skeleton, each.select_frames(frames))[0][:, joints]
        for each in (gap.performance.motion, solution)
    )
    return float(np.linalg.norm(there - truth, axis=-1).mean())
