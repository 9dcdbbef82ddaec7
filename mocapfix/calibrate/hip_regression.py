"""Hip joint centres from the landmarks of the pelvis: regression equations from images, as a part of the calibration's prior.

Markers seldom determine the hip joints: in ordinary gait the thighs hardly move sideways, and skin and muscle slide over the
thigh as it turns. Where a marker set has markers on the iliac spines, their distances from each other predict the centres:
Harrington et al., "Prediction of the hip joint centre in adults, children, and patients with cerebral palsy based on magnetic
resonance imaging", J. Biomechanics 40 (2007) 595-602.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mocapfix.calibrate.parameters import CalibrationParameters
from mocapfix.marker_sets.landmarks import find_landmark
from mocapfix.skeleton import Skeleton
from mocapfix.subject import Subject

HIP_REGRESSION_SD_M = 0.008
"""Standard deviation per axis of a predicted hip joint centre: 12.3 +- 5.9 mm in space in 67 adults whose landmarks and joints
were found in computed tomography (Mantovani et al., Gait & Posture 44 (2016) 48-54)."""
BACKWARD_PER_DEPTH, BACKWARD_M = 0.24, 0.0099
"""Distance of the centre behind the middle of the anterior iliac spines: a share of the pelvis' depth, and metres more."""
DOWNWARD_PER_WIDTH, DOWNWARD_M = 0.30, 0.0109
"""The same for its distance below it, from the pelvis' width."""
SIDEWARD_PER_WIDTH, SIDEWARD_M = 0.33, 0.0073
"""The same for its distance to the side."""
MAX_LANDMARK_DISTANCE_M = 0.001
"""Distance on the average body up to which a marker of a set is the one on a landmark: all sets give a landmark one place."""
DERIVATIVE_STEP_M = 1e-4
"""Step of the numerical derivatives; the equations are nearly linear over centimetres."""
HIP_JOINTS = ("LeftUpLeg", "RightUpLeg")


class PelvisLandmarks(NamedTuple):
    """The markers of a subject on landmarks of the pelvis.

    left_anterior, right_anterior  indices of the markers on the anterior superior iliac spines
    posterior                      those on the posterior ones, or the one on the sacrum between them
    """

    left_anterior: int
    right_anterior: int
    posterior: tuple[int, ...]


class HipEvidence(NamedTuple):
    """What the regression says of the unknowns of a calibration, linearised at the start, where all are 0.

    error     (6,) m: the body's hip joint centres, left and right, relative to the predicted ones
    jacobian  (6, Q) its derivatives with respect to the unknowns
    """

    error: Float[np.ndarray, "6"]
    jacobian: Float[np.ndarray, "6 Q"]


def add_hip_regression(parameters: CalibrationParameters, start: Subject, average: Skeleton) -> CalibrationParameters:
    """Return the parameters with the prediction of the hip joints in their prior, the very same ones if there is none.

    start    the subject at the start of the calibration
    average  the skeleton of which the subject's is a scaled copy
    """
    evidence = build_hip_evidence(start, average, parameters)
    if evidence is None:
        return parameters
    precision = evidence.jacobian.T / HIP_REGRESSION_SD_M**2
    information = parameters.information + precision @ evidence.jacobian
    gradient = parameters.information @ parameters.expected - precision @ evidence.error
    return replace(parameters, information=information, expected=np.linalg.solve(information, gradient))


def find_pelvis_landmarks(subject: Subject, average: Skeleton) -> PelvisLandmarks | None:
    """Return the markers on the landmarks of the pelvis of an uncalibrated subject; None if one is missing.

    average  the skeleton of which the subject's is a scaled copy
    """
    ratio = subject.skeleton.total_length_m / average.total_length_m
    pelvis = average.find_joint("Hips")

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
    """Return the centres of the left and the right hip joint from the iliac spines of a person, all in metres.

    posterior  the middle of the posterior superior iliac spines
    """
    middle, across = (left_anterior + right_anterior) / 2, left_anterior - right_anterior
    width_m, depth_m = float(np.linalg.norm(across)), float(np.linalg.norm(middle - posterior))
    to_left = across / width_m
    forward = middle - posterior - (middle - posterior) @ to_left * to_left
    forward /= np.linalg.norm(forward)
    up = np.cross(forward, to_left)
    centre = middle - (BACKWARD_PER_DEPTH * depth_m + BACKWARD_M) * forward - (DOWNWARD_PER_WIDTH * width_m + DOWNWARD_M) * up
    sideward = (SIDEWARD_PER_WIDTH * width_m + SIDEWARD_M) * to_left
    return np.array([centre + sideward, centre - sideward])


def build_hip_evidence(start: Subject, average: Skeleton, parameters: CalibrationParameters) -> HipEvidence | None:
    """Return what the regression says of the unknowns, None if the subject has no markers on the landmarks."""
    landmarks = find_pelvis_landmarks(start, average)
    if landmarks is None:
        return None
    skeleton, posterior = start.skeleton, list(landmarks.posterior)
    hips = [skeleton.find_joint(name) for name in HIP_JOINTS]
    stubs = skeleton.parents[hips]  # between the pelvis and a hip joint
    points = np.array(
        [
            *(skeleton.offsets[hips] + skeleton.offsets[stubs]),
            *start.marker_offsets[list(landmarks[:2])],
            start.marker_offsets[posterior].mean(0),
        ]
    )

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
