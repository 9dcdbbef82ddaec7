"""HybrIK: the pose of every frame in closed form from its joint positions (Li et al. 2021; HybrIK-X: Li et al. 2023)."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from mocapfix.errors import ConstraintError
from mocapfix.kernels.hybrik import HYBRIK_ADAPTIVE, HYBRIK_NAIVE, HYBRIK_X, HybrikObservations, solve_hybrik_frames
from mocapfix.kernels.joint_registration import RootPoints, register_root_frames
from mocapfix.model.motion import FrameStatus, Motion
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.solve import mean_pose
from mocapfix.solve.parallel import run_over_frames
from mocapfix.solve.twist_regressor import MarkedSubject, build_bones, find_stub_joints, load_shipped_regressor

HybrikVariant = Literal["naive", "adaptive", "x"]

VARIANT_CODES: dict[str, int] = {"naive": HYBRIK_NAIVE, "adaptive": HYBRIK_ADAPTIVE, "x": HYBRIK_X}
DEFAULT_JOINT_SD_M = 0.01
"""Standard deviation per axis of a joint position for which none is given."""
MIN_JOINT_SD_M = 1e-6
"""Smallest accepted standard deviation of a joint position."""
MAX_REACH_ERROR_M = 0.02
"""Distance between a hand or the head and the nearest position its bones can reach above which the frame's status says so."""
NO_TWIST_INFORMATION = 1e-6
"""Information, in 1/rad^2, of a zero twist for bones whose twist is unknown."""
MIN_ROOT_POINTS = 3
"""Points of a frame that determine the root rotation."""


class RootRegistration(NamedTuple):
    """The root of T frames: position (T, 3) m, rotation (T, 3, 3), and (T,) whether the frame itself determines them."""

    position: np.ndarray
    rotation: np.ndarray
    is_known: np.ndarray


def solve_hybrik(
    positions: ArrayLike,
    subject: Subject,
    *,
    variant: HybrikVariant | str = "x",
    joint_sd: ArrayLike | float = DEFAULT_JOINT_SD_M,
    twists: ArrayLike | None = None,
    markers: ArrayLike | None = None,
    held_joints: ArrayLike | None = None,
) -> Motion:
    """Return the pose of every frame, each independent of the others.

    The root is registered to the hips (HybrIK's appendix A, with reflections excluded). Then, down the tree, each bone is swung
    to its far end and twisted according to markers or to the twist regressor. Joints without a bone to a known point keep the
    mean pose. A frame that does not determine the root takes it from its neighbours.

    Variants: "naive" rotates each bone according to the relative positions of the given joints (Algorithm 1), so that errors of
    the bone lengths accumulate. "adaptive" points it from the position that its joint obtained (Algorithm 2). "x" treats hands
    and head as trees of their own, brings them to their positions and bends the joint before to reach them (HybrIK-X, 3.2.3); it
    also fits the position of the hips.

    Parameters
    ----------
    positions    (T, J, 3) m, Y up, from any source; NaN where unknown
    joint_sd     standard deviation of the joint positions in metres per axis, one for all or (T, J)
    twists       (T or 1, J, 2) cosine and sine of the angle about each bone, scaled by its information in 1/rad^2; by default
                 they are predicted from the joint positions
    markers      (T, K, 3) m in the subject's order, NaN if not visible; those off a bone's axis determine its twist
    held_joints  (J,) bool: joints that keep the mean pose; by default the hip stubs for "x" and none for the other variants

    The `status` of the returned motion marks frames that were guessed and frames whose hands or head the bones do not reach.
    Raises ConstraintError for an array of the wrong shape or with invalid values.
    """
    skeleton = get_cmu_skeleton(subject)
    joint_positions = check_array("positions", positions, (None, len(skeleton.names), 3))
    frame_count, joint_count = joint_positions.shape[:2]
    if variant not in tuple(VARIANT_CODES):
        raise ConstraintError(f"There is no HybrIK variant {variant!r}; choose one of: {', '.join(VARIANT_CODES)}.")
    prior = mean_pose.load_mean_pose_prior("mean-pose", skeleton)
    if held_joints is None:
        held_joints = find_stub_joints(skeleton, prior) if variant == "x" else np.zeros(joint_count)
    is_held = check_array("held_joints", held_joints, (joint_count,)).astype(bool)
    bones, root_points = build_bones(skeleton, prior, MarkedSubject(subject, markers is not None), is_held)
    points = joint_positions
    if markers is not None:
        marker_positions = check_array("markers", markers, (frame_count, len(subject.joints), 3))
        points = np.concatenate([joint_positions, marker_positions], axis=1)
    variance = compute_point_variances(joint_sd, joint_positions, points.shape[1])
    root = register_root(root_points, points, variance, variant == "x")
    local_rotations = np.tile(prior.mean_rotations, (frame_count, 1, 1, 1))
    local_rotations[:, 0], reach_error = root.rotation, np.empty(frame_count)
    if twists is None:
        weighted_twists = load_shipped_regressor().predict_twists(joint_positions, root.rotation)
    else:
        weighted_twists = check_array("twists", twists, (None, joint_count, 2), allow_nan=False)
    if len(weighted_twists) not in {1, frame_count}:
        raise ConstraintError(f"twists must have 1 or {frame_count} frames, not {len(weighted_twists)}.")
    observations = HybrikObservations(points, variance, weighted_twists + [NO_TWIST_INFORMATION, 0.0])
    run_over_frames(
        solve_hybrik_frames,
        frame_count,
        bones,
        VARIANT_CODES[variant],
        observations,
        root.position,
        local_rotations,
        reach_error,
    )
    status = np.select(
        [~root.is_known, reach_error > MAX_REACH_ERROR_M, reach_error < -MAX_REACH_ERROR_M],
        [int(FrameStatus.GUESSED), int(FrameStatus.OUT_OF_REACH), int(FrameStatus.TOO_NEAR)],
        int(FrameStatus.PLACED),
    )
    marker_sd, predicted_joint_sd = (
        np.full((frame_count, len(subject.joints)), np.nan),
        np.full((frame_count, joint_count), np.nan),
    )
    return Motion(root.position, local_rotations, status, np.zeros(frame_count, int), marker_sd, predicted_joint_sd)


