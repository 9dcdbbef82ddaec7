"""Average bodies that stand where a cloud of markers is, facing all ways, and wear a marker wherever people do."""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.calibrate import scaled
from mocapfix.calibrate.attach import Atlas
from mocapfix.kernels import kinematics
from mocapfix.motion import Motion
from mocapfix.prior import Prior
from mocapfix.skeleton import Body
from mocapfix.subject import Subject

HEADINGS = 16
ARMS = (0.0, 0.5, 1.0)  # how far from hanging to a T-pose
SPREAD = 0.05  # metres: of a marker about the place it was guessed to have


def bodies(
    standing: np.ndarray, height: float, known: Atlas, body: Body, prior: Prior
) -> tuple[np.ndarray, np.ndarray, Subject]:
    """-> root (H, 3) and local rotations (H, J, 3, 3) of bodies that stand where the markers (M, 3) are, facing all ways; and
    whose they are."""
    turns = Rotation.from_euler("y", np.linspace(0, 2 * np.pi, HEADINGS, endpoint=False)[:, None]).as_matrix()
    local = np.concatenate([np.tile(raised(prior.rotations, share, body), (HEADINGS, 1, 1, 1)) for share in ARMS])
    local[:, 0] = np.tile(turns, (len(ARMS), 1, 1))
    nominal = wearing(known, body, 1.0)
    tall = np.ptp(kinematics.placed(nominal, motion_of(np.zeros((1, 3)), prior.rotations[None].copy()))[1][0, :, 1])
    person = wearing(known, body, height / float(tall))
    placed = kinematics.placed(person, motion_of(np.zeros((len(local), 3)), local))[1]
    root = np.nanmedian(standing, axis=0) - np.median(placed, axis=1)
    root[:, 1] = np.nanmin(standing[:, 1]) - placed[:, :, 1].min(1)
    return root, local, person


def raised(hanging: np.ndarray, share: float, body: Body) -> np.ndarray:
    """-> local rotations (J, 3, 3) with the arms so far between those given and a T-pose."""
    local = hanging.copy()
    for side in ("Left", "Right"):
        for bone in ("Shoulder", "Arm", "ForeArm"):
            j = body.skeleton.index(side + bone)
            local[j] = Rotation.from_rotvec((1 - share) * Rotation.from_matrix(hanging[j]).as_rotvec()).as_matrix()
    return local


def wearing(known: Atlas, body: Body, size: float) -> Subject:
    """-> somebody so many times the average body's size who wears a marker at every place."""
    names = tuple(f"place {a}" for a in range(len(known.joints)))
    spread = np.full(len(names), SPREAD)
    return Subject(scaled(body.skeleton, size), "atlas", names, known.joints, known.places * size, spread)


def motion_of(root: np.ndarray, local: np.ndarray) -> Motion:
    """-> poses as a motion of which nothing else is known."""
    nothing = np.zeros(len(root), int)
    return Motion(root, local, nothing, nothing, np.zeros(0), np.zeros(0))
