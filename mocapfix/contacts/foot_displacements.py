"""Where a foot shall be while it stands, as a smooth displacement from where the motion has it.

`soft` removes the fast part of a standing foot's motion: skin and cameras, but not the slow rolling of the foot. `lock` holds the
foot at one place in the horizontal plane. Both keep its own height, except where no marker shows the foot. A foot that markers
show in no frame of a contact stands at one place in both (`compute_hidden_displacement`). Between contacts the displacement
returns to 0, with the least acceleration (`smooth_displacement`). A foot is rigid: `restore_foot_length` keeps the distance from
ankle to toes.

The feet of an animation that slide because its path was stretched are held at the middle of their slide, as far as its steps
allow: `compute_step_displacements`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.contacts.contacts import CONTACT_JOINTS, FOOT_JOINTS, BodyContacts
from mocapfix.contacts.find_contacts import ROLLING_SPEED_M_S, compute_speed
from mocapfix.stats.sequences import find_runs, slide_windows, smooth_path, smooth_values

HORIZONTAL_AXES = [0, 2]
UP_AXIS = 1
MIN_HELD_SHARE = 1e-3  # share that a joint which is not held counts beside one that is
MIN_DISTANCE_M = 1e-3  # distance from ankle to toes below which the direction from one to the other is not known
STEEP_FOOT_SINES = (0.5, 0.85)
"""Sine of a foot's slope up to which ankle and toes move horizontally alone, and from which they move along the foot: on the toes
a small change of its length would take a large horizontal movement of the ankle."""


def restore_foot_length(
    ankle: Float[np.ndarray, "T 3"],
    toe: Float[np.ndarray, "T 3"],
    held_share: tuple[Float[np.ndarray, " T"], Float[np.ndarray, " T"]],
    length_m: Float[np.ndarray, " T"],
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]:
    """Return ankle and toes, in metres with Y up, moved towards or from each other until they are one foot's length apart.

    They move in the horizontal plane only, so that none of them sinks into the floor; those of a steep foot along the foot.

    Args:
        held_share: Of the ankle and of the toes: 1 where they are held, 0 where not; the one that is held moves less.
    """
    ankle_share, toe_share = (np.maximum(share, MIN_HELD_SHARE)[:, None] for share in held_share)
    between = toe - ankle
    distance = np.maximum(np.linalg.norm(between, axis=1), MIN_DISTANCE_M)
    flat_distance = np.maximum(np.linalg.norm(between[:, HORIZONTAL_AXES], axis=1), MIN_DISTANCE_M)
    flat_length = np.sqrt(np.maximum(length_m**2 - between[:, UP_AXIS] ** 2, MIN_DISTANCE_M**2))
    steepness = np.clip((np.abs(between[:, UP_AXIS]) / distance - STEEP_FOOT_SINES[0]) / np.ptp(STEEP_FOOT_SINES), 0, 1)
    along_share = steepness**2 * (3 - 2 * steepness)
    flat_correction = (1 - flat_length / flat_distance)[:, None] * between
    flat_correction[:, UP_AXIS] = 0.0
    along_correction = (1 - length_m / distance)[:, None] * between
    correction = flat_correction + along_share[:, None] * (along_correction - flat_correction)
    ankle_part = toe_share / (ankle_share + toe_share)
    return ankle + ankle_part * correction, toe - (1 - ankle_part) * correction


SOFT_SMOOTHING_S = 0.3  # standard deviation of the kernel that smooths a standing foot
MAX_LOCK_EXTENSION_S = 0.2  # time for which a lock extends beyond the contact, while the foot rolls on or off
MAX_LOCK_DISPLACEMENT_M = 0.035  # distance from its mean place up to which a joint is held there; a standing foot rolls by 20 mm
RETURN_TIME_S = 0.06  # time constant with which a displacement begins before a contact and ends after it
CONTACT_WEIGHT = 1000.0  # weight of the displacement within contacts relative to that of no displacement between them
MAX_DISPLACEMENT_ACCELERATION_M_S2 = 4.0  # with more it is made smoother there; a joint of a calm motion has 10 to 40 m/s^2
ACCELERATION_ROUNDS = 4  # solutions with more stiffness where the one before exceeded that acceleration
ACCELERATION_REACH_S = 0.03  # time on both sides of such a frame in which stiffness is added


class Lock(NamedTuple):
    """How a joint is held at one place."""

    largest_m: float = MAX_LOCK_DISPLACEMENT_M  # the largest distance by which it is moved towards its place
    contact_weight: float = CONTACT_WEIGHT
    acceleration_m_s2: float = MAX_DISPLACEMENT_ACCELERATION_M_S2  # from which the displacement is made smoother


TAKE_LOCK = Lock()


def compute_foot_displacements(
    position: Float[np.ndarray, "T C 3"],
    contacts: BodyContacts,
    *,
    is_locked: bool,
    lock: Lock = TAKE_LOCK,
    position_sd: Float[np.ndarray, "T C"] | None = None,
) -> Float[np.ndarray, "T C 3"]:
    """Return the displacement in metres of each joint of the feet, in every frame.

    Args:
        position: Metres: the joints of `contacts`, which are CONTACT_JOINTS.
        is_locked: Hold each contact at one place; otherwise remove its fast motion.
        lock: How it is held there.
        position_sd: Standard deviations of the positions in metres; without them all are as certain.
    """
    position_sd = np.zeros(position.shape[:2]) if position_sd is None else position_sd
    is_held = contacts.is_contact.copy()
    for c, (path, is_known) in enumerate(zip(position.swapaxes(0, 1), contacts.is_known.T, strict=True)):
        if is_locked:
            extended, shown = (extend_contacts(each, path, contacts.rate) for each in (is_held[:, c], is_held[:, c] & is_known))
            is_held[:, c] = np.where(is_known, shown, extended)  # what is seen is not held for what is inferred
        is_held[:, c] &= ~find_hidden_steps(path, is_held[:, c], is_known, position_sd[:, c], contacts.rate)
    share, moved = np.zeros(is_held.shape), np.zeros(position.shape)
    for c in np.flatnonzero(is_held.any(0)):
        is_known = contacts.is_known[:, c]
        held = compute_target(position[:, c], is_held[:, c], is_known, contacts.rate, lock.largest_m if is_locked else None)
        wanted = np.column_stack([held - position[:, c], np.ones(len(position))])
        smooth = smooth_displacement(wanted, is_held[:, c], is_known | ~is_held[:, c], contacts.rate, lock)
        hidden = compute_hidden_displacement(position[:, c], is_held[:, c], is_known, position_sd[:, c], contacts.rate, lock)
        moved[:, c], share[:, c] = smooth[:, :3] + hidden, np.clip(smooth[:, 3], 0, 1)
    target = position.copy()
    for ankle, toe in ([CONTACT_JOINTS.index(joint) for joint in joints] for joints in FOOT_JOINTS.values()):
        length_m = np.linalg.norm(position[:, toe] - position[:, ankle], axis=1)
        shares = share[:, ankle], share[:, toe]
        target[:, ankle] += moved[:, ankle] + (1 - share[:, [ankle]]) * moved[:, toe]  # what is not held moves with the other
        target[:, toe] += moved[:, toe] + (1 - share[:, [toe]]) * moved[:, ankle]
        target[:, ankle], target[:, toe] = restore_foot_length(target[:, ankle], target[:, toe], shares, length_m)
    return target - position


def extend_contacts(is_contact: Bool[np.ndarray, " T"], path: Float[np.ndarray, "T 3"], rate: float) -> Bool[np.ndarray, " T"]:
    """Return the contacts with the slow frames beside them; contacts between which the joint stays slow become one."""
    extended, reach, speed = is_contact.copy(), round(MAX_LOCK_EXTENSION_S * rate), compute_speed(path, rate)
    for first, last in find_runs(is_contact):
        for step, edge, stop in ((-1, first, max(0, first - reach)), (1, last, min(len(speed) - 1, last + reach))):
            t = edge
            while t != stop and speed[t + step] < ROLLING_SPEED_M_S:
                t += step
                extended[t] = True
    return extended


def compute_target(
    path: Float[np.ndarray, "T 3"],
    is_contact: Bool[np.ndarray, " T"],
    is_known: Bool[np.ndarray, " T"],
    rate: float,
    locked_m: float | None,
) -> Float[np.ndarray, "T 3"]:
    """Return where a joint shall be: its own path outside contacts. Unknown frames of a contact follow its known ones.

    It is moved to its mean place by `locked_m` at most, or smoothed if that is None.
    """
    target = path.copy()
    frames = np.arange(len(path))
    for first, last in find_runs(is_contact):
        span = slice(first, last + 1)
        known = frames[span][is_known[span]]
        if not len(known):
            continue
        shown = np.stack([np.interp(frames[span], known, path[known, axis]) for axis in range(3)], axis=1)
        height = shown[:, UP_AXIS].copy()
        if locked_m is not None:
            from_mean = shown - path[known].mean(0)
            from_mean[:, UP_AXIS] = 0.0
            shown -= limit_length(from_mean, locked_m)
        else:
            shown = smooth_values(shown, SOFT_SMOOTHING_S * rate)
        shown[:, UP_AXIS] = height
        target[span] = shown
    return target


STEP_ACCELERATION_M_S2 = 10.0  # with which a foot comes to or leaves the place where it stands
HIDDEN_RETURN_SD_M = 0.03  # standard deviation of a joint at which the displacement of a hidden foot takes RETURN_TIME_S
MIN_SD_M = 0.001  # smallest one that counts
MAX_LEG_SD_M = 0.4  # largest one: of a foot anywhere within reach of known hips; with more the body is lost, and no leg holds it


def compute_hidden_displacement(
    path: Float[np.ndarray, "T 3"],
    is_contact: Bool[np.ndarray, " T"],
    is_known: Bool[np.ndarray, " T"],
    position_sd: Float[np.ndarray, " T"],
    rate: float,
    lock: Lock,
) -> Float[np.ndarray, "T 3"]:
    """Return the displacement of a joint, in metres, for its contacts that markers show in no frame.

    It stands at the place of `find_hidden_place`. Where the path is certain it is not displaced.
    """
    wanted, sd = np.zeros(path.shape), np.clip(position_sd, MIN_SD_M, MAX_LEG_SD_M)
    is_held = is_contact & (position_sd <= MAX_LEG_SD_M)
    for first, last in find_runs(is_contact):
        if not is_known[first : last + 1].any():
            held = first + np.flatnonzero(is_held[first : last + 1])
            wanted[held] = find_hidden_place(path, first, last, sd, rate) - path[held]
    if not wanted.any():
        return wanted
    return smooth_displacement(wanted, is_held, np.zeros(len(path), bool), rate, lock, (sd / HIDDEN_RETURN_SD_M) ** 4)


def find_hidden_place(
    path: Float[np.ndarray, "T 3"], first: int, last: int, sd: Float[np.ndarray, " T"], rate: float
) -> Float[np.ndarray, "3"]:
    """Return where a joint stands in a contact that markers show in no frame, in metres.

    It is the mean of its path, in which a frame counts by its certainty; those beside the contact count the less, the farther a
    foot may have moved.
    """
    frames = np.arange(len(path))
    beside_s = np.maximum(np.maximum(first - frames, frames - last), 0) / rate
    variance = sd**2 + (STEP_ACCELERATION_M_S2 / 2 * beside_s**2) ** 2
    return np.average(path, axis=0, weights=1 / variance)


MAX_HIDDEN_DEVIATION_M = 0.4  # of a hidden joint from where it stands, above which it steps; with 0.3 training people drift more
STEP_SPEED_SHARE = 0.5  # share of the largest speed of a step down to which it lasts


def find_hidden_steps(
    path: Float[np.ndarray, "T 3"],
    is_held: Bool[np.ndarray, " T"],
    is_known: Bool[np.ndarray, " T"],
    position_sd: Float[np.ndarray, " T"],
    rate: float,
) -> Bool[np.ndarray, " T"]:
    """Return the hidden frames of contacts in which a joint steps from one place to another.

    A contact in which its path is more than MAX_HIDDEN_DEVIATION_M from where it stands is divided where the path is fastest.
    """
    is_step, speed, sd = np.zeros(len(path), bool), compute_speed(path, rate), np.clip(position_sd, MIN_SD_M, MAX_LEG_SD_M)
    runs = find_runs(is_held)
    while runs:
        first, last = runs.pop()
        frames, is_hidden = np.arange(first, last + 1), ~is_known[first : last + 1]
        if not is_hidden.any():
            continue
        if is_hidden.all():
            place = find_hidden_place(path, first, last, sd, rate)
        else:
            place = np.stack([np.interp(frames, frames[~is_hidden], axis) for axis in path[frames[~is_hidden]].T], axis=1)
        if (np.linalg.norm(path[frames] - place, axis=1)[is_hidden] > MAX_HIDDEN_DEVIATION_M).any():
            step = int(np.where(is_hidden, speed[frames], -1.0).argmax())
            fast = find_runs(is_hidden & (speed[frames] >= STEP_SPEED_SHARE * speed[first + step]))
            begin, end = next((first + run[0], first + run[1]) for run in fast if run[0] <= step <= run[1])
            is_step[begin : end + 1] = True
            runs += [run for run in ((first, begin - 1), (end + 1, last)) if run[0] <= run[1]]
    return is_step


def limit_length(vectors: Float[np.ndarray, "T 3"], max_length: float) -> Float[np.ndarray, "T 3"]:
    """Return vectors, those that are longer than the largest length shortened to it."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors * np.minimum(1, max_length / np.maximum(length, max_length))


