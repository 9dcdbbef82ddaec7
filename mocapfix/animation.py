"""An animation: a tree of any joints, and the numbers that move it, as a BVH or an ASF/AMC holds them."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from mocapfix.kernels import euler_angles
from mocapfix.stats.runs import find_runs

AXIS_LETTERS = "XYZ"


@dataclass(frozen=True)
class Animation:
    """A tree of J joints, parents before children, and C numbers in each of T frames.

    The fields are the file's own, in its units, axes and degrees. What the methods return is in metres, Y up, right-handed,
    as if the whole file had been scaled and turned so.

    names     J names; the first joint is the root
    parents   (J,) index of each joint's parent, -1 for the root
    offsets   (J, 3) the joint in its parent's axes, in the rest pose
    ends      J arrays (E, 3): the end sites of a joint in its axes; most joints have none
    channels  for each joint its numbers' names in order: Xposition, Zrotation, ... ; the first rotation is the outermost;
              Length, of ASF alone, lengthens the bones beyond the joint
    values    (T, C) the channels of all joints, one joint after the other; NaN where the file has none
    rate      frames a second
    path      the file it was read from
    first_frame  the file's own number of frame 0, 1 where it numbers none; people are always shown the file's numbers
    starts    (T, C) the byte of the file at which each number is spelled; None where no file has these very numbers
    unit      metres in a unit of length
    axes      (3, 3) from the file's axes into those with Y up
    rest      (J, 3, 3) the axes about which each joint's rotations are told, in the rest pose: the file's in BVH, the bone's
              own in ASF. Every joint itself has the file's axes in the rest pose
    added     (J,) bool: do the joint's positions come on top of its offset? Else they stand in its place
    skeleton  the file in which the tree is, where it is another one, as of an AMC
    radians   are the file's angles in radians? `values` has degrees all the same
    notes     sentences on what the file does not say and was assumed
    """

    names: tuple[str, ...]
    parents: np.ndarray
    offsets: np.ndarray
    end_sites: tuple[np.ndarray, ...]
    channels: tuple[tuple[str, ...], ...]
    values: np.ndarray
    rate: float
    path: Path | None = None
    first_frame: int = 1
    value_byte_offsets: np.ndarray | None = None
    unit_m: float = 0.01
    rotation_y_up_file: np.ndarray = field(default_factory=lambda: np.eye(3))
    rest_rotations: np.ndarray = field(default_factory=lambda: np.eye(3)[None])
    is_position_added: np.ndarray = field(default_factory=lambda: np.zeros(1, bool))
    skeleton_path: Path | None = None
    uses_radians: bool = False
    notes: tuple[str, ...] = ()

    @property
    def frame_count(self) -> int:
        return len(self.values)

    @property
    def name(self) -> str:
        return self.path.name if self.path else "the animation"

    @property
    def has_reference_pose(self) -> bool:
        """Is the first frame a pose put before the motion, as CMU's BVH release has a T-pose? Its angles are whole degrees,
        those of the next frame are not."""
        turning = np.concatenate([self.get_rotation_channels(joint)[0] for joint in range(len(self.names))])
        first, second = (self.values[frame, turning] for frame in (0, min(1, self.frame_count - 1)))
        return bool((first == np.round(first)).all() and (second != np.round(second)).any())

    def index(self, name: str) -> int:
        return self.names.index(name)

    @cached_property
    def joint_columns(self) -> tuple[np.ndarray, ...]:
        """For each joint the columns of `values` that are its channels."""
        stops = np.cumsum([len(each) for each in self.channels])
        return tuple(np.arange(stop - len(each), stop) for each, stop in zip(self.channels, stops, strict=True))

    def get_rotation_channels(self, joint: int) -> tuple[np.ndarray, np.ndarray]:
        """-> a joint's columns that are rotations, and the axis of each (0, 1 or 2), the outermost first."""
        return self._select_channels(joint, "rotation")

    def get_position_channels(self, joint: int) -> tuple[np.ndarray, np.ndarray]:
        """-> a joint's columns that are positions, and the axis of each."""
        return self._select_channels(joint, "position")

    def _select_channels(self, joint: int, kind: str) -> tuple[np.ndarray, np.ndarray]:
        own = [at for at, name in enumerate(self.channels[joint]) if name.endswith(kind)]
        return self.joint_columns[joint][own], np.array([AXIS_LETTERS.index(self.channels[joint][at][0]) for at in own], int)

    def compute_local_rotations(self) -> np.ndarray:
        """-> (T, J, 3, 3) each joint's axes in its parent's (the root's in the world), Y up; the identity in the rest pose."""
        out = np.empty((self.frame_count, len(self.names), 3, 3))
        for joint, (_, rest) in enumerate(self._list_joint_conventions()):
            columns, axes = self.get_rotation_channels(joint)
            turned = self.rotation_y_up_file @ rest
            out[:, joint] = turned @ euler_angles.compute_euler_matrices(np.radians(self.values[:, columns]), axes) @ turned.T
        return out

    def compute_local_positions(self) -> np.ndarray:
        """-> (T, J, 3) metres: each joint in its parent's axes (the root in the world), Y up."""
        out = np.tile(self.offsets, (self.frame_count, 1, 1))
        for joint, (added, rest) in enumerate(self._list_joint_conventions()):
            columns, axes = self.get_position_channels(joint)
            if added:
                out[:, joint] += self.values[:, columns] @ rest[:, axes].T
            else:
                out[:, joint, axes] = self.values[:, columns]
            if "Length" in self.channels[joint]:
                longer = self.values[:, self.joint_columns[joint][self.channels[joint].index("Length")]]
                for child in np.flatnonzero(self.parents == joint):
                    out[:, child] += longer[:, None] * self.offsets[child] / np.linalg.norm(self.offsets[child])
        return out @ self.rotation_y_up_file.T * self.unit_m

    def compute_world_poses(self) -> tuple[np.ndarray, np.ndarray]:
        """-> positions (T, J, 3) in metres and rotations (T, J, 3, 3) of the joints in the world, Y up."""
        return compose_transforms(self.parents, self.compute_local_positions(), self.compute_local_rotations())

    def compute_rest_positions(self) -> np.ndarray:
        """-> (J, 3) metres: the joints in the rest pose, Y up, the root at its offset."""
        places = self.offsets @ self.rotation_y_up_file.T * self.unit_m
        return compose_transforms(self.parents, places[None], np.tile(np.eye(3), (1, len(places), 1, 1)))[0][0]

    def replace_rotations(self, joints: np.ndarray, frames: np.ndarray, rotations: np.ndarray) -> np.ndarray:
        """-> (T, C) the values with some joints (n,) in some frames (m,) turned as rotations (m, n, 3, 3) say, as
        `rotations()` gives them; all else stays.

        Angles are told in each joint's own order. Over a run of frames they follow the frame before it without a leap, at the
        start of the animation backwards from the frame after it; over all frames they go on from what the first had. A joint
        that is free in fewer than three axes comes as near as these let it.
        """
        values, own = self.values.copy(), self._list_joint_conventions()
        for at, joint in enumerate(joints):
            columns, axes = self.get_rotation_channels(int(joint))
            resting = self.rotation_y_up_file @ own[joint][1]
            turned = resting.T @ rotations[:, at] @ resting
            for run, among, beside in _iterate_runs(self.frame_count, frames):
                near = np.nan_to_num(np.radians(values[beside, columns]))
                values[run[:, None], columns] = np.degrees(
                    euler_angles.compute_continuous_euler_angles(np.ascontiguousarray(turned[among]), axes, near)
                )
        return values

    def replace_positions(self, joints: np.ndarray, frames: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """-> (T, C) the values with some joints (n,) in some frames (m,) at places (m, n, 3), as `places()` gives them.

        Joints without positions of their own stay where they are.
        """
        values = self.values.copy()
        told = positions @ self.rotation_y_up_file / self.unit_m
        own = self._list_joint_conventions()
        for at, joint in enumerate(joints):
            (columns, axes), (added, rest) = self.get_position_channels(int(joint)), own[joint]
            place = (told[:, at] - self.offsets[joint]) @ rest if added else told[:, at]
            values[np.asarray(frames)[:, None], columns] = place[:, axes]
        return values

    def replace_values(self, values: np.ndarray) -> "Animation":
        """-> the same animation moved by other numbers (T, C)."""
        return replace(self, values=values)

    def _list_joint_conventions(self) -> list[tuple[bool, np.ndarray]]:
        """-> for each joint whether its positions are added, and (3, 3) its rest."""
        count = len(self.names)
        return list(
            zip(np.broadcast_to(self.is_position_added, count), np.broadcast_to(self.rest_rotations, (count, 3, 3)), strict=True)
        )


def compose_transforms(parents: np.ndarray, positions: np.ndarray, rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> positions (T, J, 3) and rotations (T, J, 3, 3) in the world, where places (T, J, 3) and local rotations
    (T, J, 3, 3) in the parents' axes carry the joints of a tree, parents before children."""
    position, rotation = positions.copy(), rotations.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            position[:, joint] = position[:, parent] + (rotation[:, parent] @ positions[:, joint, :, None])[..., 0]
            rotation[:, joint] = rotation[:, parent] @ rotations[:, joint]
    return position, rotation


def _iterate_runs(frame_count: int, frames: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, int]]:
    """-> for each run of frames: the frames in the order in which they are followed, where each is in `frames`, and the
    frame they start from."""
    among = np.full(frame_count, -1)
    among[frames] = np.arange(len(frames))
    for first, last in find_runs(among >= 0):
        own = np.arange(first, last + 1)
        if first == 0 and last + 1 < frame_count:
            yield own[::-1], among[own[::-1]], last + 1
        else:
            yield own, among[own], max(first - 1, 0)
