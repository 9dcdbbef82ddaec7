"""Faults put into sound animations, found and mended: how far the joints are off beside interpolating across each fault.

Interpolation is told where each fault begins and ends and goes from its last sound frame to its first; so is the mending in the
rows "told", which says what the mending is worth. In the rows "found" the faults have to be found first.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from mocapfix.bench.injected_turns import KINDS, LENGTHS, Put, damaged
from mocapfix.bench.limb import Performance, performed
from mocapfix.clock import Progress
from mocapfix.detect import turns as detected
from mocapfix.errors import SceneError
from mocapfix.faults import Fault, Kind
from mocapfix.kernels import kinematics
from mocapfix.motion import Motion
from mocapfix.skeleton import cmu31
from mocapfix.solve import turns as solved
from mocapfix.synthetic import motions
from mocapfix.synthetic.truth import person
from mocapfix.train.recordings.recording import RATE

LEAST = 3.4  # seconds of a performance that has room for faults
WAYS = ("linear", "told", "found")
TOLD_AS: dict[str, Kind] = {
    "flip": "flip", "pop": "pop", "jitter": "jitter", "limb lost": "gap", "figure lost": "gap", "root off": "spike",
}  # fmt: skip
NO_TREMBLE = "jitter", "1 frame"  # what trembles in one frame has popped
TREMBLE = np.radians(3.0)


@dataclass
class Tally:
    """What is measured of one kind and length: mean joint errors of each fault by way, and how many faults were found."""

    errors: dict[str, list[float]] = field(default_factory=lambda: {way: [] for way in WAYS})
    found: int = 0

    def row(self) -> dict[str, float]:
        """-> faults, the part found, error in mm by way, and what each leaves of linear's."""
        mean = {way: 1e3 * float(np.mean(each)) for way, each in self.errors.items()}
        said = {"faults": len(self.errors["linear"]), "found": self.found / len(self.errors["linear"])}
        said |= {f"{way}_mm": mm for way, mm in mean.items()}
        return said | {f"{way}_over_linear": mean[way] / mean["linear"] for way in WAYS[1:]}


def measure(
    data: Path | None, trials: int, seed: int = 0, progress: Progress = lambda _: None, kinds: tuple[str, ...] = tuple(KINDS)
) -> dict:
    """-> `rows`: kind: length: a Tally's row; `pooled`: of all faults of a length what is left of linear's error, told and found;
    `alarms_per_minute` by kind in the sound trials, and `touched`, the part of the sound samples that was changed.

    data  the folder that holds test.npz of motion; None composes motion. Raises SceneError or ReadError where there is none.
    """
    if trials < 1:
        raise SceneError(f"At least one trial is needed, not {trials}.")
    chosen, tallies, alarms, seconds = list(_trials(data, trials)), {}, {}, 0.0
    touched: list[float] = []
    for n, trial in enumerate(chosen):
        progress(f"{trial.name}, {n + 1} of {len(chosen)}")
        seconds += trial.motion.frames / trial.rate
        for fault in _found(trial.motion, trial.rate):
            alarms[fault.kind] = alarms.get(fault.kind, 0) + 1
        for k, kind in enumerate(kinds):
            for m, length in enumerate(LENGTHS):
                if (kind, length) != NO_TREMBLE:
                    rng = np.random.default_rng([seed, n, k, m])
                    touched.append(_scored(trial, kind, length, rng, tallies.setdefault((kind, length), Tally())))
    rows: dict[str, dict] = {}
    for (kind, length), tally in tallies.items():
        if tally.errors["linear"]:
            rows.setdefault(kind, {})[length] = tally.row()
    pooled = {}
    for length in LENGTHS:
        sums = {way: sum(sum(t.errors[way]) for (_, own), t in tallies.items() if own == length) for way in WAYS}
        pooled[length] = {way: sums[way] / sums["linear"] for way in WAYS[1:]} if sums["linear"] else {}
    per_minute = {kind: 60 * count / seconds for kind, count in sorted(alarms.items())}
    return {"rows": rows, "pooled": pooled, "alarms_per_minute": per_minute, "touched": float(np.mean(touched))}


