"""Benchmark of fault detection and repair in animations: joint errors in comparison with interpolation across each fault.

Faults like those of marker-based solvers, inertial suits and video are injected into sound motions; in a gap the last value is
held, or the values are zero or absent. Interpolation is given the first and last frame of each fault, and so is the repair in the
rows "known", which measure the repair alone. In the rows "detected" the faults are detected first.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import NamedTuple, TypedDict

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix import synthetic as motions
from mocapfix.animations.detect import detect_pose_faults
from mocapfix.animations.repair import repair_animation
from mocapfix.animations.repair_methods import FrameSpan, RepairMethod, exclude_span, interpolate_linearly
from mocapfix.errors import SceneError
from mocapfix.lab.recordings import TRAINING_RATE_HZ
from mocapfix.lab.sound_takes import PerformedMotion, read_performed_motions
from mocapfix.model.faults import Fault, FaultKind
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.model.stage_timer import ProgressCallback
from mocapfix.solve import kinematics
from mocapfix.solve.motion_prior import predict_shipped_gap
from mocapfix.solve.pose_prior import PoseModel
from mocapfix.solve.prior_conditioner import PriorConditioner
from mocapfix.solve.trained_priors import load_pose_model
from mocapfix.synthetic import draw_subject

FAULT_SPACING_S = 2.0  # between two faults
EDGE_MARGIN_S = 0.8  # before the first fault and after the last
FAULT_DURATION_RANGES_S = {"1 frame": (0.0, 0.0), "short": (0.2, 0.5), "long": (0.5, 1.0)}
INJECTED_JITTER_SD_RAD = np.radians(3.0)
MIN_POP_DEG, MAX_POP_DEG = 10, 60
MIN_ROOT_OFFSET_M, MAX_ROOT_OFFSET_M = 0.1, 0.5
INJECTED_LIMB_JOINT_NAMES = (("Arm", "ForeArm", "Hand"), ("UpLeg", "Leg", "Foot"), ("ForeArm", "Hand"), ("Leg", "Foot"))
# Suffixes of the joints that get faults.
INJECTABLE_JOINT_NAMES = ("UpLeg", "Leg", "Foot", "Arm", "ForeArm", "Hand", "Neck", "Head", "LowerBack", "Spine", "Shoulder")


class InjectedAnimationFault(NamedTuple):
    """A fault of some joints in the frames first..last, inclusive. A fault of all joints includes the root position."""

    kind: str
    joints: tuple[int, ...]
    first: int
    last: int


@dataclass(frozen=True)
class _Target:
    """The poses that an injector changes in place, the frames that it changes, and its source of random numbers."""

    root_position: Float[np.ndarray, "T 3"]
    local_rotations: Float[np.ndarray, "T J 3 3"]
    skeleton: Skeleton
    frames: slice
    rng: np.random.Generator


def inject_animation_faults(
    motion: Motion, skeleton: Skeleton, rate: float, kind: str, duration_name: str, rng: np.random.Generator
) -> tuple[Motion, list[InjectedAnimationFault]]:
    """Return a motion with as many faults of a kind as fit into it, and the faults. Absent values are NaN.

    Args:
        kind: One of ANIMATION_FAULT_INJECTORS.
        duration_name: One of FAULT_DURATION_RANGES_S.
    """
    root_position, local_rotations = motion.root_position.copy(), motion.local_rotations.copy()
    faults: list[InjectedAnimationFault] = []
    min_duration_s, max_duration_s = FAULT_DURATION_RANGES_S[duration_name]
    margin = round(EDGE_MARGIN_S * rate)
    next_first = margin
    while True:
        frame_count = max(1, round(rng.uniform(min_duration_s, max_duration_s) * rate))
        first = next_first + int(rng.integers(margin))
        if first + frame_count + margin > motion.frame_count:
            break
        last = first + frame_count - 1
        target = _Target(root_position, local_rotations, skeleton, slice(first, last + 1), rng)
        faults.append(InjectedAnimationFault(kind, ANIMATION_FAULT_INJECTORS[kind](target), first, last))
        next_first = last + 1 + round(FAULT_SPACING_S * rate)
    return replace(motion, root_position=root_position, local_rotations=local_rotations), faults


def _inject_flip(target: _Target) -> tuple[int, ...]:
    """Rotate one joint by 180 degrees about one of its axes."""
    joint = _draw_joint(target)
    flip = _convert_rotation_vectors(target.rng.permuted([np.pi, 0.0, 0.0]))
    target.local_rotations[target.frames, joint] = target.local_rotations[target.frames, joint] @ flip
    return (joint,)


def _inject_pop(target: _Target) -> tuple[int, ...]:
    """Rotate one joint by 10 to 60 degrees: in its own axes, in those of its parent, or in one of its angles."""
    joint, angle = _draw_joint(target), np.radians(target.rng.uniform(MIN_POP_DEG, MAX_POP_DEG))
    variant = target.rng.integers(3)
    rotations = target.local_rotations[target.frames, joint]
    if variant == 2:
        angles = Rotation.from_matrix(rotations).as_euler("ZYX")
        angles[:, target.rng.integers(3)] += angle * target.rng.choice([-1, 1])
        target.local_rotations[target.frames, joint] = Rotation.from_euler("ZYX", angles).as_matrix()
        return (joint,)
    axis = target.rng.normal(size=3)
    offset = _convert_rotation_vectors(angle * axis / np.linalg.norm(axis))
    target.local_rotations[target.frames, joint] = offset @ rotations if variant else rotations @ offset
    return (joint,)


def _inject_jitter(target: _Target) -> tuple[int, ...]:
    """Add independent noise to the rotations of one joint or of a limb."""
    joints = (_draw_joint(target),) if target.rng.integers(2) else _draw_limb(target)
    frame_count = target.frames.stop - target.frames.start
    for joint in joints:
        noise = _convert_rotation_vectors(target.rng.normal(0, INJECTED_JITTER_SD_RAD, (frame_count, 3)))
        target.local_rotations[target.frames, joint] = target.local_rotations[target.frames, joint] @ noise
    return joints


def _inject_limb_gap(target: _Target) -> tuple[int, ...]:
    """Hold the rotations of a limb, or set them to zero or NaN."""
    joints = _draw_limb(target)
    values = [target.local_rotations[target.frames.start - 1, joints], np.eye(3), np.nan]
    target.local_rotations[target.frames, joints] = values[target.rng.integers(3)]
    return joints


def _inject_figure_gap(target: _Target) -> tuple[int, ...]:
    """Hold all rotations and the root position, or set them to zero or NaN."""
    variant, before = target.rng.integers(3), target.frames.start - 1
    target.local_rotations[target.frames] = [target.local_rotations[before], np.eye(3), np.nan][variant]
    target.root_position[target.frames] = [target.root_position[before], np.zeros(3), np.nan][variant]
    return tuple(range(target.local_rotations.shape[1]))


def _inject_root_offset(target: _Target) -> tuple[int, ...]:
    """Move the root by 0.1 to 0.5 m."""
    direction = target.rng.normal(size=3)
    distance_m = target.rng.uniform(MIN_ROOT_OFFSET_M, MAX_ROOT_OFFSET_M)
    target.root_position[target.frames] += distance_m * direction / np.linalg.norm(direction)
    return (0,)


ANIMATION_FAULT_INJECTORS: dict[str, Callable[[_Target], tuple[int, ...]]] = {
    "flip": _inject_flip,
    "pop": _inject_pop,
    "jitter": _inject_jitter,
    "limb gap": _inject_limb_gap,
    "figure gap": _inject_figure_gap,
    "root offset": _inject_root_offset,
}


def _draw_joint(target: _Target) -> int:
    joints = [joint for joint, name in enumerate(target.skeleton.names) if name.endswith(INJECTABLE_JOINT_NAMES)]
    return int(target.rng.choice(joints))


def _draw_limb(target: _Target) -> tuple[int, ...]:
    side = ("Left", "Right")[target.rng.integers(2)]
    names = INJECTED_LIMB_JOINT_NAMES[target.rng.integers(len(INJECTED_LIMB_JOINT_NAMES))]
    return tuple(target.skeleton.find_joint(side + name) for name in names)


def _convert_rotation_vectors(vectors: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3 3"]:
    return Rotation.from_rotvec(vectors).as_matrix()


MIN_MOTION_DURATION_S = 3.4  # of a motion that has room for a fault
COMPOSED_MOTION_DURATION_S = 10.0  # of the first composed motion; each further one is a second longer
MM_PER_M = 1e3
SECONDS_PER_MINUTE = 60
COMPARED_REPAIRS = ("linear", "known", "detected")
# By injected kind: the kind that detection gives the fault.
DETECTED_KIND: dict[str, FaultKind] = {
    "flip": "flip",
    "pop": "pop",
    "jitter": "jitter",
    "limb gap": "gap",
    "figure gap": "gap",
    "root offset": "spike",
}
SKIPPED_COMBINATION = ("jitter", "1 frame")  # jitter of one frame is a pop


class RepairRow(TypedDict):
    """Results for the faults of one kind and duration: mean joint errors, and their ratios to those of interpolation."""

    faults: int
    detected_share: float
    linear_mm: float
    known_mm: float
    detected_mm: float
    known_over_linear: float
    detected_over_linear: float


class RepairReport(TypedDict):
    """Results of the benchmark."""

    rows: dict[str, dict[str, RepairRow]]  # by kind and duration of faults
    pooled: dict[str, dict[str, float]]  # by duration: ratios to the error of interpolation over all faults, known and detected
    alarms_per_minute: dict[str, float]  # by kind, in the sound motions
    changed_share: float  # part of the values outside the faults that the repair changed


@dataclass
class RepairScores:
    """Mean joint errors of each fault of one kind and duration, by repair, and the number of faults that were detected."""

    errors_m: dict[str, list[float]] = field(default_factory=lambda: {repair: [] for repair in COMPARED_REPAIRS})
    detected_count: int = 0

    def summarise(self) -> RepairRow:
        """Return the means over the faults."""
        count = len(self.errors_m["linear"])
        mean_mm = {repair: MM_PER_M * float(np.mean(errors)) for repair, errors in self.errors_m.items()}
        return RepairRow(
            faults=count,
            detected_share=self.detected_count / count,
            linear_mm=mean_mm["linear"],
            known_mm=mean_mm["known"],
            detected_mm=mean_mm["detected"],
            known_over_linear=mean_mm["known"] / mean_mm["linear"],
            detected_over_linear=mean_mm["detected"] / mean_mm["linear"],
        )


def measure_animation_repair(
    data: Path | None,
    trials: int,
    seed: int = 0,
    progress: ProgressCallback = lambda _: None,
    kinds: tuple[str, ...] = tuple(ANIMATION_FAULT_INJECTORS),
) -> RepairReport:
    """Measure detection and repair of injected faults.

    Raises SceneError without trials, and ReadError if there is no motion in the folder.

    Args:
        data: Folder that contains test.npz of recorded motion; None for composed motion.
        trials: Number of motions.
        kinds: Of injected faults.
    """
    if trials < 1:
        raise SceneError(f"At least one trial is needed, not {trials}.")
    performances = list(_iterate_performances(data, trials))
    scores: dict[tuple[str, str], RepairScores] = {}
    alarms: dict[str, int] = {}
    changed_shares: list[float] = []
    duration_s = 0.0
    for n, performance in enumerate(performances):
        progress(f"{performance.name}, {n + 1} of {len(performances)}")
        duration_s += performance.motion.frame_count / performance.rate_hz
        for fault in _detect_faults(performance.motion, performance.rate_hz):
            alarms[fault.kind] = alarms.get(fault.kind, 0) + 1
        for k, kind in enumerate(kinds):
            for m, duration_name in enumerate(FAULT_DURATION_RANGES_S):
                if (kind, duration_name) != SKIPPED_COMBINATION:
                    rng = np.random.default_rng([seed, n, k, m])
                    own_scores = scores.setdefault((kind, duration_name), RepairScores())
                    changed_shares.append(_score_trial(performance, kind, duration_name, rng, own_scores))
    rows: dict[str, dict[str, RepairRow]] = {}
    for (kind, duration_name), own_scores in scores.items():
        if own_scores.errors_m["linear"]:
            rows.setdefault(kind, {})[duration_name] = own_scores.summarise()
    return RepairReport(
        rows=rows,
        pooled={duration_name: _pool_scores(scores, duration_name) for duration_name in FAULT_DURATION_RANGES_S},
        alarms_per_minute={kind: SECONDS_PER_MINUTE * count / duration_s for kind, count in sorted(alarms.items())},
        changed_share=float(np.mean(changed_shares)),
    )


def _pool_scores(scores: dict[tuple[str, str], RepairScores], duration_name: str) -> dict[str, float]:
    """Return the ratios to the error of interpolation over all faults of a duration."""
    selected = [own_scores for (_, own_duration), own_scores in scores.items() if own_duration == duration_name]
    sums = {repair: sum(sum(each.errors_m[repair]) for each in selected) for repair in COMPARED_REPAIRS}
    return {repair: sums[repair] / sums["linear"] for repair in COMPARED_REPAIRS[1:]} if sums["linear"] else {}


def _iterate_performances(data: Path | None, count: int) -> Iterator[PerformedMotion]:
    """Yield motions: composed ones, or recordings that are spread evenly over the test set."""
    if data is None:
        for n in range(count):
            subject = draw_subject(np.random.default_rng(n), asymmetric=True)
            motion = motions.compose_motion(subject, COMPOSED_MOTION_DURATION_S + n, TRAINING_RATE_HZ)
            yield PerformedMotion(motion, TRAINING_RATE_HZ, f"composed {n + 1}")
        return
    recordings = read_performed_motions(Path(data) / "test.npz")
    long = [each for each in recordings if each.motion.frame_count >= MIN_MOTION_DURATION_S * each.rate_hz]
    for index in np.unique(np.linspace(0, len(long) - 1, min(count, len(long))).astype(int)):
        yield long[index]


def _detect_faults(motion: Motion, rate: float) -> list[Fault]:
    names = load_cmu31_body().skeleton.names
    return detect_pose_faults(names, motion.root_position, motion.local_rotations, ["ZYX"] * len(names), rate)


@cache
def load_shipped_autoencoder() -> PoseModel:
    """Return the pose prior that is used by default."""
    return load_pose_model("autoencoder", load_cmu31_body().skeleton)


def _score_trial(
    performance: PerformedMotion, kind: str, duration_name: str, rng: np.random.Generator, scores: RepairScores
) -> float:
    """Add the errors of the faults injected into a motion to the scores. Returns the share of sound values that changed."""
    skeleton, truth, rate = load_cmu31_body().skeleton, performance.motion, performance.rate_hz
    damaged, injected = inject_animation_faults(truth, skeleton, rate, kind, duration_name, rng)
    if not injected:
        return 0.0
    joint_count, detected_faults = len(skeleton.names), _detect_faults(damaged, rate)
    known_faults = [fault for each in injected for fault in build_expected_faults(each, joint_count)]
    poses = skeleton.parents, damaged.root_position, damaged.local_rotations, ["ZYX"] * joint_count
    conditioner = PriorConditioner(load_shipped_autoencoder, 1.0, predict_shipped_gap)
    known, detected = (repair_animation(*poses, faults, rate, conditioner) for faults in (known_faults, detected_faults))
    positions = {
        "linear": _compute_joint_positions(*interpolate_faults(damaged.root_position, damaged.local_rotations, injected)),
        "known": _compute_joint_positions(known.root_position, known.local_rotations),
        "detected": _compute_joint_positions(detected.root_position, detected.local_rotations),
    }
    expected = _compute_joint_positions(truth.root_position, truth.local_rotations)
    is_sound = np.ones(detected.method.shape, bool)
    for each in injected:
        frames = slice(each.first, each.last + 1)
        tracks = [track for fault in build_expected_faults(each, joint_count) for track in fault.markers]
        is_sound[frames, tracks] = False
        scores.detected_count += any(
            fault.first <= each.last and each.first <= fault.last and not set(tracks).isdisjoint(fault.markers)
            for fault in detected_faults
        )
        for repair, found in positions.items():
            error_m = np.linalg.norm(found[frames] - expected[frames], axis=-1).mean()
            scores.errors_m[repair].append(float(error_m))
    return float((detected.method != RepairMethod.UNCHANGED)[is_sound].mean())


def build_expected_faults(injected: InjectedAnimationFault, joint_count: int) -> list[Fault]:
    """Return an injected fault as detection would return it."""
    kind = DETECTED_KIND[injected.kind]
    if kind == "jitter":
        return [Fault(kind, joint, injected.first, injected.last, INJECTED_JITTER_SD_RAD, "") for joint in injected.joints]
    if kind == "spike":
        tracks = (joint_count,)
    elif len(injected.joints) == joint_count:
        tracks = (*injected.joints, joint_count)
    else:
        tracks = injected.joints
    return [Fault(kind, tracks[0], injected.first, injected.last, np.nan, "", 1.0, tracks[1:])]


def interpolate_faults(
    root_position: Float[np.ndarray, "T 3"], local_rotations: Float[np.ndarray, "T J 3 3"], injected: list[InjectedAnimationFault]
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T J 3 3"]]:
    """Interpolate from the last frame before each fault to the first after it: rotations spherically, the position linearly."""
    root_position, local_rotations = root_position.copy(), local_rotations.copy()
    for fault in injected:
        span = FrameSpan(fault.first, fault.last, TRAINING_RATE_HZ)
        is_sound = exclude_span(np.ones(len(root_position), bool), span)
        for joint in fault.joints if fault.kind != "root offset" else ():
            local_rotations[span.frames, joint] = interpolate_linearly(local_rotations[:, joint], is_sound, span)
        if fault.kind == "root offset" or len(fault.joints) == local_rotations.shape[1]:
            root_position[span.frames] = interpolate_linearly(root_position, is_sound, span)
    return root_position, local_rotations


def _compute_joint_positions(
    root_position: Float[np.ndarray, "T 3"], local_rotations: Float[np.ndarray, "T J 3 3"]
) -> Float[np.ndarray, "T J 3"]:
    tree = kinematics.build_kinematic_tree(load_cmu31_body().skeleton)
    return kinematics.compute_tree_poses(tree, np.ascontiguousarray(root_position), np.ascontiguousarray(local_rotations))[0]
