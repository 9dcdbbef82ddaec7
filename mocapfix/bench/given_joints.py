"""MNN-IK's test (4.2): the places of a few joints, chosen at random, are given; how near comes the whole pose?

As there, poses stand at the origin without heading, and are solved from the mean pose. All priors are given the same joints
of the same poses. The error of a pose is the mean over its 31 joints; the paper does not say of what its deviations are, here
they are those of the poses' errors about their mean.
"""

import time
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.bench import compared_priors
from mocapfix.bench.compared_priors import ComparedPrior, ComparedPriors, JointTask, PlacedPoses, build_joint_task
from mocapfix.report.stage_timer import ProgressCallback

# MERGED: mocapfix.bench.given_joints
GIVEN_JOINT_COUNTS = (6, 8, 10, 15)
GIVEN_JOINT_SD_M = 0.005  # metres: how sure a given place is said to be


def measure_given_joints(
    rotations: np.ndarray, priors: ComparedPriors, reference_rotations: np.ndarray, sets_per_pose: int, progress: ProgressCallback
) -> dict:
    """-> number of joints given: prior: `row`, of poses (N, J, 3, 3), each solved `sets` times, from other joints each time."""
    said = {}
    for count in GIVEN_JOINT_COUNTS:
        task = build_joint_task(
            np.concatenate([rotations] * sets_per_pose),
            draw_given_joints(sets_per_pose * len(rotations), rotations.shape[1], count),
            GIVEN_JOINT_SD_M,
        )
        said[str(count)] = {}
        for name, model in priors.items():
            progress(f"{count} joints given, {name}")
            said[str(count)][name] = summarise_pose_errors(
                *compute_pose_errors(task, compared_priors.solve_joint_task(task, model, task.build_start(reference_rotations)))
            )
    return said


def draw_given_joints(pose_count: int, joint_count: int, given_count: int) -> np.ndarray:
    """-> (N, J) bool: `count` joints of each pose, always the same."""
    order = np.random.default_rng(given_count).random((pose_count, joint_count)).argsort(axis=1)
    return order < given_count


def compute_pose_errors(task: JointTask, solution: compared_priors.PlacedPoses) -> tuple[np.ndarray, np.ndarray]:
    """-> (N,) metres and (N,) radians: how far joints are from their places, and turns from the truth's, mean over joints."""
    true = compared_priors.place_known_poses(task.skeleton, np.zeros((len(task.true_rotations), 3)), task.true_rotations)
    far = np.linalg.norm(solution.joint_positions - true.joint_positions, axis=2).mean(axis=1)
    turn = np.swapaxes(task.true_rotations, 2, 3) @ solution.rotations
    return far, Rotation.from_matrix(turn.reshape(-1, 3, 3)).magnitude().reshape(turn.shape[:2]).mean(axis=1)


def summarise_pose_errors(position_error_m: np.ndarray, rotation_error_rad: np.ndarray) -> dict[str, float]:
    """-> means and deviations over poses, of errors (N,) in metres and radians."""
    millimetres, degrees = 1e3 * position_error_m, np.degrees(rotation_error_rad)
    return {
        "position_mm": float(millimetres.mean()),
        "rotation_deg": float(degrees.mean()),
        "position_sd": float(millimetres.std()),
        "rotation_sd": float(degrees.std()),
    }


def compute_improvements(results: dict, name: str) -> dict[str, dict[str, float]]:
    """-> other prior: by how many percent `name` is better than it."""
    others = [other for other in next(iter(results.values())) if other != name]
    keys = {"position_percent": "position_mm", "rotation_percent": "rotation_deg"}
    return {
        other: {percent: compute_improvement_percent(results, name, other, key) for percent, key in keys.items()}
        for other in others
    }


def compute_improvement_percent(results: dict, name: str, other: str, key: str) -> float:
    """-> percent, the mean over the numbers of joints given (as MNN-IK counts its 25 and 39 %, 4.2)."""
    return 100 * float(np.mean([1 - rows[name][key] / rows[other][key] for rows in results.values()]))


# MERGED: mocapfix.bench.iterations
# How the errors fall as the solve goes on: MNN-IK's Figure 5, and how near each prior comes after how many iterations.
CURVE_JOINT_COUNT = 10  # joints
MAX_SHOWN_ITERATIONS = 25  # iterations shown


