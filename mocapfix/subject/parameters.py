"""Calibration parameters: what calibration may change of a body, and the prior deviations of people from the average.

The parameters are the size, the principal components of body shape, the scale of each bone group, the length of each bone, the
direction of each bone of the trunk, the marker offsets, and the take's mean pose.

Markers seldom determine the hip joints: in ordinary gait the thighs hardly move sideways, and skin and muscle slide over them.
Where markers are on the iliac spines, their distances predict the centres: Harrington et al., "Prediction of the hip joint
centre in adults, children, and patients with cerebral palsy based on magnetic resonance imaging", J. Biomechanics 40 (2007)
595-602.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mocapfix.model.skeleton import BodyModel, Skeleton
from mocapfix.model.subject import Subject
from mocapfix.solve.mean_pose import MeanPosePrior
from mocapfix.solve.terms import ShapeDeformations
from mocapfix.subject.library import find_landmark

BODY_SIZE_SD = 1e3  # relative standard deviation of the size: practically free, since the take determines it well
BONE_GROUP_SD = 0.05  # relative, of a bone group's length, left and right together; the most likely over the CMU subjects
INDIVIDUAL_BONE_LENGTH_SD = 0.03  # relative, within its group: the asymmetry of the CMU subjects
# Joints at the ends of bones whose direction differs from person to person. A limb's bone defines the axes of its segment.
LEANING_BONES = ("LeftUpLeg", "RightUpLeg", "Neck", "Neck1", "Head", "LeftArm", "RightArm")
FIRM_BONES = ("Spine", "Spine1")  # whose direction looks like a bend of the joint below: the fit hardly changes it
# Standard deviation of the direction of such a bone about each axis across it: that of each of CMU's subjects from the principal
# components of the others.
PEOPLE_LEAN_SD_RAD = 0.04
FIRM_BONE_LEAN_SD_RAD = 0.005  # the same as the fit assumes it for FIRM_BONES
MEAN_POSE_SD_RAD = 0.02  # standard deviation of a take's mean pose from the average about axes for which no variation is known
MIN_SCALED_BONE_LENGTH_M = 0.02  # length above which an offset counts as a bone with a length of its own


class CalibratedBody(NamedTuple):
    """A body given by calibration parameters: joint and marker offsets in metres, and the rotation vectors of its mean pose."""

    offsets: np.ndarray
    marker_offsets: np.ndarray
    mean_pose_vectors: np.ndarray


@dataclass(frozen=True)
class CalibrationParameters:
    """The definition of Q shared unknowns, all 0 at the start.

    They are P coefficients of deformations, the shifts of K markers (K, 3) in metres, and the rotation vectors (F, 3) in radians
    of the take's mean pose from the average, for the free joints below the root.
    """

    offsets: Float[np.ndarray, "J 3"]  # m: joint offsets at the start
    marker_offsets: Float[np.ndarray, "K 3"]  # m: marker offsets at the start
    free_joints: np.ndarray  # (J,) joints that turn
    deformations: ShapeDeformations  # change of the offsets with each of the P coefficients
    information: Float[np.ndarray, "Q Q"]  # inverse covariance of the unknowns about those expected, as the fit assumes it
    # (Q,) actual variance of people over that which the fit assumes: 1 unless the fit holds an unknown firmly.
    variance_ratio: Float[np.ndarray, " Q"]
    expected: Float[np.ndarray, " Q"]  # the most likely values before the take is seen: 0 unless landmarks predict joints

    @property
    def gradient_covariance(self) -> Float[np.ndarray, "Q Q"]:
        """The covariance of the prior's gradient at the true values, larger for unknowns that the fit holds firmly."""
        return self.information * np.sqrt(self.variance_ratio * self.variance_ratio[:, None])

    @cached_property
    def shape_basis(self) -> Float[np.ndarray, "U Q"]:
        """The change of all offsets of joints and markers, and of the mean pose, with each unknown (see `kernels.schur`)."""
        joint_offsets, marker_offsets = (each.reshape(len(each), -1) for each in self.deformations)
        basis = np.zeros((joint_offsets.shape[1] + len(self.information) - len(joint_offsets), len(self.information)))
        deformed = np.hstack([joint_offsets, marker_offsets]).T
        basis[: len(deformed), : len(joint_offsets)] = deformed
        basis[joint_offsets.shape[1] :, len(joint_offsets) :] = np.eye(len(basis) - joint_offsets.shape[1])
        return basis

    def compute_body(self, unknowns: Float[np.ndarray, " Q"]) -> CalibratedBody:
        """Return the body that the unknowns describe."""
        coefficient_count = len(self.deformations.marker_offsets)
        coefficients, shifts, vectors = np.split(unknowns, [coefficient_count, coefficient_count + self.marker_offsets.size])
        marker_offsets = (
            self.marker_offsets + np.tensordot(coefficients, self.deformations.marker_offsets, 1) + shifts.reshape(-1, 3)
        )
        mean_pose_vectors = np.zeros_like(self.offsets)
        mean_pose_vectors[np.flatnonzero(self.free_joints)[1:]] = vectors.reshape(-1, 3)
        offsets = self.offsets + np.tensordot(coefficients, self.deformations.joint_offsets, 1)
        return CalibratedBody(offsets, marker_offsets, mean_pose_vectors)


