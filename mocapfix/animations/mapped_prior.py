"""The trained models of poses and motion, for the joints of an animation."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.animations import retarget
from mocapfix.animations.joint_mapping import find_ancestor
from mocapfix.animations.retarget import SkeletonAlignment
from mocapfix.kernels import quaternions
from mocapfix.motion_prior.gap_combination import GapContext, GapPrediction
from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve.prior_conditioner import PriorConditioner
from mocapfix.stats.transform_trees import compose_transforms


@dataclass(frozen=True, kw_only=True)
class MappedPriorConditioner(PriorConditioner):
    """Trained models of poses and motion, applied to the joints of a file, which are mapped to the model's 31 joints.

    parents    (J,) the tree of the file
    alignment  the model's joints in the file
    """

    parents: Int[np.ndarray, " J"]
    alignment: SkeletonAlignment

    def predict_gap(self, context: GapContext, joints: Int[np.ndarray, " L"]) -> GapPrediction | None:
        """As `PriorConditioner.predict_gap`, for joints of the file."""
        if self.predict_motion is None or self.alignment.file_joints[0] != 0:  # the root's position is that of the hips
            return None
        context, file_joints = context.crop(), self.alignment.file_joints
        _, world = compose_transforms(self.parents, np.zeros(context.local_rotations.shape[:3]), context.local_rotations)
        # A joint without a counterpart is known where the nearest joint above it that has one is known.
        is_mapped, parents = file_joints >= 0, self.alignment.skeleton.parents
        sources = [j if is_mapped[j] else find_ancestor(j, parents, is_mapped) for j in range(len(file_joints))]
        is_known = context.is_known[:, file_joints[sources]]
        model = context._replace(local_rotations=retarget.convert_rotations_to_cmu31(world, self.alignment), is_known=is_known)
        size_ratio = self.alignment.skeleton.total_length_m / load_cmu31_body().skeleton.total_length_m
        predicted = self.predict_motion(model, size_ratio)
        if predicted is None:
            return None
        file_rotations = context.local_rotations[context.frames].copy()
        variance = np.full(file_rotations.shape[:2], np.inf)
        for joint in np.flatnonzero((file_joints >= 0) & np.isin(file_joints, joints)).tolist():
            if np.isfinite(predicted.variance[:, joint]).all():
                rotations = retarget.compute_file_rotation(
                    self.parents, file_rotations, self.alignment, joint, predicted.rotations
                )
                file_rotations[:, file_joints[joint]], variance[:, file_joints[joint]] = rotations, predicted.variance[:, joint]
        return predicted._replace(rotations=file_rotations, variance=variance).select_joints(joints)

    def predict_rotations(
        self,
        local_rotations: Float[np.ndarray, "T J 3 3"],
        observed_joints: Int[np.ndarray, " O"],
        occluded_joints: Int[np.ndarray, " L"],
        frames: Int[np.ndarray, " N"],
        reference: Float[np.ndarray, "N Q"],
    ) -> Float[np.ndarray, "N Q"]:
        """As `PriorConditioner.predict_rotations`, for joints of the file; `reference` for joints without a counterpart."""
        file_joints = self.alignment.file_joints[1:]
        observed, occluded = (1 + np.flatnonzero(np.isin(file_joints, joints)) for joints in (observed_joints, occluded_joints))
        if not len(observed) or not len(occluded):
            return reference
        file_rotations = local_rotations[frames]
        _, world_rotations = compose_transforms(self.parents, np.zeros(file_rotations.shape[:3]), file_rotations)
        model_rotations = retarget.convert_rotations_to_cmu31(world_rotations, self.alignment)
        any_sign = np.ones((len(frames), 4 * len(occluded)))
        predicted = super().predict_rotations(model_rotations, observed, occluded, np.arange(len(frames)), any_sign)
        for i, joint in enumerate(occluded):
            model_rotations[:, joint] = Rotation.from_quat(predicted[:, 4 * i : 4 * i + 4]).as_matrix()
            file_rotations[:, self.alignment.file_joints[joint]] = retarget.compute_file_rotation(
                self.parents, file_rotations, self.alignment, int(joint), model_rotations
            )
        result = reference.reshape(len(frames), len(occluded_joints), 4).copy()
        for i, joint in enumerate(occluded_joints):
            if joint in self.alignment.file_joints[occluded]:
                all_frames = np.ones(len(frames), bool)
                joint_quaternions = 2 * quaternions.extract_joint_quaternions(file_rotations, int(joint), all_frames)
                is_opposite = (joint_quaternions * result[:, i]).sum(1, keepdims=True) < 0
                result[:, i] = np.where(is_opposite, -joint_quaternions, joint_quaternions)
        return result.reshape(reference.shape)
