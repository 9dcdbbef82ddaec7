"""The circumstances of a body by which moments of a take are alike (see `kernels.process`), and how far that tells of its joints.

Its other joints turned and turning alike, the root as high, as upright, as fast.

The numbers below make the smallest error on CMU's training subjects, arms and legs lost for 0.5 to 2 s. A length for every part
of the body in place of the few here, a slow course through time, or likeness that time wears out, gained less than 2 %.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.kernels.process import Likeness

MOMENT = 0.067  # seconds before and after, over which turning is measured
TURNED, TURNING = 1.0, 50.0  # radians, radians a second: the differences of joints that count as one
UPRIGHT, HEIGHT = 0.5, 0.5  # of the up vector; metres
SPEED, SPIN = 5.0, 20.0  # metres a second, radians a second, of the root
LIKENESS = Likeness(smooth=0.3, like=0.6, time=0.06, again=1.6, together=0.8, noise=1.5e-4)
# Of turns that a file gives and nobody solved from markers: they are exact, so that moments less near and less alike tell, too.
EXACT = Likeness(smooth=0.45, like=0.08, time=0.4, again=6.0, together=0.8, noise=1e-5)


def circumstances(root: np.ndarray, local: np.ndarray, told: np.ndarray, frames: np.ndarray, rate: float) -> np.ndarray:
    """-> (N, F) the circumstances of the body at N `frames`, each in units of a difference that counts as one.

    root (T, 3) metres, local (T, J, 3, 3); told: indices of the joints that are asked
    """
    span, last = max(1, round(MOMENT * rate)), len(root) - 1
    before, after = np.maximum(frames - span, 0), np.minimum(frames + span, last)
    seconds = (after - before) / rate + (last == 0)

    def turning(joints: np.ndarray) -> np.ndarray:
        step = np.swapaxes(local[before][:, joints], -1, -2) @ local[after][:, joints]
        return (Rotation.from_matrix(step.reshape(-1, 3, 3)).as_rotvec().reshape(len(frames), -1)) / seconds[:, None]

    inside = np.swapaxes(local[frames, 0], 1, 2)
    moving = np.einsum("tab,tb->ta", inside, root[after] - root[before]) / seconds[:, None]
    turned = local[frames][:, told].reshape(len(frames), -1) / np.sqrt(2)  # a small turn's size is that of its matrix over sqrt 2
    joints, hips = [turned / TURNED, turning(told) / TURNING], [inside[:, :, 1] / UPRIGHT, root[frames, 1:2] / HEIGHT]
    return np.concatenate([*joints, *hips, moving / SPEED, turning(np.array([0])) / SPIN], axis=1)
