"""A calibrated hand: the person's hand, its palm on the body and its markers, and the terms of its poses."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mocapfix.hands.finger_markers import FingerMarkers
from mocapfix.hands.hand_model import HAND_JOINTS, RAY_ROOTS, TIP_JOINTS, HandModel, HandPrior, load_hand
from mocapfix.model.subject import Subject
from mocapfix.solve.kinematics import Poses, compute_tree_poses
from mocapfix.solve.minimise import KernelTerms, SolverSettings, minimise
from mocapfix.solve.model_terms import LatentCodeTerm, PoseModelTerm, linearise_model_term
from mocapfix.solve.terms import (
    JointLimitTerm,
    KinematicTree,
    MarkerAttachment,
    TrackingTerm,
    build_joint_limit_term,
    build_marker_term,
)

MARKER_SD_M = 0.004  # per axis, of a finger marker about its place in one frame: skin, and joints that are no hinges
PALM_MARKER_SD_M = 0.005  # the same of a marker on the back of the hand
PALM_LEVER_M = 0.1  # a palm that is uncertain by this much is uncertain by a radian
ROBUST_SCALES_M = (0.1, 0.03)  # distances of a marker beyond which it is an outlier, at the start and at the end
POSE_ITERATIONS = 20  # of a frame at each robust scale
HAND_DAMPING_RATIO = 1e-6


class PalmPath(NamedTuple):
    """What the body says of the palm in T frames: the forearm carries the wrist, and the hand joint has the palm's axes.

    The body's hand joint lies in the forearm, where that turns, so that its position says less of a hand that bends at the wrist.
    """

    position: Float[np.ndarray, "T 3"]  # of the forearm's joint, metres
    rotation: Float[np.ndarray, "T 3 3"]  # of the forearm, in the world
    hand_rotation: Float[np.ndarray, "T 3 3"]
    sd_m: Float[np.ndarray, " T"]  # per axis, of the wrist
    sd_rad: Float[np.ndarray, " T"]  # of the palm

    def select_frames(self, frames: Int[np.ndarray, " N"]) -> "PalmPath":
        return PalmPath(*(each[frames] for each in self))


@dataclass(frozen=True)
class CalibratedHand:
    """One person's hand, the place of its palm on the body, and the markers on it.

    Attributes:
        model: The hand with its lengths; its prior is that of the take.
        palm_position: Metres: the wrist in the axes of the body's forearm.
        palm_rotation: Of the palm in the axes of the body's hand joint.
        markers: K markers: those of fingers, and those of the body that are on the back of the hand.
        marker_offsets: Metres: their places in the axes of their joints.
        point_sd_m: Per axis, of the 15 joints and five tips: what the errors of the calibration add to those of a frame.
    """

    model: HandModel
    palm_position: Float[np.ndarray, "3"]
    palm_rotation: Float[np.ndarray, "3 3"]
    markers: FingerMarkers
    marker_offsets: Float[np.ndarray, "K 3"]
    point_sd_m: Float[np.ndarray, "20"]

    @property
    def tree(self) -> KinematicTree:
        return KinematicTree(self.model.skeleton.parents, self.model.skeleton.offsets, self.model.free_joints)

    @property
    def attachment(self) -> MarkerAttachment:
        return MarkerAttachment(self.markers.markers.joints, self.marker_offsets)

    @property
    def subject(self) -> Subject:
        """The hand as a body with markers."""
        own = self.markers.markers
        return Subject(self.model.skeleton, own.name, own.labels, own.joints, self.marker_offsets, own.marker_spread)

    @property
    def marker_sd_m(self) -> Float[np.ndarray, " K"]:
        """The standard deviation per axis of each marker about its place in one frame."""
        return np.where(self.attachment.joints > 0, MARKER_SD_M, PALM_MARKER_SD_M)

    @property
    def length_m(self) -> float:
        """The length of the hand: that of the prior, in proportion to the bones of its middle finger."""
        middle = [RAY_ROOTS[2] + 1, RAY_ROOTS[2] + 2, RAY_ROOTS[2] + 3]
        own, usual = (
            np.linalg.norm(each.skeleton.offsets[middle], axis=1).sum() for each in (self.model, load_hand(self.model.side))
        )
        return self.model.length_m * float(own / usual)

    @cached_property
    def limits(self) -> JointLimitTerm:
        return build_joint_limit_term(self.model.limits, self.model.limit_sd_rad)

    def place_palm(self, palm: PalmPath) -> Poses:
        """Return the roots of hands, as the body carries them, in the pose of rest."""
        root = palm.position + palm.rotation @ self.palm_position
        local = np.tile(self.model.skeleton.rest_rotations, (len(root), 1, 1, 1))
        local[:, 0] = palm.hand_rotation @ self.palm_rotation
        return root, local

    def track_palm(self, palm: PalmPath) -> TrackingTerm:
        """Return the term that keeps the root at the palm, and no joint anywhere."""
        root, local = self.place_palm(palm)
        weight = np.zeros(local.shape[:2])
        weight[:, 0] = palm.sd_rad**-2.0
        return TrackingTerm(local, weight, root, palm.sd_m**-2.0)

    def build_terms(self, markers: np.ndarray, is_used: np.ndarray, tracking: TrackingTerm) -> KernelTerms:
        """Return the terms of frames without the prior. The tips are points that are not measured."""
        joints, offsets = self.attachment
        points = MarkerAttachment(np.concatenate([joints, TIP_JOINTS]), np.concatenate([offsets, self.model.tips]))
        tips = np.zeros((len(markers), len(TIP_JOINTS)), bool)
        measured = np.concatenate([markers, np.zeros((*tips.shape, 3))], axis=1)
        sd_m = np.append(self.marker_sd_m, np.ones(len(TIP_JOINTS)))
        return build_marker_term(points, measured, np.concatenate([is_used, tips], axis=1), sd_m), tracking, self.limits

    def compute_points(self, poses: Poses) -> Float[np.ndarray, "T 20 3"]:
        """Return the 15 joints and the five tips in the world, in metres."""
        position, rotation = compute_tree_poses(self.tree, *poses)
        tips = position[:, TIP_JOINTS] + (rotation[:, TIP_JOINTS] @ self.model.tips[..., None])[..., 0]
        return np.concatenate([position[:, HAND_JOINTS], tips], axis=1)


def minimise_hand_poses(
    hand: CalibratedHand, terms: KernelTerms, start: Poses, scales_m: tuple[float, ...], iterations: int
) -> tuple[Poses, Float[np.ndarray, "T P"]]:
    """Return the poses of least cost under the terms and the hand's prior, and their codes."""
    settings = SolverSettings(tuple((scale / MARKER_SD_M) ** 2 for scale in scales_m), iterations, HAND_DAMPING_RATIO)
    solution = minimise(hand.tree, (*terms, PoseModelTerm(hand.model.prior)), start, settings)
    return solution.poses, solution.codes


def linearise_hand_prior(hand: CalibratedHand, frame_count: int) -> LatentCodeTerm:
    """Return the prior as a term of the kernels, the same for all frames."""
    prior: HandPrior = hand.model.prior
    return linearise_model_term(hand.tree, prior, 1.0, np.zeros((1, prior.code_size)), 0.0, np.zeros(frame_count, int))