def build_calibration_parameters(start: Subject, body: BodyModel, prior: MeanPosePrior) -> CalibrationParameters:
    """Return the parameters from `body` at the estimated size, whose marker spread is that of people's offsets."""
    offsets, marker_offsets = start.skeleton.offsets, start.marker_offsets
    shapes = body.shape_components * np.linalg.norm(offsets) / np.linalg.norm(body.skeleton.offsets)
    groups = np.zeros((len(body.bone_groups), *offsets.shape))
    for g, joints in enumerate(map(list, body.bone_groups.values())):
        groups[g, joints] = offsets[joints]
    bones = list_bones(start.skeleton)
    leans, firm_leans = (list_bone_leans(start.skeleton, names) for names in (LEANING_BONES, FIRM_BONES))
    joint_deformations = np.concatenate([offsets[None], shapes, groups, bones, leans, firm_leans])
    # the size alone moves the markers along
    marker_deformations = np.concatenate([marker_offsets[None], np.zeros((len(joint_deformations) - 1, *marker_offsets.shape))])
    length_sd = *[BONE_GROUP_SD] * len(groups), *[INDIVIDUAL_BONE_LENGTH_SD] * len(bones)
    lean_sd = *[PEOPLE_LEAN_SD_RAD] * len(leans), *[FIRM_BONE_LEAN_SD_RAD] * len(firm_leans)
    sd = (BODY_SIZE_SD, *[1.0] * len(shapes), *length_sd, *lean_sd, *np.repeat(start.marker_spread, 3))
    free_below_root = np.flatnonzero(body.free_joints)[1:]
    mean_pose_information = np.linalg.inv(prior.between_take_covariance[free_below_root] + MEAN_POSE_SD_RAD**2 * np.eye(3))
    information = np.diag(np.concatenate([1 / np.square(sd), np.zeros(3 * len(mean_pose_information))]))
    for first, block in zip(range(len(sd), len(information), 3), mean_pose_information, strict=True):
        information[first : first + 3, first : first + 3] = block
    variance_ratio = np.ones(len(information))
    variance_ratio[len(joint_deformations) - len(firm_leans) : len(joint_deformations)] = (
        PEOPLE_LEAN_SD_RAD / FIRM_BONE_LEAN_SD_RAD
    ) ** 2
    deformations = ShapeDeformations(joint_deformations, marker_deformations)
    expected = np.zeros(len(information))
    return CalibrationParameters(offsets, marker_offsets, body.free_joints, deformations, information, variance_ratio, expected)