def measure_iterations(
    rotations: np.ndarray, priors: ComparedPriors, reference_rotations: np.ndarray, name: str, progress: ProgressCallback
) -> dict:
    """-> the means over poses (N, J, 3, 3) as the solve goes on: it is stopped after 0, 1, ... iterations.

    A network is asked between rounds of several, and a later round is not stopped; hence `iterations`.

    iterations   prior: how many had been spent
    position_mm  prior: error of the joints
    cost         of the solve under the prior `name`: the `total`, and what of it the `given` joints and the `prior` have
    """
    task = build_joint_task(rotations, draw_given_joints(len(rotations), rotations.shape[1], CURVE_JOINT_COUNT), GIVEN_JOINT_SD_M)
    said = {"iterations": {}, "position_mm": {}}
    for each, model in priors.items():
        progress(f"iterations, {each}")
        way = [
            compared_priors.solve_joint_task(task, model, task.build_start(reference_rotations), most)
            for most in range(MAX_SHOWN_ITERATIONS + 1)
        ]
        said["iterations"][each] = [float(found.iterations.mean()) for found in way]
        said["position_mm"][each] = [1e3 * float(compute_pose_errors(task, found)[0].mean()) for found in way]
        if each == name:
            said["cost"] = compute_iteration_costs(task, way)
    return said


def compute_iteration_costs(task: JointTask, solutions: list[PlacedPoses]) -> dict[str, list[float]]:
    """-> half the sum of squares in standard deviations, of a pose after each iteration."""
    totals = np.array([found.cost.mean() for found in solutions])
    given = np.array([compute_fit_costs(task, found).mean() for found in solutions])
    return {"total": totals.tolist(), "given": given.tolist(), "prior": (totals - given).tolist()}


def compute_fit_costs(task: JointTask, solution: PlacedPoses) -> np.ndarray:
    """-> (N,) how far the given joints are from their places."""
    away = np.where(task.is_given[..., None], solution.joint_positions - task.given_positions, 0.0) / task.sd_m
    return 0.5 * (away**2).sum(axis=(1, 2))


# MERGED: mocapfix.bench.speed
# How many frames a second a prior poses on all cores, of frames that need it: GIVEN joints of 31, each frame for itself.
SPEED_JOINT_COUNT = 10  # joints
SPEED_ROUNDS = 3  # of which the fastest counts, for other programs slow it
START_ROTATION_SD_RAD, START_POSITION_SD_M = (
    0.15,
    0.03,
)  # radians and metres per axis: how far from a pose its course through time starts it


def measure_prior_speed(
    rotations: np.ndarray, model: ComparedPrior, reference_rotations: np.ndarray, progress: ProgressCallback
) -> dict[str, float]:
    """-> `fps` of poses (N, J, 3, 3) from a start as a course through time gives it, and `fps_from_mean_pose`."""
    progress("frames a second")
    task, rng = (
        build_joint_task(rotations, draw_given_joints(len(rotations), rotations.shape[1], SPEED_JOINT_COUNT), GIVEN_JOINT_SD_M),
        np.random.default_rng(0),
    )
    turned = (
        Rotation.from_rotvec(rng.normal(0, START_ROTATION_SD_RAD, (rotations[..., 0, 0].size, 3)))
        .as_matrix()
        .reshape(rotations.shape)
    )
    starts = {
        "fps": (rng.normal(0, START_POSITION_SD_M, (len(rotations), 3)), turned @ rotations),
        "fps_from_mean_pose": task.build_start(reference_rotations),
    }
    spent = {
        name: min(time_rounds(lambda s=start: compared_priors.solve_joint_task(task, model, s), SPEED_ROUNDS))
        for name, start in starts.items()
    }
    return {name: len(rotations) / least for name, least in spent.items()}


def time_rounds(call: Callable[[], object], rounds: int) -> list[float]:
    """-> what it took each time; it is called once before, for what is only done the first time."""
    call()
    spent = []
    for _ in range(rounds):
        started = time.perf_counter()
        call()
        spent.append(time.perf_counter() - started)
    return spent