def smooth_displacement(
    displacement: Float[np.ndarray, "T D"],
    is_contact: Bool[np.ndarray, " T"],
    is_limited: Bool[np.ndarray, " T"],
    rate: float,
    lock: Lock = TAKE_LOCK,
    between_variance: Float[np.ndarray, " T"] | float = 1.0,
) -> Float[np.ndarray, "T D"]:
    """Return the smoothest displacement that is near the given one in contacts and near 0 between them.

    It minimises the integral of contact_weight |x - d|^2 over contacts, of |x|^2 between them, over a given variance, and of
    RETURN_TIME_S^4 |x''|^2.
    The last weight is larger where x would accelerate too much, as between two contacts at different places that almost touch.

    Args:
        displacement: The first three columns are the displacement in metres.
        is_limited: Where the acceleration is limited; not where the given displacement removes an error of a hidden foot.
    """
    variance = np.where(is_contact, rate / lock.contact_weight, rate * between_variance)
    power = np.full(len(displacement), RETURN_TIME_S**-4)
    wanted = np.where(is_contact[:, None], displacement, 0.0)
    smooth = smooth_path(wanted, variance, power, rate)
    reach = 2 * round(ACCELERATION_REACH_S * rate) + 1
    is_free = slide_windows(~is_limited, reach).any(1)
    for _ in range(ACCELERATION_ROUNDS if len(smooth) > 2 else 0):
        acceleration = np.linalg.norm(np.diff(smooth[:, :3], 2, axis=0), axis=1) * rate**2
        if acceleration.max() <= lock.acceleration_m_s2:
            break
        excess = np.pad(np.maximum(1, acceleration / lock.acceleration_m_s2), 1, mode="edge")
        near = slide_windows(np.where(is_free, 1, excess), reach).max(1)
        power /= near**2
        smooth = smooth_path(wanted, variance, power, rate)
    return smooth


