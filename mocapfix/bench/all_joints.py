"""What a prior does where it is not needed: all joints' places are given.

It should leave the places where they are; with noise on them, not make them worse; and turn each bone about itself as people
do, of which places say nothing.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.bench import compared_priors
from mocapfix.bench.compared_priors import ComparedPriors, PlacedPoses, build_joint_task
from mocapfix.report.stage_timer import ProgressCallback
from mocapfix.skeleton import Skeleton

ALL_JOINTS_SD_M = 0.003  # metres per axis: the noise, and how sure a place is said to be
MIN_TWIST_BONE_LENGTH_M = 0.01  # metres: two joints nearer to one another have no bone between them


def measure_all_joints(
    rotations: np.ndarray, priors: ComparedPriors, reference_rotations: np.ndarray, progress: ProgressCallback
) -> dict[str, dict[str, float]]:
    """-> prior: what it changes, of poses (N, J, 3, 3).

    bias_mm    how far it moves joints whose places are given exactly, from where they are without it
    noisy_mm   how far joints are from the truth whose given places are off by SD along each axis
    twist_deg  how far bones are turned about themselves from the truth, the places given exactly
    """
    every, noise = (
        np.ones(rotations.shape[:2], bool),
        np.random.default_rng(0).normal(0, ALL_JOINTS_SD_M, (*rotations.shape[:2], 3)),
    )
    exact, noisy, said = (
        build_joint_task(rotations, every, ALL_JOINTS_SD_M),
        build_joint_task(rotations, every, ALL_JOINTS_SD_M, noise),
        {},
    )
    truth = compared_priors.place_known_poses(exact.skeleton, np.zeros((len(rotations), 3)), rotations)
    alone = None
    for name, model in priors.items():
        progress(f"all joints given, {name}")
        found, shaken = (
            compared_priors.solve_joint_task(task, model, task.build_start(reference_rotations)) for task in (exact, noisy)
        )
        alone = alone or found  # the first on the shelf is no prior
        said[name] = {
            "bias_mm": compute_joint_distance_mm(found, alone),
            "noisy_mm": compute_joint_distance_mm(shaken, truth),
            "twist_deg": float(np.degrees(compute_bone_twist_errors(exact.skeleton, found, truth).mean())),
        }
    return said


def compute_joint_distance_mm(first: PlacedPoses, second: PlacedPoses) -> float:
    """-> mm, the mean distance of the joints."""
    return 1e3 * float(np.linalg.norm(first.joint_positions - second.joint_positions, axis=2).mean())


def compute_bone_twist_errors(skeleton: Skeleton, solution: PlacedPoses, truth: PlacedPoses) -> np.ndarray:
    """-> (N, B) radians: how far each bone is turned about its own direction.

    A bone is a joint with one child: two children tell how it is turned, and of a joint with none there is no direction.
    """
    bones, children = find_twist_bones(skeleton)
    along = truth.joint_positions[:, children] - truth.joint_positions[:, bones]
    along /= np.linalg.norm(along, axis=2, keepdims=True)
    turn = solution.world_rotations[:, bones] @ np.swapaxes(truth.world_rotations[:, bones], 2, 3)
    quaternions = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_quat().reshape(*along.shape[:2], 4)
    angle = 2 * np.arctan2((quaternions[..., :3] * along).sum(axis=2), quaternions[..., 3])
    return np.abs((angle + np.pi) % (2 * np.pi) - np.pi)


def find_twist_bones(skeleton: Skeleton) -> tuple[np.ndarray, np.ndarray]:
    """-> joints that have one child only, some way off, and those children."""
    only = [(j, kids[0]) for j in range(len(skeleton.names)) if len(kids := np.flatnonzero(skeleton.parents == j)) == 1]
    bones, children = np.array([(j, kid) for j, kid in only if np.linalg.norm(skeleton.offsets[kid]) > MIN_TWIST_BONE_LENGTH_M]).T
    return bones, children