def list_bones(skeleton: Skeleton) -> Float[np.ndarray, "B J 3"]:
    """Return for each of B bones the offsets in metres of the joints it carries, zero for all others.

    Joints at the same offset from one parent share a bone: the thorax carries the neck and both shoulders.
    """
    offsets, bones = skeleton.offsets, list[np.ndarray]()
    for j in np.flatnonzero(np.linalg.norm(offsets, axis=1) > MIN_SCALED_BONE_LENGTH_M):
        is_same = (skeleton.parents == skeleton.parents[j]) & np.isclose(offsets, offsets[j]).all(1)
        if np.flatnonzero(is_same)[0] == j:
            bones.append(np.where(is_same[:, None], offsets, 0.0))
    return np.array(bones)


def list_bone_leans(skeleton: Skeleton, joint_names: tuple[str, ...]) -> Float[np.ndarray, "L J 3"]:
    """Return the changes of the joints' offsets by a rotation of each bone about two axes across it, in metres per radian.

    Args:
        joint_names: One joint at the end of each bone; joints at the same offset from one parent share a bone.
    """
    offsets, leans = skeleton.offsets, list[np.ndarray]()
    for j in map(skeleton.find_joint, joint_names):
        is_same = (skeleton.parents == skeleton.parents[j]) & np.isclose(offsets, offsets[j]).all(1)
        length_m, across = np.linalg.norm(offsets[j]), np.linalg.svd(offsets[j][None])[2][1:]
        leans += [np.where(is_same[:, None], length_m * direction, 0.0) for direction in across]
    return np.array(leans)


# Standard deviation per axis of a predicted hip joint centre: 12.3 +- 5.9 mm in space in 67 adults whose landmarks and joints
# were found in computed tomography (Mantovani et al., Gait & Posture 44 (2016) 48-54).
HIP_REGRESSION_SD_M = 0.008
# Distance of the centre behind the middle of the anterior iliac spines: a share of the pelvis' depth, and metres more.
BACKWARD_PER_DEPTH, BACKWARD_M = 0.24, 0.0099
DOWNWARD_PER_WIDTH, DOWNWARD_M = 0.30, 0.0109  # the same for its distance below it, from the pelvis' width
SIDEWARD_PER_WIDTH, SIDEWARD_M = 0.33, 0.0073  # the same for its distance to the side
MAX_LANDMARK_DISTANCE_M = 0.001  # of a marker on a landmark of the average body: all sets give it one place
DERIVATIVE_STEP_M = 1e-4  # step of the numerical derivatives; the equations are nearly linear over centimetres
HIP_JOINTS = ("LeftUpLeg", "RightUpLeg")


class PelvisLandmarks(NamedTuple):
    """The markers of a subject on landmarks of the pelvis."""

    left_anterior: int  # left_anterior, right_anterior: indices of the markers on the anterior superior iliac spines
    right_anterior: int
    posterior: tuple[int, ...]  # those on the posterior ones, or the one on the sacrum between them


class HipEvidence(NamedTuple):
    """What the regression says of the unknowns of a calibration, linearised at the start, where all are 0."""

    error: Float[np.ndarray, "6"]  # m: the body's hip joint centres, left and right, relative to the predicted ones
    jacobian: Float[np.ndarray, "6 Q"]  # its derivatives with respect to the unknowns


def add_hip_regression(parameters: CalibrationParameters, start: Subject) -> CalibrationParameters:
    """Return the parameters with the prediction of the hip joints in their prior, the very same ones if there is none."""
    evidence = build_hip_evidence(start, parameters)
    if evidence is None:
        return parameters
    precision = evidence.jacobian.T / HIP_REGRESSION_SD_M**2
    information = parameters.information + precision @ evidence.jacobian
    gradient = parameters.information @ parameters.expected - precision @ evidence.error
    return replace(parameters, information=information, expected=np.linalg.solve(information, gradient))


