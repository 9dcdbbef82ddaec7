"""What people's poses say of the lost joints of any body whose joints are known to be people's.

The model knows the 31 joints. The file's are told to it as these, and what it says of them is turned back into the file's.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix import retarget
from mocapfix.animation import carried
from mocapfix.fitted import Fitted
from mocapfix.kernels import quaternions
from mocapfix.solve.people import People


@dataclass(frozen=True)
class MappedPeople(People):
    """A trained model of poses, asked of a file's joints.

    parents  (J,) the file's tree;  fit  how the 31 joints lie in it
    """

    parents: np.ndarray
    fit: Fitted

    def turns(self, local: np.ndarray, told: np.ndarray, lost: np.ndarray, frames: np.ndarray, near: np.ndarray) -> np.ndarray:
        """As `People.turns`, of the file's joints; of those that no joint of the 31 stands for it is `near`."""
        body = self.fit.joints[1:]
        known, wanted = (1 + np.flatnonzero(np.isin(body, joints)) for joints in (told, lost))
        if not len(known) or not len(wanted):
            return near
        there = local[frames]
        _, world = carried(self.parents, np.zeros(there.shape[:3]), there)
        ours = retarget.ours(world, self.fit)
        said = super().turns(ours, known, wanted, np.arange(len(frames)), np.ones((len(frames), 4 * len(wanted))))
        for at, joint in enumerate(wanted):
            ours[:, joint] = Rotation.from_quat(said[:, 4 * at : 4 * at + 4]).as_matrix()
            there[:, self.fit.joints[joint]] = retarget.theirs(self.parents, there, self.fit, int(joint), ours)
        found = near.reshape(len(frames), len(lost), 4).copy()
        for at, joint in enumerate(lost):
            if joint in self.fit.joints[wanted]:
                turned = 2 * quaternions.of_joint(there, int(joint), np.ones(len(frames), bool))
                found[:, at] = np.where((turned * found[:, at]).sum(1, keepdims=True) < 0, -turned, turned)
        return found.reshape(near.shape)
