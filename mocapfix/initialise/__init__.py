"""Initialisation: a first pose for every frame, each on its own, so that a lost frame cannot spoil the next.

Ways to it, by the names in scenes.STARTS:

hybrik-...    joints from the markers (initialise/joints), and from these each frame's pose in closed form (closed_form)
registration  the subject's segments laid on the markers seen, down the tree (kernels/registration)
previous      none but for the first frame: each other goes on from where the solve of the one before it ended
"""

import numpy as np

from mocapfix.initialise import joints, necks
from mocapfix.initialise.closed_form import Way, hybrik
from mocapfix.initialise.previous import going_on
from mocapfix.kernels.registration import poses
from mocapfix.motion import Motion
from mocapfix.prior import Prior
from mocapfix.scenes import START
from mocapfix.skeleton import Body
from mocapfix.subject import Subject
from mocapfix.take import Take

__all__ = ["hybrik", "motion"]

DOUBTED = 0.25  # of its weight: a marker that counts no more lies 5 cm from where the others lay its segment
HYBRIK: dict[str, Way] = {"hybrik-x": "x", "hybrik-adaptive": "adaptive", "hybrik-naive": "naive"}


def motion(worn: Take, subject: Subject, body: Body, prior: Prior, by: str = START) -> Motion:
    """-> every frame's pose in closed form; NaN where a frame has none of its own and goes on from the one before it.

    worn   the take's markers in the subject's order, NaN where not seen or not believed
    prior  its mean pose is that of joints that the body does not turn
    by     the way to it, one of scenes.STARTS
    """
    if by in HYBRIK:
        placed, held = joints.positions(worn, subject, body), ~body.free
        heard = np.where(placed.trust[..., None] > DOUBTED, worn.markers, np.nan)
        found = hybrik(placed.positions, subject, way=HYBRIK[by], deviation=placed.deviation, markers=heard, held=held)
        found.rotations[:, held] = prior.rotations[held]
        return necks.bent(found, subject, prior)
    registered = poses(subject, body.free, prior, worn.markers)
    return going_on(registered, worn.seen) if by == "previous" else registered
