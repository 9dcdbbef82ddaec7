"""What somebody gives to be posed, made sure of."""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from mocapfix.errors import ConstraintError
from mocapfix.initialise.bones import MarkedSubject, build_bones, find_stub_joints
from mocapfix.initialise.twist_regressor import load_shipped_regressor
from mocapfix.kernels.hybrik import HYBRIK_ADAPTIVE, HYBRIK_NAIVE, HYBRIK_X, HybrikObservations, solve_hybrik_frames
from mocapfix.kernels.joint_registration import RootPoints, register_root_frames
from mocapfix.motion import FOLDED, GUESSED, PLACED, STRETCHED, Motion
from mocapfix.pose_prior import mean_pose
from mocapfix.skeleton import Skeleton, load_cmu31_body
from mocapfix.solve.parallel import run_over_frames
from mocapfix.subject import Subject

# MERGED: mocapfix.initialise.given
MIN_JOINT_SD_M = 1e-6  # metres: nobody knows a joint better


def get_cmu_skeleton(subject: Subject) -> Skeleton:
    """-> the subject's skeleton. Raises ConstraintError where it is not the CMU skeleton's 31 joints."""
    if subject.skeleton.names != load_cmu31_body().skeleton.names:
        raise ConstraintError("HybrIK is for the 31 joints of the CMU skeleton; the subject's are others.")
    return subject.skeleton


def check_array(name: str, values: ArrayLike, shape: tuple[int | None, ...], allow_nan: bool = True) -> np.ndarray:
    """-> what was given, as the kernels want it. Raises ConstraintError where it has not the shape, None being any number; or
    where a number is infinite or, unless some may be unknown, NaN."""
    try:
        found = np.asarray(values).astype(float, order="C", casting="same_kind", copy=False)
    except (TypeError, ValueError) as error:
        raise ConstraintError(f"{name} must be an array of numbers ({error}).") from error
    wanted = ", ".join("any" if length is None else str(length) for length in shape)
    if found.ndim != len(shape) or any(b not in {None, a} for a, b in zip(found.shape, shape, strict=True)):
        raise ConstraintError(f"{name} must be of shape ({wanted}), not {found.shape}.")
    if np.isinf(found).any() or (not allow_nan and np.isnan(found).any()):
        raise ConstraintError(f"{name} holds a number that is not finite{'; what is unknown must be NaN' if allow_nan else ''}.")
    return found


def compute_point_variances(joint_sd: ArrayLike, positions: np.ndarray, point_count: int) -> np.ndarray:
    """-> (T or 1, Q) m^2 per axis: of joints, as their deviation says, and 0 of the other points, which have their own spread.

    Raises ConstraintError where the deviation of a known joint is not from LEAST up.
    """
    shape = positions.shape[:2] if np.ndim(joint_sd) else ()
    joint_sd = check_array("deviation", joint_sd, shape)
    known = ~np.isnan(positions).any(axis=2) if shape else ()
    if not (joint_sd[known] >= MIN_JOINT_SD_M).all():
        raise ConstraintError(f"A deviation must be {MIN_JOINT_SD_M:g} metres or more wherever the joint's position is known.")
    found = np.zeros((len(positions) if shape else 1, point_count))
    found[:, : positions.shape[1]] = np.nan_to_num(np.square(joint_sd), nan=1.0)  # of what is unknown nobody asks
    return found


# MERGED: mocapfix.initialise.root
# The root's place and turn, frame by frame, by registering what it carries; from the frames around where that is too little.
MIN_ROOT_POINTS = 3  # places that tell a turn


