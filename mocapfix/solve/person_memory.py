"""The memory of a person: how one person moved in other takes, from which limbs that no marker shows are inferred as well.

It holds poses of which every joint was measured, in stretches without a gap: KEY_RATE_HZ while the person stands still, more the
faster a joint rotates, up to every thirtieth of a second. Between them poses are interpolated. It belongs to a body: the lengths
of its bones tell whether a subject can be the same person. `solve.occluded_joints` uses it.

A file is NAME.safetensors, whose header holds the version, the joints, and the takes with digests of their files: a take does not
remember itself.
"""

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int16, Int32
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from mocapfix.errors import SceneError, format_name_list
from mocapfix.io.files import replace_atomically
from mocapfix.kernels import lie
from mocapfix.model.motion import FrameStatus, Motion
from mocapfix.model.skeleton import Skeleton
from mocapfix.stats.sequences import find_runs

KEY_RATE_HZ = 4.0  # of the poses of a person who stands still
KEY_STEP_RAD = 0.1  # rotation of a joint from one pose to the next
MAX_KEY_RATE_HZ = 30.0  # of the poses of the fastest motion
MIN_STRETCH_S = 0.5  # shorter stretches are left out
MAX_KEYS = 16_000  # poses of a memory, 4.3 MB; of more, evenly spaced ones are kept
QUATERNION_UNIT = 1 / 32767
STRETCH_APART_S = 1e6  # between the stretches on the common clock, more than any of them lasts
MAX_BONE_DIFFERENCE = 0.06  # median relative difference of two bodies' bones above which they are different people
DIGESTED_BYTES = 1 << 20  # of a take's file, which tell it from others
FILE_KIND, FILE_VERSION = "memory of a person", 1


@dataclass(frozen=True)
class RememberedTake:
    """A take in a memory."""

    name: str
    digest: str  # of its file, as `digest_capture` returns it


@dataclass(frozen=True)
class PersonMemory:
    """N poses of a person, in S stretches of takes, in the order of time within each. Joint 0 is the root."""

    joint_names: tuple[str, ...]
    takes: tuple[RememberedTake, ...]
    bone_lengths_m: Float32[np.ndarray, " J"]  # from each joint to its parent
    is_shown: Bool[np.ndarray, "takes J"]  # the joints that the markers of a take show
    stretch_take: Int32[np.ndarray, " S"]
    stretch: Int32[np.ndarray, " N"]  # of each pose, rising
    time_s: Float[np.ndarray, " N"]  # from the beginning of the take
    root_position: Float32[np.ndarray, "N 3"]  # metres
    quaternions: Int16[np.ndarray, "N J 4"]  # of the local rotations, in QUATERNION_UNIT

    @cached_property
    def clock_s(self) -> Float[np.ndarray, " N"]:
        """The times of the poses, those of a stretch after those of the one before."""
        return self.time_s + STRETCH_APART_S * self.stretch

    @property
    def take_of_key(self) -> Int32[np.ndarray, " N"]:
        """The take of each pose."""
        return self.stretch_take[self.stretch]

    def find_keys(self, joints: Int[np.ndarray, " O"]) -> Int[np.ndarray, " K"]:
        """Return the poses of takes that show some joints."""
        return np.flatnonzero(np.all(self.is_shown[:, joints], axis=1)[self.take_of_key])

    def leave_out(self, digest: str) -> "PersonMemory":
        """Return the memory without the take whose file has this digest."""
        is_other = [take.digest != digest for take in self.takes]
        return replace(self, is_shown=self.is_shown & np.array(is_other, bool)[:, np.newaxis])

    def measure_pose_distances(
        self, keys: Int[np.ndarray, " K"], rotations: Float[np.ndarray, "Q J 3 3"], joints: Int[np.ndarray, " O"]
    ) -> Float[np.ndarray, "K Q"]:
        """Return how much the rotations of some joints differ between poses of the memory and others, in squared radians."""
        known, squares = np.ones(len(rotations), bool), np.zeros((len(keys), len(rotations)))
        for joint in joints:
            other = lie.extract_joint_quaternions(rotations, joint, known)
            cosine = QUATERNION_UNIT * self.quaternions[keys, joint].astype(float) @ other.T
            squares += 4 * np.maximum(1 - cosine**2, 0.0)  # of half the angle
        return squares

    def interpolate(
        self, keys: Int[np.ndarray, " M"], offset_s: float
    ) -> tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, "M J 3 3"]]:
        """Return root positions and local rotations some time after poses, or at the end of their stretches."""
        clock, stretch = self.clock_s, self.stretch[keys]
        first, last = (np.searchsorted(self.stretch, stretch, side) for side in ("left", "right"))
        last = last - 1
        wanted = np.clip(clock[keys] + offset_s, clock[first], clock[last])
        below = np.clip(np.searchsorted(clock, wanted, "right") - 1, first, np.maximum(last - 1, first))
        above = np.minimum(below + 1, last)
        share = (wanted - clock[below]) / np.where(above > below, clock[above] - clock[below], 1.0)
        root, (start, end) = self.root_position.astype(float), self.quaternions[np.stack([below, above])].astype(float)
        end = np.where(((start * end).sum(axis=2) < 0)[..., None], -end, end)
        mixed = np.ascontiguousarray(np.swapaxes(start + share[:, None, None] * (end - start), 0, 1))
        rotations = np.empty((len(keys), len(self.joint_names), 3, 3))
        for joint, quaternions in enumerate(mixed):
            lie.store_joint_quaternions(quaternions, joint, rotations)
        return root[below] + share[:, None] * (root[above] - root[below]), rotations

    def describe_frames(self, keys: Int[np.ndarray, " M"]) -> str:
        """Return the take that has most of some poses, and from when to when, in whole seconds: "walk2, 0:31-0:33"."""
        of_take = self.take_of_key[keys]
        take = int(np.bincount(of_take).argmax())
        times_s = self.time_s[keys[of_take == take]]
        seconds = math.floor(times_s.min()), math.ceil(times_s.max())
        return f"{self.takes[take].name}, {'-'.join(f'{each // 60}:{each % 60:02d}' for each in seconds)}"


