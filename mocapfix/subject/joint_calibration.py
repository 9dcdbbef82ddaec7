"""Joint calibration: one person's bones and marker offsets from frames of several takes.

The takes share the bones and the marker offsets; each has a mean pose of its own, since what a person does differs from take to
take. Where a marker was attached again or moved, it has a further place, which some of the takes share. The unknowns of one take
are a selection from those of all takes: the normal equations of the takes (see `refinement`) are summed into those of all.

The bias of a calibration that the motion of skin causes, estimated by calibrating from simulated markers and removed.

The poses of all frames are fitted together with the body, and absorb a part of the markers' noise: a hand with one marker seems
to turn more than it does, and its bone becomes too short. The bias does not shrink with more frames (Neyman & Scott 1948,
"Consistent estimates based on partially consistent observations"). It is the mean change of the calibration by noise, here by
noise and its opposite, so that what is linear in the noise cancels (indirect inference, Gourieroux, Monfort & Renault 1993).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mocapfix.model.skeleton import BodyModel
from mocapfix.model.subject import Subject
from mocapfix.solve.kinematics import Poses, compute_tree_poses
from mocapfix.solve.mean_pose import MeanPosePrior
from mocapfix.solve.minimise import minimise_shared
from mocapfix.subject import refinement
from mocapfix.subject.calibration import CalibrationFrames, build_average_subject
from mocapfix.subject.parameters import CalibrationParameters, add_hip_regression, build_calibration_parameters
from mocapfix.subject.refinement import RefinementState, estimate_residual_sd

TAKE_DISTANCE_S = 1e3
"""Distance in time at which frames of different takes are treated: their errors are independent."""
MAX_JOINT_ROUNDS = 20
"""Steps of the shared unknowns."""


@dataclass(frozen=True)
class JointUnknowns:
    """The layout of the unknowns of all takes, and their prior.

    Attributes:
        of_take: for each take, the indices (Q,) of its own unknowns among all N of them.
        information: (N, N) inverse covariance of the unknowns about those expected.
        expected: (N,) the most likely values before the takes are seen.
    """

    of_take: tuple[Int[np.ndarray, " Q"], ...]
    information: Float[np.ndarray, "N N"]
    expected: Float[np.ndarray, " N"]


class JointState(NamedTuple):
    """The state of all takes: the unknowns (N,), cost and gradient (N,) there, and the state of each take."""

    unknowns: np.ndarray
    cost: float
    gradient: np.ndarray
    of_take: tuple[RefinementState, ...]

    @property
    def poses(self) -> list[Poses]:
        """The poses of each take."""
        return [(state.root_position, state.local_rotations) for state in self.of_take]


@dataclass(frozen=True)
class JointCalibration:
    """A person calibrated from T takes.

    Attributes:
        subject: the person with the markers at place 0.
        marker_offsets: (T, K, 3) metres, the markers as they are placed in each take.
        states: the refined frames of each take.
    """

    subject: Subject
    marker_offsets: Float[np.ndarray, "T K 3"]
    states: tuple[RefinementState, ...]


def calibrate_jointly(
    takes: Sequence[CalibrationFrames],
    places: Int[np.ndarray, "T K"],
    body: BodyModel,
    prior: MeanPosePrior,
    previous: JointCalibration | None = None,
) -> JointCalibration:
    """Return the bones and marker offsets that explain frames of several takes best.

    takes     all with the same K markers
    places    number of the place of each marker in each take: takes with the same number share its offset
    previous  a calibration from the same frames with other places, from whose poses the refinement begins
    """
    size_ratio = float(np.median([take.size_ratio for take in takes]))
    start = build_average_subject(takes[0], body, size_ratio)
    plain = build_calibration_parameters(start, body, prior)
    parameters = add_hip_regression(plain, start, body.skeleton)
    unknowns = lay_out_unknowns(plain, parameters, places)
    poses = [(each.root_position, each.local_rotations) for each in (takes if previous is None else previous.states)]

    def fit(values: np.ndarray, poses: Sequence[Poses]) -> JointState:
        states: list[RefinementState] = []
        deviation = values - unknowns.expected
        gradient = unknowns.information @ deviation
        cost = float(0.5 * deviation @ gradient)
        for take, indices, start_poses in zip(takes, unknowns.of_take, poses, strict=True):
            of_take = values[indices]
            # the prior is that of all takes together, and is added once
            shape = replace(parameters, information=np.zeros_like(parameters.information))
            problem = refinement.build_calibration_problem(start, body, prior, take.markers, shape.compute_body(of_take))
            states.append(refinement.solve_and_linearise(shape, problem, of_take, *start_poses))
            cost += states[-1].cost
            gradient[indices] += states[-1].gradient
        return JointState(values, cost, gradient, tuple(states))

    def sum_curvature(state: JointState) -> np.ndarray:
        curvature = unknowns.information.copy()
        for of_take, indices in zip(state.of_take, unknowns.of_take, strict=True):
            curvature[np.ix_(indices, indices)] += refinement.compute_curvature(of_take)
        return curvature

    values = np.zeros(len(unknowns.expected))
    if previous is not None:
        for state, indices in zip(previous.states, unknowns.of_take, strict=True):
            values[indices] = state.unknowns
    first = fit(values, poses)
    found, _ = minimise_shared(lambda values, state: fit(values, state.poses), first, sum_curvature, MAX_JOINT_ROUNDS)
    return build_joint_calibration(start, parameters, takes, places, found.of_take)


def lay_out_unknowns(
    plain: CalibrationParameters, parameters: CalibrationParameters, places: Int[np.ndarray, "T K"]
) -> JointUnknowns:
    """Return the unknowns of all takes: deformations, markers at place 0, their further places, and mean poses of the takes.

    plain       the parameters without the prediction of the hip joints, whose prior holds for further places
    parameters  those with it
    """
    take_count, marker_count = places.shape
    body_count = len(parameters.deformations.marker_offsets)
    shared = body_count + 3 * marker_count
    pose_count = len(parameters.information) - shared
    further = [(int(marker), int(place)) for marker, place in zip(*_find_further_places(places), strict=True)]
    first_pose = shared + 3 * len(further)
    total = first_pose + take_count * pose_count
    information, expected = np.zeros((total, total)), np.zeros(total)
    information[:shared, :shared] = parameters.information[:shared, :shared]
    expected[:shared] = parameters.expected[:shared]
    for number, (marker, _) in enumerate(further):
        own = slice(shared + 3 * number, shared + 3 * number + 3)
        nominal = slice(body_count + 3 * marker, body_count + 3 * marker + 3)
        information[own, own] = plain.information[nominal, nominal]
    of_take: list[np.ndarray] = []
    for t in range(take_count):
        indices = np.arange(len(parameters.information))
        for number, (marker, place) in enumerate(further):
            if places[t, marker] == place:
                nominal = body_count + 3 * marker
                indices[nominal : nominal + 3] = shared + 3 * number + np.arange(3)
        own_pose = slice(first_pose + t * pose_count, first_pose + (t + 1) * pose_count)
        indices[shared:] = np.arange(own_pose.start, own_pose.stop)
        information[own_pose, own_pose] = parameters.information[shared:, shared:]
        of_take.append(indices)
    return JointUnknowns(tuple(of_take), information, expected)


def build_joint_calibration(
    start: Subject,
    parameters: CalibrationParameters,
    takes: Sequence[CalibrationFrames],
    places: Int[np.ndarray, "T K"],
    states: Sequence[RefinementState],
) -> JointCalibration:
    """Return the calibration of refined states, with the standard deviations of the subject as if all takes were one."""
    body_count = len(parameters.deformations.marker_offsets)
    shared = body_count + parameters.marker_offsets.size
    unknowns = states[0].unknowns.copy()
    unknowns[shared:] = np.mean([state.unknowns[shared:] for state in states], axis=0)
    for k in range(places.shape[1]):
        if common := [state for state, row in zip(states, places, strict=True) if row[k] == 0]:
            own = slice(body_count + 3 * k, body_count + 3 * k + 3)
            unknowns[own] = common[0].unknowns[own]
    markers = np.concatenate(
        [np.where((row == 0)[:, None], take.markers, np.nan) for take, row in zip(takes, places, strict=True)]
    )
    calibrated = parameters.compute_body(unknowns)
    first = states[0].problem
    problem = replace(
        first,
        marker_positions=markers,
        solver_mask=~np.isnan(markers[..., 0]),
        attachment=first.attachment._replace(offsets=calibrated.marker_offsets),
        pose_prior=first.pose_prior._replace(mean_vectors=calibrated.mean_pose_vectors),
    )
    root, local = (np.concatenate([getattr(state, name) for state in states]) for name in ("root_position", "local_rotations"))
    pooled = refinement.linearise_frames(parameters, problem, unknowns, root, local)
    times_s = np.concatenate([take.times_s + t * TAKE_DISTANCE_S for t, take in enumerate(takes)])
    subject = refinement.build_refined_subject(start, pooled, refinement.compute_curvature(pooled), times_s)
    offsets = np.array([state.problem.attachment.offsets for state in states])
    return JointCalibration(subject, offsets, tuple(states))


def _find_further_places(places: Int[np.ndarray, "T K"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the markers and the numbers of all places other than 0."""
    pairs = sorted({(int(k), int(places[t, k])) for t, k in zip(*np.nonzero(places), strict=True)})
    return np.array([k for k, _ in pairs], int), np.array([place for _, place in pairs], int)


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
