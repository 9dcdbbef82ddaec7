"""The benchmarks' pictures, as PNG: errors over iterations, hands before and after, and how far bones are twisted."""

import re
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mocapfix.bench.hands import Moment
from mocapfix.files import replacing
from mocapfix.train.mirror import mirrored_name

TURN = np.radians(20)  # from straight ahead, towards the body's left
MARGIN = 0.15  # metres around the joints that are measured
INK, PAPER, BONE, TRUE = "#38414c", "#f6f7f9", "#8fb3dc", "#1b2a3a"
COSTS = {"total": "total", "given": "given joints", "prior": "prior"}
PRIORS = {"none": "#8a94a0", "pca": "#e08a00", "gaussian": "#1f9d57", "mixture": "#7a5bd0", "mnn-ik": "#d93a3a",
          "autoencoder": "#2b6cb0"}  # fmt: skip
SIDES = {"left": ("#2b6cb0", -0.18), "middle": ("#8a94a0", 0.0), "right": ("#e08a00", 0.18)}  # colour, rows further down
WAYS = {"naive": "#d93a3a", "adaptive": "#e08a00", "x": "#2b6cb0"}
MARKER, BAD, MENDED = "#5a6470", "#d93a3a", "#1f9d57"


def hands(target: Path, moment: Moment) -> None:
    """Draw a moment: by its damaged markers alone, as it was cleaned, and as it was captured. Raises WriteError."""
    flat = projection(moment)
    shown = flat(moment.true[[*moment.measured, *moment.skeleton.parents[moment.measured]]])
    (left, low), (right, high) = shown.min(axis=0) - MARGIN, shown.max(axis=0) + MARGIN
    figure = Figure(figsize=(12, 0.5 + 4 * (high - low) / (right - left)), layout="constrained")
    panels = (
        (f"Before: by these markers alone {moment.alone_mm:.0f} mm off", moment.alone, moment.before, moment.sound, BAD),
        (f"After: {moment.cleaned_mm:.0f} mm off", moment.cleaned, moment.after, moment.before, MENDED),
        ("As captured (in the others dashed and hollow)", moment.true, moment.sound, moment.sound, MARKER),
    )
    for on, (title, joints, markers, unlike, colour) in zip(figure.subplots(1, 3), panels, strict=True):
        bones(on, moment, flat(joints), BONE, 12)
        if joints is not moment.true:
            bones(on, moment, flat(moment.true), TRUE, 1.5, linestyle=(0, (3, 2)))
            on.scatter(*flat(moment.sound)[moment.damaged].T, s=130, facecolors="none", edgecolors=TRUE, zorder=4)
        changed = moment.damaged & (markers != unlike).any(axis=1)
        on.scatter(*flat(markers).T, s=90, c=np.where(changed, colour, MARKER), edgecolors="white", zorder=3)
        on.set_title(title, fontsize=11, color=INK, loc="left")
        on.set(aspect="equal", facecolor=PAPER, xticks=[], yticks=[], xlim=(left, right), ylim=(low, high))
        on.spines[:].set_visible(False)
    save(target, figure)


def projection(moment: Moment):
    """-> a function from places (N, 3) to the picture (N, 2), metres: seen from before the body, a little from its left."""
    left = moment.true[moment.skeleton.index("LeftArm")] - moment.true[moment.skeleton.index("RightArm")]
    left = left * [1, 0, 1] / np.linalg.norm(left * [1, 0, 1])
    front = np.cross(left, [0.0, 1.0, 0.0])
    across = left * np.cos(TURN) - front * np.sin(TURN)
    return lambda places: np.stack([places @ across, places[..., 1]], axis=-1)


def bones(on: Axes, moment: Moment, joints: np.ndarray, colour: str, width: float, **style) -> None:
    """Draw a line from each joint (J, 2) to its parent."""
    child = np.flatnonzero(moment.skeleton.parents >= 0)
    ends = np.stack([joints[moment.skeleton.parents[child]], joints[child]])
    on.plot(ends[..., 0], ends[..., 1], color=colour, linewidth=width, solid_capstyle="round", **style)


