"""Benchmark of the speed of file readers and writers: one minute of 53 markers at 120 Hz, composed by mocapfix."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np

from mocapfix import synthetic, write
from mocapfix.read import bvh, capture
from mocapfix.synthetic import SyntheticTake
from mocapfix.write import rig
from mocapfix.write.resampling import resample_motion

FILE_REPEATS = 9  # of every operation; the median counts
FILE_MARKER_COUNT = 53
REPAIRED_SAMPLE_SHARE = 0.02  # fraction of the samples that are changed before a file is written

Jobs = dict[str, Callable[[], object]]  # operations by name


def measure_file_speed(duration_s: float = 60.0) -> list[dict[str, str | int | float]]:
    """Return for each operation its name `what`, the number of `frames`, and the median time in `ms`."""
    truth = compose_file_take(duration_s)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "composed.c3d"
        synthetic.write_synthetic_take(path, truth)
        rows: list[dict[str, str | int | float]] = []
        for name, job in (build_take_jobs(path) | build_motion_jobs(path, truth)).items():
            duration_ms = 1e3 * median(_time_call(job) for _ in range(FILE_REPEATS))
            rows.append({"what": name, "frames": len(truth.marker_positions), "ms": duration_ms})
        return rows


def build_take_jobs(path: Path) -> Jobs:
    """Return the operations on the composed take's C3D; they write to the same folder."""
    take, target = capture.read_take(path), path.with_name("repaired.c3d")
    is_repaired = np.random.default_rng(0).random(take.visible.shape) < REPAIRED_SAMPLE_SHARE
    markers, sd_m = np.where(is_repaired[..., None], 1.0, take.markers), np.where(is_repaired, 0.001, np.nan)
    repaired = take.replace_markers(markers, sd_m)
    return {
        "read C3D": lambda: capture.read_take(path),
        "write C3D": lambda: write.patch_c3d(target, take, repaired),
    }


def build_motion_jobs(path: Path, truth: SyntheticTake) -> Jobs:
    """Return the operations on the true motion of the composed take; they write to the folder of `path`."""
    take, skeleton, motion, rate = capture.read_take(path), truth.subject.skeleton, truth.motion, truth.rate
    bvh_path, amc_path, builder = path.with_suffix(".bvh"), path.with_suffix(".amc"), rig.load_rig("motionbuilder")
    captured, target = path.with_name("captured.bvh"), path.with_name("repaired.bvh")
    write.write_bvh(captured, skeleton, motion, rate)
    animation = bvh.read_bvh(captured)
    is_repaired = np.random.default_rng(0).random(animation.values.shape) < REPAIRED_SAMPLE_SHARE
    values = np.where(is_repaired, animation.values + 1.0, animation.values)
    return {
        "read BVH": lambda: bvh.read_bvh(captured),
        "write BVH, repaired": lambda: write.patch_animation(target, animation, values),
        "write BVH": lambda: write.write_bvh(bvh_path, skeleton, motion, rate),
        "write BVH for MotionBuilder": lambda: write.write_rig_bvh(bvh_path, builder, skeleton, motion, rate),
        "write glTF": lambda: write.write_gltf(path.with_suffix(".glb"), skeleton, motion, rate),
        "write ASF/AMC": lambda: write.write_asf_amc(amc_path.with_suffix(".asf"), amc_path, skeleton, motion, rate),
        "write NPZ": lambda: write.write_npz(path.with_suffix(".npz"), take, skeleton, motion, rate),
        "resample 120 to 25 frames per second": lambda: resample_motion(motion, rate, 25.0),
    }


def compose_file_take(duration_s: float) -> SyntheticTake:
    """Return a composed take of a person, with markers of a second person up to FILE_MARKER_COUNT."""
    truth = synthetic.compose_take(seconds=duration_s)
    copied = range(FILE_MARKER_COUNT - len(truth.labels))
    return replace(
        truth,
        labels=(*truth.labels, *(f"beside:{truth.labels[m]}" for m in copied)),
        damaged_positions=np.concatenate([truth.damaged_positions, truth.damaged_positions[:, copied] + 1.0], axis=1),
        missing_mask=np.concatenate([truth.missing_mask, truth.missing_mask[:, copied]], axis=1),
    )


def _time_call(job: Callable[[], object]) -> float:
    started = perf_counter()
    job()
    return perf_counter() - started
