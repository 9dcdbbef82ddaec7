"""How long files take to read and to write: a minute of 53 markers at 120 Hz, composed by mocapfix."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np

from mocapfix import read, rig, synthetic, write
from mocapfix.read import bvh as bvh_file
from mocapfix.resample import resampled
from mocapfix.synthetic import Truth

REPEATS = 9
MARKERS = 53
MENDED = 0.02  # of the samples


def measured(seconds: float = 60.0) -> list[dict]:
    """-> for every thing that is done to a file: `what`, `frames`, and `ms`, the median of REPEATS."""
    truth = composed(seconds)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "composed.c3d"
        synthetic.write(path, truth)
        return [
            {"what": what, "frames": len(truth.markers), "ms": 1e3 * median(_seconds(work) for _ in range(REPEATS))}
            for what, work in (works(path) | of_motion(path, truth)).items()
        ]


def works(path: Path) -> dict[str, Callable[[], object]]:
    """-> what is timed, by name, on the composed take's C3D at `path`; other files go beside it."""
    take, target = read.take(path), path.with_name("mended.c3d")
    mended = np.random.default_rng(0).random(take.seen.shape) < MENDED
    after = take.with_markers(np.where(mended[..., None], 1.0, take.markers), np.where(mended, 0.001, np.nan))
    return {
        "read C3D": lambda: read.take(path),
        "write C3D": lambda: write.c3d(target, take, after),
    }


def of_motion(path: Path, truth: Truth) -> dict[str, Callable[[], object]]:
    """-> what is timed, by name, on how the composed take's person truly moves; files go beside `path`."""
    take, skeleton, motion, rate = read.take(path), truth.subject.skeleton, truth.motion, truth.rate
    bvh, amc, builder = path.with_suffix(".bvh"), path.with_suffix(".amc"), rig.load("motionbuilder")
    captured, target = path.with_name("captured.bvh"), path.with_name("mended.bvh")
    write.bvh(captured, skeleton, motion, rate)
    animation = bvh_file.animation(captured)
    mended = np.random.default_rng(0).random(animation.values.shape) < MENDED
    values = np.where(mended, animation.values + 1.0, animation.values)
    return {
        "read BVH": lambda: bvh_file.animation(captured),
        "write BVH, mended": lambda: write.patched(target, animation, values),
        "write BVH": lambda: write.bvh(bvh, skeleton, motion, rate),
        "write BVH for MotionBuilder": lambda: write.bvh_for(bvh, builder, skeleton, motion, rate),
        "write glTF": lambda: write.gltf(path.with_suffix(".glb"), skeleton, motion, rate),
        "write ASF/AMC": lambda: write.asf_amc(amc.with_suffix(".asf"), amc, skeleton, motion, rate),
        "write NPZ": lambda: write.npz(path.with_suffix(".npz"), take, skeleton, motion, rate),
        "make 25 frames a second of 120": lambda: resampled(motion, rate, 25.0),
    }


def composed(seconds: float) -> Truth:
    """-> somebody who walks, and as much of somebody beside them as makes up MARKERS."""
    truth = synthetic.take(seconds=seconds)
    more = range(MARKERS - len(truth.labels))
    return replace(
        truth,
        labels=(*truth.labels, *(f"beside:{truth.labels[m]}" for m in more)),
        damaged=np.concatenate([truth.damaged, truth.damaged[:, more] + 1.0], axis=1),
        struck=np.concatenate([truth.struck, truth.struck[:, more]], axis=1),
    )


def _seconds(work: Callable[[], object]) -> float:
    started = perf_counter()
    work()
    return perf_counter() - started
