"""The protocols of Learnable SMPLify (3.2.3): any pose refined (plug-in), a take followed frame after frame (sequential).

Both can be iterated (B.3): each further pass starts from the result of the pass before.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mocapfix.learned_ik.network import IkNetwork
from mocapfix.learned_ik.pose_transfer import build_transfer_tree, correct_poses, transfer_poses
from mocapfix.learned_ik.position_smoothing import smooth_positions
from mocapfix.skeleton import Skeleton
from mocapfix.solve.kinematics import Poses, build_kinematic_tree, compute_tree_poses

FIRST_SELECTED_FRAME = 60  # from this frame on, the published sequential protocol selects among three poses


@dataclass(frozen=True)
class PoseRegressor:
    """A network, applied to the poses of one skeleton.

    passes  number of evaluations for each frame
    """

    network: IkNetwork
    skeleton: Skeleton
    passes: int = 1

    def refine_poses(self, start: Poses, positions: Float[np.ndarray, "T J 3"], joint_sd: Float[np.ndarray, "T J"]) -> Poses:
        """Return poses, each from its own start pose.

        positions  of the joints in metres, NaN where unknown
        joint_sd   their standard deviations in metres per axis
        """
        tree, poses = build_transfer_tree(self.skeleton), start
        for _ in range(self.passes):
            transferred, features = transfer_poses(tree, poses, positions, joint_sd)
            poses = correct_poses(tree, poses[1], transferred, self.network.evaluate(features))
        return poses

    def refine_take(
        self, start: Poses, positions: Float[np.ndarray, "T J 3"], joint_sd: Float[np.ndarray, "T J"], rate_hz: float
    ) -> Poses:
        """Return the poses of a take, each from its own start pose, from joint positions smoothed over time."""
        return self.refine_poses(start, *smooth_positions(positions, joint_sd, rate_hz))

    def follow_take(
        self,
        first: Poses,
        positions: Float[np.ndarray, "T J 3"],
        joint_sd: Float[np.ndarray, "T J"],
        *,
        has_selector: bool = False,
    ) -> Poses:
        """Return the poses of all frames, each started from the frame before; the first one from `first` (one frame).

        has_selector  from FIRST_SELECTED_FRAME on, keep whichever has the least joint error: the prediction, a prediction from
                      the pose of the first frame, or a copy of the pose before. The published code does this.
        """
        root, local = np.empty(positions.shape[::2]), np.empty((*positions.shape[:2], 3, 3))
        current = first
        for t in range(len(positions)):
            given, sd = positions[t : t + 1], joint_sd[t : t + 1]
            predicted = self.refine_poses(current, given, sd)
            if has_selector and t >= FIRST_SELECTED_FRAME:
                restarted = self.refine_poses((root[:1], local[:1]), given, sd)
                candidates = (predicted, restarted, (given[:, 0], current[1]))
                errors = [self._compute_joint_error(each, given) for each in candidates]
                predicted = candidates[int(np.argmin(errors))]
            current = predicted
            root[t], local[t] = current[0][0], current[1][0]
        return root, local

    def _compute_joint_error(self, poses: Poses, positions: Float[np.ndarray, "T J 3"]) -> float:
        placed, _ = compute_tree_poses(build_kinematic_tree(self.skeleton), *poses)
        return float(np.nanmean(np.linalg.norm(placed - positions, axis=-1)))
