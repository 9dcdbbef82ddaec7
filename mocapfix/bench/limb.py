"""A limb lost for a while: how far its joints, as they are put back, lie from where they were.

Recordings of people that no model was trained on are performed by the average body, which wears the markers of its set and one
on every joint. Somewhere an arm (from the elbow out) or a leg (from the knee out) is hidden, and the take is solved as any
other is. Beside that stands what each way of filling the gap is worth on its own (see `limb_ways`).
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mocapfix import initialise, marker_set, prior, solve
from mocapfix.bench import limb_ways
from mocapfix.clock import Progress
from mocapfix.errors import ReadError
from mocapfix.kernels import kinematics
from mocapfix.motion import Motion
from mocapfix.prior.contract import PoseModel
from mocapfix.skeleton import cmu31
from mocapfix.solve import SolveOptions
from mocapfix.subject import Subject
from mocapfix.take import Take
from mocapfix.train.flips import longest_between
from mocapfix.train.poses import slight
from mocapfix.train.recordings import shards

SECONDS = (0.5, 1.0, 2.0)  # how long a limb is lost
AROUND = 0.4  # seconds that are seen before and after at the least
UNIT = 0.0254 / 0.45  # metres: the unit of the places in CMU's own releases
LIMBS = {  # the joints whose rotations are lost; and those whose places are, which are scored
    "arm": (("Arm", "ForeArm", "Hand"), ("ForeArm", "Hand", "FingerBase")),
    "leg": (("UpLeg", "Leg", "Foot"), ("Leg", "Foot", "ToeBase")),
}


class Performance(NamedTuple):
    """A recording without flips, by its name, as somebody performs it who has the average body."""

    motion: Motion
    rate: float
    name: str


class Gap(NamedTuple):
    """Frames `first` to `last` of a performance, in which the limb of one side is lost."""

    performance: Performance
    side: str
    first: int
    last: int


def run(
    data: Path, model: PoseModel | None, count: int = 20, seed: int = 0, progress: Progress = lambda _: None
) -> dict[str, dict]:
    """-> limb -> seconds ("0.5", "1", "2") -> mean error in mm over the lost joints and the gap's frames, and under `ways` the
    same of each way of filling it alone: way -> limb -> seconds.

    data   the folder that holds test.npz, with skeletons.json beside it: motion of people whom the model has not seen
    model  the trained model that is in the solve; None for the take and time alone
    count  how many gaps there are of each limb and length, at places drawn alike from all frames by `seed`

    Raises ReadError where there is no such motion.
    """
    performances, rng = list(performed(data / "test.npz")), np.random.default_rng(seed)
    table: dict[str, dict] = {}
    for limb in LIMBS:
        for seconds in SECONDS:
            errors: dict[str, list[float]] = {}
            for n, gap in enumerate(drawn(performances, seconds, count, rng)):
                progress(f"{limb} lost for {seconds:g} s, {n + 1} of {count}")
                for way, motion in solved(gap, limb, model):
                    errors.setdefault(way, []).append(off(gap, limb, motion))
            for way, found in errors.items():
                table.setdefault(way, {}).setdefault(limb, {})[f"{seconds:g}"] = 1e3 * float(np.mean(found))
    return table.pop("mocapfix") | {"ways": table}


def performed(path: Path) -> Iterator[Performance]:
    """Yield the recordings of a shard, between flips, with their places. Raises ReadError where it is none."""
    names = cmu31().skeleton.names
    try:
        with np.load(path) as shard:
            places = np.split(UNIT * shard["root"].astype(float), shard["start"][1:])
        json.loads((path.parent / "skeletons.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, KeyError) as error:
        raise ReadError(f"{path}: is no shard of motion with its skeletons.json beside it ({error}).") from error
    firm = ~slight(names)
    for recording, place in zip(shards.read(path), places, strict=True):
        kept = longest_between(recording.rotations[:, firm], recording.rate)
        yield Performance(motion(place[kept], recording.rotations[kept]), recording.rate, recording.name)


def motion(root: np.ndarray, rotations: np.ndarray) -> Motion:
    """-> a motion that nobody had to solve: root (T, 3) metres, rotations (T, J, 3, 3)."""
    none = np.zeros(len(root), int)
    sure = np.zeros(rotations.shape[:2])
    return Motion(np.ascontiguousarray(root), np.ascontiguousarray(rotations), none, none, sure[:, :0], sure)


def drawn(performances: list[Performance], seconds: float, count: int, rng: np.random.Generator) -> list[Gap]:
    """-> gaps, each frame at which one can begin as likely as any other."""
    room = [each.motion.frames - round((seconds + 2 * AROUND) * each.rate) for each in performances]
    begins = np.maximum(room, 0)
    gaps = []
    for place in rng.integers(begins.sum(), size=count):
        n = int(np.searchsorted(np.cumsum(begins), place, side="right"))
        each = performances[n]
        first = int(place - begins[:n].sum()) + round(AROUND * each.rate)
        side = ("Left", "Right")[rng.integers(2)]
        gaps.append(Gap(each, side, first, first + round(seconds * each.rate) - 1))
    return gaps


def solved(gap: Gap, limb: str, model: PoseModel | None) -> Iterator[tuple[str, Motion]]:
    """Yield what the solve makes of the take with the gap, and each other way alone of the same solve, by name."""
    body, subject = cmu31(), wearing_all()
    habits, limits = prior.load("mean-pose", body.skeleton), prior.load_limits(body.skeleton)
    worn = struck(gap, limb, subject)
    start = initialise.motion(worn, subject, body, habits)
    found = solve.motion(worn, subject, body, habits, limits, start, SolveOptions(), (lambda: model) if model else None)
    yield "mocapfix", found
    turned = np.array([body.skeleton.index(gap.side + name) for name in LIMBS[limb][0]])
    yield from limb_ways.alone(found, turned, gap.first, gap.last, gap.performance.rate, model)
    if model is not None:
        yield "the take and time", solve.motion(worn, subject, body, habits, limits, start, SolveOptions())


def wearing_all() -> Subject:
    """-> the average body with the markers of its set and one on every joint, which the joint's parent carries."""
    skeleton, worn = cmu31().skeleton, marker_set.load("cmu41")
    carriers = np.maximum(skeleton.parents, 0)
    joints, places = np.r_[worn.joints, carriers], np.r_[worn.places, skeleton.offsets * (skeleton.parents >= 0)[:, None]]
    labels = worn.labels + skeleton.names
    return Subject(skeleton, worn.name, labels, joints, np.ascontiguousarray(places), np.zeros(len(labels)))


def struck(gap: Gap, limb: str, subject: Subject) -> Take:
    """-> the performance's markers, those that the limb carries missing in the gap."""
    parents, names = subject.skeleton.parents, subject.skeleton.names
    lost = np.isin(names, [gap.side + name for name in LIMBS[limb][0]])
    for j in range(1, len(names)):
        lost[j] |= lost[parents[j]]
    markers = kinematics.placed(subject, gap.performance.motion)[1]
    markers[gap.first : gap.last + 1, lost[subject.joints]] = np.nan
    return Take(markers, subject.labels, gap.performance.rate)


def off(gap: Gap, limb: str, found: Motion) -> float:
    """-> metres: the mean distance of the lost joints from the true ones over the gap."""
    skeleton, frames = cmu31().skeleton, np.arange(gap.first, gap.last + 1)
    joints = [skeleton.index(gap.side + name) for name in LIMBS[limb][1]]
    truth, there = (kinematics.world(skeleton, each.at(frames))[0][:, joints] for each in (gap.performance.motion, found))
    return float(np.linalg.norm(there - truth, axis=-1).mean())
