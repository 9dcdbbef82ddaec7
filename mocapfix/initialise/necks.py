"""The joints of a neck, which carry no markers: how each bends is people's habit, though both its ends are known."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.kernels import kinematics
from mocapfix.motion import Motion
from mocapfix.prior import Prior
from mocapfix.subject import Subject


def bent(found: Motion, subject: Subject, habits: Prior) -> Motion:
    """-> the motion, joints on the way to a leaf with markers bent from the mean pose by equal parts of the leaf's turn.

    Two short bones that are all but straight fold this way or that for a millimetre more or less between their ends. Their
    solve would end on that side: markers hardly tell.
    """
    skeleton, rotations = subject.skeleton, found.rotations.copy()
    world = kinematics.world(skeleton, found)[1]
    for chain in chains(subject):
        turn = world[:, skeleton.parents[chain[0]]].swapaxes(1, 2) @ world[:, chain[-1]]
        mean = np.linalg.multi_dot(habits.rotations[chain])
        vector = Rotation.from_matrix(mean.T @ turn).as_rotvec()
        part = Rotation.from_rotvec(vector / len(chain)).as_matrix()
        before = np.eye(3)
        for j in chain[:-1]:
            rotations[:, j] = habits.rotations[j] @ part
            before = before @ rotations[:, j]
        rotations[:, chain[-1]] = np.swapaxes(before, -1, -2) @ turn
    return replace(found, rotations=rotations)


def chains(subject: Subject) -> list[list[int]]:
    """-> for each leaf with markers, the joints down to it from the last one with markers above: none, where that is next."""
    parents, carrying = subject.skeleton.parents, set(subject.joints.tolist())
    found = []
    for leaf in carrying - set(parents.tolist()):
        chain = [leaf]
        while int(parents[chain[0]]) > 0 and int(parents[chain[0]]) not in carrying:
            chain.insert(0, int(parents[chain[0]]))
        if len(chain) > 1:
            found.append(chain)
    return found