def register_root(
    root_points: RootPoints, points: Float[np.ndarray, "T Q 3"], variance: np.ndarray, fit_position: bool
) -> RootRegistration:
    """Return the root of every frame by least squares without reflections (HybrIK, appendix A, whose Eq. 33 allows them).

    Frames with too few points take the rotation of the nearest frame and an interpolated position.

    points        in metres, NaN where unknown; the first is the root
    variance      (T or 1, Q) m^2 per axis
    fit_position  whether the root position is fitted as well; otherwise it is kept where it is known
    """
    frame_count = len(points)
    position, rotation = np.empty((frame_count, 3)), np.empty((frame_count, 3, 3))
    point_count = np.empty(frame_count, int)
    run_over_frames(
        register_root_frames, frame_count, root_points, points, variance, fit_position, position, rotation, point_count
    )
    is_known = point_count >= MIN_ROOT_POINTS
    known = np.flatnonzero(is_known)
    if 0 < len(known) < frame_count:
        frames = np.arange(frame_count)
        nearest = known[np.rint(np.interp(frames, known, np.arange(len(known)))).astype(int)]
        interpolated = np.stack([np.interp(frames, known, position[known, axis]) for axis in range(3)], axis=1)
        # a known root position is kept although its rotation is not determined
        fallback = np.where(np.isnan(points[:, :1]).any(axis=2), interpolated, points[:, 0])
        position, rotation = np.where(is_known[:, None], position, fallback), rotation[nearest]
    return RootRegistration(position, rotation, is_known)


def get_cmu_skeleton(subject: Subject) -> Skeleton:
    """Return the subject's skeleton. Raises ConstraintError unless it has the 31 joints of the CMU skeleton."""
    if subject.skeleton.names != load_cmu31_body().skeleton.names:
        raise ConstraintError("HybrIK requires the 31 joints of the CMU skeleton; the subject has other joints.")
    return subject.skeleton


def check_array(name: str, values: ArrayLike | float, shape: tuple[int | None, ...], allow_nan: bool = True) -> np.ndarray:
    """Return an argument as a contiguous array of floats.

    Raises ConstraintError if its shape differs from `shape` (None: any length), or if it has infinite or forbidden NaN values.
    """
    try:
        array = np.asarray(values).astype(float, order="C", casting="same_kind", copy=False)
    except (TypeError, ValueError) as error:
        raise ConstraintError(f"{name} must be an array of numbers ({error}).") from error
    expected = ", ".join("any" if length is None else str(length) for length in shape)
    if array.ndim != len(shape) or any(b not in {None, a} for a, b in zip(array.shape, shape, strict=True)):
        raise ConstraintError(f"{name} must be of shape ({expected}), not {array.shape}.")
    if np.isinf(array).any() or (not allow_nan and np.isnan(array).any()):
        remedy = "; mark unknown values with NaN" if allow_nan else ""
        raise ConstraintError(f"{name} holds a number that is not finite{remedy}.")
    return array


def compute_point_variances(
    joint_sd: ArrayLike | float, positions: Float[np.ndarray, "T J 3"], point_count: int
) -> Float[np.ndarray, "N Q"]:
    """Return the variances (T or 1, Q) in m^2 per axis: of joints from their standard deviation, 0 for all other points.

    Raises ConstraintError if the standard deviation of a known joint is below MIN_JOINT_SD_M.
    """
    shape = positions.shape[:2] if np.ndim(joint_sd) else ()
    sd = check_array("joint_sd", joint_sd, shape)
    is_known = ~np.isnan(positions).any(axis=2) if shape else ()
    if not (sd[is_known] >= MIN_JOINT_SD_M).all():
        raise ConstraintError(f"joint_sd must be {MIN_JOINT_SD_M:g} metres or more wherever the position of the joint is known.")
    variances = np.zeros((len(positions) if shape else 1, point_count))
    variances[:, : positions.shape[1]] = np.nan_to_num(np.square(sd), nan=1.0)  # unknown joints are not used
    return variances
