"""Where a foot shall be while it stands, as a smooth displacement from where the motion has it.

`soft` removes the fast part of a standing foot's motion: skin and cameras, but not the slow rolling of the foot. `lock` holds the
foot at one place in the horizontal plane. Both keep its own height, except where no marker shows the foot. Between contacts the
displacement returns to 0, with the least acceleration.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d

from mocapfix.contacts.contacts import BodyContacts
from mocapfix.contacts.standing import compute_speed
from mocapfix.stats.sequences import find_runs
from mocapfix.stats.smooth_paths import smooth_path

SOFT_SMOOTHING_S = 0.1
"""Standard deviation of the kernel that smooths a standing foot."""
LOCK_EXTENSION_SPEED_M_S = 0.2
"""Speed up to which a lock extends beyond the contact: the foot is rolling on or off, in contact with the floor."""
MAX_LOCK_EXTENSION_S = 0.1
RETURN_TIME_S = 0.05
"""Time constant with which a displacement begins before a contact and ends after it."""
CONTACT_WEIGHT = 300.0
"""Weight of the displacement within contacts relative to that of no displacement between them."""
UP = 1


def compute_foot_displacements(
    position: Float[np.ndarray, "T C 3"], contacts: BodyContacts, *, is_locked: bool
) -> Float[np.ndarray, "T C 3"]:
    """Return the displacement in metres of each joint in contact, in every frame.

    position   (T, C, 3) m: the joints of `contacts`
    is_locked  hold each contact at one place; otherwise remove its fast motion
    """
    displacement = np.zeros(position.shape)
    for c in range(position.shape[1]):
        is_contact, is_known, path = contacts.is_contact[:, c], contacts.is_known[:, c], position[:, c]
        if is_locked:
            is_contact = extend_contacts(is_contact, compute_speed(path, contacts.rate), contacts.rate)
        if is_contact.any():
            target = compute_target(path, is_contact, is_known, contacts.rate, is_locked=is_locked)
            displacement[:, c] = smooth_displacement(target - path, is_contact, contacts.rate)
    return displacement


def extend_contacts(is_contact: Bool[np.ndarray, " T"], speed: Float[np.ndarray, " T"], rate: float) -> Bool[np.ndarray, " T"]:
    """Return the contacts, with the slow frames beside them; contacts stay apart from one another."""
    extended, reach = is_contact.copy(), round(MAX_LOCK_EXTENSION_S * rate)
    for first, last in find_runs(is_contact):
        for step, edge, stop in ((-1, first, max(0, first - reach)), (1, last, min(len(speed) - 1, last + reach))):
            t = edge
            while t != stop and speed[t + step] < LOCK_EXTENSION_SPEED_M_S and not extended[t + step]:
                t += step
                extended[t] = True
    return extended


def compute_target(
    path: Float[np.ndarray, "T 3"],
    is_contact: Bool[np.ndarray, " T"],
    is_known: Bool[np.ndarray, " T"],
    rate: float,
    *,
    is_locked: bool,
) -> Float[np.ndarray, "T 3"]:
    """Return where a joint shall be: its own path outside contacts. Unknown frames of a contact follow its known ones."""
    target = path.copy()
    frames = np.arange(len(path))
    for first, last in find_runs(is_contact):
        span = slice(first, last + 1)
        known = frames[span][is_known[span]]
        if not len(known):
            continue
        shown = np.stack([np.interp(frames[span], known, path[known, axis]) for axis in range(3)], axis=1)
        height = shown[:, UP].copy()
        if is_locked:
            shown[:] = path[known].mean(0)
        else:
            shown = gaussian_filter1d(shown, SOFT_SMOOTHING_S * rate, axis=0, mode="nearest")
        shown[:, UP] = height
        target[span] = shown
    return target


def smooth_displacement(
    displacement: Float[np.ndarray, "T 3"], is_contact: Bool[np.ndarray, " T"], rate: float
) -> Float[np.ndarray, "T 3"]:
    """Return the smoothest displacement that is near the given one in contacts and near 0 between them.

    It minimises the integral of CONTACT_WEIGHT |x - d|^2 over contacts, of |x|^2 between them, and of RETURN_TIME_S^4 |x''|^2.
    """
    variance = np.where(is_contact, rate / CONTACT_WEIGHT, rate)
    power = np.full(len(displacement), RETURN_TIME_S**-4)
    return smooth_path(np.where(is_contact[:, None], displacement, 0.0), variance, power, rate)
