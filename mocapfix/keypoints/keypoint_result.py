"""The result of solving a film of keypoints, its report, and its output files."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from mocapfix.files.output_files import check_outputs_absent, make_output_folder, replace_atomically
from mocapfix.keypoints.keypoint_file import Keypoints
from mocapfix.motion import FrameStatus, Motion
from mocapfix.report.stage_timer import StageTimer
from mocapfix.skeleton import Skeleton
from mocapfix.solve.constraints import Camera
from mocapfix.solve.kinematics import compute_world_poses

if TYPE_CHECKING:
    from mocapfix.report.keypoint_report import KeypointReport

KEYPOINT_OUTPUT_KINDS = ("bvh", "report.html", "report.json", "rrd")


@dataclass(frozen=True)
class KeypointResult:
    """A motion from keypoints, the camera, and what both were estimated from."""

    name: str
    title: str
    keypoints: Keypoints
    rate_hz: float
    skeleton: Skeleton
    motion: Motion
    camera: Camera
    prior_name: str
    timer: StageTimer

    @cached_property
    def _positions(self) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T V 3"]]:
        joints, rotations = compute_world_poses(self.skeleton, self.motion)
        return joints, self.keypoints.detector.compute_point_positions(joints, rotations)

    @property
    def joint_positions(self) -> Float[np.ndarray, "T J 3"]:
        """World positions in metres."""
        return self._positions[0]

    @property
    def reprojection_error_px(self) -> Float[np.ndarray, "T V"]:
        """Distances from each keypoint to the image of its point on the body; NaN for a missing keypoint."""
        distance = np.linalg.norm(self.camera.project(self._positions[1]) - self.keypoints.position_px, axis=-1)
        return np.where(self.keypoints.confidence > 0, distance, np.nan)

    @property
    def report(self) -> KeypointReport:
        """The report, for report.json."""
        error_px, detector = self.reprojection_error_px, self.keypoints.detector
        by_keypoint = [column[np.isfinite(column)] for column in error_px.T]
        means = [round(float(column.mean()), 2) if len(column) else None for column in by_keypoint]
        return {
            "scene": self.name,
            "frames": self.keypoints.frame_count,
            "rate_hz": self.rate_hz,
            "order": detector.name,
            "prior": self.prior_name,
            "camera": {
                "pixels_per_metre": round(self.camera.scale, 3),
                "origin_px": [round(float(x), 2) for x in self.camera.centre],
                "pitch_down_deg": round(float(np.degrees(np.arcsin(-self.camera.rotation[2, 1]))), 3),
            },
            "reprojection_px": {
                "mean": round(float(np.nanmean(error_px)), 2),
                "p95": round(float(np.nanpercentile(error_px, 95)), 2),
                "by_keypoint": dict(zip(detector.labels, means, strict=True)),
            },
            "status": {FrameStatus(status).description: count for status, count in Counter(self.motion.status.tolist()).items()},
            "seconds": self.timer.stage_seconds,
        }

    def write(self, folder: Path, overwrite: bool = False) -> dict[str, Path]:
        """Write the motion as BVH, a page, a report and a recording. Return the files by kind.

        Raises WriteError if one exists already (and overwrite is False), or cannot be written.
        """
        from mocapfix.report.keypoint_report import KeypointFilm, write_keypoint_page, write_keypoint_recording
        from mocapfix.write.bvh import write_bvh

        outputs = {kind: folder / f"{self.name}.{kind}" for kind in KEYPOINT_OUTPUT_KINDS}
        check_outputs_absent(outputs.values(), overwrite)
        make_output_folder(folder)
        keypoints, joint_px = self.keypoints, self.camera.project(self.joint_positions)
        film = KeypointFilm(
            self.title, self.rate_hz, keypoints.image_size_px, keypoints.position_px, keypoints.confidence, self.skeleton,
            self.joint_positions, joint_px,
        )  # fmt: skip
        with self.timer("write"):
            write_bvh(outputs["bvh"], self.skeleton, self.motion, self.rate_hz)
            write_keypoint_recording(outputs["rrd"], film)
            write_keypoint_page(outputs["report.html"], film, self.report)
        with replace_atomically(outputs["report.json"]) as part:
            part.write_text(json.dumps(self.report, indent=1) + "\n", encoding="utf-8")
        return outputs
