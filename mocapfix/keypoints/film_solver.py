"""Keypoints that a detector found in a film, and its poses and camera from these alone (MNN-IK, 5.2; HybrIK-X, Eqs. 21-22).

One person and one scaled orthographic camera: its scale is one for all frames, estimated on some of them by solving those again
for every scale. HybrIK-X alternates a pose for the scale and the scale in closed form, which converges slowly, as a pose can lean
until it fits nearly any large scale. Its fixed point, the scale that reproduces itself, is found by the secant method instead.

An image does not determine whether a knee points towards the camera or away, nor always which way a person faces. So, at that
scale, each frame is solved from several headings, the most likely sequence of the solutions is found (Viterbi's algorithm), and
all frames are solved again, tracking that sequence made smooth.

Keypoints are read from one JSON file for a film,

    {"order": "openpose", "rate": 30, "image": [1280, 720], "frames": [{"people": [{"pose_keypoints_2d": [x, y, c, ...]}]}, ...]}

x and y in pixels, to the right and down, c the confidence from 0 (not found) to 1; or from OpenPose's own output: a folder with a
JSON file for each frame, ordered by name, or one such file. Both have the same frames. With COCO's points the key is "keypoints".
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from pydantic import PositiveFloat
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError, SceneError, TakeError
from mocapfix.io.keypoint_json import describe_unread_hands
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.io.yaml_files import StrictModel, read_yaml_model
from mocapfix.model.motion import Motion, PoseUncertainty
from mocapfix.model.skeleton import Skeleton
from mocapfix.solve.kinematics import build_kinematic_tree, compute_tree_poses
from mocapfix.solve.minimise import PoseSolution, SolverSettings, minimise
from mocapfix.solve.model_terms import INITIAL_CODE_DAMPING, PoseModelTerm
from mocapfix.solve.pose_prior import PoseModel
from mocapfix.solve.single_pose import Camera
from mocapfix.solve.smoothing import smooth_poses
from mocapfix.solve.terms import KinematicTree, ReprojectionTerm, TrackingTerm, compute_robust_weights
from mocapfix.stats.sequences import find_cheapest_states


@dataclass(frozen=True)
class KeypointDetector:
    """The V keypoints of a detector."""

    name: str
    json_key: str  # the key of a person's points in its JSON
    labels: tuple[str, ...]  # V names
    joints: Int[np.ndarray, " V"]  # the joint that carries each
    offsets: Float[np.ndarray, "V 3"]  # metres, in the joint's axes
    # standard deviation per axis of a point detected with confidence 1, people's differences included
    sd_m: Float[np.ndarray, " V"]

    def compute_point_positions(
        self, joints: Float[np.ndarray, "T J 3"], rotations: Float[np.ndarray, "T J 3 3"]
    ) -> Float[np.ndarray, "T V 3"]:
        """Return the keypoints' world positions in metres, for joints' world positions and rotations."""
        return joints[:, self.joints] + np.einsum("tvab,vb->tva", rotations[:, self.joints], self.offsets)


class _DetectorPoint(StrictModel):
    joint: str
    offset: tuple[float, float, float]
    sd: PositiveFloat


class _DetectorFile(StrictModel):
    name: str
    key: str
    points: dict[str, _DetectorPoint]


def list_detectors() -> list[str]:
    return sorted(path.stem for path in (find_shipped_folder("scenes") / "keypoints").glob("*.yaml"))


def load_detector(name: str, skeleton: Skeleton) -> KeypointDetector:
    """Return the detector scenes/keypoints/NAME.yaml. Raises SceneError that lists the shipped ones, or names the invalid key."""
    if name not in list_detectors():
        raise SceneError(f"Unknown keypoint order {name!r}; choose one of: {', '.join(list_detectors())}.")
    file = read_yaml_model(_DetectorFile, find_shipped_folder("scenes") / "keypoints" / f"{name}.yaml")
    points = file.points.values()
    for label, point in file.points.items():
        if point.joint not in skeleton.names:
            raise SceneError(f"keypoints/{name}.yaml: points.{label}.joint: the skeleton has no joint {point.joint!r}.")
    joints = np.array([skeleton.find_joint(point.joint) for point in points])
    offsets, sd_m = np.array([point.offset for point in points]), np.array([point.sd for point in points])
    return KeypointDetector(file.name, file.key, tuple(file.points), joints, offsets, sd_m)


FRAME_FILE_DETECTOR = "openpose"  # the detector that writes a file for each frame
MIN_SHARED_CONFIDENCE = 1e-9  # sum of two people's confidences, by which a distance is divided


@dataclass(frozen=True)
class Keypoints:
    """One person's keypoints over T frames."""

    detector: KeypointDetector
    position_px: Float[np.ndarray, "T V 2"]  # to the right and down; anything where the confidence is 0
    confidence: Float[np.ndarray, "T V"]  # 0 to 1; 0 where a point was not found
    rate_hz: float | None  # None if the file does not contain it
    image_size_px: tuple[float, float] | None  # width and height; None if the file does not contain them
    notes: list[str] = field(default_factory=list)

    @property
    def frame_count(self) -> int:
        return len(self.position_px)