def iterations(target: Path, said: dict, default: str) -> None:
    """Draw what `bench.iterations` measured: the default's costs, and every prior's errors. Raises WriteError."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    spent = said["iterations"]
    for (name, curve), colour in zip(said["cost"].items(), (INK, BAD, MENDED), strict=True):
        left.semilogy(spent[default], curve, color=colour, label=COSTS[name])
    left.set(title=f"What is minimised: {default}", ylabel="half the sum of squares, in standard deviations")
    for name, curve in said["position_mm"].items():
        right.plot(spent[name], curve, color=PRIORS[name], label=name, linewidth=2.5 if name == default else 1.5)
    right.set(title="Error of all joints", ylabel="mm", ylim=(0, None))
    for on in (left, right):
        on.set(xlabel="iterations", facecolor=PAPER, xlim=(0, None))
        on.grid(color="white", linewidth=1.2)
        on.spines[:].set_visible(False)
        on.legend(frameon=False)
    save(target, figure)


def twists(target: Path, spread: dict[str, tuple[float, ...]]) -> None:
    """Draw `bench.twists.distribution`: a row for each joint, left and right beside one another. Raises WriteError."""
    rows = list(dict.fromkeys(one_sided(name)[1] for name in spread))
    figure = Figure(figsize=(10, 0.8 + 0.42 * len(rows)), layout="constrained")
    on = figure.subplots()
    for name, (low, quarter, median, three, high) in spread.items():
        side, joint = one_sided(name)
        (colour, shift), row = SIDES[side], rows.index(joint)
        on.barh(row + shift, high - low, left=low, height=0.07, color=colour)
        on.barh(row + shift, three - quarter, left=quarter, height=0.28, color=colour, label=side)
        on.plot([median, median], [row + shift - 0.16, row + shift + 0.16], color=TRUE, linewidth=2, solid_capstyle="butt")
    handles = dict(zip(*reversed(on.get_legend_handles_labels()), strict=True))
    on.legend([handles[side] for side in SIDES if side in handles], [side for side in SIDES if side in handles], frameon=False)
    on.set(yticks=range(len(rows)), yticklabels=rows, ylim=(len(rows) - 0.4, -0.6), facecolor=PAPER, xticks=range(-180, 181, 15))
    least, most = (each([row[at] for row in spread.values()]) for each, at in ((min, 0), (max, -1)))
    on.set(xlim=(least - 5, most + 5), xlabel="turn about the bone, degrees: median, middle half, and all but 1 % on either side")
    on.grid(axis="x", color="white", linewidth=1.2)
    on.set_axisbelow(True)
    on.spines[:].set_visible(False)
    on.tick_params(length=0)
    save(target, figure)


def one_sided(name: str) -> tuple[str, str]:
    """-> the side that a joint is on, a key of SIDES, and its name without it."""
    if mirrored_name(name) == name:
        return "middle", name
    return ("left" if name.startswith("L") else "right"), re.sub("^(Left|Right|L|R)", "", name)


def jitter(target: Path, said: dict) -> None:
    """Draw what `bench.jitter` measured: each way's errors over how far joints are off. Raises WriteError."""
    figure = Figure(figsize=(11, 6.5), layout="constrained")
    grid = figure.subplots(2, 3, sharex=True, sharey="row")
    panels = {"jitter_mm": "from the truth", "from_given_mm": "from the joints as given", "wrong_bones_mm": "bones another's"}
    for row, part in zip(grid, ("body", "hands"), strict=True):
        for on, (key, title) in zip(row, panels.items(), strict=True):
            curves = {way: [ways[way][f"{part}_mm"] for ways in said[key].values()] for way in WAYS}
            amounts = [int(amount) for amount in said[key]]
            for way, colour in WAYS.items():
                on.plot(amounts, curves[way], "o-", color=colour, label=way, linewidth=2)
            if key != "from_given_mm":
                given = [each[f"{part}_mm"] for each in said["given_mm"].values()]
                on.plot(amounts, given, color=MARKER, label="joints as given", linestyle=(0, (3, 2)))
            on.set_title(f"{part.title()}: {title}", fontsize=11, color=INK, loc="left")
            on.set(facecolor=PAPER, xticks=amounts)
            on.grid(color="white", linewidth=1.2)
            on.spines[:].set_visible(False)
        row[0].set(ylabel="mean error, mm", ylim=(0, None))
    for on in grid[-1]:
        on.set_xlabel("joints given ± mm along each axis")
    grid[0, 0].legend(frameon=False)
    save(target, figure)


def save(target: Path, figure: Figure) -> None:
    with replacing(target) as part:
        figure.savefig(part, format="png", dpi=110)
