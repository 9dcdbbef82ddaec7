"""An animation: a tree of joints and the channel values that move it, as stored in a BVH or ASF/AMC file; and its points."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.kernels import euler_angles
from mocapfix.model.skeleton import Skeleton, compose_transforms, find_common_joint, list_path
from mocapfix.model.take import Take
from mocapfix.stats.sequences import find_runs

AXIS_LETTERS = "XYZ"
HEAD_JOINT_PATTERN = re.compile(r"head|skull", re.IGNORECASE)
MIN_LIMB_JOINTS = 3  # of a limb; what has fewer joints may be a prop or a camera
FOOT_JOINT_PATTERN = re.compile(r"foot|feet|ankle|toe", re.IGNORECASE)


@dataclass(frozen=True)
class Animation:
    """A tree of J joints, parents before children, and C channels over T frames.

    The fields are in the file's units, axes and degrees. The methods return metres in a right-handed frame with Y up.

    Attributes:
        names: J joint names, the root first.
        parents: Index of each joint's parent, -1 for the root.
        offsets: Position of each joint in its parent's axes, as the file gives it. Where position channels replace it,
            `bone_offsets` has the one that the figure has.
        end_sites: J arrays (E, 3): the end sites of a joint in its axes; most joints have none.
        channels: Names of each joint's channels, in order: Xposition, Zrotation, ...; the first rotation is the outermost.
            Length, in ASF only, lengthens the bones to the joint's children.
        values: Values of all joints' channels, joint by joint; NaN where the file has no value.
        rate: Frames per second.
        path: File that the animation was read from.
        first_frame: The file's number of frame 0, 1 if the file does not number its frames; messages use the file's numbers.
        value_byte_offsets: (T, C) position of each value in the file, in bytes; None if no file holds these values.
        wrong_rate_bytes: First byte and byte after the frame time in the file, if it is not that of `rate`: a copy has it
            corrected.
        unit_m: Length of a file unit in metres.
        rotation_y_up_file: (3, 3) from the file's axes to axes with Y up.
        rest_rotations: (J, 3, 3) or (1, 3, 3) axes of each joint's rotations in the rest pose: the file's axes in BVH, the bone's
            axes in ASF. The joints themselves have the file's axes in the rest pose.
        is_position_added: (J,) or (1,) bool: position channels are added to the joint's offset; otherwise they replace it.
        skeleton_path: File that holds the tree, if it is a separate one (the ASF of an AMC).
        uses_radians: The file's angles are in radians; `values` are in degrees in any case.
        notes: Sentences about assumptions made in reading the file.
    """

    names: tuple[str, ...]
    parents: Int[np.ndarray, " J"]
    offsets: Float[np.ndarray, "J 3"]
    end_sites: tuple[np.ndarray, ...]
    channels: tuple[tuple[str, ...], ...]
    values: Float[np.ndarray, "T C"]
    rate: float
    path: Path | None = None
    first_frame: int = 1
    value_byte_offsets: np.ndarray | None = None
    wrong_rate_bytes: tuple[int, int] | None = None
    unit_m: float = 0.01
    rotation_y_up_file: np.ndarray = field(default_factory=lambda: np.eye(3))
    rest_rotations: np.ndarray = field(default_factory=lambda: np.eye(3)[None])
    is_position_added: np.ndarray = field(default_factory=lambda: np.zeros(1, bool))
    skeleton_path: Path | None = None
    uses_radians: bool = False
    notes: tuple[str, ...] = ()

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return len(self.values)

    @property
    def name(self) -> str:
        """File name, for messages."""
        return self.path.name if self.path else "the animation"

    @property
    def has_reference_pose(self) -> bool:
        """True if the first frame is a reference pose before the motion, such as the T-pose in CMU's BVH release.

        The angles of such a frame are whole degrees, and those of the next frame are not.
        """
        columns = np.concatenate([self.get_rotation_channels(joint)[0] for joint in range(len(self.names))])
        first, second = (self.values[frame, columns] for frame in (0, min(1, self.frame_count - 1)))
        return bool((first == np.round(first)).all() and (second != np.round(second)).any())

    @cached_property
    def _world_poses(self) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T J 3 3"]]:
        return compose_transforms(self.parents, self.compute_local_positions(), self.compute_local_rotations())

    @cached_property
    def joint_columns(self) -> tuple[Int[np.ndarray, " _"], ...]:
        """Columns of `values` that hold each joint's channels."""
        stops = np.cumsum([len(each) for each in self.channels])
        return tuple(np.arange(stop - len(each), stop) for each, stop in zip(self.channels, stops, strict=True))

    @cached_property
    def bone_offsets(self) -> Float[np.ndarray, "J 3"]:
        """The offset of each joint as the figure is posed, in file units and its parent's axes.

        Where position channels replace a joint's offset it is the median of their values, otherwise the offset of the file.
        """
        offsets = self.offsets.copy()
        for joint in np.flatnonzero(~np.broadcast_to(self.is_position_added, len(self.names))).tolist():
            columns, axes = self.get_position_channels(joint)
            values = self.values[:, columns]
            values = values[np.isfinite(values).all(1)]
            if len(values):
                offsets[joint, axes] = np.median(values, axis=0)
        return offsets

    @cached_property
    def skeleton(self) -> Skeleton:
        """The joints in metres with all angles zero and the posed figure's bones, whose ends are the first end sites."""
        ends = np.array([sites[0] if len(sites) else [np.nan] * 3 for sites in self.end_sites], float).reshape(-1, 3)
        rotation = self.rotation_y_up_file.T * self.unit_m
        return Skeleton(self.names, self.parents, self.bone_offsets @ rotation, ends @ rotation)

    @cached_property
    def body_root(self) -> int:
        """The joint from which the body branches: the hips, whatever reference nodes are above them.

        It is the last joint above both the first head and the first foot by their names or, without such names, the first joint
        from which several limbs go.
        """
        head, foot = (
            [joint for joint, name in enumerate(self.names) if pattern.search(name)][:1]
            for pattern in (HEAD_JOINT_PATTERN, FOOT_JOINT_PATTERN)
        )
        if head and foot:
            return find_common_joint(self.parents, (head[0], foot[0]))
        size = np.ones(len(self.names), int)
        for joint in range(len(self.names) - 1, 0, -1):
            size[self.parents[joint]] += size[joint] if self.parents[joint] >= 0 else 0
        joint = int(np.argmax(np.where(self.parents < 0, size, 0)))
        while len(children := np.flatnonzero((self.parents == joint) & (size >= MIN_LIMB_JOINTS))) == 1:
            joint = int(children[0])
        return joint

    @cached_property
    def is_below_body_root(self) -> Bool[np.ndarray, " J"]:
        """Whether each joint is below the body root: the joints that bones lead to."""
        is_below = np.zeros(len(self.names), bool)
        for joint in range(1, len(self.names)):
            is_below[joint] = self.parents[joint] == self.body_root or is_below[self.parents[joint]]
        return is_below

    @cached_property
    def moving_joint(self) -> int:
        """The joint whose position channels move the figure most: the root, the hips, or a joint between them.

        Percentiles of the positions are compared, so that no fault of a few frames decides.
        """
        joints = [joint for joint in list_path(self.body_root, -1, self.parents) if self.get_position_channels(joint)[0].size]
        ranges: list[float] = []
        for joint in joints:
            values = self.values[:, self.get_position_channels(joint)[0]]
            values = values[np.isfinite(values).all(1)]
            ranges.append(float(np.ptp(np.percentile(values, (5, 95), axis=0), axis=0).sum()) if len(values) else 0.0)
        return joints[int(np.argmax(ranges))] if joints else 0

    def get_rotation_channels(self, joint: int) -> tuple[Int[np.ndarray, " c"], Int[np.ndarray, " c"]]:
        """Return the columns of a joint's rotation channels and the axis of each (0, 1 or 2), the outermost first."""
        return self._select_channels(joint, "rotation")

    def get_position_channels(self, joint: int) -> tuple[Int[np.ndarray, " c"], Int[np.ndarray, " c"]]:
        """Return the columns of a joint's position channels and the axis of each (0, 1 or 2)."""
        return self._select_channels(joint, "position")

    def _select_channels(self, joint: int, quantity: str) -> tuple[Int[np.ndarray, " c"], Int[np.ndarray, " c"]]:
        channels = self.channels[joint]
        selected = [index for index, name in enumerate(channels) if name.endswith(quantity)]
        return self.joint_columns[joint][selected], np.array([AXIS_LETTERS.index(channels[index][0]) for index in selected], int)

    def compute_local_rotations(self) -> Float[np.ndarray, "T J 3 3"]:
        """Compute each joint's rotation relative to its parent (the root's: to the world), the identity in the rest pose."""
        local_rotations = np.empty((self.frame_count, len(self.names), 3, 3))
        for joint, (_, rest_rotation) in enumerate(self._list_joint_conventions()):
            columns, axes = self.get_rotation_channels(joint)
            basis = self.rotation_y_up_file @ rest_rotation
            matrices = euler_angles.compute_euler_matrices(np.radians(self.values[:, columns]), axes)
            local_rotations[:, joint] = basis @ matrices @ basis.T
        return local_rotations

    def compute_local_positions(self) -> Float[np.ndarray, "T J 3"]:
        """Compute each joint's position in its parent's axes (the root's: in the world), in metres."""
        positions = np.tile(self.offsets, (self.frame_count, 1, 1))
        for joint, (is_added, rest_rotation) in enumerate(self._list_joint_conventions()):
            columns, axes = self.get_position_channels(joint)
            if is_added:
                positions[:, joint] += self.values[:, columns] @ rest_rotation[:, axes].T
            else:
                positions[:, joint, axes] = self.values[:, columns]
            if "Length" in self.channels[joint]:
                extra_length = self.values[:, self.joint_columns[joint][self.channels[joint].index("Length")]]
                for child in np.flatnonzero(self.parents == joint):
                    positions[:, child] += extra_length[:, None] * self.offsets[child] / np.linalg.norm(self.offsets[child])
        return positions @ self.rotation_y_up_file.T * self.unit_m

    def compute_world_poses(self) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T J 3 3"]]:
        """Compute the positions in metres and the rotations of the joints in the world. Callers must not write into them."""
        return self._world_poses

    def replace_rotations(
        self, joints: Int[np.ndarray, " n"], frames: Int[np.ndarray, " m"], rotations: Float[np.ndarray, "m n 3 3"]
    ) -> "Animation":
        """Return the animation with the local rotations of some joints replaced in some frames.

        `rotations` are as `compute_local_rotations` returns them. They are converted to angles in each joint's own rotation
        order. In each run of frames the angles continue those of the frame before the run, or, at the start of the animation,
        backwards those of the frame after it; if all frames are replaced, they start from the first frame's old angles. A joint
        with fewer than three rotation channels gets the nearest rotation that they can represent.
        """
        values, conventions = self.values.copy(), self._list_joint_conventions()
        for index, joint in enumerate(joints):
            columns, axes = self.get_rotation_channels(int(joint))
            basis = self.rotation_y_up_file @ conventions[joint][1]
            rotations_file = basis.T @ rotations[:, index] @ basis
            for run, among, beside in _iterate_runs(self.frame_count, frames):
                start = np.nan_to_num(np.radians(values[beside, columns]))
                values[run[:, None], columns] = np.degrees(
                    euler_angles.compute_continuous_euler_angles(np.ascontiguousarray(rotations_file[among]), axes, start)
                )
        return self.replace_values(values)

    def replace_positions(
        self, joints: Int[np.ndarray, " n"], frames: Int[np.ndarray, " m"], positions: Float[np.ndarray, "m n 3"]
    ) -> "Animation":
        """Return the animation with the local positions of some joints replaced in some frames.

        `positions` are as `compute_local_positions` returns them. Joints without position channels do not change.
        """
        values, conventions = self.values.copy(), self._list_joint_conventions()
        positions_file = positions @ self.rotation_y_up_file / self.unit_m
        for index, joint in enumerate(joints):
            (columns, axes), (is_added, rest_rotation) = self.get_position_channels(int(joint)), conventions[joint]
            position = positions_file[:, index]
            if is_added:
                position = (position - self.offsets[joint]) @ rest_rotation
            values[np.asarray(frames)[:, None], columns] = position[:, axes]
        return self.replace_values(values)

    def replace_values(self, values: Float[np.ndarray, "t c"]) -> "Animation":
        """Return the animation with other channel values, also of another number of frames."""
        return replace(self, values=values)

    def _list_joint_conventions(self) -> list[tuple[bool, Float[np.ndarray, "3 3"]]]:
        """Return, for each joint, whether positions are added to the offset, and the axes of its rotations (3, 3)."""
        count = len(self.names)
        is_added = np.broadcast_to(self.is_position_added, count)
        return list(zip(is_added.tolist(), np.broadcast_to(self.rest_rotations, (count, 3, 3)), strict=True))


