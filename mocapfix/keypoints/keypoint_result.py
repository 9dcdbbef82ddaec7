"""What a film of keypoints gives, and how it is put into a folder."""

import json
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from mocapfix.files.output_files import check_outputs_absent, make_output_folder, replace_atomically
from mocapfix.keypoints.camera_scale import KeypointCamera
from mocapfix.keypoints.keypoint_file import Keypoints
from mocapfix.motion import STATUS_TEXTS, Motion
from mocapfix.report.stage_timer import StageTimer
from mocapfix.skeleton import Skeleton
from mocapfix.solve import kinematics

KEYPOINT_OUTPUT_KINDS = ("bvh", "report.html", "report.json", "rrd")


@dataclass(frozen=True)
class KeypointResult:
    """A motion from keypoints, the camera that saw it, and what both were made of."""

    name: str
    title: str
    keypoints: Keypoints
    rate_hz: float
    skeleton: Skeleton
    motion: Motion
    camera: KeypointCamera
    prior_name: str
    timer: StageTimer

    @cached_property
    def _positions(self) -> tuple[np.ndarray, np.ndarray]:
        joints, turns = kinematics.compute_world_poses(self.skeleton, self.motion)
        return joints, self.keypoints.detector.compute_point_positions(joints, turns)

    @property
    def joint_positions(self) -> np.ndarray:
        """-> (T, J, 3) metres, in the world."""
        return self._positions[0]

    @property
    def reprojection_error_px(self) -> np.ndarray:
        """-> (T, V) pixels from each keypoint to where the camera sees its point on the body; NaN where it was not found."""
        apart = np.linalg.norm(self.camera.project(self._positions[1]) - self.keypoints.position_px, axis=-1)
        return np.where(self.keypoints.confidence > 0, apart, np.nan)

    @property
    def report(self) -> dict:
        """-> the record: frames, rate_hz, order, prior, camera, reprojection_px, status (sentence: frames), seconds."""
        distance, known = self.reprojection_error_px, self.keypoints.detector
        found = [column[np.isfinite(column)] for column in distance.T]
        means = [round(float(column.mean()), 2) if len(column) else None for column in found]
        return {
            "scene": self.name,
            "frames": self.keypoints.frame_count,
            "rate_hz": self.rate_hz,
            "order": known.name,
            "prior": self.prior_name,
            "camera": {
                "pixels_per_metre": round(self.camera.scale_px_m, 3),
                "origin_px": [round(float(x), 2) for x in self.camera.offset_px],
                "looks_down_deg": round(float(np.degrees(np.arcsin(-self.camera.rotation[2, 1]))), 3),
            },
            "reprojection_px": {
                "mean": round(float(np.nanmean(distance)), 2),
                "p95": round(float(np.nanpercentile(distance, 95)), 2),
                "by_keypoint": dict(zip(known.labels, means, strict=True)),
            },
            "status": {STATUS_TEXTS[status]: count for status, count in Counter(self.motion.status.tolist()).items()},
            "seconds": self.timer.stage_seconds,
        }

    def write(self, folder: Path, overwrite: bool = False) -> dict[str, Path]:
        """Write the motion as BVH, a page, a report and a recording. -> the files by kind

        Raises WriteError where one is there already (and overwrite is False), or cannot be written.
        """
        from mocapfix import write
        from mocapfix.report import keypoint_report

        outputs = {kind: folder / f"{self.name}.{kind}" for kind in KEYPOINT_OUTPUT_KINDS}
        check_outputs_absent(outputs.values(), overwrite)
        make_output_folder(folder)
        seen, images = self.keypoints, self.camera.project(self.joint_positions)
        shown = keypoint_report.KeypointFilm(
            self.title,
            self.rate_hz,
            seen.image_size_px,
            seen.position_px,
            seen.confidence,
            self.skeleton,
            self.joint_positions,
            images,
        )
        with self.timer("write"):
            write.write_bvh(outputs["bvh"], self.skeleton, self.motion, self.rate_hz)
            keypoint_report.write_keypoint_recording(outputs["rrd"], shown)
            keypoint_report.write_keypoint_page(outputs["report.html"], shown, self.report)
        with replace_atomically(outputs["report.json"]) as part:
            part.write_text(json.dumps(self.report, indent=1) + "\n", encoding="utf-8")
        return outputs
