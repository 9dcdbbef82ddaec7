"""Faults put into sound animations, found and mended: how far the joints are off beside interpolating across each fault.

Interpolation is told where each fault begins and ends and goes from its last sound frame to its first; so is the mending in the
rows "told", which says what the mending is worth. In the rows "found" the faults have to be found first.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from mocapfix.animations import detect as detected
from mocapfix.animations import repair as solved
from mocapfix.bench.injected_animation_faults import (
    ANIMATION_FAULT_INJECTORS,
    FAULT_DURATION_RANGES_S,
    InjectedAnimationFault,
    inject_animation_faults,
)
from mocapfix.bench.sound_takes import PerformedMotion, read_performed_motions
from mocapfix.errors import SceneError
from mocapfix.faults import Fault, FaultKind
from mocapfix.motion import Motion
from mocapfix.report.stage_timer import ProgressCallback
from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve import kinematics
from mocapfix.synthetic import motions
from mocapfix.synthetic.synthetic_takes import draw_subject
from mocapfix.train.shard_recordings import TRAINING_RATE_HZ

MIN_PERFORMANCE_DURATION_S = 3.4  # seconds of a performance that has room for faults
COMPARED_REPAIRS = ("linear", "told", "found")
DETECTED_KIND: dict[str, FaultKind] = {
    "flip": "flip", "pop": "pop", "jitter": "jitter", "limb lost": "gap", "figure lost": "gap", "root off": "spike",
}  # fmt: skip
SKIPPED_COMBINATION = "jitter", "1 frame"  # what trembles in one frame has popped
EXPECTED_JITTER_SD_RAD = np.radians(3.0)


@dataclass
class RepairScores:
    """What is measured of one kind and length: mean joint errors of each fault by way, and how many faults were found."""

    errors_m: dict[str, list[float]] = field(default_factory=lambda: {way: [] for way in COMPARED_REPAIRS})
    detected_count: int = 0

    def summarise(self) -> dict[str, float]:
        """-> faults, the part found, error in mm by way, and what each leaves of linear's."""
        mean = {way: 1e3 * float(np.mean(each)) for way, each in self.errors_m.items()}
        said = {"faults": len(self.errors_m["linear"]), "found": self.detected_count / len(self.errors_m["linear"])}
        said |= {f"{way}_mm": mm for way, mm in mean.items()}
        return said | {f"{way}_over_linear": mean[way] / mean["linear"] for way in COMPARED_REPAIRS[1:]}


def measure_animation_repair(
    data: Path | None,
    trials: int,
    seed: int = 0,
    progress: ProgressCallback = lambda _: None,
    kinds: tuple[str, ...] = tuple(ANIMATION_FAULT_INJECTORS),
) -> dict:
    """-> `rows`: kind: length: a Tally's row; `pooled`: of all faults of a length what is left of linear's error, told and found;
    `alarms_per_minute` by kind in the sound trials, and `touched`, the part of the sound samples that was changed.

    data  the folder that holds test.npz of motion; None composes motion. Raises SceneError or ReadError where there is none.
    """
    if trials < 1:
        raise SceneError(f"At least one trial is needed, not {trials}.")
    chosen, tallies, alarms, seconds = list(_iterate_performances(data, trials)), {}, {}, 0.0
    touched: list[float] = []
    for n, trial in enumerate(chosen):
        progress(f"{trial.name}, {n + 1} of {len(chosen)}")
        seconds += trial.motion.frame_count / trial.rate_hz
        for fault in _detect_faults(trial.motion, trial.rate_hz):
            alarms[fault.kind] = alarms.get(fault.kind, 0) + 1
        for k, kind in enumerate(kinds):
            for m, length in enumerate(FAULT_DURATION_RANGES_S):
                if (kind, length) != SKIPPED_COMBINATION:
                    rng = np.random.default_rng([seed, n, k, m])
                    touched.append(_score_trial(trial, kind, length, rng, tallies.setdefault((kind, length), RepairScores())))
    rows: dict[str, dict] = {}
    for (kind, length), tally in tallies.items():
        if tally.errors_m["linear"]:
            rows.setdefault(kind, {})[length] = tally.summarise()
    pooled = {}
    for length in FAULT_DURATION_RANGES_S:
        sums = {way: sum(sum(t.errors_m[way]) for (_, own), t in tallies.items() if own == length) for way in COMPARED_REPAIRS}
        pooled[length] = {way: sums[way] / sums["linear"] for way in COMPARED_REPAIRS[1:]} if sums["linear"] else {}
    per_minute = {kind: 60 * count / seconds for kind, count in sorted(alarms.items())}
    return {"rows": rows, "pooled": pooled, "alarms_per_minute": per_minute, "touched": float(np.mean(touched))}


