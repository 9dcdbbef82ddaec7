"""How near HybrIK's three ways come where the joints that they are given are off (HybrIK, Table 3; HybrIK-X, Table 7).

A joint is off by up to so much along each axis, anything within as likely. What is found is held against where the joints
truly are and, as HybrIK's Eq. 14 has it, against where they were given. The bones are the person's own, or those of somebody
else: then the joints are of composed PEOPLE, whose bones lie 8 mm off the average body's, as those of CMU's subjects do, and the
average body's are taken for them.
"""

from typing import NamedTuple, get_args

import numpy as np

from mocapfix import marker_sets
from mocapfix.bench.common_task import build_known_motion
from mocapfix.initialise.hybrik import DEFAULT_JOINT_SD_M, HybrikVariant
from mocapfix.initialise.initial_motion import solve_hybrik
from mocapfix.report.stage_timer import ProgressCallback
from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve import kinematics
from mocapfix.subject import Subject
from mocapfix.synthetic.synthetic_takes import draw_subject

JOINT_NOISE_MM = (0, 10, 20, 30)  # millimetres along each axis
HAND_NAME_PARTS = ("Hand", "FingerBase", "Thumb")  # and the fingers' HandIndex
COMPOSED_PEOPLE_COUNT = 20
NO_TWISTS = np.broadcast_to([1.0, 0.0], (1, len(load_cmu31_body().skeleton.names), 2))


class NoisyJoints(NamedTuple):
    """Where joints are and where they are said to be, (N, J, 3) metres, and by how much that is off."""

    true_positions: np.ndarray
    given_positions: np.ndarray
    sd_m: float  # metres per axis


def measure_joint_noise(poses: np.ndarray, progress: ProgressCallback) -> dict[str, dict]:
    """-> what is measured: millimetres of jitter: of poses (N, J, 3, 3), the way's `parts`.

    jitter_mm       from where the joints truly are
    from_given_mm   from where they were given
    given_mm        how far those are from one another
    wrong_bones_mm  from where the joints truly are, the bones being somebody else's
    """
    subject, said = build_cmu41_subject(), {"jitter_mm": {}, "from_given_mm": {}, "given_mm": {}, "wrong_bones_mm": {}}
    own = kinematics.compute_world_poses(subject.skeleton, build_known_motion(np.zeros((len(poses), 3)), poses))[0]
    others = compute_composed_joints(poses)
    for jitter in JOINT_NOISE_MM:
        progress(f"joints off by {jitter} mm")
        right, wrong, key = add_joint_noise(own, jitter), add_joint_noise(others, jitter), str(jitter)
        found = {way: solve_hybrik_joints(right, subject, way) for way in get_args(HybrikVariant)}
        said["jitter_mm"][key] = {way: summarise_body_parts(joints, right.true_positions) for way, joints in found.items()}
        said["from_given_mm"][key] = {way: summarise_body_parts(joints, right.given_positions) for way, joints in found.items()}
        said["given_mm"][key] = summarise_body_parts(right.given_positions, right.true_positions)
        said["wrong_bones_mm"][key] = {
            way: summarise_body_parts(solve_hybrik_joints(wrong, subject, way), wrong.true_positions)
            for way in get_args(HybrikVariant)
        }
    return said


def build_cmu41_subject() -> Subject:
    """-> the average body in CMU's 41 markers."""
    worn = marker_sets.load_marker_set("cmu41")
    return Subject(load_cmu31_body().skeleton, worn.name, worn.labels, worn.joints, worn.marker_offsets, worn.marker_spread)


def compute_composed_joints(rotations: np.ndarray) -> np.ndarray:
    """-> (N, J, 3) metres: the joints of PEOPLE, each of whom takes a part of the poses; always the same people."""
    bodies = [draw_subject(np.random.default_rng(who), asymmetric=True).skeleton for who in range(COMPOSED_PEOPLE_COUNT)]
    shares = [build_known_motion(np.zeros((len(share), 3)), share) for share in np.array_split(rotations, COMPOSED_PEOPLE_COUNT)]
    return np.concatenate([kinematics.compute_world_poses(body, share)[0] for body, share in zip(bodies, shares, strict=True)])


def add_joint_noise(true_positions: np.ndarray, noise_mm: int) -> NoisyJoints:
    """-> joints that are said to be up to `jitter` millimetres off along each axis; always the same ones."""
    most = 1e-3 * noise_mm
    given = true_positions + np.random.default_rng(noise_mm).uniform(-most, most, true_positions.shape)
    return NoisyJoints(true_positions, given, most / np.sqrt(3) or DEFAULT_JOINT_SD_M)


def solve_hybrik_joints(task: NoisyJoints, subject: Subject, method: HybrikVariant) -> np.ndarray:
    """-> (N, J, 3) metres: where a way puts the joints."""
    found = solve_hybrik(task.given_positions, subject, variant=method, joint_sd=task.sd_m, twists=NO_TWISTS)
    return kinematics.compute_world_poses(subject.skeleton, found)[0]


def summarise_body_parts(positions: np.ndarray, true_positions: np.ndarray) -> dict[str, float]:
    """-> mm, the mean distance over the joints: all of them, the hands' and the rest."""
    far = 1e3 * np.linalg.norm(positions - true_positions, axis=2)
    hand = np.array([any(part in name for part in HAND_NAME_PARTS) for name in load_cmu31_body().skeleton.names])
    return {"all_mm": float(far.mean()), "body_mm": float(far[:, ~hand].mean()), "hands_mm": float(far[:, hand].mean())}


def compute_noise_ratios(errors: dict[str, dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """-> millimetres of jitter: how much of naive's error adaptive leaves, of all joints and the body's, and X of adaptive's."""
    return {
        jitter: {
            "adaptive_over_naive_all": ways["adaptive"]["all_mm"] / ways["naive"]["all_mm"],
            "adaptive_over_naive_body": ways["adaptive"]["body_mm"] / ways["naive"]["body_mm"],
            "x_over_adaptive_hands": ways["x"]["hands_mm"] / ways["adaptive"]["hands_mm"],
        }
        for jitter, ways in errors.items()
        if jitter != "0"  # of nothing there is no part
    }
