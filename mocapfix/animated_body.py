"""Whose joints an animation's are: people's, where their names say so, so that what is known of people can be asked of them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mocapfix import hierarchies, joint_points
from mocapfix.animation import Animation
from mocapfix.errors import SceneError
from mocapfix.fitted import Fitted, fitted
from mocapfix.hierarchies import ancestor
from mocapfix.motion import PLACED, Motion
from mocapfix.retarget import to_cmu31
from mocapfix.solve.mapped import MappedPeople
from mocapfix.solved import How
from mocapfix.subject import Subject
from mocapfix.take import Take


@dataclass(frozen=True)
class Body:
    """The 31 joints in an animation: its tree parents (J,), and how they lie in it."""

    parents: np.ndarray
    fit: Fitted

    def people(self, how: How) -> MappedPeople | None:
        """-> whom to ask of lost joints; None where nobody is to be asked."""
        return MappedPeople(how.model, how.options.prior_scale, self.parents, self.fit) if how.model else None

    def moved(self, places: Take) -> tuple[Subject | None, Motion | None]:
        """-> the body and its motion, of the places of an animation's joints; None where some number of it is not there."""
        root, local = to_cmu31(joint_points.moved(places), self.fit)
        if not (np.isfinite(root).all() and np.isfinite(local).all()):
            return None, None
        known, ours = self.fit.joints >= 0, self.fit.skeleton
        told = [joint if known[joint] else ancestor(joint, ours.parents, known) for joint in range(len(known))]
        none, unsure = np.zeros(places.frames, int), np.zeros(places.seen.shape)
        if places.deviation is not None:
            unsure = np.nan_to_num(places.deviation)
        motion = Motion(root, local, none + PLACED, none, np.zeros((places.frames, 0)), unsure[:, self.fit.joints[told]])
        return Subject(ours, "", (), np.zeros(0, int), np.zeros((0, 3)), np.zeros(0)), motion


def of(animation: Animation, hierarchy: str | Path | None = None) -> tuple[Body | None, str]:
    """-> the body of an animation, None where it is nobody's, and a sentence that says why.

    hierarchy  a style of joints' names or its YAML file; None: the one that finds most of the 31
    Raises SceneError where there is no such style, or where the given one finds no body.
    """
    choice = hierarchies.mapped(animation.names, animation.parents, hierarchy)
    if choice.mapped is None:
        if hierarchy is not None:
            raise SceneError(f"{hierarchy}: does not fit {animation.name}. {choice.reason}")
        return None, choice.reason
    fit = fitted(animation, choice.mapped)
    if fit is None:
        return None, "The figure stands neither in its rest pose nor ever, so that its joints cannot be compared with people's."
    return Body(animation.parents, fit), choice.reason
