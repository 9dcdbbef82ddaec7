"""A first guess at markers whose labels tell nothing: a body laid on the cloud they make.

In a frame in which the cloud is tall somebody stands. The average body is put there facing all ways, its arms raised, half
raised and hanging, with the markers of each set that ships; every marker takes the place for markers that it lies nearest to, no
two the same one, and the body is solved to these, in turns (iterative closest points; Besl & McKay 1992). The likeliest bodies
are tried on more frames, in all of which a marker must keep its place: on a body that faces backwards or has an arm for a leg
it does not.
"""

import numpy as np
from scipy.optimize import linear_sum_assignment

from mocapfix.calibrate import attach, average, frames, refine
from mocapfix.calibrate.attach import Atlas
from mocapfix.calibrate.standing import SPREAD, bodies, motion_of, wearing
from mocapfix.errors import TakeError
from mocapfix.kernels import kinematics
from mocapfix.kernels.pose import Tree
from mocapfix.kernels.problem import Attached, Problem, no_pull, pull_to, within
from mocapfix.marker_set import MarkerSet, shipped
from mocapfix.prior import JointLimits, Prior
from mocapfix.skeleton import Body
from mocapfix.take import Take

FEWEST = 20  # markers: on fewer a body can lie in any way
TALL = (0.5, 0.8, 1.0)  # of the frames are less tall than those that a body is laid on: arms raised are taller than anybody
ROUNDS = 20  # of nearest places
GATES = (0.4, 0.15)  # metres, the first round's and the last's: a marker farther from every place has none
MARKER_SD, LIMITS_SD = 0.04, 0.1  # metres, radians: of a stranger's markers about the average body's, of joints beyond limits
HOPEFUL = 9  # bodies that are tried on more frames
TRIED = 60  # frames they are tried on
FOLLOWED = 6  # rounds of that
NEVER = 0.95  # of the last gate: a marker that is on average as far from every place has none


def guessed(take: Take, labels: tuple[str, ...], body: Body, prior: Prior, limits: JointLimits) -> MarkerSet:
    """-> a set that has each of the take's markers where the body has a place for it, under `labels`.

    Raises TakeError where there are too few markers to lay a body on.
    """
    looked = frames.candidates(take.markers)
    some = take.markers[looked[np.unique(np.linspace(0, len(looked) - 1, TRIED).astype(int))]]
    if (~np.isnan(some[..., 0])).sum(1).max(initial=0) < FEWEST:
        raise TakeError(f"{take.name}: shows fewer than {FEWEST} markers at once; name a known set that it is like (--like).")
    height = np.ptp(np.where(np.isnan(some[..., 1]), np.nanmean(some[..., 1], axis=1, keepdims=True), some[..., 1]), axis=1)
    standing = np.argsort(height)[[round(share * (len(height) - 1)) for share in TALL]]
    hopes = []
    for known in map(attach.atlas, zip(shipped())):
        for frame in standing:
            assigned, misfit = laid(some[frame], float(height[frame]), known, body, prior, limits)
            hopes += [(float(misfit[h]), assigned[h], known) for h in range(len(misfit))]
    hopes.sort(key=lambda hope: hope[0])
    tried = [(known, *followed(assigned, some, known, body, prior)) for _, assigned, known in hopes[:HOPEFUL]]
    known, best, _ = min(tried, key=lambda each: each[2])
    return guess_of(best, labels, known)


def laid(
    standing: np.ndarray, height: float, known: Atlas, body: Body, prior: Prior, limits: JointLimits
) -> tuple[np.ndarray, np.ndarray]:
    """-> for H bodies the place (H, M) in the atlas that each of a frame's markers (M, 3) has, -1 for none, and the mean misfit
    (H,) in metres.

    height  metres, of the markers
    """
    root, local, person = bodies(standing, height, known, body, prior)
    tree = Tree(body.skeleton.parents, person.skeleton.offsets, body.free)
    pull, walls = pull_to(prior), within(limits, LIMITS_SD)
    assigned, misfit = np.full((len(root), len(standing)), -1), np.full(len(root), np.inf)
    for gate in np.geomspace(*GATES, ROUNDS):
        placed = kinematics.placed(person, motion_of(root, local))[1]
        target = np.full(placed.shape, np.nan)
        for h, there in enumerate(placed):
            assigned[h], misfit[h] = nearest(np.linalg.norm(standing[:, None] - there, axis=-1), float(gate))
            has = assigned[h] >= 0
            target[h, assigned[h, has]] = standing[has]
        attached = Attached(person.joints, person.places)
        problem = Problem(tree, attached, target, ~np.isnan(target[..., 0]), MARKER_SD, pull, walls)
        problem.solve(root, local, no_pull(local.shape[1]), (float(gate),), 5)
    return assigned, misfit


def nearest(distance: np.ndarray, gate: float) -> tuple[np.ndarray, float]:
    """-> the place (M,) that each marker has by its distances from A places (M, A), in metres, no two the same one, -1 for none
    nearer than `gate` or left; and the mean distance of those that are seen, without a place as at the gate."""
    assigned, seen = np.full(len(distance), -1), np.flatnonzero(~np.isnan(distance[:, 0]))
    capped = np.minimum(distance[seen], gate)
    rows, columns = linear_sum_assignment(capped)
    near = capped[rows, columns] < NEVER * gate
    assigned[seen[rows[near]]] = columns[near]
    return assigned, float((capped[rows, columns].sum() + gate * (len(seen) - len(rows))) / max(len(seen), 1))


def followed(
    assigned: np.ndarray, markers: np.ndarray, known: Atlas, body: Body, prior: Prior
) -> tuple[np.ndarray, float]:
    """-> places (M,) in the atlas that the markers keep in all frames (N, M, 3), from those they have in one; and the mean misfit
    in metres."""
    misfit, gate = np.inf, GATES[1]
    for _ in range(FOLLOWED):
        guess = guess_of(assigned, tuple(map(str, range(len(assigned)))), known)
        worn = Take(markers[:, [int(label) for label in guess.labels]], guess.labels, 1.0)
        person = average(worn, guess, body)
        motion = refine.posed(person, body, prior, worn.markers)
        grown = wearing(known, body, person.skeleton.size / body.skeleton.size)
        placed = kinematics.placed(grown, motion)[1]
        distance = np.full((len(assigned), placed.shape[1]), np.nan)
        for m in np.flatnonzero(~np.isnan(markers[..., 0]).all(0)):
            apart = np.linalg.norm(markers[:, m, None] - placed, axis=-1)
            distance[m] = np.nanmean(np.minimum(apart, gate), axis=0)
        assigned, misfit = nearest(distance, gate)
    return assigned, misfit


def guess_of(assigned: np.ndarray, labels: tuple[str, ...], known: Atlas) -> MarkerSet:
    """-> the markers that have a place (M,) in the atlas, as a set."""
    on = np.flatnonzero(assigned >= 0)
    which, spread = assigned[on], np.full(len(on), SPREAD)
    names = tuple(labels[m] for m in on)
    return MarkerSet("guess", "guess", "cmu31", names, known.joints[which], known.places[which], spread, ((),) * len(on))
