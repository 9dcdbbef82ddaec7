"""The memory of a person: what is kept of takes, its file, and limbs that are inferred from it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from safetensors.numpy import load_file, save
from scipy.spatial.transform import Rotation

from mocapfix.errors import SceneError
from mocapfix.model.motion import FrameStatus, Motion
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import person_memory
from mocapfix.solve.occluded_joints import KnownMotion, infer_occluded_joints
from mocapfix.solve.person_memory import (
    RememberedTake,
    describe_other_person,
    digest_capture,
    join_memories,
    read_memory,
    remember_motion,
    write_memory,
)

SKELETON = load_cmu31_body().skeleton
FREE = load_cmu31_body().free_joints
LEFT, RIGHT = ([SKELETON.find_joint(side + name) for name in ("Arm", "ForeArm")] for side in ("Left", "Right"))
RATE, FRAMES, LOST = 60.0, 480, slice(200, 300)


def draw_gestures(seed, stretch=1.0, frames=FRAMES):
    """Return root and local rotations of arms that move independently of each other, `stretch` times as fast."""
    rng, t = np.random.default_rng(seed), stretch * np.arange(frames) / RATE
    local = np.tile(np.eye(3), (frames, len(SKELETON.names), 1, 1))
    for joint in LEFT + RIGHT:
        frequency, phase = rng.uniform(0.2, 0.6, (3, 3)), rng.uniform(0, 2 * np.pi, (3, 3))
        vectors = 0.3 * np.sin(2 * np.pi * t[:, None, None] * frequency + phase).sum(axis=1)
        local[:, joint] = Rotation.from_rotvec(vectors).as_matrix()
    return np.tile([0.0, 1.0, 0.0], (frames, 1)), local


def build_motion(poses):
    root, local = poses
    status = np.full(len(root), int(FrameStatus.CONVERGED))
    return Motion(root, local, status, np.zeros(len(root), int), np.zeros(0), np.zeros(0))


def remember(poses, name="other", is_inferred=None, status=None):
    motion = build_motion(poses)
    if status is not None:
        motion = replace(motion, status=status)
    inferred = np.zeros((motion.frame_count, len(SKELETON.names)), bool) if is_inferred is None else is_inferred
    return remember_motion(RememberedTake(name, f"digest of {name}"), SKELETON, motion, FREE, inferred, RATE)


def infer(poses, memory):
    """Return the mean error in radians of the left arm that is lost, its variance, and the gaps that were remembered."""
    root, truth = poses
    rotations, variance = truth.copy(), np.full(truth.shape[:2], 1e-4)
    is_unobserved = np.zeros(truth.shape[:2], bool)
    is_unobserved[LOST, LEFT] = True
    rotations[is_unobserved], variance[is_unobserved] = np.eye(3), 0.3
    known = KnownMotion(root, rotations, variance, is_unobserved, np.flatnonzero(FREE)[1:], RATE, memory)
    remembered = infer_occluded_joints(known, None)
    turn = np.swapaxes(truth[LOST][:, LEFT], -1, -2) @ rotations[LOST][:, LEFT]
    error = Rotation.from_matrix(turn.reshape(-1, 3, 3)).magnitude().mean()
    return error, variance[LOST][:, LEFT].mean(), remembered


@pytest.mark.parametrize("seed", range(2))
def test_an_arm_lost_in_a_motion_that_another_take_shows_is_restored_from_it(seed):
    poses = draw_gestures(seed)
    alone, variance_alone, nothing = infer(poses, None)
    memory = join_memories([remember(draw_gestures(seed + 10)), remember(draw_gestures(seed, stretch=1.1), "same")])
    error, variance, remembered = infer(poses, memory)
    assert error < 0.5 * alone
    assert variance < variance_alone
    assert not nothing
    (gap,) = remembered
    assert (gap.first, gap.last, gap.joints) == (LOST.start, LOST.stop - 1, tuple(LEFT))
    assert gap.source in ("same, 0:02-0:05", "same, 0:03-0:05")  # 3.3 to 5 s, less a tenth


def test_a_memory_of_another_motion_costs_nothing_on_average():
    errors = [
        [infer(poses, memory)[0] for memory in (None, remember(draw_gestures(seed + 20)))]
        for seed, poses in ((seed, draw_gestures(seed)) for seed in range(1, 4))
    ]
    alone, with_memory = np.sum(errors, axis=0)
    assert with_memory < 1.05 * alone


def test_a_take_does_not_remember_itself():
    poses = draw_gestures(0)
    alone, variance, _ = infer(poses, None)
    assert infer(poses, remember(poses).leave_out("digest of other"))[:2] == (alone, variance)


def test_a_memory_that_does_not_show_the_joints_is_not_used():
    poses, memory = draw_gestures(0), remember(draw_gestures(0))
    is_shown = memory.is_shown & ~np.isin(np.arange(len(FREE)), RIGHT)
    assert infer(poses, replace(memory, is_shown=is_shown)) == infer(poses, None)


def test_only_frames_with_measured_joints_are_kept():
    is_inferred = np.zeros((FRAMES, len(SKELETON.names)), bool)
    is_inferred[100:200, LEFT] = True
    status = np.full(FRAMES, int(FrameStatus.CONVERGED))
    status[300:310] = FrameStatus.GUESSED
    memory = remember(draw_gestures(0), is_inferred=is_inferred, status=status)
    frames = np.rint(memory.time_s * RATE).astype(int)
    assert memory.stretch.max() == 2
    assert not is_inferred[frames].any()
    assert (status[frames] == FrameStatus.CONVERGED).all()


def test_poses_are_dense_where_the_body_moves():
    root, local = draw_gestures(0)
    local[: FRAMES // 2] = local[FRAMES // 2]
    memory = remember((root, local))
    at_rest = memory.time_s < FRAMES / 2 / RATE
    assert at_rest.sum() == pytest.approx(FRAMES / 2 / RATE * person_memory.KEY_RATE_HZ, abs=2)
    assert (~at_rest).sum() > 2 * at_rest.sum()


def test_poses_between_are_interpolated_and_end_with_their_stretch():
    root, local = draw_gestures(1)
    root = root + np.linspace(0, 1, FRAMES)[:, None]
    memory = join_memories([remember((root, local)), remember((root, local), "again")])
    frames = np.rint(memory.time_s * RATE).astype(int)
    keys = np.flatnonzero(frames < FRAMES - 8)
    position, rotations = memory.interpolate(keys, 0.1)
    np.testing.assert_allclose(position, root[frames[keys] + 6], atol=1e-6)
    turn = np.swapaxes(rotations, -1, -2) @ local[frames[keys] + 6]
    assert Rotation.from_matrix(turn.reshape(-1, 3, 3)).magnitude().max() < 0.01
    last = np.array([len(keys) // 2, len(frames) - 1])
    np.testing.assert_allclose(memory.interpolate(last, 1e3)[0], np.tile(root[frames[-1]], (2, 1)), atol=1e-6)


def test_a_long_memory_is_thinned(monkeypatch):
    monkeypatch.setattr(person_memory, "MAX_KEYS", 50)
    memory = join_memories([remember(draw_gestures(0)), remember(draw_gestures(1))])
    assert len(memory.time_s) == len(memory.quaternions) == 50
    assert set(memory.stretch) == {0, 1}


def test_a_file_has_what_was_written(tmp_path):
    memory = join_memories([remember(draw_gestures(0)), remember(draw_gestures(1), "walk2")])
    write_memory(tmp_path / "p.safetensors", memory)
    read = read_memory(tmp_path / "p.safetensors", SKELETON)
    assert read.takes == memory.takes
    for name in person_memory.ARRAYS:
        np.testing.assert_array_equal(getattr(read, name), getattr(memory, name))
    assert (tmp_path / "p.safetensors").stat().st_size < 300 * len(memory.time_s) + 4000


def damage(name):
    def change(path):
        header = {"kind": person_memory.FILE_KIND, "version": 1, "joints": SKELETON.names, "takes": [["a", ""]]}
        arrays = load_file(path)
        if name == "foreign":
            header = {"kind": "autoencoder"}
        elif name == "version":
            header["version"] = 2
        elif name == "time":
            arrays["time_s"] = arrays["time_s"][::-1].copy()
        elif name == "index":
            arrays["stretch"] = arrays["stretch"] + 7
        elif name == "missing":
            del arrays["stretch"]
        elif name == "nothing":
            arrays["quaternions"] *= 0
        path.write_bytes(path.read_bytes()[:5000] if name == "cut" else save(arrays, {"mocapfix": json.dumps(header)}))

    return change


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("cut", "is not the memory of a person"),
        ("foreign", "its header says that it is something else"),
        ("version", "written by another version"),
        ("time", "its poses cannot be used"),
        ("index", "its poses cannot be used"),
        ("missing", "is not the memory of a person"),
        ("nothing", "its poses cannot be used"),
    ],
)
def test_a_file_that_cannot_be_used_is_named(name, text, tmp_path):
    path = tmp_path / "p.safetensors"
    write_memory(path, remember(draw_gestures(0)))
    damage(name)(path)
    with pytest.raises(SceneError, match=text) as raised:
        read_memory(path, SKELETON)
    assert str(path) in str(raised.value)


def test_a_file_that_is_missing_is_named(tmp_path):
    with pytest.raises(SceneError, match=r"gone\.safetensors.*No such file"):
        read_memory(tmp_path / "gone.safetensors", SKELETON)


def test_bones_show_another_person():
    memory = remember(draw_gestures(0))
    assert describe_other_person(memory, replace(SKELETON, offsets=1.03 * SKELETON.offsets)) == ""
    assert "differ by 10%" in describe_other_person(memory, replace(SKELETON, offsets=1.1 * SKELETON.offsets))


def test_a_digest_tells_files_apart(tmp_path):
    (tmp_path / "a").write_bytes(b"1")
    (tmp_path / "b").write_bytes(b"2")
    assert digest_capture(tmp_path / "a") != digest_capture(tmp_path / "b")
    assert digest_capture(None) == digest_capture(tmp_path / "gone") == ""
