"""A film of keypoints whose poses and camera are known."""

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.keypoints.film_solver import build_camera, build_camera_rotation, load_detector
from mocapfix.model.motion import Motion
from mocapfix.solve.kinematics import compute_world_poses
from mocapfix.solve.single_pose import Camera
from mocapfix.synthetic import compose_take

IMAGE_WIDTH_PX = 1280
IMAGE_HEIGHT_PX = 720
CAMERA_SCALE_PX_M = 180.0  # pixels per metre
FLOOR_HEIGHT_PX = 600.0  # row of the floor in the image
SUBJECT_HEADING_RAD = np.radians(60)  # 0: facing the camera
KEYPOINT_NOISE_SD_M = 0.012  # of a keypoint of confidence 1; inversely proportional to the confidence
MISSING_KEYPOINT_SHARE = 0.05  # of the keypoints


def compose_example_film(
    detector_name: str, seconds: float, rate: float, seed: int = 0
) -> tuple[dict[str, Any], Float[np.ndarray, "T J 3"], Camera]:
    """Return the contents of a JSON file for `film_solver.read_keypoints`, the true joints in metres and the true camera."""
    rng, take = np.random.default_rng(seed), compose_take(seed=seed, seconds=seconds, rate=rate)
    skeleton = take.subject.skeleton
    detector = load_detector(detector_name, skeleton)
    joints, rotations = compute_world_poses(skeleton, _rotate_heading(take.motion))
    positions = detector.compute_point_positions(joints, rotations)
    middle = CAMERA_SCALE_PX_M * (joints[:, 0, 0].min() + joints[:, 0, 0].max()) / 2
    camera = build_camera(build_camera_rotation(0.0), CAMERA_SCALE_PX_M, np.array([IMAGE_WIDTH_PX / 2 - middle, FLOOR_HEIGHT_PX]))
    confidence = rng.uniform(0.5, 1.0, positions.shape[:2])
    noise = rng.normal(size=positions.shape[:2] + (2,))
    pixels = camera.project(positions) + CAMERA_SCALE_PX_M * KEYPOINT_NOISE_SD_M / confidence[..., None] * noise
    points = np.concatenate([pixels.round(1), confidence.round(2)[..., None]], axis=-1)
    points[rng.random(confidence.shape) < MISSING_KEYPOINT_SHARE] = 0.0
    frames = [{"people": [{detector.json_key: frame.ravel().tolist()}]} for frame in points]
    film = {"order": detector_name, "rate": rate, "image": [IMAGE_WIDTH_PX, IMAGE_HEIGHT_PX], "frames": frames}
    return film, joints, camera


def _rotate_heading(motion: Motion) -> Motion:
    """Return the motion, rotated about the vertical."""
    rotation = Rotation.from_euler("y", SUBJECT_HEADING_RAD).as_matrix()
    local = motion.local_rotations.copy()
    local[:, 0] = rotation @ local[:, 0]
    root = motion.root_position @ rotation.T
    return Motion(root, local, motion.status, motion.iterations, motion.marker_sd, motion.joint_sd)
