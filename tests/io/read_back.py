"""Motions for tests of the writers, and a BVH reader that is independent of the package."""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import load_cmu31_body

SKELETON = load_cmu31_body().skeleton


class Bvh:
    """The content of a BVH in file units and order."""

    def __init__(self, text):
        self.names, self.parents, self.offsets, self.channels, self.ends = [], [], [], [], {}
        head, motion = text.split("MOTION\n")
        open_joints, ending = [], False
        for words in map(str.split, head.splitlines()):
            match words:
                case ["ROOT" | "JOINT", name]:
                    self.parents.append(open_joints[-1] if open_joints else -1)
                    self.names.append(name)
                case ["End", "Site"]:
                    ending = True
                case ["{"]:
                    open_joints.append(len(self.names) - 1)
                case ["}"]:
                    open_joints.pop()
                    ending = False
                case ["OFFSET", *numbers] if ending:
                    self.ends[self.names[-1]] = [float(x) for x in numbers]
                case ["OFFSET", *numbers]:
                    self.offsets.append([float(x) for x in numbers])
                case ["CHANNELS", count, *names]:
                    assert int(count) == len(names)
                    self.channels.append(names)
        assert not open_joints
        frames, frame_time, *rows = motion.splitlines()
        self.frames, self.frame_time = int(frames.removeprefix("Frames: ")), frame_time.removeprefix("Frame Time: ")
        self.rows = np.array([row.split() for row in rows], float)

    def compute_world_positions(self):
        """Return joint positions (T, J, 3) in file units."""
        position, rotation, column = [], [], 0
        for joint, (parent, names) in enumerate(zip(self.parents, self.channels, strict=True)):
            values = self.rows[:, column : column + len(names)]
            column += len(names)
            rotations = Rotation.from_euler("".join(name[0] for name in names[-3:]), values[:, -3:], degrees=True).as_matrix()
            if parent < 0:
                position.append(values[:, :3] + self.offsets[joint])
                rotation.append(rotations)
            else:
                position.append(position[parent] + rotation[parent] @ np.array(self.offsets[joint]))
                rotation.append(rotation[parent] @ rotations)
        assert column == self.rows.shape[1]
        return np.stack(position, axis=1)


def smooth_rotations(seed, frames, joints, swing):
    """Return rotations (frames, joints, 3, 3) about moving axes, up to `swing` radians from rest."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, frames)[:, None, None]
    waves = sum(rng.normal(size=(joints, 3)) * np.sin(2 * np.pi * k * time + rng.uniform(0, 7, (joints, 3))) for k in (1, 2, 3))
    vectors = swing * waves / np.linalg.norm(waves, axis=-1).max()
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, joints, 3, 3)


def motion_of(rotations, root=None):
    frames = len(rotations)
    root = np.zeros((frames, 3)) if root is None else root
    return Motion(root, rotations, np.zeros(frames, int), np.zeros(frames, int), np.zeros((frames, 0)), np.zeros((frames, 0)))
