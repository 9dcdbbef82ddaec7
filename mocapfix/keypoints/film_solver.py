"""Poses and camera of a film, from its keypoints alone (MNN-IK, 5.2; HybrIK-X, Eqs. 21-22).

One person and one camera: its scale is one for all frames, found on some of them by solving those anew for every scale that
is asked. At that scale each frame is solved from several headings, the likeliest course through the guesses is taken, and
all frames once more, pulled to that course made smooth.
"""

from dataclasses import replace

import numpy as np

from mocapfix.errors import TakeError
from mocapfix.keypoints import headings
from mocapfix.keypoints.camera_scale import KeypointCamera, fit_camera_scale, solve_camera_scale, subtract_weighted_mean
from mocapfix.keypoints.keypoint_file import Keypoints
from mocapfix.keypoints.reprojection_problem import MIN_KEYPOINT_CONFIDENCE, WIDE_ROBUST_SCALE_SD, ReprojectionProblem
from mocapfix.motion import Motion
from mocapfix.options import SolveOptions
from mocapfix.pose_prior.model import PoseModel
from mocapfix.skeleton import Skeleton
from mocapfix.solve import smoothing
from mocapfix.solve.pose_problem import PoseUncertainty
from mocapfix.solve.pose_solver import PoseSolution

MAX_SCALE_FRAMES = 16  # frames at most that tell the scale
MIN_KEYPOINTS_PER_FRAME = 4  # keypoints in a frame that does
SCALE_QUANTILE = 0.9  # of a film's frames look smaller than somebody who stands
FRAME_POSE_SD, MISSING_FRAME_POSE_SD = (
    0.1,
    10.0,
)  # radians, and metres: how far one frame's pose is wrong by itself; one in which nobody was found


def solve_film(
    keypoints: Keypoints, rate: float, skeleton: Skeleton, model: PoseModel, rotation: np.ndarray, prior_scale: float = 1.0
) -> tuple[Motion, KeypointCamera]:
    """-> the motion, the floor at a height of zero and the first frame's root over the origin, and the camera.

    rotation  (3, 3) world to camera, see camera.looking
    strength  times the model's standard deviations: with 2 it is believed half as much

    The camera's scale is as right as the skeleton's size: an image does not tell a tall person far away from a short one.

    Raises TakeError where the keypoints are too few, or not those of somebody upright, to tell it.
    """
    weight = np.where(keypoints.confidence < MIN_KEYPOINT_CONFIDENCE, 0.0, (keypoints.confidence / keypoints.detector.sd_m) ** 2)
    sight = ReprojectionProblem(skeleton, keypoints.detector, model, prior_scale, rotation, keypoints.position_px, weight)
    scale = estimate_camera_scale(sight)
    poses, _, cost = solve_headings(sight, scale)
    joints, _ = sight.compute_positions(poses.root_position, poses.local_rotations)
    count = keypoints.frame_count
    path = headings.find_cheapest_path(
        cost, headings.compute_transition_costs(joints.reshape(count, -1, *joints.shape[1:]), rate)
    )
    taken = np.arange(count) * cost.shape[1] + path
    smooth = smooth_film_poses(poses.root_position[taken], poses.local_rotations[taken], np.any(weight > 0, axis=1), rate)
    poses = sight.solve(scale, smooth.root, smooth.rotations, smooth)
    return move_to_floor(sight, poses, scale)


def estimate_camera_scale(problem: ReprojectionProblem) -> float:
    """-> pixels per metre that answer themselves: of the frames that show most, spread over the film."""
    shown = np.flatnonzero((problem.weight > 0).sum(axis=1) >= MIN_KEYPOINTS_PER_FRAME)
    if not len(shown):
        raise TakeError(
            f"In no frame are {MIN_KEYPOINTS_PER_FRAME} keypoints found with a confidence of {MIN_KEYPOINT_CONFIDENCE:g} and more: too few for a body."
        )
    few = problem.select_frames(shown[np.linspace(0, len(shown) - 1, min(MAX_SCALE_FRAMES, len(shown))).round().astype(int)])
    few = replace(
        few, robust_scales_sd=(WIDE_ROBUST_SCALE_SD,)
    )  # at a scale that is too small much lies far off, and must say so

    local = None

    def answer(scale: float) -> float:
        nonlocal local  # what one scale gave is near what the next will give
        poses, places, cost = solve_headings(few, scale, local)
        local = poses.local_rotations
        best = places.reshape(*cost.shape, *places.shape[1:])[np.arange(len(cost)), cost.argmin(axis=1)]
        return check_camera_scale(
            fit_camera_scale(few.project_to_image_plane(best), few.position_px, few.compute_robust_weights(scale, best))
        )

    return solve_camera_scale(answer, check_camera_scale(estimate_initial_scale(few)))


