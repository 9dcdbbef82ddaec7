"""SCOPE's three experiments: how long a Gauss-Newton direction takes as joints, measurements and shape parameters grow.

SCOPE, section 5.6 and supplement B, on the trees of a body without hands (K = 23 joints) and with them (K = 51). N counts
measured numbers, that is rows of the Jacobian (SCOPE, Table 6): a 3-D keypoint is three. Every joint has its pull.
"""

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.bench.scene import Scene, placed
from mocapfix.kernels.pose import Pose, Tree
from mocapfix.kernels.terms import Courses, Directions, Points, Views

# pelvis; hips and spine; knees, ankles, feet; neck, collars, head, shoulders, elbows, wrists
BODY = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
WRISTS, FINGERS, KNUCKLES = (20, 21), 5, 3
JOINTS = (23, 51)  # K: all but the pelvis
MEASURED = tuple(range(120, 601, 120))  # N
SHAPES = tuple(range(11))  # P
EACH = 3 + 2 + 3  # numbers: a 3-D keypoint, a 2-D keypoint, a part orientation
SD = 0.01  # of a measurement: metres, radians, and the camera's focal length
HABIT = 0.5  # radians, of a joint from its target


def parents(hands: bool) -> np.ndarray:
    """-> (K + 1,) the tree: one joint for each hand, or three for each of its fingers."""
    tree = [*BODY]
    for wrist in WRISTS:
        for _ in range(FINGERS if hands else 1):
            tree += [wrist, *range(len(tree), len(tree) + KNUCKLES - 1)] if hands else [wrist]
    return np.array(tree)


def scene(joints: int, keypoints: int, each: bool, shapes: int, seed: int = 0) -> Scene:
    """-> a random body of K = `joints` joints with so many 3-D keypoints spread over it, seen nearly where they are.

    each  every joint also carries a 3-D keypoint, a 2-D keypoint and a part orientation
    """
    rng, parent = np.random.default_rng(seed), parents(hands=joints == max(JOINTS))
    bodies = np.arange(len(parent))
    alone = bodies if each else bodies[:0]
    local = Rotation.from_rotvec(rng.normal(0, 0.5, (len(parent), 3))).as_matrix()
    offsets, shape = rng.normal(0, 0.15, (len(parent), 3)), rng.normal(0, 0.01, (shapes, len(parent), 3))
    tree = Tree(parent, offsets, np.ones(len(parent), bool), shape)
    pose = placed(tree, np.zeros(3), local)
    pull = Courses(local[None, rng.permutation(len(parent))], np.full((1, len(parent)), HABIT**-2), np.zeros((1, 3)), np.zeros(1))
    points = keypoints_of(rng, pose, np.concatenate([np.arange(keypoints) % len(parent), alone]))
    return Scene(tree, points, images_of(rng, pose, alone), parts_of(rng, pose, alone), pull, pose)


def keypoints_of(rng: np.random.Generator, pose: Pose, joints: np.ndarray) -> Points:
    """-> 3-D keypoints on these joints (N,)."""
    places = rng.normal(0, 0.1, (len(joints), 3))
    return Points(joints, places, near(rng, world_of(pose, joints, places)), np.full((1, len(joints)), SD**-2))


def images_of(rng: np.random.Generator, pose: Pose, joints: np.ndarray) -> Views:
    """-> 2-D keypoints on these joints (N,), as a camera 4 m before the body sees them."""
    places, camera = rng.normal(0, 0.1, (len(joints), 3)), np.array([[0.0, 0.0, 4.0]])
    there = world_of(pose, joints, places) + camera
    seen, one = near(rng, there[:, :2] / there[:, 2:]), np.zeros(len(joints), int)
    return Views(joints, places, one, np.eye(3)[None], camera, np.ones(1, bool), seen, np.full((1, len(joints)), SD**-2))


def parts_of(rng: np.random.Generator, pose: Pose, joints: np.ndarray) -> Directions:
    """-> part orientations of these joints (N,)."""
    along = rng.normal(0, 1, (len(joints), 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    seen = near(rng, np.einsum("nab,nb->na", pose.rotation[joints], along))
    return Directions(joints, along, seen, np.full((1, len(joints)), SD**-2))


def world_of(pose: Pose, joints: np.ndarray, places: np.ndarray) -> np.ndarray:
    """-> (N, 3) metres: where the joints carry these places."""
    return pose.position[joints] + np.einsum("nab,nb->na", pose.rotation[joints], places)


def near(rng: np.random.Generator, true: np.ndarray) -> np.ndarray:
    """-> what is measured in the one frame, three standard deviations off."""
    return (true + rng.normal(0, 3 * SD, true.shape))[None]


def experiments(shapes: tuple[int, ...] = SHAPES) -> Iterator[tuple[dict[str, int], Scene]]:
    """-> each experiment's settings at each point of its course, and the scene: experiments 1, 2, and 3 for these P."""
    for number, count in ((1, 0), (2, max(SHAPES))):
        for joints in JOINTS:
            for numbers in MEASURED:
                row = {"experiment": number, "joints": joints, "measured": numbers, "shapes": count}
                yield row, scene(joints, numbers // 3, False, count)
    for joints in JOINTS:
        for count in shapes:
            row = {"experiment": 3, "joints": joints, "measured": EACH * (joints + 1), "shapes": count}
            yield row, scene(joints, 0, True, count)
