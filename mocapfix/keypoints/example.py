"""Keypoints of a motion that mocapfix composes, as a detector might have found them: the shipped scene, with known truth."""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix import synthetic
from mocapfix.kernels import kinematics
from mocapfix.keypoints import detector
from mocapfix.keypoints.camera import Camera, looking
from mocapfix.motion import Motion

WIDTH, HEIGHT = 1280, 720  # pixels
SCALE, FLOOR = 180.0, 600.0  # pixels per metre; where the floor is in the image
TURN = np.radians(60)  # from facing the camera
STRAYS = 0.012  # metres: how far a point lies off that was surely found; a doubtful one as much farther as it is doubtful
LOST = 0.05  # part of the points that are not found


def film(order: str, seconds: float, rate: float, seed: int = 0) -> tuple[dict, np.ndarray, Camera]:
    """-> what mocapfix.keypoints.read takes, the true joints (T, J, 3) in metres and the true camera."""
    rng, truth = np.random.default_rng(seed), synthetic.take(seed=seed, seconds=seconds, rate=rate)
    skeleton, known = truth.subject.skeleton, detector.load(order, truth.subject.skeleton)
    joints, turns = kinematics.world(skeleton, _turned(truth.motion))
    places = known.placed(joints, turns)
    middle = SCALE * (joints[:, 0, 0].min() + joints[:, 0, 0].max()) / 2
    camera = Camera(looking(0.0), SCALE, np.array([WIDTH / 2 - middle, FLOOR]))
    sure = rng.uniform(0.5, 1.0, places.shape[:2])
    pixels = camera.image(places) + SCALE * STRAYS / sure[..., None] * rng.normal(size=places.shape[:2] + (2,))
    points = np.concatenate([pixels.round(1), sure.round(2)[..., None]], axis=-1)
    points[rng.random(sure.shape) < LOST] = 0.0
    people = [{"people": [{known.key: frame.ravel().tolist()}]} for frame in points]
    return {"order": order, "rate": rate, "image": [WIDTH, HEIGHT], "frames": people}, joints, camera


def _turned(motion: Motion) -> Motion:
    """-> the motion, facing another way."""
    turn = Rotation.from_euler("y", TURN).as_matrix()
    local = motion.rotations.copy()
    local[:, 0] = turn @ local[:, 0]
    return Motion(motion.root @ turn.T, local, motion.status, motion.iterations, motion.deviation, motion.joint_deviation)