def read_keypoints(path: Path, skeleton: Skeleton) -> Keypoints:
    """Return the most visible person's keypoints. Raises ReadError that names the file, the frame (from 0) and the key."""
    files = sorted(path.glob("*.json")) if path.is_dir() else [path]
    if not files:
        raise ReadError(f"{path}: contains no keypoints (.json); give a file, or the folder that OpenPose wrote.")
    content = _read_json(files[0])
    if "people" in content:
        order, rate, image = FRAME_FILE_DETECTOR, None, None
        frames = [(str(file), _read_json(file)) for file in files]
    else:
        order, rate, image = _parse_header(path, content)
        frames = [(f"{path}: frames.{t}", frame) for t, frame in enumerate(content["frames"])]
    try:
        detector = load_detector(order, skeleton)
    except SceneError as error:
        raise ReadError(f"{path}: order: {error}") from error
    points = track_person([_parse_people(where, frame, detector) for where, frame in frames], len(detector.labels))
    if not points[..., 2].any():
        raise ReadError(f"{path}: no person was found in any frame.")
    position_px, confidence = np.ascontiguousarray(points[..., :2]), np.ascontiguousarray(points[..., 2])
    return Keypoints(detector, position_px, confidence, rate, image, describe_unread_hands(frame for _, frame in frames))


def track_person(people: list[Float[np.ndarray, "_ V 3"]], points: int) -> Float[np.ndarray, "T V 3"]:
    """Return the points (x, y, confidence) of one of the people found in each frame; zero where no person was found.

    The person is the most visible one in the first frame with people, and then the one nearest to their last position.
    """
    track, last = np.zeros((len(people), points, 3)), None
    for t, found in enumerate(people):
        if not len(found):
            continue
        person = found[found[..., 2].sum(axis=1).argmax()]
        if last is not None:
            weight = found[..., 2] * last[:, 2]
            distance = np.linalg.norm(found[..., :2] - last[:, :2], axis=-1)
            mean_distance = (weight * distance).sum(axis=1) / np.maximum(weight.sum(axis=1), MIN_SHARED_CONFIDENCE)
            person = found[np.where(weight.any(axis=1), mean_distance, np.inf).argmin()]
        track[t] = last = person
    return track


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ReadError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error}).") from error
    except json.JSONDecodeError as error:
        raise ReadError(f"{path}, line {error.lineno}: is not valid JSON ({error.msg}).") from error
    if not isinstance(content, dict) or not ("people" in content or "frames" in content):
        raise ReadError(f"{path}: contains neither frames nor people; is it a file of keypoints?")
    return content  # pyright: ignore[reportUnknownVariableType] (JSON)


def _parse_header(path: Path, content: dict[str, Any]) -> tuple[str, float | None, tuple[float, float] | None]:
    """Return order, rate and image size of a film's file."""
    order, rate, image = content.get("order"), content.get("rate"), content.get("image")
    if not isinstance(order, str):
        raise ReadError(f"{path}: order: must be one of {', '.join(list_detectors())}, not {order!r}.")
    if rate is not None and not (isinstance(rate, int | float) and 0 < rate < np.inf):
        raise ReadError(f"{path}: rate: must be frames a second, more than 0, not {rate!r}.")
    sides = image if isinstance(image, list) and len(image) == 2 else [0]
    if image is not None and not all(isinstance(side, int | float) and 0 < side < np.inf for side in sides):
        raise ReadError(f"{path}: image: must be [width, height] in pixels, not {image!r}.")
    if not isinstance(content["frames"], list) or not content["frames"]:
        raise ReadError(f"{path}: frames: must be a list of at least one frame.")
    size = (float(image[0]), float(image[1])) if image else None
    return order, None if rate is None else float(rate), size


