"""The pose problem of a film: keypoints in the images of an orthographic camera, and a pose prior."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.terms import ReprojectionTerm, TrackingTerm
from mocapfix.keypoints.detectors import KeypointDetector
from mocapfix.pose_prior.model import PoseModel
from mocapfix.skeleton import Skeleton
from mocapfix.solve.kinematics import build_kinematic_tree, compute_tree_poses
from mocapfix.solve.pose_solver import PoseSolution, solve_poses

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