def _iterate_runs(
    frame_count: int, frames: Int[np.ndarray, " m"]
) -> Iterator[tuple[Int[np.ndarray, " r"], Int[np.ndarray, " r"], int]]:
    """Yield each run of consecutive frames: its frames in processing order, their indices in `frames`, and the start frame.

    The start frame is the one whose angles the run continues.
    """
    index_of_frame = np.full(frame_count, -1)
    index_of_frame[frames] = np.arange(len(frames))
    for first, last in find_runs(index_of_frame >= 0):
        run = np.arange(first, last + 1)
        if first == 0 and last + 1 < frame_count:
            run, start = run[::-1], last + 1
        else:
            start = max(first - 1, 0)
        yield run, index_of_frame[run], start


def build_joint_take(animation: Animation) -> Take:
    """Build the take of an animation's joint positions."""
    return _build_point_take(animation, animation.compute_world_poses()[0], animation.names)


def build_tip_take(animation: Animation) -> Take:
    """Build the take of an animation's joint tips, followed by the position of the joint that moves the figure.

    The tip of a joint is the mean of its children and end sites. A rotation error of a joint displaces its tip but not the
    joint itself, so faults and changes refer to tips.
    """
    positions, rotations = animation.compute_world_poses()
    points = np.empty((animation.frame_count, len(animation.names) + 1, 3))
    for joint in range(len(animation.names)):
        end_offsets = animation.end_sites[joint] @ animation.rotation_y_up_file.T * animation.unit_m
        end_positions = positions[:, [joint]] + end_offsets @ np.swapaxes(rotations[:, joint], -1, -2)
        outer = np.concatenate([positions[:, animation.parents == joint], end_positions], axis=1)
        points[:, joint] = outer.mean(1) if outer.shape[1] else positions[:, joint]
    points[:, -1] = positions[:, animation.moving_joint]
    return _build_point_take(animation, points, list_track_names(animation.names, animation.moving_joint))


