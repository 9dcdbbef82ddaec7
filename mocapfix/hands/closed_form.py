"""The poses of a hand in closed form from points on it: HybrIK on the tree of the hand, each frame by itself.

The palm is registered to the wrist and the knuckles. Then each joint is swung, from the place that it obtained, to the points at
the end of its segment (HybrIK's Algorithm 2). Fingers have hinges: the twist of a joint is near zero, and turns the plane in
which the next joint bends towards the points beyond. The saddle joint of the thumb pronates as it opposes: its twist follows
from its swing, by the hand's prior.
"""

import numpy as np
from jaxtyping import Float

from mocapfix.hands.calibrated_hand import PALM_LEVER_M, CalibratedHand, PalmPath
from mocapfix.hands.hand_model import HAND_JOINTS, RAY_ROOTS, HandModel
from mocapfix.solve.hybrik import (
    BonePoint,
    HybrikVariant,
    pack_bones,
    pack_root_points,
    register_root,
    solve_hybrik_tree,
)
from mocapfix.solve.kinematics import Poses
from mocapfix.stats.rigid_alignment import compute_rotations


def pose_in_closed_form(
    hand: CalibratedHand, points: Float[np.ndarray, "T K 3"], palm: PalmPath, variant: HybrikVariant = "adaptive"
) -> Poses:
    """Return the poses of frames that are independent of each other; joints without points beyond them have the mean pose.

    Args:
        points: The markers of the hand in metres, NaN where unknown.
        palm: What the body says of the palm; its wrist and axes are points beside those of the hand.
        variant: "adaptive", or "naive" for comparison.
    """
    skeleton, (joints, offsets) = hand.model.skeleton, hand.attachment
    count, mean = len(skeleton.names), skeleton.rest_rotations.copy()
    mean[HAND_JOINTS] = mean[HAND_JOINTS] @ compute_rotations(hand.model.prior.mean_vectors[HAND_JOINTS])
    carriers = hand.markers.turning_joints
    of_bones: list[list[BonePoint]] = [[] for _ in skeleton.names]
    for k, (joint, offset) in enumerate(zip(joints.tolist(), offsets, strict=True)):
        place = offset
        while joint != carriers[k]:  # up to the palm across the root of a ray
            place, joint = skeleton.offsets[joint] + mean[joint] @ place, skeleton.parents[joint]
        of_bones[joint].append(BonePoint(count + k, place, True, 0.0))
    root_points, of_bones[0] = of_bones[0], []
    for joint in HAND_JOINTS[np.isin(HAND_JOINTS, skeleton.parents)]:
        child = joint + 1  # a hinge
        for point in [each for each in of_bones[child] if each.is_child]:
            variance = (hand.model.prior.axis_sd_rad[child, 1] * np.linalg.norm(point.rest_position)) ** 2
            place = skeleton.offsets[child] + mean[child] @ point.rest_position
            of_bones[joint].append(BonePoint(point.point_index, place, False, float(variance)))
    root, rest = hand.place_palm(palm)
    axes = root[:, None] + PALM_LEVER_M * rest[:, 0].swapaxes(-1, -2)
    root_points += [BonePoint(count + len(joints) + axis, PALM_LEVER_M * np.eye(3)[axis], False, 0.0) for axis in range(3)]
    every, is_centre = np.full((len(points), count, 3), np.nan), joints != carriers
    every[:, joints[is_centre]] = points[:, is_centre]
    every = np.concatenate([every, points, axes], axis=1)
    variance = np.ones(every.shape[:2])
    variance[:, count:-3] = hand.marker_sd_m**2
    variance[:, -3:] = (palm.sd_m**2 + (PALM_LEVER_M * palm.sd_rad) ** 2)[:, None]
    root, rotation, _ = register_root(pack_root_points(root_points), every, variance, True)
    local = np.tile(mean, (len(points), 1, 1, 1))
    local[:, 0] = rotation
    twists = np.zeros((len(points), count, 2))
    twists[:, HAND_JOINTS, 0] = hand.model.prior.axis_sd_rad[HAND_JOINTS, 0] ** -2.0
    thumb = RAY_ROOTS[0] + 1
    place = root + (local[:, 0] @ skeleton.offsets[RAY_ROOTS[0]])
    aim = ((every[:, thumb + 1] - place)[:, None] @ local[:, 0] @ mean[RAY_ROOTS[0]])[:, 0]
    twists[:, thumb] = predict_saddle_twist(hand.model, aim)
    bones = pack_bones(skeleton, of_bones, np.zeros(count, bool), np.full(count, -1))
    solve_hybrik_tree(bones, (every, variance, twists), (root, local), variant)
    return root, local


def predict_saddle_twist(model: HandModel, aim: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 2"]:
    """Return cosine and sine, times the information, of the twist of the thumb's saddle joint.

    Args:
        aim: The direction of the thumb's first bone in the axes of its ray; NaN where unknown, for the mean twist.
    """
    joint, prior = RAY_ROOTS[0] + 1, model.prior
    along = model.skeleton.offsets[joint + 1] / np.linalg.norm(model.skeleton.offsets[joint + 1])
    modes = prior.components[:, joint]
    covariance = modes.T @ modes + np.diag(prior.axis_sd_rad[joint] ** 2)
    gain = covariance[0, 1:] @ np.linalg.inv(covariance[1:, 1:])
    axis = np.cross(along, aim)
    sine = np.linalg.norm(axis, axis=1)
    turn = axis * (np.arctan2(sine, aim @ along) / np.maximum(sine, 1e-12))[:, None]
    beside = np.nan_to_num(turn[:, 1:] - prior.mean_vectors[joint, 1:])
    twist = (prior.mean_vectors[joint, 0] + beside @ gain) * along[0]
    return np.stack([np.cos(twist), np.sin(twist)], axis=1) / (covariance[0, 0] - gain @ covariance[1:, 0])