def _trials(data: Path | None, count: int) -> Iterator[Performance]:
    """Yield so many performances, of the test people's as unlike ones as may be."""
    if data is None:
        for n in range(count):
            subject = person(np.random.default_rng(n), crooked=True)
            yield Performance(motions.compose(subject, 10.0 + n, RATE), RATE, f"composed {n + 1}")
        return
    long = [each for each in performed(Path(data) / "test.npz") if each.motion.frames >= LEAST * each.rate]
    for at in np.unique(np.linspace(0, len(long) - 1, min(count, len(long))).astype(int)):
        yield long[at]


def _found(motion: Motion, rate: float) -> list[Fault]:
    names = cmu31().skeleton.names
    return detected.found(names, motion.root, motion.rotations, ["ZYX"] * len(names), rate)


def _scored(trial: Performance, kind: str, length: str, rng: np.random.Generator, tally: Tally) -> float:
    """Add what becomes of a trial's faults to the tally; -> the part of the sound samples that was changed."""
    skeleton, truth = cmu31().skeleton, trial.motion
    struck, put = damaged(truth, skeleton, trial.rate, kind, length, rng)
    if not put:
        return 0.0
    orders, faults = ["ZYX"] * len(skeleton.names), _found(struck, trial.rate)
    given = (skeleton.parents, struck.root, struck.rotations, orders)
    told = solved.mended(*given, [each for p in put for each in as_faults(p, len(orders))], trial.rate)
    mended = solved.mended(*given, faults, trial.rate)
    poses = {"linear": interpolated(struck.root, struck.rotations, put), "told": told[:2], "found": mended[:2]}
    places = {way: _places(*each) for way, each in poses.items()}
    true, sound = _places(truth.root, truth.rotations), np.ones(mended.way.shape, bool)
    for each in put:
        span, courses = slice(each.first, each.last + 1), as_faults(each, len(orders))
        struck_courses = [m for fault in courses for m in fault.markers]
        sound[span, struck_courses] = False
        tally.found += any(f.first <= each.last and each.first <= f.last and set(f.markers) & set(struck_courses) for f in faults)
        for way, found in places.items():
            tally.errors[way].append(float(np.linalg.norm(found[span] - true[span], axis=-1).mean()))
    return float((mended.way != solved.AS_IT_IS)[sound].mean())


def as_faults(put: Put, count: int) -> list[Fault]:
    """-> what was put into a skeleton of so many joints, as detection would tell it."""
    kind = TOLD_AS[put.kind]
    if kind == "jitter":
        return [Fault(kind, j, put.first, put.last, TREMBLE, "") for j in put.joints]
    markers = (count,) if kind == "spike" else put.joints + (count,) * (len(put.joints) == count)
    return [Fault(kind, markers[0], put.first, put.last, np.nan, "", 1.0, markers[1:])]


def interpolated(root: np.ndarray, local: np.ndarray, put: list[Put]) -> tuple[np.ndarray, np.ndarray]:
    """-> places (T, 3) and local rotations (T, J, 3, 3) with every fault bridged from its last sound frame to its first, joint by
    joint: spherically, and the root's place in a straight line where it is part of the fault."""
    root, local = root.copy(), local.copy()
    for each in put:
        span, ends = np.arange(each.first, each.last + 1), np.array([each.first - 1, each.last + 1])
        for j in each.joints if each.kind != "root off" else ():
            local[span, j] = Slerp(ends, Rotation.from_matrix(local[ends, j]))(span).as_matrix()
        if each.kind == "root off" or len(each.joints) == local.shape[1]:
            share = ((span - ends[0]) / (ends[1] - ends[0]))[:, None]
            root[span] = (1 - share) * root[ends[0]] + share * root[ends[1]]
    return root, local


def _places(root: np.ndarray, local: np.ndarray) -> np.ndarray:
    return kinematics.carried(kinematics.tree_of(cmu31().skeleton), np.ascontiguousarray(root), np.ascontiguousarray(local))[0]