def find_pelvis_landmarks(subject: Subject) -> PelvisLandmarks | None:
    """Return the markers on the landmarks of the pelvis of an uncalibrated subject; None if one is missing."""
    ratio, pelvis = subject.skeleton.size_ratio, subject.skeleton.find_joint("Hips")

    def find_marker(landmark_name: str) -> list[int]:
        distance = np.linalg.norm(subject.marker_offsets / ratio - find_landmark(landmark_name).offset, axis=1)
        return np.flatnonzero((distance <= MAX_LANDMARK_DISTANCE_M) & (subject.joints == pelvis)).tolist()

    left, right = (find_marker(f"{side} anterior superior iliac spine") for side in ("left", "right"))
    pairs = [find_marker(f"{side} posterior superior iliac spine") for side in ("left", "right")]
    posterior = pairs[0][:1] + pairs[1][:1] if all(pairs) else find_marker("sacrum")[:1]
    return PelvisLandmarks(left[0], right[0], tuple(posterior)) if left and right and posterior else None


def predict_hip_joints(
    left_anterior: Float[np.ndarray, "3"], right_anterior: Float[np.ndarray, "3"], posterior: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "2 3"]:
    """Return the centres of both hips, in metres, from the iliac spines; `posterior` is the middle of the posterior ones."""
    middle, across = (left_anterior + right_anterior) / 2, left_anterior - right_anterior
    width_m, depth_m = float(np.linalg.norm(across)), float(np.linalg.norm(middle - posterior))
    to_left = across / width_m
    forward = middle - posterior - (middle - posterior) @ to_left * to_left
    forward /= np.linalg.norm(forward)
    up = np.cross(forward, to_left)
    centre = middle - (BACKWARD_PER_DEPTH * depth_m + BACKWARD_M) * forward - (DOWNWARD_PER_WIDTH * width_m + DOWNWARD_M) * up
    sideward = (SIDEWARD_PER_WIDTH * width_m + SIDEWARD_M) * to_left
    return np.array([centre + sideward, centre - sideward])


def build_hip_evidence(start: Subject, parameters: CalibrationParameters) -> HipEvidence | None:
    """Return what the regression says of the unknowns, None if the subject has no markers on the landmarks."""
    landmarks = find_pelvis_landmarks(start)
    if landmarks is None:
        return None
    skeleton, posterior = start.skeleton, list(landmarks.posterior)
    hips = [skeleton.find_joint(name) for name in HIP_JOINTS]
    stubs = skeleton.parents[hips]  # between the pelvis and a hip joint
    places, of_hips = start.marker_offsets, skeleton.offsets[hips] + skeleton.offsets[stubs]
    points = np.array([*of_hips, *places[list(landmarks[:2])], places[posterior].mean(0)])

    def compute_error(flat_points: np.ndarray) -> np.ndarray:
        hip_joints, spines = np.split(flat_points.reshape(-1, 3), [2])
        return (hip_joints - predict_hip_joints(*spines)).ravel()

    steps = DERIVATIVE_STEP_M * np.eye(points.size)
    flat = points.ravel()
    derivative = np.array(
        [(compute_error(flat + step) - compute_error(flat - step)) / (2 * DERIVATIVE_STEP_M) for step in steps]
    ).T
    joint_deformations, marker_deformations = parameters.deformations
    coefficient_count, unknown_count = len(marker_deformations), len(parameters.information)
    motion = np.zeros((len(points), 3, unknown_count))  # of the points with the unknowns
    joint_motion = joint_deformations[:, hips] + joint_deformations[:, stubs]
    motion[:2, :, :coefficient_count] = joint_motion.transpose(1, 2, 0)
    for point, indices in enumerate(((landmarks.left_anterior,), (landmarks.right_anterior,), landmarks.posterior), start=2):
        for k in indices:
            motion[point, :, :coefficient_count] += marker_deformations[:, k].T / len(indices)
            shift = coefficient_count + 3 * k
            motion[point, :, shift : shift + 3] += np.eye(3) / len(indices)
    return HipEvidence(compute_error(flat), derivative @ motion.reshape(points.size, unknown_count))
