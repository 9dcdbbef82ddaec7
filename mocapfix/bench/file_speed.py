"""How long files take to read and to write: a minute of 53 markers at 120 Hz, composed by mocapfix."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np

from mocapfix import synthetic, write
from mocapfix.read import bvh as bvh_file
from mocapfix.read import capture
from mocapfix.synthetic import SyntheticTake
from mocapfix.write import rig
from mocapfix.write.resampling import resample_motion

FILE_REPEATS = 9
FILE_MARKER_COUNT = 53
REPAIRED_SAMPLE_SHARE = 0.02  # of the samples


def measure_file_speed(duration_s: float = 60.0) -> list[dict]:
    """-> for every thing that is done to a file: `what`, `frames`, and `ms`, the median of REPEATS."""
    truth = compose_file_take(duration_s)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "composed.c3d"
        synthetic.write_synthetic_take(path, truth)
        return [
            {
                "what": what,
                "frames": len(truth.marker_positions),
                "ms": 1e3 * median(_time_call(work) for _ in range(FILE_REPEATS)),
            }
            for what, work in (build_take_jobs(path) | build_motion_jobs(path, truth)).items()
        ]


def build_take_jobs(path: Path) -> dict[str, Callable[[], object]]:
    """-> what is timed, by name, on the composed take's C3D at `path`; other files go beside it."""
    take, target = capture.read_take(path), path.with_name("mended.c3d")
    mended = np.random.default_rng(0).random(take.visible.shape) < REPAIRED_SAMPLE_SHARE
    after = take.replace_markers(np.where(mended[..., None], 1.0, take.markers), np.where(mended, 0.001, np.nan))
    return {
        "read C3D": lambda: capture.read_take(path),
        "write C3D": lambda: write.patch_c3d(target, take, after),
    }


def build_motion_jobs(path: Path, truth: SyntheticTake) -> dict[str, Callable[[], object]]:
    """-> what is timed, by name, on how the composed take's person truly moves; files go beside `path`."""
    take, skeleton, motion, rate = capture.read_take(path), truth.subject.skeleton, truth.motion, truth.rate
    bvh, amc, builder = path.with_suffix(".bvh"), path.with_suffix(".amc"), rig.load_rig("motionbuilder")
    captured, target = path.with_name("captured.bvh"), path.with_name("mended.bvh")
    write.write_bvh(captured, skeleton, motion, rate)
    animation = bvh_file.read_bvh(captured)
    mended = np.random.default_rng(0).random(animation.values.shape) < REPAIRED_SAMPLE_SHARE
    values = np.where(mended, animation.values + 1.0, animation.values)
    return {
        "read BVH": lambda: bvh_file.read_bvh(captured),
        "write BVH, mended": lambda: write.patch_animation(target, animation, values),
        "write BVH": lambda: write.write_bvh(bvh, skeleton, motion, rate),
        "write BVH for MotionBuilder": lambda: write.write_rig_bvh(bvh, builder, skeleton, motion, rate),
        "write glTF": lambda: write.write_gltf(path.with_suffix(".glb"), skeleton, motion, rate),
        "write ASF/AMC": lambda: write.write_asf_amc(amc.with_suffix(".asf"), amc, skeleton, motion, rate),
        "write NPZ": lambda: write.write_npz(path.with_suffix(".npz"), take, skeleton, motion, rate),
        "make 25 frames a second of 120": lambda: resample_motion(motion, rate, 25.0),
    }


def compose_file_take(duration_s: float) -> SyntheticTake:
    """-> somebody who walks, and as much of somebody beside them as makes up MARKERS."""
    truth = synthetic.compose_take(seconds=duration_s)
    more = range(FILE_MARKER_COUNT - len(truth.labels))
    return replace(
        truth,
        labels=(*truth.labels, *(f"beside:{truth.labels[m]}" for m in more)),
        damaged_positions=np.concatenate([truth.damaged_positions, truth.damaged_positions[:, more] + 1.0], axis=1),
        missing_mask=np.concatenate([truth.missing_mask, truth.missing_mask[:, more]], axis=1),
    )


def _time_call(job: Callable[[], object]) -> float:
    started = perf_counter()
    job()
    return perf_counter() - started