def check_camera_scale(scale: float) -> float:
    """-> the scale. Raises TakeError where it is none: by points in one place, or of somebody who stands on his head."""
    if not scale > 0:
        raise TakeError(
            "The keypoints tell no size of a body; do their pixels count to the right and down, from somebody upright?"
        )
    return scale


def estimate_initial_scale(problem: ReprojectionProblem) -> float:
    """-> pixels per metre, by the middle pose in the heading that looks largest: most poses are no larger than they stand."""
    _, places = problem.compute_positions(
        np.zeros((headings.HEADING_COUNT, 3)), headings.rotate_to_headings(problem.model.reference_rotations)
    )
    flat = problem.project_to_image_plane(places)
    scales = [
        max(fit_camera_scale(heading[None], pixels[None], weight[None]) for heading in flat)
        for pixels, weight in zip(problem.position_px, problem.weight, strict=True)
    ]
    return float(np.quantile(scales, SCALE_QUANTILE))


def solve_headings(
    problem: ReprojectionProblem, scale: float, local: np.ndarray | None = None
) -> tuple[PoseSolution, np.ndarray, np.ndarray]:
    """-> each frame's guesses, one frame's after another's, their points (T H, V, 3) in metres, and their costs (T, H).

    local  (T H, J, 3, 3) where to start; None for the middle pose, in all headings
    """
    count = len(problem.position_px)
    many = problem.select_frames(np.repeat(np.arange(count), headings.HEADING_COUNT))
    local = np.tile(headings.rotate_to_headings(problem.model.reference_rotations), (count, 1, 1, 1)) if local is None else local
    _, places = many.compute_positions(np.zeros((len(local), 3)), local)
    off = many.position_px / scale - many.project_to_image_plane(places)
    shift = (off - subtract_weighted_mean(off, many.weight))[:, 0]  # the mean, in every row
    root = shift @ many.rotation[:2]
    poses = many.solve(scale, root, local)
    _, places = many.compute_positions(poses.root_position, poses.local_rotations)
    return poses, places, poses.cost.reshape(count, -1)


def smooth_film_poses(root: np.ndarray, local: np.ndarray, is_visible: np.ndarray, rate: float):
    """-> the smooth course of poses (T, 3) and (T, J, 3, 3), as a pull; frames not seen (T,) lie on it."""
    frames, joints = local.shape[:2]
    variance = np.where(is_visible, FRAME_POSE_SD, MISSING_FRAME_POSE_SD) ** 2
    known = PoseUncertainty(np.zeros((frames, 0)), np.zeros((frames, joints)), np.repeat(variance[:, None], joints, 1), variance)
    return smoothing.smooth_poses(root, local.copy(), known, np.ones(joints, bool), rate, SolveOptions())


def move_to_floor(problem: ReprojectionProblem, poses: PoseSolution, scale: float) -> tuple[Motion, KeypointCamera]:
    """-> the motion moved so that the lowest joint is at zero height and the first root over the origin; its camera with it."""
    joints, _ = problem.compute_positions(poses.root_position, poses.local_rotations)
    origin = np.array([poses.root_position[0, 0], joints[..., 1].min(), poses.root_position[0, 2]])
    none, unknown = np.zeros((len(joints), 0)), np.full(joints.shape[:2], np.nan)
    motion = Motion(poses.root_position - origin, poses.local_rotations, poses.status, poses.iterations, none, unknown)
    return motion, KeypointCamera(problem.rotation, scale, scale * problem.project_to_image_plane(origin))
