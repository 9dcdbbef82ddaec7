"""What bones' twists are worth: joints are given exactly, and the body's markers show how its bones are turned (HybrIK, Table 1).

Joints lie on bones and say nothing of their twists. These are drawn at random, or left out, or what people do whose joints are
so, or what the markers themselves say, seen exactly or NOISE off.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.bench.limb import motion
from mocapfix.clock import Progress
from mocapfix.initialise import hybrik
from mocapfix.initialise.bones import away
from mocapfix.kernels import kinematics
from mocapfix.motion import Motion
from mocapfix.subject import Subject

NOISE = 0.01  # metres per axis
SURE = 1e9  # 1/rad^2: as sure of a twist as nothing else is


def measure(poses: np.ndarray, subject: Subject, progress: Progress) -> dict[str, dict]:
    """-> whence the twists are: of poses (N, J, 3, 3), what `errors` says."""
    true, rng = motion(np.zeros((len(poses), 3)), poses), np.random.default_rng(0)
    joints, markers = kinematics.placed(subject, true)
    angle = rng.uniform(-np.pi, np.pi, joints.shape[:2])
    sources = {
        "random": {"twists": SURE * np.stack([np.cos(angle), np.sin(angle)], axis=-1)},
        "zero": {"twists": SURE * np.broadcast_to([1.0, 0.0], (1, joints.shape[1], 2))},
        "regressed": {},
        "noisy_markers": {"markers": markers + rng.normal(0, NOISE, markers.shape)},
        "markers": {"markers": markers},
    }
    said = {}
    for name, source in sources.items():
        progress(f"twists: {name}")
        said[name] = errors(subject, hybrik(joints, subject, **source), true)
    return said


def errors(subject: Subject, found: Motion, true: Motion) -> dict:
    """-> mean distances of joints and markers from where the true motion carries them, mm; and of every bone's joint how far it
    is turned from the truth, degrees: since both its ends are right, that is the error of its twist.
    """
    (joints, markers), (there, worn) = (kinematics.placed(subject, each) for each in (found, true))
    turn = apart(subject, found, true)
    bones = np.unique(subject.skeleton.parents[away(subject.skeleton)])
    return {
        "joints_mm": 1e3 * float(np.linalg.norm(joints - there, axis=2).mean()),
        "markers_mm": 1e3 * float(np.linalg.norm(markers - worn, axis=2).mean()),
        "twist_deg": {subject.skeleton.names[j]: float(np.degrees(turn[:, j].mean())) for j in bones if j > 0},
    }


def apart(subject: Subject, found: Motion, true: Motion) -> np.ndarray:
    """-> (N, J) radians: how far joints are turned in the world from the truth."""
    one, other = (kinematics.world(subject.skeleton, each)[1] for each in (found, true))
    turn = np.swapaxes(other, 2, 3) @ one
    return Rotation.from_matrix(turn.reshape(-1, 3, 3)).magnitude().reshape(turn.shape[:2])
