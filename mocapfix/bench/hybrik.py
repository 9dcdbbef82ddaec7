"""What HybrIK's closed form is worth: the papers' tables on people whom no model has seen, its speed, and it as a start."""

from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import get_args

import numpy as np

from mocapfix import initialise, prior
from mocapfix.bench import jitter, off_bones, starts, unseen
from mocapfix.bench.limb import motion
from mocapfix.bench.speed import seconds
from mocapfix.clock import Progress
from mocapfix.initialise import hybrik
from mocapfix.initialise.closed_form import Way
from mocapfix.kernels import kinematics
from mocapfix.kernels.threads import cores
from mocapfix.skeleton import cmu31
from mocapfix.subject import Subject
from mocapfix.take import Take

POSES = 10_000  # of a folder's, at most
FRAMES = 60_000  # at a time, of which the speed is told
ROUNDS = 5
RATE = 120.0  # Hz, of a take that is nothing but poses


def measure(data: Path | None, captures: Path | None, progress: Progress) -> dict:
    """-> every figure of the benchmark, ready for JSON.

    data      a folder of CMU motion whose `test` subjects are the poses and, in its test.npz, takes for the starts; None for the
              poses that ship
    captures  a folder of C3D files, for the starts, too

    Raises ReadError where a folder does not hold what it should.
    """
    progress("reading")
    poses = unseen.of_subjects(data, POSES) if data else unseen.shipped()
    subject = jitter.average()
    shaken = jitter.measure(poses, progress)
    said = {"poses": len(poses), "threads": cores()} | shaken
    said["ratios"] = {key: jitter.ratios(shaken[key]) for key in ("jitter_mm", "wrong_bones_mm")}
    said["twist"] = off_bones.measure(poses, subject, progress)
    progress("frames a second")
    said |= speeds(poses, subject)
    said["starts"] = starts.run(data=data, captures=captures, progress=progress)
    return said


def speeds(poses: np.ndarray, subject: Subject) -> dict:
    """-> frames a second on all cores, of poses (N, J, 3, 3) over and over, from arrays in memory.

    fps               X from joint positions, its twists regressed
    fps_by_way        each way's closed form alone, its twists given
    from_markers_fps  X from markers: their joint positions, too
    """
    turned = np.tile(poses, (-(-FRAMES // len(poses)), 1, 1, 1))
    joints, markers = kinematics.placed(subject, motion(np.zeros((len(turned), 3)), turned))
    worn, body = Take(markers, subject.labels, RATE), cmu31()
    habits = prior.load("mean-pose", body.skeleton)
    return {
        "fps": a_second(len(turned), lambda: hybrik(joints, subject)),
        "fps_by_way": {
            way: a_second(len(turned), lambda w=way: hybrik(joints, subject, way=w, twists=jitter.UNTWISTED))
            for way in get_args(Way)
        },
        "from_markers_fps": a_second(len(turned), lambda: initialise.motion(worn, subject, body, habits, by="hybrik-x")),
    }


def a_second(frames: int, once: Callable[[], object]) -> float:
    """-> frames a second, by the median over ROUNDS."""
    return frames / median(seconds(once, ROUNDS))
