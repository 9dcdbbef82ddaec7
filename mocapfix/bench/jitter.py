"""How near HybrIK's three ways come where the joints that they are given are off (HybrIK, Table 3; HybrIK-X, Table 7).

A joint is off by up to so much along each axis, anything within as likely. What is found is held against where the joints
truly are and, as HybrIK's Eq. 14 has it, against where they were given. The bones are the person's own, or those of somebody
else: then the joints are of composed PEOPLE, whose bones lie 8 mm off the average body's, as those of CMU's subjects do, and the
average body's are taken for them.
"""

from typing import NamedTuple, get_args

import numpy as np

from mocapfix import marker_set
from mocapfix.bench.limb import motion
from mocapfix.clock import Progress
from mocapfix.initialise import hybrik
from mocapfix.initialise.closed_form import DEVIATION, Way
from mocapfix.kernels import kinematics
from mocapfix.skeleton import cmu31
from mocapfix.subject import Subject
from mocapfix.synthetic.truth import person

JITTERS = (0, 10, 20, 30)  # millimetres along each axis
HAND = ("Hand", "FingerBase", "Thumb")  # and the fingers' HandIndex
PEOPLE = 20
UNTWISTED = np.broadcast_to([1.0, 0.0], (1, len(cmu31().skeleton.names), 2))


class Task(NamedTuple):
    """Where joints are and where they are said to be, (N, J, 3) metres, and by how much that is off."""

    true: np.ndarray
    given: np.ndarray
    deviation: float  # metres per axis


def measure(poses: np.ndarray, progress: Progress) -> dict[str, dict]:
    """-> what is measured: millimetres of jitter: of poses (N, J, 3, 3), the way's `parts`.

    jitter_mm       from where the joints truly are
    from_given_mm   from where they were given
    given_mm        how far those are from one another
    wrong_bones_mm  from where the joints truly are, the bones being somebody else's
    """
    subject, said = average(), {"jitter_mm": {}, "from_given_mm": {}, "given_mm": {}, "wrong_bones_mm": {}}
    own = kinematics.world(subject.skeleton, motion(np.zeros((len(poses), 3)), poses))[0]
    others = of_people(poses)
    for jitter in JITTERS:
        progress(f"joints off by {jitter} mm")
        right, wrong, key = shaken(own, jitter), shaken(others, jitter), str(jitter)
        found = {way: places(right, subject, way) for way in get_args(Way)}
        said["jitter_mm"][key] = {way: parts(joints, right.true) for way, joints in found.items()}
        said["from_given_mm"][key] = {way: parts(joints, right.given) for way, joints in found.items()}
        said["given_mm"][key] = parts(right.given, right.true)
        said["wrong_bones_mm"][key] = {way: parts(places(wrong, subject, way), wrong.true) for way in get_args(Way)}
    return said


def average() -> Subject:
    """-> the average body in CMU's 41 markers."""
    worn = marker_set.load("cmu41")
    return Subject(cmu31().skeleton, worn.name, worn.labels, worn.joints, worn.places, worn.spread)


def of_people(poses: np.ndarray) -> np.ndarray:
    """-> (N, J, 3) metres: the joints of PEOPLE, each of whom takes a part of the poses; always the same people."""
    bodies = [person(np.random.default_rng(who), crooked=True).skeleton for who in range(PEOPLE)]
    shares = [motion(np.zeros((len(share), 3)), share) for share in np.array_split(poses, PEOPLE)]
    return np.concatenate([kinematics.world(body, share)[0] for body, share in zip(bodies, shares, strict=True)])


def shaken(true: np.ndarray, jitter: int) -> Task:
    """-> joints that are said to be up to `jitter` millimetres off along each axis; always the same ones."""
    most = 1e-3 * jitter
    given = true + np.random.default_rng(jitter).uniform(-most, most, true.shape)
    return Task(true, given, most / np.sqrt(3) or DEVIATION)


def places(task: Task, subject: Subject, way: Way) -> np.ndarray:
    """-> (N, J, 3) metres: where a way puts the joints."""
    found = hybrik(task.given, subject, way=way, deviation=task.deviation, twists=UNTWISTED)
    return kinematics.world(subject.skeleton, found)[0]


def parts(joints: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """-> mm, the mean distance over the joints: all of them, the hands' and the rest."""
    far = 1e3 * np.linalg.norm(joints - true, axis=2)
    hand = np.array([any(part in name for part in HAND) for name in cmu31().skeleton.names])
    return {"all_mm": float(far.mean()), "body_mm": float(far[:, ~hand].mean()), "hands_mm": float(far[:, hand].mean())}


def ratios(said: dict[str, dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """-> millimetres of jitter: how much of naive's error adaptive leaves, of all joints and the body's, and X of adaptive's."""
    return {
        jitter: {
            "adaptive_over_naive_all": ways["adaptive"]["all_mm"] / ways["naive"]["all_mm"],
            "adaptive_over_naive_body": ways["adaptive"]["body_mm"] / ways["naive"]["body_mm"],
            "x_over_adaptive_hands": ways["x"]["hands_mm"] / ways["adaptive"]["hands_mm"],
        }
        for jitter, ways in said.items()
        if jitter != "0"  # of nothing there is no part
    }