def _parse_people(where: str, frame: object, detector: KeypointDetector) -> Float[np.ndarray, "N V 3"]:
    """Return the people of a frame: x, y and confidence, clipped to 0 to 1."""
    people = frame.get("people") if isinstance(frame, dict) else None
    if not isinstance(people, list):
        raise ReadError(f"{where}: people: must be a list.")
    points = np.zeros((len(people), len(detector.labels), 3))
    for n, person in enumerate(people):
        try:
            numbers = np.array(person[detector.json_key], float)
            points[n] = numbers.reshape(len(detector.labels), 3)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            expected = f"x, y and confidence of {len(detector.labels)} points ({detector.name})"
            raise ReadError(f"{where}: people.{n}.{detector.json_key}: must contain {expected}.") from error
    if not np.isfinite(points).all():
        raise ReadError(f"{where}: people: contains a number that is not finite.")
    points[..., 2] = points[..., 2].clip(0, 1)
    return points


SCALE_TOLERANCE = 2e-3  # of the scale's logarithm: a smaller step ends the search
MAX_SCALE_STEP = 0.2  # of the scale's logarithm
MAX_SCALE_EVALUATIONS = 12
MIN_DAMPING_SLOPE = 0.05  # least slope of the secant method, for scales that nearly reproduce any scale
MIN_WEIGHT = 1e-300  # of a frame, by which a mean is divided


def build_camera(rotation: Float[np.ndarray, "3 3"], scale_px_m: float, origin_px: Float[np.ndarray, "2"]) -> Camera:
    """Return a scaled orthographic camera.

    Args:
        rotation: World to camera: x right, y down, z ahead.
        scale_px_m: Pixels per metre.
        origin_px: The image of the world's origin.
    """
    return Camera(rotation, (0.0, 0.0, 0.0), scale_px_m, origin_px, perspective=False)


def build_camera_rotation(pitch_down_rad: float) -> Float[np.ndarray, "3 3"]:
    """Return the rotation from world to camera of a camera pitched down that faces -Z, the front of a person."""
    sine, cosine = np.sin(pitch_down_rad), np.cos(pitch_down_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, -cosine, sine], [0.0, -sine, -cosine]])


def fit_camera_scale(
    flat: Float[np.ndarray, "T V 2"], position_px: Float[np.ndarray, "T V 2"], weight: Float[np.ndarray, "T V"]
) -> float:
    """Return pixels per metre: Eq. 22 in closed form, one for all frames, each frame's offset free; NaN without points.

    Args:
        flat: Metres: the points projected to the camera's image plane.
    """
    a, b = subtract_weighted_mean(flat, weight), subtract_weighted_mean(position_px, weight)
    extent = (weight[..., None] * a * a).sum()
    return float((weight[..., None] * a * b).sum() / extent) if extent > 0 else np.nan


def subtract_weighted_mean(
    points: Float[np.ndarray, "*batch V 2"], weight: Float[np.ndarray, "*batch V"]
) -> Float[np.ndarray, "*batch V 2"]:
    """Return points relative to the weighted mean of their frame."""
    total = np.maximum(weight.sum(axis=-1), MIN_WEIGHT)[..., None]
    return points - ((weight[..., None] * points).sum(axis=-2) / total)[..., None, :]


