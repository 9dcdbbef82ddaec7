"""HybrIK: the pose of every frame in closed form from its joint positions (Li et al. 2021; HybrIK-X: Li et al. 2023).

A joint's rotation is a twist about its bone, the direction to its children, followed by a swing of the bone (section 3.2). Joint
positions determine the swing. They determine the twist only through the variation among people's poses and through the bones
beyond; a small network predicts it (section 3.3), evaluated here with numpy.
"""

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy.typing import ArrayLike
from safetensors import SafetensorError
from safetensors.numpy import load_file

from mocapfix.errors import ConstraintError, SceneError
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.kernels.hybrik import (
    HYBRIK_ADAPTIVE,
    HYBRIK_NAIVE,
    HYBRIK_X,
    BoneLines,
    HybrikObservations,
    HybrikSkeleton,
    compute_bone_direction_frames,
    evaluate_layer_frames,
    solve_hybrik_frames,
)
from mocapfix.kernels.joint_registration import RootPoints, register_root_frames
from mocapfix.model.motion import FrameStatus, Motion
from mocapfix.model.skeleton import Skeleton, load_cmu31_body, load_cmu31_skeleton
from mocapfix.model.subject import Subject
from mocapfix.solve import mean_pose
from mocapfix.solve.kinematics import Poses
from mocapfix.solve.mean_pose import MeanPosePrior
from mocapfix.solve.parallel import run_over_frames

SUBTREE_ROOTS = ("Head", "LeftHand", "RightHand")
"""The roots of the sub-trees, which are also the end joints of the body (HybrIK-X, 3.2.3)."""
MIN_JOINT_DISTANCE_M = 1e-4  # distance below which two joints count as coincident, with no bone between them
STIFF_JOINT_SD_RAD = 0.1  # standard deviation of the rotation of a joint that hardly turns, such as a clavicle
BONE_MARKER_SD_M = 0.01  # standard deviation per axis of a marker about its offset
WEAK_TRUNK_SD_M = 10.0
"""Standard deviation of trunk joints in the registration of the root: negligible weight unless no point at the hips is known."""


class BonePoint(NamedTuple):
    """A point that a joint's rotation moves."""

    point_index: int  # index among J joints and K markers
    rest_position: np.ndarray  # (3,) m in the joint's axes
    is_child: bool  # whether it is a child joint, which determines the swing
    variance: float  # m^2 per axis about the rest position


def find_separate_joints(skeleton: Skeleton) -> Bool[np.ndarray, " J"]:
    """Find the joints that do not coincide with their parents, so that there is a bone between the two."""
    return (np.linalg.norm(skeleton.offsets, axis=1) > MIN_JOINT_DISTANCE_M) & (skeleton.parents >= 0)


def find_stiff_joints(prior: MeanPosePrior) -> Bool[np.ndarray, " J"]:
    """Find the joints that the mean pose locks about all axes."""
    return np.linalg.matrix_rank(prior.locked_information) == 3


def build_bones(
    subject: Subject, prior: MeanPosePrior, has_markers: bool, is_held: Bool[np.ndarray, " J"]
) -> tuple[HybrikSkeleton, RootPoints]:
    """Return the bones for HybrIK, and the points that determine the root. Markers, if there are any, follow the joints.

    Args:
        prior: The mean pose; a joint that it locks about all axes is stiff, and what it carries moves with its parent.
        is_held: Joints that keep the mean pose.
    """
    skeleton, parents = subject.skeleton, subject.skeleton.parents
    points = [list_bone_points(j, subject, prior, has_markers) for j in range(len(parents))]
    root_points, points[0] = points[0], []
    conflict_joint = np.full(len(parents), -1)
    for k in (skeleton.find_joint(name) for name in SUBTREE_ROOTS):
        conflict_joint[parents[parents[k]]] = k
    near_root = {point.point_index for point in root_points}
    trunk = [point for point in list_trunk_points(skeleton, prior) if point.point_index not in near_root]
    return pack_bones(skeleton, points, is_held, conflict_joint), pack_root_points([*root_points, *trunk])


