"""What happens to a marker's place: it is knocked, or slides, and stays elsewhere on its segment."""

import numpy as np

from mocapfix.bench.stage import Place, Stage
from mocapfix.faults import Kind, Moved
from mocapfix.kernels import kinematics

MOVE = (0.015, 0.06)  # metres on the segment
LATER_GAP = 0.5  # seconds: a gap of a marker that moved, after it did


def move(stage: Stage, kind: Kind, begins: tuple[float, float], lasts: tuple[float, float]) -> None:
    """A marker goes elsewhere on its segment and stays there; `begins` and `lasts` are parts of the take. Later it has a gap."""
    first = round(stage.frames * stage.rng.uniform(*begins))
    settled = first + round(stage.frames * stage.rng.uniform(*lasts))
    marker, way = int(stage.rng.integers(stage.count)), stage.way(*MOVE)
    if not stage.free(Place((marker,), 0, stage.frames - 1)):
        return
    _, rotation = kinematics.world(stage.sound.subject.skeleton, stage.sound.motion)
    share = np.clip((np.arange(stage.frames) - first + 1) / (settled - first + 1), 0, 1)
    shift = share[:, None] * (rotation[:, stage.sound.subject.joints[marker]] @ way)
    stage.markers[:, marker] += shift
    stage.true[:, marker] += shift
    size = float(np.linalg.norm(way))
    stage.happened(Moved(kind, marker, first, stage.frames - 1, size, "", settled=settled))
    length = round(LATER_GAP * stage.rate)
    start = int(stage.rng.integers(settled + 1, stage.frames - length - 1))
    stage.hide(marker, start, start + length - 1)