def solve_camera_scale(estimate_scale: Callable[[float], float], initial_scale: float) -> float:
    """Return the fixed point estimate_scale(scale) = scale, by the secant method on logarithms."""
    log_scale = np.log(initial_scale)
    error = np.log(estimate_scale(initial_scale)) - log_scale
    step = np.clip(error, -MAX_SCALE_STEP, MAX_SCALE_STEP)
    for _ in range(MAX_SCALE_EVALUATIONS - 1):
        if abs(step) < SCALE_TOLERANCE:
            break
        log_scale, previous_error = log_scale + step, error
        error = np.log(estimate_scale(float(np.exp(log_scale)))) - log_scale
        slope = (error - previous_error) / step  # -1 if the estimate does not depend on the scale, 0 if it always equals it
        step = np.clip(error / max(-slope, MIN_DAMPING_SLOPE), -MAX_SCALE_STEP, MAX_SCALE_STEP)
    return float(np.exp(log_scale + step))


ROOT_POSITION_SD_M = 10.0  # of the root about its start, as an orthographic camera does not determine its distance
MAX_FILM_ITERATIONS = 30  # of a frame
WIDE_ROBUST_SCALE_SD = 10.0  # Geman-McClure scale, in standard deviations: the weight of a keypoint farther away tends to zero
NARROW_ROBUST_SCALE_SD = 6.0  # likewise, of the final solve
MIN_KEYPOINT_CONFIDENCE = 0.1  # keypoints of less confidence are ignored


