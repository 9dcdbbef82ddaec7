"""The pose problem of a film: keypoints in the images of a scaled orthographic camera (MNN-IK, Eq. 5.2), and a pose prior.

The scale of the camera is estimated too. HybrIK-X (Eqs. 21-22) alternates: a pose for the scale, then the scale in closed form,
by least squares over the image of that pose. As a pose can lean towards the camera or away from it until it fits nearly any
scale that is large enough, the alternation converges slowly. Its fixed point, the scale that reproduces itself, is found by the
secant method instead.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.terms import ReprojectionTerm, TrackingTerm
from mocapfix.keypoints.keypoint_file import KeypointDetector
from mocapfix.model.skeleton import Skeleton
from mocapfix.solve.kinematics import build_kinematic_tree, compute_tree_poses
from mocapfix.solve.pose_prior import PoseModel
from mocapfix.solve.pose_solver import PoseSolution, solve_poses
from mocapfix.solve.single_pose import Camera

SCALE_TOLERANCE = 2e-3  # of the scale's logarithm: a smaller step ends the search
MAX_SCALE_STEP = 0.2  # of the scale's logarithm
MAX_SCALE_EVALUATIONS = 12
MIN_DAMPING_SLOPE = 0.05  # least slope of the secant method, for scales that nearly reproduce any scale
MIN_WEIGHT = 1e-300  # of a frame, by which a mean is divided


def build_camera(rotation: Float[np.ndarray, "3 3"], scale_px_m: float, origin_px: Float[np.ndarray, "2"]) -> Camera:
    """Return a scaled orthographic camera.

    rotation    world to camera: x right, y down, z ahead
    scale_px_m  pixels per metre
    origin_px   the image of the world's origin
    """
    return Camera(rotation, (0.0, 0.0, 0.0), scale_px_m, origin_px, perspective=False)


def build_camera_rotation(pitch_down_rad: float) -> Float[np.ndarray, "3 3"]:
    """Return the rotation from world to camera of a camera that faces -Z, pitched down.

    It sees the front of a person who faces +Z.
    """
    sine, cosine = np.sin(pitch_down_rad), np.cos(pitch_down_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, -cosine, sine], [0.0, -sine, -cosine]])


def fit_camera_scale(
    flat: Float[np.ndarray, "T V 2"], position_px: Float[np.ndarray, "T V 2"], weight: Float[np.ndarray, "T V"]
) -> float:
    """Return pixels per metre: Eq. 22 in closed form, one for all frames, each frame's offset free; NaN without points.

    flat  metres: the points projected to the camera's image plane
    """
    a, b = subtract_weighted_mean(flat, weight), subtract_weighted_mean(position_px, weight)
    extent = (weight[..., None] * a * a).sum()
    return float((weight[..., None] * a * b).sum() / extent) if extent > 0 else np.nan


def subtract_weighted_mean(
    points: Float[np.ndarray, "*batch V 2"], weight: Float[np.ndarray, "*batch V"]
) -> Float[np.ndarray, "*batch V 2"]:
    """Return points relative to the weighted mean of their frame."""
    total = np.maximum(weight.sum(axis=-1), MIN_WEIGHT)[..., None]
    return points - ((weight[..., None] * points).sum(axis=-2) / total)[..., None, :]


def solve_camera_scale(estimate_scale: Callable[[float], float], initial_scale: float) -> float:
    """Return the fixed point estimate_scale(scale) = scale, by the secant method on logarithms.

    estimate_scale  the scale of Eq. 22 for the poses that are solved with a scale
    """
    log_scale = np.log(initial_scale)
    error = np.log(estimate_scale(initial_scale)) - log_scale
    step = np.clip(error, -MAX_SCALE_STEP, MAX_SCALE_STEP)
    for _ in range(MAX_SCALE_EVALUATIONS - 1):
        if abs(step) < SCALE_TOLERANCE:
            break
        log_scale, previous_error = log_scale + step, error
        error = np.log(estimate_scale(float(np.exp(log_scale)))) - log_scale
        slope = (error - previous_error) / step  # -1 if the estimate does not depend on the scale, 0 if it always equals it
        step = np.clip(error / max(-slope, MIN_DAMPING_SLOPE), -MAX_SCALE_STEP, MAX_SCALE_STEP)
    return float(np.exp(log_scale + step))


ROOT_POSITION_SD_M = 10.0  # of the root about its start, as an orthographic camera does not determine its distance
WIDE_ROBUST_SCALE_SD = 10.0  # Geman-McClure scale, in standard deviations: the weight of a keypoint farther away tends to zero
NARROW_ROBUST_SCALE_SD = 6.0  # likewise, of the final solve
MIN_KEYPOINT_CONFIDENCE = 0.1  # keypoints of less confidence are ignored


@dataclass(frozen=True)
class ReprojectionProblem:
    """T frames of keypoints, each solved independently.

    rotation          world to camera
    prior_scale       factor on the prior's standard deviations
    weight            1/m^2; 0 for a missing keypoint
    robust_scales_sd  in standard deviations, wide to narrow; the solve runs through them
    """

    skeleton: Skeleton
    detector: KeypointDetector
    model: PoseModel
    prior_scale: float
    rotation: Float[np.ndarray, "3 3"]
    position_px: Float[np.ndarray, "T V 2"]
    weight: Float[np.ndarray, "T V"]
    robust_scales_sd: tuple[float, ...] = (WIDE_ROBUST_SCALE_SD, NARROW_ROBUST_SCALE_SD)

    def select_frames(self, frames: Int[np.ndarray, " N"]) -> "ReprojectionProblem":
        """Return the problem of some frames, by index; an index may be repeated."""
        return replace(self, position_px=self.position_px[frames], weight=self.weight[frames])

    @property
    def tree(self) -> KinematicTree:
        return build_kinematic_tree(self.skeleton)

    def solve(
        self,
        scale_px_m: float,
        root: Float[np.ndarray, "T 3"],
        local: Float[np.ndarray, "T J 3 3"],
        tracking: TrackingTerm | None = None,
    ) -> PoseSolution:
        """Return the solved poses for a camera scale, from the poses root and local, which are tracked weakly by default."""
        d, joints = self.detector, len(self.skeleton.names)
        reprojection = ReprojectionTerm(
            d.joints, d.offsets, np.zeros(len(d.joints), int), self.rotation[None], np.zeros((1, 3)), np.zeros(1, bool),
            np.ascontiguousarray(self.position_px / scale_px_m), self.weight,
        )  # fmt: skip
        near_start = TrackingTerm(np.zeros((1, joints, 3, 3)), np.zeros((1, joints)), root, np.full(1, ROOT_POSITION_SD_M**-2))
        terms = (reprojection, tracking or near_start)
        scales2 = np.array(self.robust_scales_sd) ** 2
        return solve_poses(self.tree, terms, self.model, root, local, prior_scale=self.prior_scale, squared_robust_scales=scales2)

    def compute_positions(
        self, root: Float[np.ndarray, "T 3"], local: Float[np.ndarray, "T J 3 3"]
    ) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T V 3"]]:
        """Return the world positions of the joints and of the keypoints, in metres."""
        joints, rotations = compute_tree_poses(self.tree, root, local)
        return joints, self.detector.compute_point_positions(joints, rotations)

    def project_to_image_plane(self, positions: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Return world positions in the camera's x and y axes, in metres."""
        return positions @ self.rotation[:2].T

    def compute_robust_weights(self, scale_px_m: float, positions: Float[np.ndarray, "T V 3"]) -> Float[np.ndarray, "T V"]:
        """Return the keypoints' weights in 1/m^2, beside points at `positions`, at the solve's last robust scale."""
        error = self.position_px / scale_px_m - self.project_to_image_plane(positions)
        square = self.weight * (error**2).sum(axis=-1)
        return self.weight / (1 + square / self.robust_scales_sd[-1] ** 2) ** 2
