"""What calibration may change of a body, and how far people, marker places and the poses of one take stray from it."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from mocapfix.calibrate.shape_responses import ShapeDeformations
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.skeleton import BodyModel, Skeleton
from mocapfix.subject import Subject

BODY_SIZE_SD = 1e3  # part of the size: free, since the take tells it better than anything
BONE_GROUP_SD = 0.05  # part of a bone group's length, left and right together: likeliest of each CMU subject, given the others
INDIVIDUAL_BONE_LENGTH_SD = (
    0.03  # part of a bone's length that it has for itself, left and right apart: CMU's subjects are that crooked
)
MEAN_POSE_SD_RAD = 0.02  # radians: so far a take's mean pose strays from people's about axes where none is known to
MIN_SCALED_BONE_LENGTH_M = 0.02  # metres: what is shorter is no bone


@dataclass(frozen=True)
class CalibrationParameters:
    """The shared unknowns (Q,): P of them along deformations, then the K markers' shifts (K, 3) in metres, then the take's mean
    pose: by how much the free joints below the root are turned from people's (F, 3), radians; all zero at first.

    offsets, places  (J, 3), (K, 3) metres: the body that is changed
    free             (J,) bool, joints that turn
    deformations     what changes with each of the P
    information      (Q, Q) the unknowns' inverse covariance about zero
    """

    offsets: np.ndarray
    marker_offsets: np.ndarray
    free_joints: np.ndarray
    deformations: ShapeDeformations
    information: np.ndarray

    def compute_body(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """-> offsets (J, 3) and places (K, 3) in metres, and the mean pose's turns (J, 3) in radians."""
        dense = len(self.deformations.marker_offsets)
        along, shifts, turned = np.split(unknowns, [dense, dense + self.marker_offsets.size])
        places = self.marker_offsets + np.tensordot(along, self.deformations.marker_offsets, 1) + shifts.reshape(-1, 3)
        turns = np.zeros_like(self.offsets)
        turns[np.flatnonzero(self.free_joints)[1:]] = turned.reshape(-1, 3)
        return self.offsets + np.tensordot(along, self.deformations.joint_offsets, 1), places, turns


def build_calibration_parameters(start: Subject, body: BodyModel, prior: MeanPosePrior) -> CalibrationParameters:
    """-> size, shape, scales of bone groups, each bone's own length and marker places of `start`, and the mean pose, free.

    start  `body` at some size; its spread is by how far people's markers lie from its places
    """
    offsets, places = start.skeleton.offsets, start.marker_offsets
    shapes = body.shape_components * np.linalg.norm(offsets) / np.linalg.norm(body.skeleton.offsets)
    groups = np.zeros((len(body.bone_groups), *offsets.shape))
    for g, joints in enumerate(map(list, body.bone_groups.values())):
        groups[g, joints] = offsets[joints]
    lengths = list_bones(start.skeleton)
    along = np.concatenate([offsets[None], shapes, groups, lengths])
    with_size = np.concatenate([places[None], np.zeros((len(along) - 1, *places.shape))])
    own = *[BONE_GROUP_SD] * len(groups), *[INDIVIDUAL_BONE_LENGTH_SD] * len(lengths)
    deviations = (BODY_SIZE_SD, *[1.0] * len(shapes), *own, *np.repeat(start.marker_spread, 3))
    habits = np.linalg.inv(prior.between_take_covariance[np.flatnonzero(body.free_joints)[1:]] + MEAN_POSE_SD_RAD**2 * np.eye(3))
    information = np.asarray(block_diag(np.diag(1 / np.square(deviations)), *habits))
    return CalibrationParameters(offsets, places, body.free_joints, ShapeDeformations(along, with_size), information)


def list_bones(skeleton: Skeleton) -> np.ndarray:
    """-> (B, J, 3) metres: the offsets of one bone each, as long as it is.

    Joints at the same offset from one parent hang on one bone: the thorax carries the neck and both shoulders.
    """
    offsets, found = skeleton.offsets, []
    for j in np.flatnonzero(np.linalg.norm(offsets, axis=1) > MIN_SCALED_BONE_LENGTH_M):
        same = (skeleton.parents == skeleton.parents[j]) & np.isclose(offsets, offsets[j]).all(1)
        if np.flatnonzero(same)[0] == j:
            found.append(np.where(same[:, None], offsets, 0.0))
    return np.array(found)