def _iterate_performances(data: Path | None, count: int) -> Iterator[PerformedMotion]:
    """Yield so many performances, of the test people's as unlike ones as may be."""
    if data is None:
        for n in range(count):
            subject = draw_subject(np.random.default_rng(n), asymmetric=True)
            yield PerformedMotion(
                motions.compose_motion(subject, 10.0 + n, TRAINING_RATE_HZ), TRAINING_RATE_HZ, f"composed {n + 1}"
            )
        return
    long = [
        each
        for each in read_performed_motions(Path(data) / "test.npz")
        if each.motion.frame_count >= MIN_PERFORMANCE_DURATION_S * each.rate_hz
    ]
    for at in np.unique(np.linspace(0, len(long) - 1, min(count, len(long))).astype(int)):
        yield long[at]


def _detect_faults(motion: Motion, rate: float) -> list[Fault]:
    names = load_cmu31_body().skeleton.names
    return detected.detect_pose_faults(names, motion.root_position, motion.local_rotations, ["ZYX"] * len(names), rate)


def _score_trial(trial: PerformedMotion, kind: str, length: str, rng: np.random.Generator, scores: RepairScores) -> float:
    """Add what becomes of a trial's faults to the tally; -> the part of the sound samples that was changed."""
    skeleton, truth = load_cmu31_body().skeleton, trial.motion
    struck, put = inject_animation_faults(truth, skeleton, trial.rate_hz, kind, length, rng)
    if not put:
        return 0.0
    orders, faults = ["ZYX"] * len(skeleton.names), _detect_faults(struck, trial.rate_hz)
    given = (skeleton.parents, struck.root_position, struck.local_rotations, orders)
    told = solved.repair_animation(*given, [each for p in put for each in build_expected_faults(p, len(orders))], trial.rate_hz)
    mended = solved.repair_animation(*given, faults, trial.rate_hz)
    poses = {
        "linear": interpolate_faults(struck.root_position, struck.local_rotations, put),
        "told": told[:2],
        "found": mended[:2],
    }
    places = {way: _compute_joint_positions(*each) for way, each in poses.items()}
    true, sound = _compute_joint_positions(truth.root_position, truth.local_rotations), np.ones(mended.method.shape, bool)
    for each in put:
        span, courses = slice(each.first, each.last + 1), build_expected_faults(each, len(orders))
        struck_courses = [m for fault in courses for m in fault.markers]
        sound[span, struck_courses] = False
        scores.detected_count += any(
            f.first <= each.last and each.first <= f.last and set(f.markers) & set(struck_courses) for f in faults
        )
        for way, found in places.items():
            scores.errors_m[way].append(float(np.linalg.norm(found[span] - true[span], axis=-1).mean()))
    return float((mended.method != solved.RepairMethod.UNCHANGED)[sound].mean())


def build_expected_faults(injected: InjectedAnimationFault, joint_count: int) -> list[Fault]:
    """-> what was put into a skeleton of so many joints, as detection would tell it."""
    kind = DETECTED_KIND[injected.kind]
    if kind == "jitter":
        return [Fault(kind, j, injected.first, injected.last, EXPECTED_JITTER_SD_RAD, "") for j in injected.joints]
    markers = (joint_count,) if kind == "spike" else injected.joints + (joint_count,) * (len(injected.joints) == joint_count)
    return [Fault(kind, markers[0], injected.first, injected.last, np.nan, "", 1.0, markers[1:])]


def interpolate_faults(
    root: np.ndarray, local: np.ndarray, injected: list[InjectedAnimationFault]
) -> tuple[np.ndarray, np.ndarray]:
    """-> places (T, 3) and local rotations (T, J, 3, 3) with every fault bridged from its last sound frame to its first, joint by
    joint: spherically, and the root's place in a straight line where it is part of the fault."""
    root, local = root.copy(), local.copy()
    for each in injected:
        span, ends = np.arange(each.first, each.last + 1), np.array([each.first - 1, each.last + 1])
        for j in each.joints if each.kind != "root off" else ():
            local[span, j] = Slerp(ends, Rotation.from_matrix(local[ends, j]))(span).as_matrix()
        if each.kind == "root off" or len(each.joints) == local.shape[1]:
            share = ((span - ends[0]) / (ends[1] - ends[0]))[:, None]
            root[span] = (1 - share) * root[ends[0]] + share * root[ends[1]]
    return root, local


def _compute_joint_positions(root: np.ndarray, local: np.ndarray) -> np.ndarray:
    return kinematics.compute_tree_poses(
        kinematics.build_kinematic_tree(load_cmu31_body().skeleton), np.ascontiguousarray(root), np.ascontiguousarray(local)
    )[0]
