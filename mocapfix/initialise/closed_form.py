"""HybrIK: every frame's pose in closed form from where its joints are (Li et al. 2021; HybrIK-X: Li et al. 2023)."""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from mocapfix import prior
from mocapfix.errors import ConstraintError
from mocapfix.initialise import root
from mocapfix.initialise.bones import Wearing, bones_of, stubs
from mocapfix.initialise.given import array, known_skeleton, variances
from mocapfix.initialise.twist import regressor
from mocapfix.kernels.hybrik import ADAPTIVE, NAIVE, Seen, X, recur_frames
from mocapfix.kernels.threads import over_frames
from mocapfix.motion import FOLDED, GUESSED, PLACED, STRETCHED, Motion
from mocapfix.subject import Subject

Way = Literal["naive", "adaptive", "x"]

WAYS: dict[str, int] = {"naive": NAIVE, "adaptive": ADAPTIVE, "x": X}
DEVIATION = 0.01  # metres per axis: how far a joint is taken to be from where it is given, where nobody says
MISSED = 0.02  # metres: a hand or the head so far from where the bones can bring it is worth a word
NO_TWIST = 1e-6  # 1/rad^2: how sure it is that a bone of which nothing is known is not twisted


def hybrik(
    positions: ArrayLike,
    subject: Subject,
    *,
    way: Way = "x",
    deviation: ArrayLike = DEVIATION,
    twists: ArrayLike | None = None,
    markers: ArrayLike | None = None,
    held: ArrayLike | None = None,
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

    Raises ConstraintError where an array has not the shape it must have, or holds what cannot be.
    """
    skeleton = known_skeleton(subject)
    places = array("positions", positions, (None, len(skeleton.names), 3))
    frames, joints = places.shape[:2]
    if way not in tuple(WAYS):
        raise ConstraintError(f"There is no way {way!r} of HybrIK; choose one of: {', '.join(WAYS)}.")
    habits = prior.load("mean-pose", skeleton)
    held = (stubs(skeleton, habits) if way == "x" else np.zeros(joints)) if held is None else held
    bones, trunk = bones_of(skeleton, habits, Wearing(subject, markers is not None), array("held", held, (joints,)).astype(bool))
    points = places
    if markers is not None:
        points = np.concatenate([places, array("markers", markers, (frames, len(subject.joints), 3))], axis=1)
    variance = variances(deviation, places, points.shape[1])
    place, turn, known = root.registered(trunk, points, variance, way == "x")
    local = np.tile(habits.rotations, (frames, 1, 1, 1))
    local[:, 0], missed = turn, np.empty(frames)
    said = regressor().regressed(places, turn) if twists is None else array("twists", twists, (None, joints, 2), False)
    if len(said) not in {1, frames}:
        raise ConstraintError(f"twists must be for all {frames} frames, or one for every frame; they are for {len(said)}.")
    over_frames(recur_frames, frames, bones, WAYS[way], Seen(points, variance, said + [NO_TWIST, 0.0]), place, local, missed)
    status = np.select([~known, missed > MISSED, missed < -MISSED], [GUESSED, STRETCHED, FOLDED], PLACED)
    unknown = np.full((frames, len(subject.joints)), np.nan), np.full((frames, joints), np.nan)
    return Motion(place, local, status, np.zeros(frames, int), *unknown)