def pack_bones(
    skeleton: Skeleton, points: list[list[BonePoint]], is_held: Bool[np.ndarray, " J"], conflict_joint: Int[np.ndarray, " J"]
) -> HybrikSkeleton:
    """Return the bones of any tree, from the points that each joint's rotation moves."""
    is_solved = np.array([any(point.is_child for point in each) for each in points]) & ~is_held
    first_point, is_off_axis = np.cumsum([0, *map(len, points)]), np.concatenate([find_off_axis_points(each) for each in points])
    index, rest_position, is_child, variance = map(np.array, zip(*(point for each in points for point in each), strict=True))
    of_points = first_point, index, rest_position, is_child, is_off_axis, variance
    return HybrikSkeleton(skeleton.parents, skeleton.offsets, is_solved, *of_points, conflict_joint)


def pack_root_points(points: list[BonePoint]) -> RootPoints:
    """Return points that determine the root of any tree."""
    index, rest_position, _, variance = map(np.array, zip(*points, strict=True))
    distance = np.linalg.norm(rest_position[:, None] - rest_position, axis=2)
    return RootPoints(index, rest_position, variance, (distance < MIN_JOINT_DISTANCE_M).argmax(axis=1))


def list_bone_points(j: int, subject: Subject, prior: MeanPosePrior, has_markers: bool) -> list[BonePoint]:
    """List all points that the rotation of joint `j` moves."""
    skeleton, offsets = subject.skeleton, subject.skeleton.offsets
    root = [BonePoint(0, np.zeros(3), False, 0.0)] if j == 0 else []
    joints: list[BonePoint] = []
    for c in np.flatnonzero(skeleton.parents == j):
        is_separate = find_separate_joints(skeleton)[c]
        if is_separate or j == 0:
            joints.append(BonePoint(int(c), offsets[c], bool(is_separate), 0.0))
        if find_stiff_joints(prior)[c]:
            for g in np.flatnonzero(skeleton.parents == c):
                position = offsets[c] + prior.mean_rotations[c] @ offsets[g]
                variance = (STIFF_JOINT_SD_RAD * np.linalg.norm(offsets[g])) ** 2 if is_separate else 0.0
                joints.append(BonePoint(int(g), position, False, float(variance)))
    own_markers = np.flatnonzero(subject.joints == j) if has_markers else []
    is_leaf = not joints
    markers = [
        BonePoint(len(skeleton.names) + int(k), subject.marker_offsets[k], is_leaf, BONE_MARKER_SD_M**2) for k in own_markers
    ]
    return root + joints + markers


def find_off_axis_points(points: list[BonePoint]) -> Bool[np.ndarray, " P"]:
    """Find the points of a joint that determine its twist: all but children at the end of its only bone."""
    positions = np.array([point.rest_position for point in points])
    is_child = np.array([point.is_child for point in points], bool)
    if not is_child.any():
        return np.ones(len(points), bool)
    return ~is_child | (np.linalg.norm(positions - positions[is_child].mean(axis=0), axis=1) > MIN_JOINT_DISTANCE_M)


def list_trunk_points(skeleton: Skeleton, prior: MeanPosePrior) -> list[BonePoint]:
    """List all joints but those of the limbs in the mean pose, with a variance of WEAK_TRUNK_SD_M squared."""
    points: list[BonePoint] = []
    positions, rotations = {0: np.zeros(3)}, {0: np.eye(3)}
    for j in range(1, len(skeleton.parents)):
        p = int(skeleton.parents[j])
        if p in positions and not skeleton.names[j].endswith(("UpLeg", "ForeArm")):
            positions[j] = positions[p] + rotations[p] @ skeleton.offsets[j]
            rotations[j] = rotations[p] @ prior.mean_rotations[j]
            points.append(BonePoint(j, positions[j], False, WEAK_TRUNK_SD_M**2))
    return points


CHEST_SPAN_JOINTS = (("Spine1", "LeftArm"), ("Spine1", "RightArm"))
"""Pairs of joints whose direction shows the rotation of the chest, in addition to the bones."""