@dataclass(frozen=True)
class ReprojectionProblem:
    """T frames of keypoints, each solved independently."""

    skeleton: Skeleton
    detector: KeypointDetector
    model: PoseModel
    prior_scale: float  # factor on the prior's standard deviations
    rotation: Float[np.ndarray, "3 3"]  # world to camera
    position_px: Float[np.ndarray, "T V 2"]
    weight: Float[np.ndarray, "T V"]  # 1/m^2; 0 for a missing keypoint
    robust_scales_sd: tuple[float, ...] = (WIDE_ROBUST_SCALE_SD, NARROW_ROBUST_SCALE_SD)  # wide to narrow

    def select_frames(self, frames: Int[np.ndarray, " N"]) -> "ReprojectionProblem":
        """Return the problem of some frames, by index; an index may be repeated."""
        return replace(self, position_px=self.position_px[frames], weight=self.weight[frames])

    @property
    def tree(self) -> KinematicTree:
        return build_kinematic_tree(self.skeleton)

    def solve(
        self,
        scale_px_m: float,
        root: Float[np.ndarray, "T 3"],
        local: Float[np.ndarray, "T J 3 3"],
        tracking: TrackingTerm | None = None,
    ) -> PoseSolution:
        """Return the solved poses for a camera scale, from the poses root and local, which are tracked weakly by default."""
        d, joints = self.detector, len(self.skeleton.names)
        reprojection = ReprojectionTerm(
            d.joints, d.offsets, np.zeros(len(d.joints), int), self.rotation[None], np.zeros((1, 3)), np.zeros(1, bool),
            np.ascontiguousarray(self.position_px / scale_px_m), self.weight,
        )  # fmt: skip
        near_start = TrackingTerm(np.zeros((1, joints, 3, 3)), np.zeros((1, joints)), root, np.full(1, ROOT_POSITION_SD_M**-2))
        terms = (reprojection, tracking or near_start, PoseModelTerm(self.model, self.prior_scale))
        settings = SolverSettings(tuple(scale**2 for scale in self.robust_scales_sd), MAX_FILM_ITERATIONS, INITIAL_CODE_DAMPING)
        return minimise(self.tree, terms, (root, local), settings)

    def compute_positions(
        self, root: Float[np.ndarray, "T 3"], local: Float[np.ndarray, "T J 3 3"]
    ) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T V 3"]]:
        """Return the world positions of the joints and of the keypoints, in metres."""
        joints, rotations = compute_tree_poses(self.tree, root, local)
        return joints, self.detector.compute_point_positions(joints, rotations)

    def project_to_image_plane(self, positions: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Return world positions in the camera's x and y axes, in metres."""
        return positions @ self.rotation[:2].T

    def compute_robust_weights(self, scale_px_m: float, positions: Float[np.ndarray, "T V 3"]) -> Float[np.ndarray, "T V"]:
        """Return the keypoints' weights in 1/m^2, beside points at `positions`, at the solve's last robust scale."""
        error = self.position_px / scale_px_m - self.project_to_image_plane(positions)
        square = self.weight * (error**2).sum(axis=-1)
        return self.weight * compute_robust_weights(square, self.robust_scales_sd[-1] ** 2)


HEADING_COUNT = 6  # start headings of each frame, in equal steps
JOINT_SPEED_SD_M_S = 1.0  # per axis, of a joint relative to the root
POSE_DOF = 12  # independent numbers of a step between poses, as joints do not move independently
MAX_SCALE_FRAMES = 16  # from which the scale is estimated
MIN_KEYPOINTS_PER_FRAME = 4  # in a frame from which the scale is estimated
SCALE_QUANTILE = 0.9  # of the frames' scales for a standing pose: most poses look smaller than a standing person
FRAME_POSE_SD = 0.1  # radians and metres: error of a frame's own pose
MISSING_FRAME_POSE_SD = 10.0  # likewise, of a frame without keypoints


def solve_film(
    keypoints: Keypoints,
    rate: float,
    skeleton: Skeleton,
    model: PoseModel,
    rotation: Float[np.ndarray, "3 3"],
    prior_scale: float = 1.0,
) -> tuple[Motion, Camera]:
    """Return the motion, with the floor at height zero and the first frame's root above the origin, and the camera.

    The error of the camera's scale is that of the skeleton's size: an image does not distinguish a tall person far away from a
    short one.

    Args:
        rotation: World to camera, see `build_camera_rotation`.
        prior_scale: Factor on the prior's standard deviations (2 = weaker prior).

    Raises:
        TakeError: If the keypoints are too few, or not those of an upright person, to determine the scale.
    """
    is_found = keypoints.confidence >= MIN_KEYPOINT_CONFIDENCE
    weight = np.where(is_found, (keypoints.confidence / keypoints.detector.sd_m) ** 2, 0.0)
    problem = ReprojectionProblem(skeleton, keypoints.detector, model, prior_scale, rotation, keypoints.position_px, weight)
    scale_px_m = estimate_camera_scale(problem)
    solution, _, cost = solve_headings(problem, scale_px_m)
    joints, _ = problem.compute_positions(solution.root_position, solution.local_rotations)
    frames = keypoints.frame_count
    step_cost = compute_transition_costs(joints.reshape(frames, -1, *joints.shape[1:]), rate)
    best = np.arange(frames) * cost.shape[1] + find_cheapest_states(step_cost, cost)
    is_visible = np.any(weight > 0, axis=1)
    root, local, shape = solution.root_position[best], solution.local_rotations[best].copy(), joints.shape[1]
    variance = np.where(is_visible, FRAME_POSE_SD, MISSING_FRAME_POSE_SD) ** 2
    of_joints, no_markers = np.repeat(variance[:, None], shape, 1), np.zeros((frames, 0))
    uncertainty = PoseUncertainty(no_markers, np.zeros((frames, shape)), of_joints, variance)
    is_uncertain = np.repeat(~is_visible[:, None], shape, 1)
    tracking = smooth_poses(root, local, uncertainty, is_uncertain, np.ones(shape, bool), rate)
    solution = problem.solve(scale_px_m, tracking.root, tracking.rotations, tracking)
    # The lowest joint is at height zero, and the first root above the origin.
    joints, _ = problem.compute_positions(solution.root_position, solution.local_rotations)
    origin = np.array([solution.root_position[0, 0], joints[..., 1].min(), solution.root_position[0, 2]])
    poses = solution.root_position - origin, solution.local_rotations
    motion = Motion(*poses, solution.status, solution.iterations, no_markers, np.full(joints.shape[:2], np.nan))
    return motion, build_camera(problem.rotation, scale_px_m, scale_px_m * problem.project_to_image_plane(origin))


def estimate_camera_scale(problem: ReprojectionProblem) -> float:
    """Return the scale (pixels per metre) that reproduces itself, on frames with enough keypoints, spread over the film."""
    usable = np.flatnonzero((problem.weight > 0).sum(axis=1) >= MIN_KEYPOINTS_PER_FRAME)
    if not len(usable):
        raise TakeError(
            f"No frame has {MIN_KEYPOINTS_PER_FRAME} keypoints with a confidence of {MIN_KEYPOINT_CONFIDENCE:g} or more, "
            "which a body needs at least."
        )
    count = min(MAX_SCALE_FRAMES, len(usable))
    sample = problem.select_frames(usable[np.linspace(0, len(usable) - 1, count).round().astype(int)])
    sample = replace(sample, robust_scales_sd=(WIDE_ROBUST_SCALE_SD,))  # at a wrong scale many keypoints lie far from the body

    local = None

    def estimate_scale(scale_px_m: float) -> float:
        nonlocal local  # the solution for one scale is the start for the next
        solution, positions, cost = solve_headings(sample, scale_px_m, local)
        local = solution.local_rotations
        best = positions.reshape(*cost.shape, *positions.shape[1:])[np.arange(len(cost)), cost.argmin(axis=1)]
        weight = sample.compute_robust_weights(scale_px_m, best)
        return check_camera_scale(fit_camera_scale(sample.project_to_image_plane(best), sample.position_px, weight))

    return solve_camera_scale(estimate_scale, check_camera_scale(estimate_initial_scale(sample)))


def check_camera_scale(scale_px_m: float) -> float:
    """Return the scale. Raises TakeError if it is not positive: for points in one place, or an upside-down person."""
    if not scale_px_m > 0:
        raise TakeError(
            "The keypoints do not determine the size of a body; pixels must count to the right and down, "
            "and the person must be upright."
        )
    return scale_px_m


def estimate_initial_scale(problem: ReprojectionProblem) -> float:
    """Return pixels per metre for the reference pose in the heading that looks largest: most poses look smaller than standing."""
    headings = rotate_to_headings(problem.model.reference_rotations)
    _, positions = problem.compute_positions(np.zeros((HEADING_COUNT, 3)), headings)
    flat = problem.project_to_image_plane(positions)
    scales = [
        max(fit_camera_scale(heading[None], pixels[None], weight[None]) for heading in flat)
        for pixels, weight in zip(problem.position_px, problem.weight, strict=True)
    ]
    return float(np.quantile(scales, SCALE_QUANTILE))


def solve_headings(
    problem: ReprojectionProblem, scale_px_m: float, local: Float[np.ndarray, "TH J 3 3"] | None = None
) -> tuple[PoseSolution, Float[np.ndarray, "TH V 3"], Float[np.ndarray, "T H"]]:
    """Return the solutions of each frame from each heading, frame after frame, their keypoints in metres, and their costs.

    Args:
        local: Where to start; None for the reference pose, in all headings.
    """
    count = len(problem.position_px)
    repeated = problem.select_frames(np.repeat(np.arange(count), HEADING_COUNT))
    if local is None:
        local = np.tile(rotate_to_headings(problem.model.reference_rotations), (count, 1, 1, 1))
    _, positions = repeated.compute_positions(np.zeros((len(local), 3)), local)
    error = repeated.position_px / scale_px_m - repeated.project_to_image_plane(positions)
    shift = (error - subtract_weighted_mean(error, repeated.weight))[:, 0]  # the mean, the same in every row
    root = shift @ repeated.rotation[:2]
    solution = repeated.solve(scale_px_m, root, local)
    _, positions = repeated.compute_positions(solution.root_position, solution.local_rotations)
    return solution, positions, solution.cost.reshape(count, -1)


def rotate_to_headings(pose: Float[np.ndarray, "J 3 3"]) -> Float[np.ndarray, "H J 3 3"]:
    """Return the pose facing the camera and rotated about the vertical in equal steps."""
    poses = np.tile(pose, (HEADING_COUNT, 1, 1, 1))
    angles = 2 * np.pi / HEADING_COUNT * np.arange(HEADING_COUNT)[:, None]
    poses[:, 0] = Rotation.from_euler("y", angles).as_matrix() @ pose[0]
    return poses


def compute_transition_costs(joints: Float[np.ndarray, "T H J 3"], rate: float) -> Float[np.ndarray, "T-1 H H"]:
    """Return the cost of the step from each solution of a frame to each solution of the next, from their joints in metres."""
    from_root = joints - joints[:, :, :1]
    square = ((from_root[:-1, :, None] - from_root[1:, None]) ** 2).sum(-1).mean(-1)
    return 0.5 * POSE_DOF / 3 * square / (JOINT_SPEED_SD_M_S / rate) ** 2
