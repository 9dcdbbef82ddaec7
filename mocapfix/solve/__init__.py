"""The solve: the pose of every frame that agrees best with markers, prior and time."""

from dataclasses import dataclass, replace

import numpy as np

from mocapfix.kernels import kinematics
from mocapfix.kernels.pose import Tree
from mocapfix.kernels.problem import Attached, Problem, no_pull, pull_to
from mocapfix.kernels.terms import Targets
from mocapfix.motion import Motion
from mocapfix.prior import Prior
from mocapfix.skeleton import Body
from mocapfix.solve import recall, temporal
from mocapfix.solve.deviation import deviations
from mocapfix.subject import Subject
from mocapfix.take import Take, runs

FLICKER = 0.025  # seconds
FAR_OFF, GUESSED = 2, 3  # indices into motion.STATUS
POOR = 0.03  # metres: a frame whose markers lie farther from the body on average is a poor one
LOOSEST = 0.5  # radians: the weakest pull to a joint's course
SUREST = 0.01  # radians: no course is surer


@dataclass(frozen=True)
class SolveOptions:
    """How the solve weighs what it is told."""

    marker_sd: float = 0.010
    """how far a sound marker lies from its place on the body, metres (standard deviation per axis)"""
    robust: tuple[float, ...] = (0.2, 0.1, 0.05)
    """Geman-McClure scales, metres, one after the other: a marker farther off than the last hardly counts"""
    habit: float = 1.0
    """how long a pose goes on, seconds: the prior speaks once in that time, not anew in every frame"""
    beside: float = 0.05
    """how long beside a gap a marker is not listened to, seconds; see `beside_gaps`"""
    tremble_turn: float = 0.01
    """how much a joint trembles from frame to frame beyond its motion, radians"""
    tremble_shift: float = 0.001
    """how much the root does, metres"""
    turn_sd: float = 0.1
    """how far a joint strays from its smooth course, radians"""
    shift_sd: float = 0.03
    """how far the root strays from its smooth course, metres"""


def motion(worn: Take, subject: Subject, body: Body, prior: Prior, start: Motion, options: SolveOptions) -> Motion:
    """-> poses, and the standard deviation of every marker the body places.

    Each frame is solved alone first; the joints' smooth courses through what that says, and how surely, then pull the
    frames to each other in a second solve.

    worn  the take's markers in the subject's order, NaN where not seen or not believed
    """
    believed = ~np.isnan(worn.markers[..., 0])
    listened = believed & ~beside_gaps(believed, worn.rate, options.beside)
    said_once = pull_to(prior.weakened(1 / (options.habit * worn.rate)))
    tree = Tree(subject.skeleton.parents, subject.skeleton.offsets, body.free)
    attached = Attached(subject.joints, subject.places)
    problem = Problem(tree, attached, worn.markers, listened, options.marker_sd, said_once)
    narrow = options.robust[-1]

    # each frame alone; then those that lack a marker, from their neighbours and as far as the course through the others says
    root, local, none = start.root.copy(), start.rotations.copy(), no_pull(len(body.free))
    _, alone = problem.solve(root, local, none, options.robust)
    gone = recall.lost(listened, subject, body.free)
    unsure = (missed(listened, subject) | gone) & body.free
    variance = problem.uncertainty(root, local, none, narrow).turns
    bridge, course_variance = bridged(local, variance, unsure, worn.rate, options)
    problem.track(root, local, bridge, unsure, narrow)

    # what no marker tells is recalled from the rest of the body, and all frames are solved again, pulled to their courses
    left_open = problem.uncertainty(root, local, none, narrow)
    told = np.where(gone, np.minimum(left_open.turns, course_variance + options.turn_sd**2), left_open.turns)
    known, variance = recall.recalled(root, local, told, gone, body.free, worn.rate)
    target = smooth(root, known, variance, left_open.root, body.free, worn.rate, options)
    root, local = target.root.copy(), target.rotations.copy()
    status, together = problem.solve(root, local, target, (narrow,))
    root, local = polished(root, local, body.free, worn.rate, options)
    solved = Motion(root, local, status, alone + together, left_open.markers, left_open.joints)

    certain = unsure / np.maximum(course_variance, SUREST**2) + gone / np.maximum(variance, SUREST**2)
    time = target._replace(information=certain[..., None, None] * np.eye(3))
    markers, joints = deviations(problem, solved, subject, prior, left_open.markers, time, narrow)
    solved = replace(solved, deviation=markers, joint_deviation=joints)
    return replace(solved, status=judged(solved, subject, worn.markers))


