"""What an orthographic camera says of poses, under a model of poses: the problem that is solved again and again."""

from dataclasses import dataclass, replace

import numpy as np

from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.terms import ReprojectionTerm, TrackingTerm
from mocapfix.keypoints.detectors import KeypointDetector
from mocapfix.motion import Motion
from mocapfix.pose_prior.model import PoseModel
from mocapfix.skeleton import Skeleton
from mocapfix.solve import kinematics
from mocapfix.solve.pose_solver import PoseSolution, solve_poses

ROOT_POSITION_SD_M = (
    10.0  # metres: how far the root may be from where it starts; an orthographic camera does not tell its distance
)
WIDE_ROBUST_SCALE_SD, NARROW_ROBUST_SCALE_SD = (
    10.0,
    6.0,
)  # standard deviations: a keypoint farther from its point hardly counts (Geman-McClure)
MIN_KEYPOINT_CONFIDENCE = 0.1  # a confidence below which a keypoint is none


@dataclass(frozen=True)
class ReprojectionProblem:
    """T frames of keypoints, to be solved each for itself.

    rotation  (3, 3) world to camera
    strength  times the model's standard deviations
    pixels    (T, V, 2)
    weight    (T, V) 1/m^2; 0 where not seen
    robust    standard deviations beyond which a keypoint hardly counts, wide to narrow: one scale after the other
    """

    skeleton: Skeleton
    detector: KeypointDetector
    model: PoseModel
    prior_scale: float
    rotation: np.ndarray
    position_px: np.ndarray
    weight: np.ndarray
    robust_scales_sd: tuple[float, ...] = (WIDE_ROBUST_SCALE_SD, NARROW_ROBUST_SCALE_SD)

    def select_frames(self, frames: np.ndarray) -> "ReprojectionProblem":
        """-> some of the frames alone, by index, also more than once."""
        return replace(self, position_px=self.position_px[frames], weight=self.weight[frames])

    @property
    def tree(self) -> KinematicTree:
        return kinematics.build_kinematic_tree(self.skeleton)

    def solve(self, scale: float, root: np.ndarray, local: np.ndarray, tracking: TrackingTerm | None = None) -> PoseSolution:
        """-> the poses at `scale` pixels per metre, from root (T, 3) and local (T, J, 3, 3), pulled to a course if given."""
        d, joints = self.detector, len(self.skeleton.names)
        views = ReprojectionTerm(
            d.joints, d.offsets, np.zeros(len(d.joints), int), self.rotation[None], np.zeros((1, 3)), np.zeros(1, bool),
            np.ascontiguousarray(self.position_px / scale), self.weight,
        )  # fmt: skip
        near = TrackingTerm(np.zeros((1, joints, 3, 3)), np.zeros((1, joints)), root, np.full(1, ROOT_POSITION_SD_M**-2))
        scales2 = np.array(self.robust_scales_sd) ** 2
        return solve_poses(
            self.tree,
            (views, tracking or near),
            self.model,
            root,
            local,
            prior_scale=self.prior_scale,
            squared_robust_scales=scales2,
        )

    def compute_positions(self, root: np.ndarray, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """-> joints (T, J, 3) and the detector's points (T, V, 3), in metres, in the world."""
        none, nothing = np.zeros(len(root), int), np.zeros((len(root), 0))
        joints, turns = kinematics.compute_world_poses(self.skeleton, Motion(root, local, none, none, nothing, nothing))
        return joints, self.detector.compute_point_positions(joints, turns)

    def project_to_image_plane(self, positions: np.ndarray) -> np.ndarray:
        """-> (..., 2) metres, of places (..., 3), as the camera's axes see them."""
        return positions @ self.rotation[:2].T

    def compute_robust_weights(self, scale: float, positions: np.ndarray) -> np.ndarray:
        """-> (T, V) in 1/m^2, how much each keypoint counts beside points (T, V, 3), as the solve counts it in the end."""
        square = self.weight * ((self.position_px / scale - self.project_to_image_plane(positions)) ** 2).sum(axis=-1)
        return self.weight / (1 + square / self.robust_scales_sd[-1] ** 2) ** 2
