"""HybrIK: every frame's pose in closed form from where its joints are (Li et al. 2021; HybrIK-X: Li et al. 2023)."""

from typing import Literal

import numpy as np

from mocapfix import prior
from mocapfix.errors import ConstraintError
from mocapfix.initialise import root
from mocapfix.initialise.bones import Wearing, bones_of, stubs
from mocapfix.initialise.twist import regressor
from mocapfix.kernels.hybrik import ADAPTIVE, NAIVE, Seen, X, recur_frames
from mocapfix.kernels.threads import over_frames
from mocapfix.motion import FOLDED, GUESSED, PLACED, STRETCHED, Motion
from mocapfix.skeleton import cmu31
from mocapfix.subject import Subject

Way = Literal["naive", "adaptive", "x"]

WAYS: dict[str, int] = {"naive": NAIVE, "adaptive": ADAPTIVE, "x": X}
DEVIATION = 0.01  # metres per axis: how far a joint is taken to be from where it is given, where nobody says
MISSED = 0.02  # metres: a hand or the head so far from where the bones can bring it is worth a word
NO_TWIST = 1e-6  # 1/rad^2: how sure it is that a bone of which nothing is known is not twisted


def hybrik(
    positions: np.ndarray,
    subject: Subject,
    *,
    way: Way = "x",
    deviation: np.ndarray | float = DEVIATION,
    twists: np.ndarray | None = None,
    markers: np.ndarray | None = None,
    held: np.ndarray | None = None,
) -> Motion:
    """-> every frame's pose on its own: each bone swung to where its far end is, and twisted as its markers or people say.

    The root is registered to the hips (HybrIK's appendix A, reflections ruled out). Then down the tree: "naive" turns each
    bone as the given joints lie to one another (Algorithm 1), so that wrong bone lengths add up; "adaptive" points it from
    where its joint came to lie (Algorithm 2); "x" takes hands and head for trees of their own, brings them where they are,
    and bends the joint before to reach there (HybrIK-X, 3.2.3), and leaves the hips the place that fits them best. A joint
    without a bone to a known place stays in people's mean pose; a frame that does not tell the root has its neighbours'.

    positions  (T, J, 3) metres, Y up, from any source; NaN where unknown
    deviation  metres per axis, one for all or (T, J): how far a joint is from where it is given
    twists     (T or 1, J, 2) cosine and sine of the angle about each bone, times how sure it is, 1/rad^2; None asks what people
               do whose joints are so (`initialise.twist`)
    markers    (T, K, 3) metres in the subject's order, NaN where not seen: those off a bone's axis tell its twist
    held       (J,) bool: joints that are left in the mean pose; None leaves the hip stubs there for "x", none for the others
    Returns a motion whose `status` names frames that were guessed, or whose hands or head the bones do not reach.

    Raises ConstraintError where an array has not the shape it must have.
    """
    check(positions, subject, way, deviation, twists, markers)
    skeleton, habits = subject.skeleton, prior.load("mean-pose", subject.skeleton)
    positions = np.asarray(positions, float)
    frames, joints = positions.shape[:2]
    if held is None:
        held = stubs(skeleton, habits) if way == "x" else np.zeros(joints, bool)
    bones, trunk = bones_of(skeleton, habits, Wearing(subject, markers is not None), held)
    points = positions if markers is None else np.concatenate([positions, markers], axis=1)
    variance = np.zeros((frames if np.ndim(deviation) else 1, points.shape[1]))
    variance[:, :joints] = np.nan_to_num(np.square(deviation), nan=1.0)  # of what is unknown nobody asks
    place, turn, known = root.registered(trunk, points, variance, way == "x")
    local = np.tile(habits.rotations, (frames, 1, 1, 1))
    local[:, 0], missed = turn, np.empty(frames)
    if twists is None:
        twists = regressor().regressed(positions, turn)
    sure = np.ascontiguousarray(twists, float) + np.array([NO_TWIST, 0.0])
    over_frames(
        recur_frames, frames, bones, WAYS[way], Seen(np.ascontiguousarray(points, float), variance, sure), place, local, missed
    )
    status = np.select([~known, missed > MISSED, missed < -MISSED], [GUESSED, STRETCHED, FOLDED], PLACED)
    unknown = np.full((frames, len(subject.joints)), np.nan), np.full((frames, joints), np.nan)
    return Motion(place, local, status, np.zeros(frames, int), *unknown)


def check(positions, subject: Subject, way: str, deviation, twists, markers) -> None:
    """Raise ConstraintError where an array has not the shape it must have, or a place or deviation cannot be one."""
    joints, count = len(cmu31().skeleton.names), len(subject.joints)
    if subject.skeleton.names != cmu31().skeleton.names:
        raise ConstraintError(f"HybrIK is for the {joints} joints of the CMU skeleton; the subject's are others.")
    if way not in WAYS:
        raise ConstraintError(f"There is no way {way!r} of HybrIK; choose one of: {', '.join(WAYS)}.")
    if np.ndim(positions) != 3 or np.shape(positions)[1:] != (joints, 3):
        raise ConstraintError(f"positions must be (frames, {joints}, 3), a place for every joint, not {np.shape(positions)}.")
    frames = len(positions)
    if markers is not None and np.shape(markers) != (frames, count, 3):
        raise ConstraintError(f"markers must be ({frames}, {count}, 3), as the subject wears them, not {np.shape(markers)}.")
    if twists is not None and (np.ndim(twists) != 3 or np.shape(twists) not in {(frames, joints, 2), (1, joints, 2)}):
        raise ConstraintError(f"twists must be ({frames} or 1, {joints}, 2), cosine and sine, not {np.shape(twists)}.")
    if np.ndim(deviation) and np.shape(deviation) != (frames, joints):
        raise ConstraintError(f"deviation must be one number or ({frames}, {joints}), not {np.shape(deviation)}.")
    if np.isinf(positions).any():
        raise ConstraintError("A position is infinite; where a joint is unknown, say NaN.")
    known = ~np.isnan(positions).any(axis=2) if np.ndim(deviation) else ()
    if not (np.asarray(deviation)[known] > 0).all():
        raise ConstraintError("A deviation must be more than 0 metres wherever the joint's position is known.")