MAX_STEP_STRETCH = 0.5  # change of a step relative to the path of its foot, above which the foot has not left its place


def compute_step_displacements(
    position: Float[np.ndarray, "T C 3"], contacts: BodyContacts, slide: Float[np.ndarray, "T 3"]
) -> Float[np.ndarray, "T C 3"]:
    """Return the displacement in metres of each joint of the feet by which a foot that stands does not slide.

    A foot stands where it is in the middle of its slide. In a swing it goes from one place to the next as its own path does, so
    that a step is stretched or shortened and no movement added.

    Args:
        position: Metres, without the slide: CONTACT_JOINTS.
        slide: Metres: the path of the slide, which all joints follow in the animation.
    """
    displacement = np.zeros(position.shape)
    for side, joints in FOOT_JOINTS.items():
        columns = [CONTACT_JOINTS.index(joint) for joint in joints]
        is_standing = contacts.find_foot_contact(side)
        if not is_standing.any():
            continue
        step_m = np.min([compute_speed(position[:, c], contacts.rate) for c in columns], axis=0) / contacts.rate
        while True:
            runs, path_m = find_runs(is_standing), np.cumsum(np.where(is_standing, 0.0, step_m))
            at_m = np.r_[0.0, [path_m[first] for first, _ in runs], path_m[-1]]
            places = np.vstack([slide[0], *(slide[first : last + 1].mean(0) for first, last in runs), slide[-1]])
            stretch = np.diff(places, axis=0) / np.maximum(np.diff(at_m), MIN_DISTANCE_M)[:, None]
            largest = int(np.linalg.norm(stretch[1:-1], axis=1).argmax()) if len(runs) > 1 else 0
            if len(runs) == 1 or np.linalg.norm(stretch[1 + largest]) <= MAX_STEP_STRETCH:
                break
            is_standing[runs[largest][1] : runs[largest + 1][0]] = True  # the foot does not go from one place to the other
        for end, beside in ((0, 1), (-1, -2)):  # beyond the first and the last place, a step is stretched like the one beside it
            largest_stretch = max(float(np.linalg.norm(stretch[beside])), 1e-9) if len(runs) > 1 else MAX_STEP_STRETCH
            towards = limit_length(stretch[[end]], largest_stretch)[0] * np.diff(at_m)[end]
            places[end] = places[beside] - towards if end == 0 else places[beside] + towards
        kept = np.stack([np.interp(path_m, at_m, axis_m) for axis_m in places.T], axis=1)
        displacement[:, columns] = (kept - slide)[:, None]
    return displacement