def judged(motion: Motion, subject: Subject, markers: np.ndarray) -> np.ndarray:
    """-> (T,) the status of every frame, as motion.STATUS words it."""
    distance = np.linalg.norm(markers - kinematics.markers(subject, *kinematics.world(subject.skeleton, motion)), axis=-1)
    seen = ~np.isnan(distance)
    mean = np.nansum(distance, axis=1) / np.maximum(seen.sum(1), 1)
    return np.where(seen.sum(1) < 3, GUESSED, np.where(mean > POOR, FAR_OFF, motion.status))


def beside_gaps(believed: np.ndarray, rate: float, longest: float) -> np.ndarray:
    """-> (T, K) bool: the samples on either side of a marker's gaps, for up to `longest` seconds.

    The pose shall not listen to them: a marker pulls the body to itself, so a body that lets go of it where its gap
    begins would jump, and the residual carried across the gap would be the residual of another pose. The last samples
    before a marker is lost are its worst, too. Flicker loses none.
    """
    mask = np.zeros_like(believed)
    for k in range(believed.shape[1]):
        for first, last in runs(~believed[:, k]):
            span = round(rate * min(longest, (last - first + 1) / rate - FLICKER))
            if span > 0:
                mask[max(0, first - span) : last + 1 + span, k] = True
    return mask


def polished(root, local, free, rate, options: SolveOptions) -> tuple[np.ndarray, np.ndarray]:
    """-> root and rotations without the tremble that skin and cameras give each frame of its own."""
    out = local.copy()
    frames = len(root)
    for j in np.flatnonzero(free):
        out[:, j] = temporal.smoothed_rotations(local[:, j], np.full(frames, options.tremble_turn**2), rate)
    return temporal.smoothed_root(root, np.full(frames, options.tremble_shift**2), rate)[0], out


def missed(listened: np.ndarray, subject: Subject) -> np.ndarray:
    """-> (T, J) bool: joints that miss a marker, their own or a child's, that the take shows at other times."""
    lacking = np.zeros((len(listened), len(subject.skeleton.names)), bool)
    for k in np.flatnonzero(listened.any(0)):
        joint = subject.joints[k]
        lacking[:, joint] |= ~listened[:, k]
        lacking[:, max(subject.skeleton.parents[joint], 0)] |= ~listened[:, k]
    lacking[:, 0] = False
    return lacking


def bridged(local, variance, unsure, rate, options: SolveOptions) -> tuple[Targets, np.ndarray]:
    """-> where each joint's course leads while the joint itself is unsure, as a pull as strong as that course is certain,
    and the course's variance (T, J), rad^2, there.
    """
    rotations, information, left_open = local.copy(), np.zeros_like(local), np.zeros(unsure.shape)
    for j in np.flatnonzero(unsure.any(0)):
        rotations[:, j], left_open[:, j] = temporal.bridged(local[:, j], variance[:, j], unsure[:, j], rate)
        certain = np.where(unsure[:, j], 1 / (left_open[:, j] + options.turn_sd**2), 0.0)
        information[:, j] = certain[:, None, None] * np.eye(3)
    return Targets(rotations, information, np.zeros((len(local), 3)), np.zeros(len(local))), left_open


def smooth(root, local, variance, root_variance, free, rate, options: SolveOptions) -> Targets:
    """-> the smooth course of every free joint and the root, as a pull for each frame."""
    rotations, information = local.copy(), np.zeros_like(local)
    for j in np.flatnonzero(free):
        rotations[:, j] = temporal.smoothed_rotations(local[:, j], variance[:, j], rate)
        doubt = np.minimum(variance[:, j], LOOSEST**2)  # joints that share a turn, as the spine's do, are unsure one by one
        information[:, j] = np.eye(3) / (options.turn_sd**2 + doubt)[:, None, None]
    smooth_root, left_open = temporal.smoothed_root(root, root_variance, rate)
    return Targets(rotations, information, smooth_root, 1 / (options.shift_sd**2 + left_open))
