"""The solve: the pose of every frame that agrees best with markers, prior and time; and single poses, of whatever is known."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mocapfix.kernels import kinematics
from mocapfix.kernels.pose import Tree
from mocapfix.kernels.problem import Attached, Problem, Uncertainty, no_pull, pull_to, within
from mocapfix.motion import Motion
from mocapfix.prior import JointLimits, Prior
from mocapfix.prior.contract import PoseModel
from mocapfix.skeleton import Body
from mocapfix.solve import courses, listening, recall
from mocapfix.solve.constraints import Camera, Constraint, Direction, Distance, Orientation, Position, Seen
from mocapfix.solve.deviation import deviations
from mocapfix.solve.options import SolveOptions
from mocapfix.solve.people import People
from mocapfix.solve.single import Pose, pose
from mocapfix.subject import Subject
from mocapfix.take import Take

__all__ = [
    "Camera", "Constraint", "Direction", "Distance", "Orientation", "Pose", "Position", "Seen", "SolveOptions", "motion", "pose",
]  # fmt: skip

FAR_OFF, GUESSED = 2, 3  # indices into motion.STATUS
POOR = 0.03  # metres: a frame whose markers lie farther from the body on average is a poor one
SUREST = 0.01  # radians: no course is surer


def motion(
    worn: Take,
    subject: Subject,
    body: Body,
    prior: Prior,
    limits: JointLimits,
    start: Motion,
    options: SolveOptions,
    model: Callable[[], PoseModel] | None = None,
) -> Motion:
    """-> poses, and the standard deviations of every joint and of every marker the body places.

    Each frame is solved alone first; the joints' smooth courses through what that says, and how surely, then pull the
    frames to each other in a second solve.

    worn   the take's markers in the subject's order, NaN where not seen or not believed
    prior  the independent joints' mean pose, which breaks ties in every frame
    start  where each frame is first solved from; NaN where it goes on from the one before it
    model  gives a trained model of poses, and is called where a limb is lost for so long that the take and time cannot tell;
           None asks them alone
    """
    rate, narrow = worn.rate, options.robust[-1]
    problem = bound(worn, subject, body, prior, limits, options)
    gone = listening.lost(problem.listened, subject, body.free)
    unsure = (listening.missed(problem.listened, subject) | gone) & body.free

    root, local = start.root.copy(), start.rotations.copy()
    alone, known, left_open = each_alone(problem, root, local, unsure, gone, rate, options)
    people = People(model, options.prior_scale) if model else None
    recall.lost_joints(root, local, known.turns, gone, body.free, rate, people)
    course = courses.smooth(root, local, known, body.free, rate, options)
    root, local = course.root.copy(), course.rotations.copy()
    status, together = problem.solve(root, local, course, (narrow,))
    certain = unsure / np.maximum(np.where(gone, known.turns, left_open), SUREST**2)
    course = course._replace(weight=certain)
    root = courses.polished(root, local, body.free, rate, options)
    solved = Motion(root, local, status, alone + together, known.markers, known.joints)
    markers, joints = deviations(problem, solved, subject, prior, known.markers, course, narrow)
    solved = replace(solved, deviation=markers, joint_deviation=joints)
    return replace(solved, status=judged(solved, subject, worn.markers))


def bound(worn: Take, subject: Subject, body: Body, prior: Prior, limits: JointLimits, options: SolveOptions) -> Problem:
    """-> the pose problem of the take, as `motion` is given it: markers, people's habits and how far joints turn."""
    gone = listening.lost(worn.seen, subject, body.free)
    listened = worn.seen & ~listening.beside_gaps(worn.seen, gone[:, subject.joints], worn.rate, options.beside)
    said_once = pull_to(prior.weakened(1 / (options.habit * worn.rate)))
    walls = within(limits, options.limit_sd * np.sqrt(options.habit * worn.rate))
    tree = Tree(subject.skeleton.parents, subject.skeleton.offsets, body.free)
    return Problem(tree, Attached(subject.joints, subject.places), worn.markers, listened, options.marker_sd, said_once, walls)


def each_alone(
    problem: Problem,
    root: np.ndarray,
    local: np.ndarray,
    unsure: np.ndarray,
    gone: np.ndarray,
    rate: float,
    options: SolveOptions,
) -> tuple[np.ndarray, Uncertainty, np.ndarray]:
    """Solve each frame alone, or as its start says, then those with joints that are unsure or gone (T, J) from their neighbours
    and as far as the course through the others says; root (T, 3) and local (T, J, 3, 3) in place. -> (T,) iterations, how far
    poses are known, and the variance (T, J) of the courses of unsure joints, rad^2
    """
    none, narrow = no_pull(local.shape[1]), options.robust[-1]
    _, iterations = problem.solve(root, local, none, options.robust)
    variance = problem.uncertainty(root, local, none, narrow).turns
    bridges, left_open = courses.bridges(local, variance, unsure, rate, options)
    problem.track(root, local, bridges, unsure, narrow)
    known = problem.uncertainty(root, local, none, narrow)
    told = np.where(gone, np.minimum(known.turns, left_open + options.turn_sd**2), known.turns)
    return iterations, known._replace(turns=told), left_open


def judged(motion: Motion, subject: Subject, markers: np.ndarray) -> np.ndarray:
    """-> (T,) the status of every frame, as motion.STATUS words it.

    markers  (T, K, 3) metres, the subject's markers, NaN where not believed
    """
    _, placed = kinematics.placed(subject, motion)
    distance = np.linalg.norm(markers - placed, axis=-1)
    seen = (~np.isnan(distance)).sum(1)
    mean = np.nansum(distance, axis=1) / np.maximum(seen, 1)
    return np.where(seen < 3, GUESSED, np.where(mean > POOR, FAR_OFF, motion.status))
