"""Measure how far people's joints turn: python -m mocapfix.train.joint_limits MOTION_FOLDER priors/joint-limits.yaml

MOTION_FOLDER is as for mocapfix.train.mean_pose. A joint's limits are, along each axis of its parent, the range of the
rotation vector from the mean pose to the poses of all subjects, each motion as it is and mirrored, but for the outermost
thousandth of the frames on either side; widened by what each of the subjects would have needed, had he been left out. A
trial in which CMU's solve of the joint jumps is left out for that joint.

Axes that CMU's skeleton holds still are not limited by that: people turn there (see mocapfix.train.mean_pose).
"""

import json
import sys
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from mocapfix import prior
from mocapfix.prior import Prior
from mocapfix.skeleton import cmu31
from mocapfix.train.flips import jumps
from mocapfix.train.mean_pose import FOREARM_TURN, HELD
from mocapfix.train.mirror import FLIP, mirrored_name

RATE = 30.0  # Hz, of the motion
OUTERMOST = 0.1  # percent of the frames on either side
NEWCOMER = 99.0  # percent of the frames of somebody who was not measured that shall lie within
REACH = 3.0  # deviations: so far a joint may turn about an axis that the skeleton holds
CARD = """\
# How far people's joints turn: the range of each joint's rotation vector from the mean pose (priors/mean-pose.yaml) along
# the axes x, y, z of its parent, in radians. The root turns freely.
# Measured by mocapfix.train.joint_limits on {frames} frames of {trials} trials of the CMU database, each also mirrored,
# but for the outermost {outermost} % on either side and trials in which the joint jumps; widened so that {newcomer} % of the
# frames of every subject would lie within, had he been left out. About axes that CMU's skeleton holds still, +-{reach}
# deviations of the mean pose.
#
# The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF
# EIA-0196217.
"""


def believed(turns: np.ndarray) -> bool:
    """-> whether a joint's local rotations (T, 3, 3) in a trial are free of jumps.

    After a jump CMU's solve may stay flipped to the trial's end, and which side of it is right is not to be seen.
    """
    return not jumps(turns, RATE).any()


def give(mean_pose: Prior, joint: int, forearm: bool) -> np.ndarray:
    """-> (3,) radians along the parent's axes: how far people turn a joint about the axes that the skeleton holds."""
    variance = HELD**4 * np.diag(mean_pose.held[joint])  # held is information: its inverse square is HELD's
    return REACH * np.sqrt(variance + (np.array([FOREARM_TURN**2, 0, 0]) if forearm else 0.0))


def measure(names: list[str], trials: list[np.ndarray], people: list[str], mean_pose: Prior) -> dict:
    """-> the limits' mapping, from joint names, trials of Euler angles (T, J, 3) in degrees, ZYX, and whose each trial is."""
    turned = [Rotation.from_euler("ZYX", t.reshape(-1, 3), degrees=True).as_matrix().reshape(*t.shape, 3) for t in trials]
    joints = {}
    for j, name in enumerate(names[1:], start=1):
        away = strays(turned, people, j, names.index(mirrored_name(name)), mean_pose.rotations[j])
        (low, high), room = span(np.concatenate(list(away.values()))), give(mean_pose, j, name.endswith("ForeArm"))
        wider = margin(away)
        joints[name] = {
            "low": [float(v) for v in np.floor(np.round(1e3 * np.minimum(low - wider, -room), 2)) / 1e3],
            "high": [float(v) for v in np.ceil(np.round(1e3 * np.maximum(high + wider, room), 2)) / 1e3],
        }
    return joints


def strays(turned: list[np.ndarray], people: list[str], joint: int, other: int, mean: np.ndarray) -> dict[str, np.ndarray]:
    """-> person: (N, 3) rotation vectors from the mean (3, 3) to a joint's turns, and to its `other` side's mirrored."""
    found: dict[str, list[np.ndarray]] = {}
    for trial, person in zip(turned, people, strict=True):
        for course in (trial[:, joint], FLIP @ trial[:, other] @ FLIP):
            if believed(course):
                found.setdefault(person, []).append(Rotation.from_matrix(course @ mean.T).as_rotvec())
    return {person: np.concatenate(courses) for person, courses in found.items()}


def span(away: np.ndarray) -> np.ndarray:
    """-> (2, 3) lowest and highest of rotation vectors (N, 3), but for the outermost."""
    return np.percentile(away, [OUTERMOST, 100 - OUTERMOST], axis=0)


def margin(away: dict[str, np.ndarray]) -> float:
    """-> radians by which the range of all others must be widened for whoever of the people needs it most."""
    widest = 0.0
    for person, mine in away.items():
        others = [theirs for name, theirs in away.items() if name != person]
        if others:
            low, high = span(np.concatenate(others))
            beyond = np.maximum(low - mine, mine - high).max(axis=1)
            widest = max(widest, float(np.percentile(beyond, NEWCOMER)))
    return widest


def main(folder: str, target: str) -> None:
    names = json.loads((Path(folder) / "skeletons.json").read_text())["joints"]
    trials, people = [], []
    for path in sorted(Path(folder).glob("train-*.npz")):
        if "approx" not in path.name:
            shard = np.load(path)
            trials += np.split(shard["euler"] / 32767 * 180, shard["start"][1:])
            people += [str(trial).split("_")[0] for trial in shard["trial"]]
    joints = measure(names, trials, people, prior.load("mean-pose", cmu31().skeleton))
    text = yaml.safe_dump({"joints": joints}, sort_keys=False, default_flow_style=None, width=120)
    frames = sum(len(trial) for trial in trials)
    card = CARD.format(frames=frames, trials=len(trials), outermost=OUTERMOST, newcomer=f"{NEWCOMER:g}", reach=f"{REACH:g}")
    Path(target).write_text(card + text)


if __name__ == "__main__":
    main(*sys.argv[1:])
