"""What a file of bones does not say: how long its unit is, and which way is up. Both are told from the figure, and said."""

import re
from dataclasses import replace

import numpy as np

from mocapfix.animation import Animation
from mocapfix.read.axes import TO_Y_UP

HEAD = re.compile(r"head|skull", re.IGNORECASE)
FOOT = re.compile(r"foot|feet|ankle|toe", re.IGNORECASE)
TALL = (1.2, 2.2)  # metres: people
REACH = 1.42  # of a person's height: the way along the bones from the tips of the fingers to those of the toes
UNITS = {"centimetres": 0.01, "metres": 1.0, "millimetres": 0.001, "CMU's units of 1/0.45 inch": 0.0254 / 0.45, "inches": 0.0254}
SLOPE = 0.8  # cosine of the angle within which a body that stands is along an axis


def sized(animation: Animation) -> Animation:
    """-> the animation with the unit by which its figure is as tall as people are: its own where that does, else the first
    of UNITS; its own where none does. A note says which unless they are centimetres."""
    reach = reaching(animation)
    fitting = {name: unit for name, unit in UNITS.items() if TALL[0] <= reach * unit / REACH <= TALL[1]}
    if TALL[0] <= reach * animation.unit / REACH <= TALL[1]:
        return animation
    if not fitting:
        tall = f"{reach * animation.unit / REACH:.2g} m tall"
        note = f"Its unit of length is not said; it was taken as {animation.unit * 100:.4g} cm: the figure is {tall}."
        return replace(animation, notes=(*animation.notes, note))
    name, unit = next(iter(fitting.items()))
    note = f"Lengths were taken as {name}, by which the figure is {reach * unit / REACH:.2f} m tall."
    return replace(animation, unit=unit, notes=(*animation.notes, note))


def reaching(animation: Animation) -> float:
    """-> the longest way along the bones from one tip of the figure to another, in the file's units."""
    deep = np.array([np.linalg.norm(ends, axis=1).max(initial=0.0) for ends in animation.ends])
    longest = deep.copy()
    for joint in range(len(deep) - 1, 0, -1):
        parent, way = animation.parents[joint], deep[joint] + np.linalg.norm(animation.offsets[joint])
        longest[parent] = max(longest[parent], longest[joint], deep[parent] + way)
        deep[parent] = max(deep[parent], way)
    return float(longest[0])


def upright(animation: Animation) -> Animation:
    """-> the animation with Y up, as most are, or Z up where its head is above its feet along Z: most of the time, or, where
    it does not stand most of the time, in the rest pose. A note says so."""
    head = [j for j, name in enumerate(animation.names) if HEAD.search(name)][:1]
    feet = [j for j, name in enumerate(animation.names) if FOOT.search(name)]
    if not head or not feet:
        return animation
    few = animation.with_values(animation.values[:: max(1, animation.frames // 200)])
    for positions in (few.world()[0], animation.resting()[None]):
        ways = positions[:, head[0]] - positions[:, feet].mean(1)
        way = ways[np.isfinite(ways).all(1)].sum(0)
        slope = way / max(np.linalg.norm(way), 1e-9)
        if slope[1] > SLOPE:
            return animation
        if slope[2] > SLOPE:
            note = "Its Z axis points up, for there the head is above the feet."
            return replace(animation, axes=TO_Y_UP["Z"], notes=(*animation.notes, note))
    return animation
