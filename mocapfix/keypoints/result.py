"""What a film of keypoints gives, and how it is put into a folder."""

import json
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from mocapfix.clock import Clock
from mocapfix.files import check_not_there, make_folder, replacing
from mocapfix.kernels import kinematics
from mocapfix.keypoints.camera import Camera
from mocapfix.keypoints.read import Keypoints
from mocapfix.motion import STATUS, Motion
from mocapfix.skeleton import Skeleton

KINDS = ("bvh", "report.html", "report.json", "rrd")


@dataclass(frozen=True)
class Result:
    """A motion from keypoints, the camera that saw it, and what both were made of."""

    name: str
    title: str
    keypoints: Keypoints
    rate: float
    skeleton: Skeleton
    motion: Motion
    camera: Camera
    prior: str
    clock: Clock

    @cached_property
    def _placed(self) -> tuple[np.ndarray, np.ndarray]:
        joints, turns = kinematics.world(self.skeleton, self.motion)
        return joints, self.keypoints.detector.placed(joints, turns)

    @property
    def joints(self) -> np.ndarray:
        """-> (T, J, 3) metres, in the world."""
        return self._placed[0]

    @property
    def distance(self) -> np.ndarray:
        """-> (T, V) pixels from each keypoint to where the camera sees its point on the body; NaN where it was not found."""
        apart = np.linalg.norm(self.camera.image(self._placed[1]) - self.keypoints.pixels, axis=-1)
        return np.where(self.keypoints.confidence > 0, apart, np.nan)

    @property
    def report(self) -> dict:
        """-> the record: frames, rate_hz, order, prior, camera, reprojection_px, status (sentence: frames), seconds."""
        distance, known = self.distance, self.keypoints.detector
        found = [column[np.isfinite(column)] for column in distance.T]
        means = [round(float(column.mean()), 2) if len(column) else None for column in found]
        return {
            "scene": self.name,
            "frames": self.keypoints.frames,
            "rate_hz": self.rate,
            "order": known.name,
            "prior": self.prior,
            "camera": {
                "pixels_per_metre": round(self.camera.scale, 3),
                "origin_px": [round(float(x), 2) for x in self.camera.offset],
                "looks_down_deg": round(float(np.degrees(np.arcsin(-self.camera.rotation[2, 1]))), 3),
            },
            "reprojection_px": {
                "mean": round(float(np.nanmean(distance)), 2),
                "p95": round(float(np.nanpercentile(distance, 95)), 2),
                "by_keypoint": dict(zip(known.labels, means, strict=True)),
            },
            "status": {STATUS[status]: count for status, count in Counter(self.motion.status.tolist()).items()},
            "seconds": self.clock.seconds,
        }

    def write(self, folder: Path, overwrite: bool = False) -> dict[str, Path]:
        """Write the motion as BVH, a page, a report and a recording. -> the files by kind

        Raises WriteError where one is there already (and overwrite is False), or cannot be written.
        """
        from mocapfix import write
        from mocapfix.show import film

        outputs = {kind: folder / f"{self.name}.{kind}" for kind in KINDS}
        check_not_there(outputs.values(), overwrite)
        make_folder(folder)
        seen, images = self.keypoints, self.camera.image(self.joints)
        shown = film.Film(self.title, self.rate, seen.image, seen.pixels, seen.confidence, self.skeleton, self.joints, images)
        with self.clock("write"):
            write.bvh(outputs["bvh"], self.skeleton, self.motion, self.rate)
            film.recording(outputs["rrd"], shown)
            film.page(outputs["report.html"], shown, self.report)
        with replacing(outputs["report.json"]) as part:
            part.write_text(json.dumps(self.report, indent=1) + "\n", encoding="utf-8")
        return outputs
