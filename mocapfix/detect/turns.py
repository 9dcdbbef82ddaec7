"""What is wrong with the turns of an animation's joints and with the place of its root.

N courses: the turns of J joints, in their parents' axes, and last the root's place. What is lost comes first, for what a file
says instead would look like every other fault; then pops and flips; then what trembles, apart from those.
"""

from collections.abc import Sequence

import numpy as np

from mocapfix.detect import lost, shifts, trembling
from mocapfix.faults import Fault, Kind
from mocapfix.kernels import offsets, quaternions

TURN = np.radians(0.5), np.radians(8.0)  # third difference that any joint may have, and the smallest pop
PLACE = 0.005, 0.04  # metres: likewise of the root
FLIP = np.radians(120.0)  # a larger pop is a flip


def found(names: Sequence[str], root: np.ndarray, local: np.ndarray, orders: Sequence[str], rate: float) -> list[Fault]:
    """-> faults by first frame; their markers are indices of joints or, for the root's place, their number J. A fault's severity
    is in radians, of the place in metres, NaN for what is lost.

    root (T, 3) metres and local (T, J, 3, 3), NaN where there is no number; orders: each joint's axes of rotation, as "ZYX"
    """
    if len(root) < 2:
        return []  # one pose does not move
    labels = (*names, f"{names[0]}'s place")
    absent = np.column_stack([np.isnan(local).any((2, 3)), np.isnan(root).any(1)])
    gone, faults = np.zeros(absent.shape, bool), []
    for each in lost.found(*travelled(root, local), absent, rate):
        gone[each.first : each.last + 1, list(each.courses)] = True
        faults.append(_of_lost(each, labels, rate))
    for j in range(local.shape[1]):
        turns = quaternions.of_joint(np.where(gone[:, j, None, None], np.eye(3), local[:, j])[:, None], 0, ~gone[:, j])
        if np.ptp(turns, axis=0).max() > 1e-4:  # it moves at all
            faults += _of_joint(j, labels[j], turns, ~gone[:, j], orders[j], rate)
    place = np.where(gone[:, -1:], 0.0, root)
    for each in shifts.found(place, offsets.of_places(place), ~gone[:, -1], rate, *PLACE):
        reason = f"{labels[-1]} is off by {each.amount * 1e3:.0f} mm {_lasting(each.first, each.last, rate)}, and then back."
        faults.append(Fault("spike", len(names), each.first, each.last, each.amount, reason, _sure(each)))
    return sorted(faults, key=lambda fault: (fault.first, fault.marker))


def travelled(root: np.ndarray, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> (T - 1, N) how far each course goes from frame to frame, and (T, N) how far it is from rest: radians; of the root's
    place, a radian for a metre."""
    step = np.linalg.norm(np.diff(local, axis=0), axis=(2, 3)) / np.sqrt(2)  # of a small turn that is its angle
    rest = np.linalg.norm(local - np.eye(3), axis=(2, 3)) / np.sqrt(2)
    steps = np.column_stack([step, np.linalg.norm(np.diff(root, axis=0), axis=1)])
    return steps, np.column_stack([rest, np.linalg.norm(root, axis=1)])


def _of_lost(each: lost.Lost, labels: Sequence[str], rate: float) -> Fault:
    what = "The whole figure" if len(each.courses) == len(labels) else ", ".join(labels[n] for n in each.courses[:4])
    what += f" and {len(each.courses) - 4} more" if 4 < len(each.courses) < len(labels) else ""
    reason = f"{what}: {each.how} {_lasting(each.first, each.last, rate)}."
    kind: Kind = "stuck" if each.how == lost.HELD else "gap"
    return Fault(kind, each.courses[0], each.first, each.last, np.nan, reason, 1.0, each.courses[1:])


def _of_joint(joint: int, label: str, turns: np.ndarray, usable: np.ndarray, order: str, rate: float) -> list[Fault]:
    """-> the pops, flips and trembles of one joint's quaternions (T, 4)."""
    faults, steady = [], usable.copy()
    course = 2 * turns
    for each in shifts.found(course, offsets.of_turns(turns, order), usable, rate, *TURN):
        kind: Kind = "flip" if each.amount > FLIP else "pop"
        what = "turned over" if kind == "flip" else "off"
        reason = f"{label} is {what} by {np.degrees(each.amount):.0f} degrees {_lasting(each.first, each.last, rate)}."
        faults.append(Fault(kind, joint, each.first, each.last, each.amount, reason, _sure(each)))
        steady[[each.first - 1, each.first, each.last, each.last + 1]] = False
    for each in trembling.found(course, steady, rate):
        size = f"{np.degrees(each.size):.1f} degrees"
        reason = f"{label} trembles by {size} about each axis {_lasting(each.first, each.last, rate)}."
        faults.append(Fault("jitter", joint, each.first, each.last, each.size, reason))
    return faults


def _lasting(first: int, last: int, rate: float) -> str:
    return "in one frame" if first == last else f"for {(last - first + 1) / rate:.2f} s"


def _sure(each: shifts.Shift) -> float:
    return round(float(1 - 10 / each.plain), 3)