def register_root(
    root_points: RootPoints, points: np.ndarray, variance: np.ndarray, fit_position: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> place (T, 3) metres and turn (T, 3, 3) of the root, and (T,) bool: whether the frame itself tells them.

    The rotation of least squares, never a reflection (HybrIK, appendix A, whose Eq. 33 does not rule it out).

    points    (T, Q, 3) metres, NaN where unknown; the first is the root
    variance  (T or 1, Q) m^2 per axis
    refine    whether the root's own place is fitted, too, or, where it is known, left as it is given
    """
    frames = len(points)
    place, turn, places = np.empty((frames, 3)), np.empty((frames, 3, 3)), np.empty(frames, int)
    run_over_frames(register_root_frames, frames, root_points, points, variance, fit_position, place, turn, places)
    told, source = places >= MIN_ROOT_POINTS, np.flatnonzero(places >= MIN_ROOT_POINTS)
    if 0 < len(source) < frames:
        nearest = source[np.rint(np.interp(np.arange(frames), source, np.arange(len(source)))).astype(int)]
        guess = np.stack([np.interp(np.arange(frames), source, place[source, a]) for a in range(3)], axis=1)
        here = np.where(np.isnan(points[:, :1]).any(axis=2), guess, points[:, 0])  # seen, it stays, however it is turned
        place, turn = np.where(told[:, None], place, here), turn[nearest]
    return place, turn, told


# MERGED: mocapfix.initialise.closed_form
# HybrIK: every frame's pose in closed form from where its joints are (Li et al. 2021; HybrIK-X: Li et al. 2023).
HybrikVariant = Literal["naive", "adaptive", "x"]

VARIANT_CODES: dict[str, int] = {"naive": HYBRIK_NAIVE, "adaptive": HYBRIK_ADAPTIVE, "x": HYBRIK_X}
DEFAULT_JOINT_SD_M = 0.01  # metres per axis: how far a joint is taken to be from where it is given, where nobody says
MAX_REACH_ERROR_M = 0.02  # metres: a hand or the head so far from where the bones can bring it is worth a word
NO_TWIST_INFORMATION = 1e-6  # 1/rad^2: how sure it is that a bone of which nothing is known is not twisted


def solve_hybrik(
    positions: ArrayLike,
    subject: Subject,
    *,
    variant: HybrikVariant = "x",
    joint_sd: ArrayLike = DEFAULT_JOINT_SD_M,
    twists: ArrayLike | None = None,
    markers: ArrayLike | None = None,
    held_joints: ArrayLike | None = None,
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
    skeleton = get_cmu_skeleton(subject)
    places = check_array("positions", positions, (None, len(skeleton.names), 3))
    frames, joints = places.shape[:2]
    if variant not in tuple(VARIANT_CODES):
        raise ConstraintError(f"There is no way {variant!r} of HybrIK; choose one of: {', '.join(VARIANT_CODES)}.")
    habits = mean_pose.load_mean_pose_prior("mean-pose", skeleton)
    held_joints = (
        (find_stub_joints(skeleton, habits) if variant == "x" else np.zeros(joints)) if held_joints is None else held_joints
    )
    bones, trunk = build_bones(
        skeleton, habits, MarkedSubject(subject, markers is not None), check_array("held", held_joints, (joints,)).astype(bool)
    )
    points = places
    if markers is not None:
        points = np.concatenate([places, check_array("markers", markers, (frames, len(subject.joints), 3))], axis=1)
    variance = compute_point_variances(joint_sd, places, points.shape[1])
    place, turn, known = register_root(trunk, points, variance, variant == "x")
    local = np.tile(habits.mean_rotations, (frames, 1, 1, 1))
    local[:, 0], missed = turn, np.empty(frames)
    said = (
        load_shipped_regressor().predict_twists(places, turn)
        if twists is None
        else check_array("twists", twists, (None, joints, 2), False)
    )
    if len(said) not in {1, frames}:
        raise ConstraintError(f"twists must be for all {frames} frames, or one for every frame; they are for {len(said)}.")
    run_over_frames(
        solve_hybrik_frames,
        frames,
        bones,
        VARIANT_CODES[variant],
        HybrikObservations(points, variance, said + [NO_TWIST_INFORMATION, 0.0]),
        place,
        local,
        missed,
    )
    status = np.select([~known, missed > MAX_REACH_ERROR_M, missed < -MAX_REACH_ERROR_M], [GUESSED, STRETCHED, FOLDED], PLACED)
    unknown = np.full((frames, len(subject.joints)), np.nan), np.full((frames, joints), np.nan)
    return Motion(place, local, status, np.zeros(frames, int), *unknown)
