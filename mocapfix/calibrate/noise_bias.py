"""The bias of a calibration that the motion of skin causes, estimated by calibrating from simulated markers and removed.

The poses of all frames are fitted together with the body, and absorb a part of the markers' noise: a hand with one marker seems
to turn more than it does, and its bone becomes too short. The bias does not shrink with more frames (Neyman & Scott 1948,
"Consistent estimates based on partially consistent observations"). It is the mean change of the calibration by noise, here by
noise and its opposite, so that what is linear in the noise cancels (indirect inference, Gourieroux, Monfort & Renault 1993).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from mocapfix.calibrate.calibration_frames import CalibrationFrames
from mocapfix.calibrate.calibration_uncertainty import estimate_residual_sd
from mocapfix.calibrate.joint_calibration import JointCalibration, calibrate_jointly
from mocapfix.calibrate.refinement import RefinementState
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.skeleton import BodyModel
from mocapfix.solve.kinematics import compute_tree_poses


def remove_noise_bias(
    calibration: JointCalibration,
    takes: Sequence[CalibrationFrames],
    places: Int[np.ndarray, "T K"],
    body: BodyModel,
    prior: MeanPosePrior,
) -> JointCalibration:
    """Return a calibration without the bias by noise of the size of its residuals."""
    predicted = [predict_frame_markers(state) for state in calibration.states]
    distance = np.concatenate(
        [np.linalg.norm(take.markers - markers, axis=-1) for take, markers in zip(takes, predicted, strict=True)]
    )
    is_free = calibration.states[0].problem.tree.free
    noise_sd_m = estimate_residual_sd(distance, 3 + 3 * int(np.isin(np.flatnonzero(is_free), takes[0].joints).sum()))
    rng = np.random.default_rng(0)
    noise = [rng.normal(0, noise_sd_m, markers.shape) for markers in predicted]

    def calibrate_simulated(sign: int) -> JointCalibration:
        simulated = [
            replace(take, markers=np.where(np.isnan(take.markers), np.nan, markers + sign * each))
            for take, markers, each in zip(takes, predicted, noise, strict=True)
        ]
        return calibrate_jointly(simulated, places, body, prior, calibration)

    plus, minus, exact = (calibrate_simulated(sign) for sign in (1, -1, 0))
    skeleton, subject = calibration.subject.skeleton, calibration.subject

    def find_bias(values: list[np.ndarray]) -> np.ndarray:
        return (values[0] + values[1]) / 2 - values[2]

    each = (plus, minus, exact)
    offsets = skeleton.offsets - find_bias([one.subject.skeleton.offsets for one in each])
    placed = subject.marker_offsets - find_bias([one.subject.marker_offsets for one in each])
    of_take = calibration.marker_offsets - find_bias([one.marker_offsets for one in each])
    unbiased = replace(subject, skeleton=replace(skeleton, offsets=offsets), marker_offsets=placed)
    return replace(calibration, subject=unbiased, marker_offsets=of_take)


def predict_frame_markers(state: RefinementState) -> Float[np.ndarray, "N K 3"]:
    """Return where the calibrated body carries its markers, in metres."""
    position, rotation = compute_tree_poses(state.problem.tree, state.root_position, state.local_rotations)
    joints, offsets = state.problem.attachment
    return position[:, joints] + np.einsum("tkab,kb->tka", rotation[:, joints], offsets)
