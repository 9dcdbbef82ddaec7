"""SCOPE's three experiments: how long a Gauss-Newton direction takes as joints, measurements and shape parameters grow.

SCOPE, section 5.6 and supplement B, on the trees of a body without hands (K = 23 joints) and with them (K = 51). N counts
measured numbers, that is rows of the Jacobian (SCOPE, Table 6): a 3-D keypoint is three. Every joint has its pull.
"""

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.bench.scene import ROWS, Measured, Scene, posed
from mocapfix.kernels.levenberg import Pull, Tree, of_frame

# pelvis; hips and spine; knees, ankles, feet; neck, collars, head, shoulders, elbows, wrists
BODY = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
WRISTS, FINGERS, KNUCKLES = (20, 21), 5, 3
JOINTS = (23, 51)  # K: all but the pelvis
MEASURED = tuple(range(120, 601, 120))  # N
SHAPES = tuple(range(11))  # P
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
    """-> a random body of K = `joints` joints with so many 3-D keypoints spread over it.

    each  every joint also carries a 3-D keypoint, a 2-D keypoint and a part orientation
    """
    rng, tree = np.random.default_rng(seed), parents(hands=joints == max(JOINTS))
    bodies = np.arange(len(tree))
    carried = np.concatenate([np.arange(keypoints) % len(tree), bodies if each else bodies[:0]])
    alone = bodies if each else bodies[:0]
    points, projections, orientations = (measured(rng, on, shapes) for on in (carried, alone, alone))
    local = Rotation.from_rotvec(rng.normal(0, 0.5, (len(tree), 3))).as_matrix()
    habit = np.tile(np.eye(3) / HABIT**2, (1, len(tree), 1, 1))
    pull = Pull(local[None, rng.permutation(len(tree))], habit, np.zeros((1, 3)), np.zeros(1))
    body = Tree(tree, rng.normal(0, 0.15, (len(tree), 3)), np.ones(len(tree), bool))
    growth = rng.normal(0, 0.01, (shapes, len(tree), 3))
    eye, root = np.array([0.0, 0.0, -4.0]), np.zeros(3)
    return aimed(rng, posed(body, growth, points, projections, orientations, eye, of_frame(pull, 0), root, local))


def measured(rng: np.random.Generator, joints: np.ndarray, shapes: int) -> Measured:
    """-> measurements that these joints (N,) carry, of what is still to be said."""
    places, growth = rng.normal(0, 0.1, (len(joints), 3)), rng.normal(0, 0.01, (shapes, len(joints), 3))
    return Measured(joints, places, growth, np.zeros_like(places), np.full(len(joints), 1 / SD**2))


def aimed(rng: np.random.Generator, scene: Scene) -> Scene:
    """-> the scene with targets near to where its pose has what is measured."""

    def near(group: Measured, seen) -> Measured:
        arm = np.einsum("nab,nb->na", scene.rotation[group.joints], group.places)
        true = seen(arm, scene.position[group.joints] + arm)
        return group._replace(targets=true + rng.normal(0, 3 * SD, true.shape))

    return scene._replace(
        points=near(scene.points, lambda arm, place: place),
        projections=near(scene.projections, lambda arm, place: (place - scene.eye) / (place - scene.eye)[:, 2:]),
        orientations=near(scene.orientations, lambda arm, place: arm / np.linalg.norm(arm, axis=1, keepdims=True)),
    )


def experiments(shapes: tuple[int, ...] = SHAPES) -> Iterator[tuple[dict[str, int], Scene]]:
    """-> each experiment's settings at each point of its course, and the scene: experiments 1, 2, and 3 for these P."""
    for number, count in ((1, 0), (2, max(SHAPES))):
        for joints in JOINTS:
            for numbers in MEASURED:
                row = {"experiment": number, "joints": joints, "measured": numbers, "shapes": count}
                yield row, scene(joints, numbers // 3, False, count)
    for joints in JOINTS:
        for count in shapes:
            row = {"experiment": 3, "joints": joints, "measured": sum(ROWS) * (joints + 1), "shapes": count}
            yield row, scene(joints, 0, True, count)
