"""Initialisation: a first pose for every frame, each on its own, so that a lost frame cannot spoil the next."""

from mocapfix.initialise.closed_form import hybrik
from mocapfix.kernels.registration import poses
from mocapfix.motion import Motion
from mocapfix.prior import Prior
from mocapfix.skeleton import Body
from mocapfix.subject import Subject
from mocapfix.take import Take

__all__ = ["hybrik", "motion"]


def motion(worn: Take, subject: Subject, body: Body, prior: Prior) -> Motion:
    """-> every frame's pose in closed form, by registering the subject's segments to the markers seen.

    worn  the take's markers in the subject's order, NaN where not seen or not believed
    """
    return poses(subject, body.free, prior, worn.markers)
