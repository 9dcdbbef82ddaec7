"""Poses and camera of a film, from its keypoints alone (MNN-IK, 5.2; HybrIK-X, Eqs. 21-22).

One person and one camera: its scale is one for all frames, found on some of them by solving those anew for every scale that
is asked. At that scale each frame is solved from several headings, the likeliest course through the guesses is taken, and
all frames once more, pulled to that course made smooth.
"""

from dataclasses import replace

import numpy as np

from mocapfix.errors import TakeError
from mocapfix.kernels.problem import Uncertainty
from mocapfix.keypoints import guesses
from mocapfix.keypoints.camera import Camera, answering, centred, fitted_scale
from mocapfix.keypoints.read import Keypoints
from mocapfix.keypoints.sight import NOT_FOUND, WIDE, Sight
from mocapfix.motion import Motion
from mocapfix.prior.contract import PoseModel
from mocapfix.skeleton import Skeleton
from mocapfix.solve import courses
from mocapfix.solve.options import SolveOptions
from mocapfix.solve.poses import Posed

TELLING = 16  # frames at most that tell the scale
ENOUGH = 4  # keypoints in a frame that does
STANDING = 0.9  # of a film's frames look smaller than somebody who stands
STRAYS, SILENT = 0.1, 10.0  # radians, and metres: how far one frame's pose is wrong by itself; one in which nobody was found


def film(
    keypoints: Keypoints, rate: float, skeleton: Skeleton, model: PoseModel, rotation: np.ndarray, strength: float = 1.0
) -> tuple[Motion, Camera]:
    """-> the motion, the floor at a height of zero and the first frame's root over the origin, and the camera.

    rotation  (3, 3) world to camera, see camera.looking
    strength  times the model's standard deviations: with 2 it is believed half as much

    The camera's scale is as right as the skeleton's size: an image does not tell a tall person far away from a short one.

    Raises TakeError where the keypoints are too few, or not those of somebody upright, to tell it.
    """
    weight = np.where(keypoints.confidence < NOT_FOUND, 0.0, (keypoints.confidence / keypoints.detector.sd) ** 2)
    sight = Sight(skeleton, keypoints.detector, model, strength, rotation, keypoints.pixels, weight)
    scale = scale_of(sight)
    poses, _, cost = guessed(sight, scale)
    joints, _ = sight.placed(poses.root, poses.rotations)
    count = keypoints.frames
    path = guesses.likeliest(cost, guesses.steps(joints.reshape(count, -1, *joints.shape[1:]), rate))
    taken = np.arange(count) * cost.shape[1] + path
    smooth = course(poses.root[taken], poses.rotations[taken], np.any(weight > 0, axis=1), rate)
    poses = sight.solved(scale, smooth.root, smooth.rotations, smooth)
    return on_the_floor(sight, poses, scale)


def scale_of(sight: Sight) -> float:
    """-> pixels per metre that answer themselves: of the frames that show most, spread over the film."""
    shown = np.flatnonzero((sight.weight > 0).sum(axis=1) >= ENOUGH)
    if not len(shown):
        raise TakeError(
            f"In no frame are {ENOUGH} keypoints found with a confidence of {NOT_FOUND:g} and more: too few for a body."
        )
    few = sight.at(shown[np.linspace(0, len(shown) - 1, min(TELLING, len(shown))).round().astype(int)])
    few = replace(few, robust=(WIDE,))  # at a scale that is too small much lies far off, and must say so

    local = None

    def answer(scale: float) -> float:
        nonlocal local  # what one scale gave is near what the next will give
        poses, places, cost = guessed(few, scale, local)
        local = poses.rotations
        best = places.reshape(*cost.shape, *places.shape[1:])[np.arange(len(cost)), cost.argmin(axis=1)]
        return upright(fitted_scale(few.flat(best), few.pixels, few.trust(scale, best)))

    return answering(answer, upright(first_scale(few)))


def upright(scale: float) -> float:
    """-> the scale. Raises TakeError where it is none: by points in one place, or of somebody who stands on his head."""
    if not scale > 0:
        raise TakeError(
            "The keypoints tell no size of a body; do their pixels count to the right and down, from somebody upright?"
        )
    return scale


def first_scale(sight: Sight) -> float:
    """-> pixels per metre, by the middle pose in the heading that looks largest: most poses are no larger than they stand."""
    _, places = sight.placed(np.zeros((guesses.HEADINGS, 3)), guesses.turned(sight.model.middle))
    flat = sight.flat(places)
    scales = [
        max(fitted_scale(heading[None], pixels[None], weight[None]) for heading in flat)
        for pixels, weight in zip(sight.pixels, sight.weight, strict=True)
    ]
    return float(np.quantile(scales, STANDING))


def guessed(sight: Sight, scale: float, local: np.ndarray | None = None) -> tuple[Posed, np.ndarray, np.ndarray]:
    """-> each frame's guesses, one frame's after another's, their points (T H, V, 3) in metres, and their costs (T, H).

    local  (T H, J, 3, 3) where to start; None for the middle pose, in all headings
    """
    count = len(sight.pixels)
    many = sight.at(np.repeat(np.arange(count), guesses.HEADINGS))
    local = np.tile(guesses.turned(sight.model.middle), (count, 1, 1, 1)) if local is None else local
    _, places = many.placed(np.zeros((len(local), 3)), local)
    off = many.pixels / scale - many.flat(places)
    shift = (off - centred(off, many.weight))[:, 0]  # the mean, in every row
    root = shift @ many.rotation[:2]
    poses = many.solved(scale, root, local)
    _, places = many.placed(poses.root, poses.rotations)
    return poses, places, poses.cost.reshape(count, -1)


def course(root: np.ndarray, local: np.ndarray, seen: np.ndarray, rate: float):
    """-> the smooth course of poses (T, 3) and (T, J, 3, 3), as a pull; frames not seen (T,) lie on it."""
    frames, joints = local.shape[:2]
    variance = np.where(seen, STRAYS, SILENT) ** 2
    known = Uncertainty(np.zeros((frames, 0)), np.zeros((frames, joints)), np.repeat(variance[:, None], joints, 1), variance)
    return courses.smooth(root, local.copy(), known, np.ones(joints, bool), rate, SolveOptions())


def on_the_floor(sight: Sight, poses: Posed, scale: float) -> tuple[Motion, Camera]:
    """-> the motion moved so that the lowest joint is at zero height and the first root over the origin; its camera with it."""
    joints, _ = sight.placed(poses.root, poses.rotations)
    origin = np.array([poses.root[0, 0], joints[..., 1].min(), poses.root[0, 2]])
    none, unknown = np.zeros((len(joints), 0)), np.full(joints.shape[:2], np.nan)
    motion = Motion(poses.root - origin, poses.rotations, poses.status, poses.iterations, none, unknown)
    return motion, Camera(sight.rotation, scale, scale * sight.flat(origin))
