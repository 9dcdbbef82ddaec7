"""Keypoints of a motion that mocapfix composes, as a detector might have found them: the shipped scene, with known truth."""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix import synthetic
from mocapfix.keypoints import detectors
from mocapfix.keypoints.camera_scale import KeypointCamera, build_camera_rotation
from mocapfix.motion import Motion
from mocapfix.solve import kinematics

IMAGE_WIDTH_PX, IMAGE_HEIGHT_PX = 1280, 720  # pixels
CAMERA_SCALE_PX_M, FLOOR_HEIGHT_PX = 180.0, 600.0  # pixels per metre; where the floor is in the image
SUBJECT_HEADING_RAD = np.radians(60)  # from facing the camera
KEYPOINT_NOISE_SD_M = (
    0.012  # metres: how far a point lies off that was surely found; a doubtful one as much farther as it is doubtful
)
MISSING_KEYPOINT_SHARE = 0.05  # part of the points that are not found


def compose_example_film(
    detector_name: str, seconds: float, rate: float, seed: int = 0
) -> tuple[dict, np.ndarray, KeypointCamera]:
    """-> what mocapfix.keypoints.keypoint_file takes, the true joints (T, J, 3) in metres and the true camera."""
    rng, truth = np.random.default_rng(seed), synthetic.compose_take(seed=seed, seconds=seconds, rate=rate)
    skeleton, known = truth.subject.skeleton, detectors.load_detector(detector_name, truth.subject.skeleton)
    joints, turns = kinematics.compute_world_poses(skeleton, _rotate_heading(truth.motion))
    places = known.compute_point_positions(joints, turns)
    middle = CAMERA_SCALE_PX_M * (joints[:, 0, 0].min() + joints[:, 0, 0].max()) / 2
    camera = KeypointCamera(
        build_camera_rotation(0.0), CAMERA_SCALE_PX_M, np.array([IMAGE_WIDTH_PX / 2 - middle, FLOOR_HEIGHT_PX])
    )
    sure = rng.uniform(0.5, 1.0, places.shape[:2])
    pixels = camera.project(places) + CAMERA_SCALE_PX_M * KEYPOINT_NOISE_SD_M / sure[..., None] * rng.normal(
        size=places.shape[:2] + (2,)
    )
    points = np.concatenate([pixels.round(1), sure.round(2)[..., None]], axis=-1)
    points[rng.random(sure.shape) < MISSING_KEYPOINT_SHARE] = 0.0
    people = [{"people": [{known.json_key: frame.ravel().tolist()}]} for frame in points]
    return {"order": detector_name, "rate": rate, "image": [IMAGE_WIDTH_PX, IMAGE_HEIGHT_PX], "frames": people}, joints, camera


def _rotate_heading(motion: Motion) -> Motion:
    """-> the motion, facing another way."""
    turn = Rotation.from_euler("y", SUBJECT_HEADING_RAD).as_matrix()
    local = motion.local_rotations.copy()
    local[:, 0] = turn @ local[:, 0]
    return Motion(motion.root_position @ turn.T, local, motion.status, motion.iterations, motion.marker_sd, motion.joint_sd)