def list_track_names(joint_names: tuple[str, ...], moving_joint: int = 0) -> tuple[str, ...]:
    """Return the names of an animation's J + 1 tracks: the rotations of its joints and the position of the one that moves it."""
    return (*joint_names, f"{joint_names[moving_joint]} position")


def compute_joint_point_sd(animation: Animation, points: Take, variance: Float[np.ndarray, "T N"]) -> Float[np.ndarray, "T M"]:
    """Compute the standard deviations per axis, in metres, of an animation's joints or tips from those of its tracks.

    A small rotation about an axis moves a point by the angle times the point's distance from the axis.

    Args:
        points: As from `build_joint_take` or `build_tip_take`.
        variance: Per axis, of the joints' rotations (rad^2) and of the root's position (m^2), as the last of N = J + 1 tracks.
    """
    frames = np.flatnonzero(variance.any(1))
    positions, frame_variance = animation.replace_values(animation.values[frames]).compute_world_poses()[0], variance[frames]
    squared = np.tile(frame_variance[:, -1:], (1, len(points.labels)))
    for joint in range(len(animation.parents)):
        ancestor = joint
        while ancestor >= 0:
            squared_distance = ((points.markers[frames, joint] - positions[:, ancestor]) ** 2).sum(-1)
            squared[:, joint] += frame_variance[:, ancestor] * squared_distance * 2 / 3
            ancestor = animation.parents[ancestor]
    sd = np.zeros(points.visible.shape)
    sd[frames] = np.sqrt(squared)
    return sd


def _build_point_take(animation: Animation, points: Float[np.ndarray, "T M 3"], labels: tuple[str, ...]) -> Take:
    return Take(points, labels, animation.rate, animation.first_frame, animation.path, notes=animation.notes, point_kind="joint")