def describe_other_person(memory: PersonMemory, skeleton: Skeleton) -> str:
    """Return a sentence if a body cannot be that of the memory; "" if it can."""
    lengths, others = np.linalg.norm(skeleton.offsets, axis=1), memory.bone_lengths_m
    is_bone = (lengths > 0) & (others > 0)
    difference = float(np.median(np.abs(np.log(lengths[is_bone] / others[is_bone]))))
    if difference <= MAX_BONE_DIFFERENCE:
        return ""
    names = format_name_list([take.name for take in memory.takes])
    return f"The memory of {names} is another person's, whose bones differ by {difference:.0%}: it was not used."


def digest_capture(path: Path | None) -> str:
    """Return a hash of the beginning and the size of a take's file; "" if it has none or cannot be read."""
    try:
        if path is None:
            return ""
        with path.open("rb") as file:
            return hashlib.sha256(file.read(DIGESTED_BYTES) + str(path.stat().st_size).encode()).hexdigest()
    except OSError:
        return ""


def remember_motion(
    take: RememberedTake,
    skeleton: Skeleton,
    motion: Motion,
    is_shown: Bool[np.ndarray, " J"],
    is_inferred: Bool[np.ndarray, "T J"],
    rate: float,
) -> PersonMemory:
    """Return what is remembered of one take: its frames without an inferred joint whose pose the markers determine.

    Args:
        is_shown: The joints that the markers show.
        is_inferred: Those that no marker shows in a frame although others do.
        rate: Frames per second.
    """
    is_sound = np.isin(motion.status, (FrameStatus.CONVERGED, FrameStatus.ITERATION_LIMIT, FrameStatus.EXACT))
    step = max(1, round(rate / MAX_KEY_RATE_HZ))
    frames, stretch = list[np.ndarray](), list[np.ndarray]()
    for first, last in find_runs(is_sound & ~is_inferred.any(axis=1)):
        if last - first >= MIN_STRETCH_S * rate:
            sampled = np.arange(first, last + 1, step)
            frames.append(sampled[_select_keys(motion.local_rotations[sampled], step / rate)])
            stretch.append(np.full(len(frames[-1]), len(stretch)))
    used = np.concatenate([np.zeros(0, int), *frames])
    known = np.ones(len(used), bool)
    rotations = np.ascontiguousarray(motion.local_rotations[used])
    quaternions = [lie.extract_joint_quaternions(rotations, joint, known) for joint in range(len(skeleton.names))]
    return PersonMemory(
        joint_names=skeleton.names,
        takes=(take,),
        bone_lengths_m=np.linalg.norm(skeleton.offsets, axis=1).astype(np.float32),
        is_shown=is_shown[None],
        stretch_take=np.zeros(len(stretch), np.int32),
        stretch=np.concatenate([np.zeros(0, int), *stretch]).astype(np.int32),
        time_s=used / rate,
        root_position=motion.root_position[used].astype(np.float32),
        quaternions=np.rint(np.stack(quaternions, axis=1) / QUATERNION_UNIT).astype(np.int16),
    )


