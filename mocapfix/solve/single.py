"""A single pose from whatever is known of it: MNN-IK's own use of its prior (section 5)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix import prior as priors
from mocapfix.errors import ConstraintError
from mocapfix.kernels import kinematics
from mocapfix.kernels.pose import Tree
from mocapfix.kernels.terms import Points, rows_of
from mocapfix.kernels.uncertainty import uncertainties
from mocapfix.motion import STATUS
from mocapfix.prior import models
from mocapfix.prior.contract import PoseModel, from_middle
from mocapfix.prior.linear import Linear
from mocapfix.skeleton import Skeleton, cmu31
from mocapfix.solve.constraints import Constraint
from mocapfix.solve.linearised import linearised
from mocapfix.solve.poses import Posed, under
from mocapfix.solve.said import terms_of, turns

MOST = 100  # iterations: a single pose has time
FACING = np.deg2rad([0, 90, 180, 270])  # of the starts: from one that faces away, a body would have to turn through itself
LOOSE = 3.0  # radians: how far joints stray about the rest pose where no prior is wanted; it only breaks ties


@dataclass(frozen=True)
class Pose:
    """A solved pose.

    skeleton    whose it is
    root        (3,) metres, in the world
    rotations   (J, 3, 3) local: each joint's axes in its parent's, the root's in the world
    joints      (J, 3) metres, the joints' places in the world
    deviation   (J,) metres: predicted standard deviation per axis of those places
    code        (P,) of the prior, each number in its own standard deviations
    cost        half the sum of squares of all residuals, in standard deviations: of k numbers that agree, about k / 2;
                of a mixture see `poses.Posed`
    status      a sentence
    iterations  of the Levenberg-Marquardt solve
    """

    skeleton: Skeleton
    root: np.ndarray
    rotations: np.ndarray
    joints: np.ndarray
    deviation: np.ndarray
    code: np.ndarray
    cost: float
    status: str
    iterations: int


def pose(
    constraints: Sequence[Constraint], prior: str | PoseModel = "autoencoder", *, scale: float = 1.0,
    skeleton: Skeleton | None = None, start: tuple[np.ndarray, np.ndarray] | None = None,
) -> Pose:  # fmt: skip
    """-> the likeliest pose under a prior that agrees with the constraints as well as their standard deviations ask.

        from mocapfix import solve
        found = solve.pose([solve.Position("LeftHand", (0.5, 1.4, 0.3)), solve.Position("Head", (0.0, 1.6, 0.0))])
        found.joints[found.skeleton.index("LeftArm")]      # where the left shoulder is, and how surely: found.deviation

    prior     a trained model or its name, as the files priors/NAME.safetensors; "none" knows nothing but the rest pose
    scale     times the prior's standard deviations: with 2 it is believed half as much
    skeleton  the average body over CMU's subjects where it is left out
    start     root (3,) metres and local rotations (J, 3, 3); else the prior's middle pose, facing four ways, the best of which
              is kept

    Raises ConstraintError where there is no constraint or one does not say what it must, the same for scale and start;
    SceneError for an unknown prior.
    """
    if not 0 < scale < np.inf:
        raise ConstraintError(f"A prior's scale must be more than 0 and finite, and is {scale!r}.")
    skeleton = cmu31().skeleton if skeleton is None else skeleton
    tree, model = kinematics.tree_of(skeleton), named(prior, skeleton) if isinstance(prior, str) else prior
    frames = len(FACING) if start is None else 1
    terms = terms_of(constraints, skeleton, frames)
    root, local = middle_poses(tree, model, terms[0]) if start is None else started(start, skeleton)
    found = under(tree, terms, model, root, local, scale=scale, most=MOST)
    best = int(np.nanargmin(found.cost))
    one = Posed(*(each[best : best + 1].copy() for each in vars(found).values()))
    joints, deviation = foretold(tree, terms, model, scale, one)
    return Pose(
        skeleton, one.root[0], one.rotations[0], joints, deviation, one.codes[0], float(one.cost[0]), STATUS[one.status[0]],
        int(one.iterations[0]),
    )  # fmt: skip


def named(prior: str, skeleton: Skeleton) -> PoseModel:
    """-> the model of a name."""
    if prior != "none":
        return models.load(prior, skeleton)
    joints = len(skeleton.names)
    rest, none = priors.load("none", skeleton).rotations, np.zeros((joints, 3))
    return Linear(skeleton.names, rest, np.full(joints, LOOSE), none, np.zeros((0, joints, 3)), LOOSE)


def middle_poses(tree: Tree, model: PoseModel, points: Points) -> tuple[np.ndarray, np.ndarray]:
    """-> root (4, 3) and local rotations (4, J, 3, 3) of the middle pose facing four ways, amidst the points that are given."""
    local = np.repeat(model.middle[None], len(FACING), axis=0)
    local[:, 0] = Rotation.from_euler("y", FACING[:, None]).as_matrix() @ local[:, 0]
    root = np.zeros((len(FACING), 3))
    if len(points.joints):
        root += points.seen[0].mean(0) - kinematics.carried(tree, root[:1], local[:1])[0][0, points.joints].mean(0)
    return root, local


def started(start: tuple[np.ndarray, np.ndarray], skeleton: Skeleton) -> tuple[np.ndarray, np.ndarray]:
    """-> a start as one frame. Raises ConstraintError where it is none."""
    root, local = (np.asarray(each, float) for each in start)
    joints = len(skeleton.names)
    if root.shape != (3,) or local.shape != (joints, 3, 3) or not (np.isfinite(root).all() and np.isfinite(local).all()):
        said = f"this one's are {root.shape} and {local.shape}"
        raise ConstraintError(f"A start is a root (3,) and rotations ({joints}, 3, 3) of finite numbers; {said}.")
    if not all(map(turns, local)):
        raise ConstraintError("A start's rotations must have rows of length one at right angles, right-handed.")
    return root[None].copy(), local[None].copy()


def foretold(tree: Tree, terms: tuple, model: PoseModel, scale: float, posed: Posed) -> tuple[np.ndarray, np.ndarray]:
    """-> the joints' places (J, 3), metres, and their standard deviations (J,) per axis, from the curvature of the cost."""
    joints, markers = len(tree.parents), len(terms[0].joints)
    shared, zero = posed.codes / scale, np.zeros(1)
    near = model.near(from_middle(posed.rotations, model.middle))
    latent = linearised(tree, near, scale, shared, 0.0, np.zeros(1, int))
    deviation, turns = np.empty((1, joints)), np.empty((1, joints))
    uncertainties(
        tree, (*terms, latent), np.inf, rows_of(terms), posed.root, posed.rotations, shared, np.empty((1, markers)), deviation,
        turns, zero, 0, 1,
    )  # fmt: skip
    return kinematics.carried(tree, posed.root, posed.rotations)[0][0], deviation[0]