@dataclass(frozen=True)
class TwistRegressor:
    """A network of L layers with rectifiers between them, for the 31 joints of the CMU skeleton."""

    weights: tuple[np.ndarray, ...]  # L matrices, inputs by outputs
    biases: tuple[np.ndarray, ...]  # L vectors; the last layer has two outputs for each joint that has a bone
    # (J,) standard deviation of people's twists about the prediction; infinite for joints without a bone
    sd_rad: Float[np.ndarray, " J"]

    def predict_twists(
        self, positions: Float[np.ndarray, "T J 3"], root_rotations: Float[np.ndarray, "T 3 3"]
    ) -> Float[np.ndarray, "T J 2"]:
        """Return the cosine and sine of each joint's twist, scaled by its information in 1/rad^2.

        The information is 1 / sd_rad^2, or less if the positions are compatible with many twists, whose mean vector is short; it
        is 0 for joints without a bone.

        Args:
            positions: Joints in the world in metres, NaN where unknown.
            root_rotations: Root axes to world axes.
        """
        outputs = self.evaluate(compute_span_directions(positions, root_rotations))
        joints = np.flatnonzero(np.isfinite(self.sd_rad))
        scale = 1 / (np.maximum(np.hypot(outputs[..., 0], outputs[..., 1]), 1) * self.sd_rad[joints] ** 2)
        twists = np.zeros((len(outputs), len(self.sd_rad), 2))
        twists[:, joints] = outputs * scale[..., None]
        return twists

    def evaluate(self, inputs: Float32[np.ndarray, "T N"]) -> Float32[np.ndarray, "T B 2"]:
        """Return the network's outputs, not normalised: cosine and sine for the B joints with a bone."""
        outputs = np.empty((len(inputs), len(self.biases[-1])), np.float32)
        run_over_frames(evaluate_layer_frames, len(inputs), self.weights, self.biases, inputs, outputs)
        return outputs.reshape(len(inputs), len(self.biases[-1]) // 2, 2)


def compute_bone_vectors(skeleton: Skeleton) -> Float[np.ndarray, "J 3"]:
    """Return each joint's bone in metres: the mean offset of its separate children; NaN without any."""
    bones = np.full(skeleton.offsets.shape, np.nan)
    is_separate = find_separate_joints(skeleton)
    for j in set(skeleton.parents[is_separate]):
        bones[j] = skeleton.offsets[is_separate & (skeleton.parents == j)].mean(axis=0)
    return bones


@cache
def build_twist_spans() -> BoneLines:
    """Return the spans whose directions are the inputs of the network: all bones, and CHEST_SPAN_JOINTS."""
    skeleton = load_cmu31_skeleton()
    spans = [(int(skeleton.parents[j]), int(j)) for j in np.flatnonzero(find_separate_joints(skeleton))]
    rest_vectors = [skeleton.offsets[j] for _, j in spans]
    for start_name, end_name in CHEST_SPAN_JOINTS:
        j = skeleton.find_joint(end_name)
        spans.append((skeleton.find_joint(start_name), j))
        rest_vectors.append(skeleton.offsets[skeleton.parents[j]] + skeleton.offsets[j])
    start, end = np.array(spans).T.copy()
    span_of_joint = {int(j): p for p, j in reversed(list(enumerate(end)))}
    return BoneLines(start, end, np.array([span_of_joint.get(int(j), -1) for j in start]), np.array(rest_vectors))


def compute_span_directions(
    positions: Float[np.ndarray, "T J 3"], root_rotations: Float[np.ndarray, "T 3 3"]
) -> Float32[np.ndarray, "T N"]:
    """Return the directions of all spans in the axes of the root, see `compute_bone_direction_frames`."""
    spans = build_twist_spans()
    directions = np.empty((len(positions), 2, len(spans.start), 3), np.float32)
    inputs = (np.ascontiguousarray(each, float) for each in (positions, root_rotations))
    run_over_frames(compute_bone_direction_frames, len(directions), spans, *inputs, directions)
    return directions.reshape(len(directions), 6 * len(spans.start))


@cache
def load_shipped_regressor() -> TwistRegressor:
    return read_twist_regressor(find_shipped_folder("priors") / "twist.safetensors")


def read_twist_regressor(path: Path) -> TwistRegressor:
    """Read a network. Raises SceneError, naming the file, if it is not one."""
    try:
        tensors = {name: values.astype(np.float32) for name, values in load_file(path).items()}
        layers = range((len(tensors) - 1) // 2)
        weights, biases = (tuple(tensors.pop(f"{kind}.{i}") for i in layers) for kind in ("weights", "offsets"))
        network = TwistRegressor(weights, biases, tensors.pop("sigma").astype(float))
        if tensors:
            raise ValueError(f"unexpected tensors: {', '.join(tensors)}")
        return check_twist_regressor(network)
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise SceneError(f"{path}: is not a twist regressor trained by mocapfix ({' '.join(str(error).split())}).") from error


def check_twist_regressor(network: TwistRegressor) -> TwistRegressor:
    """Return the network. Raises ValueError unless its layers fit the 31 joints and each other and all numbers are finite."""
    skeleton = load_cmu31_skeleton()
    has_bone = ~np.isnan(compute_bone_vectors(skeleton)[:, 0])
    widths = [6 * len(build_twist_spans().start), *map(len, network.biases)]
    if not network.weights or network.sd_rad.shape != has_bone.shape or widths[-1] != 2 * has_bone.sum():
        raise ValueError(f"it must have a cosine and a sine for the {has_bone.sum()} of {len(has_bone)} joints with a bone")
    if [each.shape for each in network.weights] != list(pairwise(widths)):
        raise ValueError(f"its layers are not {' by '.join(map(str, widths))}")
    values = np.concatenate([each.ravel() for each in (*network.weights, *network.biases)])
    if not np.isfinite(values).all() or not ((network.sd_rad > 0) & (np.isfinite(network.sd_rad) == has_bone)).all():
        raise ValueError("it has values that are not finite, or a sigma for a joint without a bone")
    return network


HybrikVariant = Literal["naive", "adaptive", "x"]

VARIANT_CODES: dict[str, int] = {"naive": HYBRIK_NAIVE, "adaptive": HYBRIK_ADAPTIVE, "x": HYBRIK_X}
DEFAULT_JOINT_SD_M = 0.01  # standard deviation per axis of a joint position for which none is given
MIN_JOINT_SD_M = 1e-6  # smallest accepted standard deviation of a joint position
MAX_REACH_ERROR_M = 0.02
"""Distance between a hand or the head and the nearest position its bones can reach above which the frame's status says so."""
NO_TWIST_INFORMATION = 1e-6  # information, in 1/rad^2, of a zero twist for bones whose twist is unknown
MIN_ROOT_POINTS = 3  # points of a frame that determine the root rotation


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

    The `status` of the returned motion marks frames that were guessed and frames whose hands or head the bones do not reach.

    Args:
        positions: (T, J, 3) m, Y up, from any source; NaN where unknown.
        joint_sd: Standard deviation of the joint positions in metres per axis, one for all or (T, J).
        twists: (T or 1, J, 2) cosine and sine of the angle about each bone, scaled by its information in 1/rad^2; by default they
            are predicted from the joint positions.
        markers: (T, K, 3) m in the subject's order, NaN if not visible; those off a bone's axis determine its twist.
        held_joints: (J,) bool: joints that keep the mean pose; by default the hip stubs for "x" and none for the other variants.

    Raises:
        ConstraintError: For an array of the wrong shape or with invalid values.
    """
    skeleton = subject.skeleton
    if skeleton.names != load_cmu31_body().skeleton.names:
        raise ConstraintError("HybrIK requires the 31 joints of the CMU skeleton; the subject has other joints.")
    joint_positions = check_array("positions", positions, (None, len(skeleton.names), 3))
    frame_count, joint_count = joint_positions.shape[:2]
    if variant not in tuple(VARIANT_CODES):
        raise ConstraintError(f"There is no HybrIK variant {variant!r}; choose one of: {', '.join(VARIANT_CODES)}.")
    prior = mean_pose.load_mean_pose_prior("mean-pose", skeleton)
    if held_joints is None:
        is_stub = find_stiff_joints(prior) & ~find_separate_joints(skeleton)  # the hip stubs, redundant with the thighs
        held_joints = is_stub & (variant == "x")
    is_held = check_array("held_joints", held_joints, (joint_count,)).astype(bool)
    bones, root_points = build_bones(subject, prior, markers is not None, is_held)
    points = joint_positions
    if markers is not None:
        marker_positions = check_array("markers", markers, (frame_count, len(subject.joints), 3))
        points = np.concatenate([joint_positions, marker_positions], axis=1)
    variance = compute_point_variances(joint_sd, joint_positions, points.shape[1])
    root_position, root_rotation, is_known = register_root(root_points, points, variance, variant == "x")
    local_rotations = np.tile(prior.mean_rotations, (frame_count, 1, 1, 1))
    local_rotations[:, 0] = root_rotation
    if twists is None:
        weighted_twists = load_shipped_regressor().predict_twists(joint_positions, root_rotation)
    else:
        weighted_twists = check_array("twists", twists, (None, joint_count, 2), allow_nan=False)
    if len(weighted_twists) not in {1, frame_count}:
        raise ConstraintError(f"twists must have 1 or {frame_count} frames, not {len(weighted_twists)}.")
    observations = points, variance, weighted_twists + [NO_TWIST_INFORMATION, 0.0]
    reach_error = solve_hybrik_tree(bones, observations, (root_position, local_rotations), variant)
    status = np.select(
        [~is_known, reach_error > MAX_REACH_ERROR_M, reach_error < -MAX_REACH_ERROR_M],
        [int(FrameStatus.GUESSED), int(FrameStatus.OUT_OF_REACH), int(FrameStatus.TOO_NEAR)],
        int(FrameStatus.PLACED),
    )
    marker_sd, predicted_joint_sd = (np.full((frame_count, n), np.nan) for n in (len(subject.joints), joint_count))
    return Motion(root_position, local_rotations, status, np.zeros(frame_count, int), marker_sd, predicted_joint_sd)


def solve_hybrik_tree(
    bones: HybrikSkeleton, observations: tuple[np.ndarray, np.ndarray, np.ndarray], poses: Poses, variant: HybrikVariant | str
) -> Float[np.ndarray, " T"]:
    """Turn the joints of any tree, in place. Return by how much its sub-trees are out of reach, in metres; negative: too near.

    Args:
        observations: Points, variances and twists; see `HybrikObservations`.
        poses: Their roots are given, and the rotations of joints without a child among the known points.
    """
    reach_error = np.empty(len(poses[0]))
    solved = bones, VARIANT_CODES[variant], HybrikObservations(*observations), *poses, reach_error
    run_over_frames(solve_hybrik_frames, len(reach_error), *solved)
    return reach_error


def register_root(
    root_points: RootPoints, points: Float[np.ndarray, "T Q 3"], variance: np.ndarray, fit_position: bool
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3 3"], Bool[np.ndarray, " T"]]:
    """Return root position (m) and rotation by least squares without reflections (HybrIK, appendix A), and whether known.

    Frames with too few points take the rotation of the nearest frame and an interpolated position.

    Args:
        points: In metres, NaN where unknown; the first is the root.
        variance: (T or 1, Q) m^2 per axis.
        fit_position: Whether the root position is fitted as well; otherwise it is kept where it is known.
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
    return position, rotation, is_known


def check_array(name: str, values: ArrayLike | float, shape: tuple[int | None, ...], allow_nan: bool = True) -> np.ndarray:
    """Return an argument as a contiguous array of floats.

    Raises:
        ConstraintError: If its shape differs from `shape` (None: any length), or if it has infinite or forbidden NaN values.
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

    Raises:
        ConstraintError: If the standard deviation of a known joint is below MIN_JOINT_SD_M.
    """
    shape = positions.shape[:2] if np.ndim(joint_sd) else ()
    sd = check_array("joint_sd", joint_sd, shape)
    is_known = ~np.isnan(positions).any(axis=2) if shape else ()
    if not (sd[is_known] >= MIN_JOINT_SD_M).all():
        raise ConstraintError(f"joint_sd must be {MIN_JOINT_SD_M:g} metres or more wherever the position of the joint is known.")
    variances = np.zeros((len(positions) if shape else 1, point_count))
    variances[:, : positions.shape[1]] = np.nan_to_num(np.square(sd), nan=1.0)  # unknown joints are not used
    return variances