def _select_keys(rotations: Float[np.ndarray, "T J 3 3"], step_s: float) -> Int[np.ndarray, " N"]:
    """Return indices of frames `step_s` apart: dense where a joint rotates, sparse where none does."""
    # the norm of a small rotation's matrix difference is sqrt(2) times its angle
    turn_rad = np.linalg.norm(np.diff(rotations, axis=0), axis=(2, 3)).max(axis=1, initial=0.0) / np.sqrt(2)
    passed = np.cumsum(np.r_[0.0, turn_rad / KEY_STEP_RAD + KEY_RATE_HZ * step_s])
    return np.flatnonzero(np.diff(np.floor(passed), prepend=-1.0))


def join_memories(memories: Sequence[PersonMemory]) -> PersonMemory:
    """Return the memory of one person from those of takes, of which there is at least one, with at most MAX_KEYS poses."""
    take_counts, stretch_counts = ([len(getattr(each, name)) for each in memories] for name in ("takes", "stretch_take"))
    takes_before, stretches_before = (np.cumsum([0, *counts[:-1]]) for counts in (take_counts, stretch_counts))

    def join(name: str, before: np.ndarray | None = None) -> np.ndarray:
        added = np.zeros(len(memories), np.int32) if before is None else before.astype(np.int32)
        arrays: list[np.ndarray] = [getattr(each, name) for each in memories]
        return np.concatenate([array if before is None else array + more for array, more in zip(arrays, added, strict=True)])

    joined = replace(
        memories[0],
        takes=tuple(take for each in memories for take in each.takes),
        is_shown=join("is_shown"),
        stretch_take=join("stretch_take", takes_before),
        stretch=join("stretch", stretches_before),
        time_s=join("time_s"),
        root_position=join("root_position"),
        quaternions=join("quaternions"),
    )
    count = len(joined.time_s)
    if count <= MAX_KEYS:
        return joined
    kept = np.flatnonzero(np.diff(np.arange(count) * MAX_KEYS // count, prepend=-1))
    arrays = {name: getattr(joined, name)[kept] for name in ("stretch", "time_s", "root_position", "quaternions")}
    return replace(joined, **arrays)


ARRAYS = ("bone_lengths_m", "is_shown", "stretch_take", "stretch", "time_s", "root_position", "quaternions")


def write_memory(path: Path, memory: PersonMemory) -> None:
    """Write a memory, replacing the file atomically. Raises WriteError if the folder cannot be written."""
    takes = [[take.name, take.digest] for take in memory.takes]
    header = {"kind": FILE_KIND, "version": FILE_VERSION, "joints": memory.joint_names, "takes": takes}
    arrays = {name: np.ascontiguousarray(getattr(memory, name)) for name in ARRAYS}
    with replace_atomically(path) as part:
        part.write_bytes(save(arrays, {"mocapfix": json.dumps(header)}))


def read_memory(path: Path, skeleton: Skeleton) -> PersonMemory:
    """Return the memory in a file. Raises SceneError, naming the file, if it is none for the joints of the skeleton."""
    try:
        with safe_open(path, "numpy") as file:
            header = json.loads((file.metadata() or {}).get("mocapfix", "{}"))
            if header.get("kind") != FILE_KIND:
                raise ValueError("its header says that it is something else")
            if header["version"] != FILE_VERSION:
                raise SceneError(f"{path}: was written by another version of mocapfix; write it again with mocapfix calibrate.")
            arrays = {name: file.get_tensor(name) for name in ARRAYS}
        takes = tuple(RememberedTake(str(name), str(digest)) for name, digest in header["takes"])
        memory = PersonMemory(tuple(header["joints"]), takes, **arrays)
        _check_memory(memory, skeleton)
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise SceneError(f"{path}: is not the memory of a person, as mocapfix calibrate writes it ({reason}).") from error
    return memory


def _check_memory(memory: PersonMemory, skeleton: Skeleton) -> None:
    """Raise ValueError if arrays do not fit the joints or one another."""
    count, stretches, takes, joints = len(memory.time_s), len(memory.stretch_take), len(memory.takes), len(skeleton.names)
    shapes = [(joints,), (takes, joints), (stretches,), (count,), (count,), (count, 3), (count, joints, 4)]
    kinds = [np.float32, bool, np.int32, np.int32, np.float64, np.float32, np.int16]
    for name, shape, kind in zip(ARRAYS, shapes, kinds, strict=True):
        array: np.ndarray = getattr(memory, name)
        if array.shape != shape or array.dtype != kind or not np.isfinite(array).all():
            raise ValueError(f"its {name.replace('_', ' ')} cannot be used")
    is_rising = (np.diff(memory.clock_s) > 0).all() and (np.abs(memory.time_s) < STRETCH_APART_S / 2).all()
    limits = ((memory.stretch, stretches), (memory.stretch_take, takes))
    is_within = all(((indices >= 0) & (indices < most)).all() for indices, most in limits)
    if memory.joint_names != skeleton.names or not is_within or not is_rising or not memory.quaternions.any(axis=2).all():
        raise ValueError("its poses cannot be used")
