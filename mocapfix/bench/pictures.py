"""The benchmarks' pictures, as PNG: errors over iterations, hands before and after, and how far bones are twisted."""

import re
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mocapfix.bench.hands import HandComparison
from mocapfix.files.output_files import replace_atomically
from mocapfix.train.training_poses import mirror_joint_name

VIEW_ANGLE_RAD = np.radians(20)  # from straight ahead, towards the body's left
PICTURE_MARGIN_M = 0.15  # metres around the joints that are measured
INK_COLOUR, PAPER_COLOUR, BONE_COLOUR, TRUTH_COLOUR = "#38414c", "#f6f7f9", "#8fb3dc", "#1b2a3a"
COST_LABELS = {"total": "total", "given": "given joints", "prior": "prior"}
PRIOR_COLOURS = {"none": "#8a94a0", "pca": "#e08a00", "gaussian": "#1f9d57", "mixture": "#7a5bd0", "mnn-ik": "#d93a3a",
          "autoencoder": "#2b6cb0"}  # fmt: skip
SIDE_STYLES = {"left": ("#2b6cb0", -0.18), "middle": ("#8a94a0", 0.0), "right": ("#e08a00", 0.18)}  # colour, rows further down
HYBRIK_METHOD_COLOURS = {"naive": "#d93a3a", "adaptive": "#e08a00", "x": "#2b6cb0"}
MARKER_COLOUR, BAD_COLOUR, REPAIRED_COLOUR = "#5a6470", "#d93a3a", "#1f9d57"


def draw_hands(target: Path, comparison: HandComparison) -> None:
    """Draw a moment: by its damaged markers alone, as it was cleaned, and as it was captured. Raises WriteError."""
    flat = build_projection(comparison)
    shown = flat(comparison.true_joints[[*comparison.measured_joints, *comparison.skeleton.parents[comparison.measured_joints]]])
    (left, low), (right, high) = shown.min(axis=0) - PICTURE_MARGIN_M, shown.max(axis=0) + PICTURE_MARGIN_M
    figure = Figure(figsize=(12, 0.5 + 4 * (high - low) / (right - left)), layout="constrained")
    panels = (
        (
            f"Before: by these markers alone {comparison.markers_only_mm:.0f} mm off",
            comparison.markers_only_joints,
            comparison.damaged_markers,
            comparison.captured_markers,
            BAD_COLOUR,
        ),
        (
            f"After: {comparison.cleaned_mm:.0f} mm off",
            comparison.cleaned_joints,
            comparison.cleaned_markers,
            comparison.damaged_markers,
            REPAIRED_COLOUR,
        ),
        (
            "As captured (in the others dashed and hollow)",
            comparison.true_joints,
            comparison.captured_markers,
            comparison.captured_markers,
            MARKER_COLOUR,
        ),
    )
    for on, (title, joints, markers, unlike, colour) in zip(figure.subplots(1, 3), panels, strict=True):
        draw_bones(on, comparison, flat(joints), BONE_COLOUR, 12)
        if joints is not comparison.true_joints:
            draw_bones(on, comparison, flat(comparison.true_joints), TRUTH_COLOUR, 1.5, linestyle=(0, (3, 2)))
            on.scatter(
                *flat(comparison.captured_markers)[comparison.is_damaged].T,
                s=130,
                facecolors="none",
                edgecolors=TRUTH_COLOUR,
                zorder=4,
            )
        changed = comparison.is_damaged & (markers != unlike).any(axis=1)
        on.scatter(*flat(markers).T, s=90, c=np.where(changed, colour, MARKER_COLOUR), edgecolors="white", zorder=3)
        on.set_title(title, fontsize=11, color=INK_COLOUR, loc="left")
        on.set(aspect="equal", facecolor=PAPER_COLOUR, xticks=[], yticks=[], xlim=(left, right), ylim=(low, high))
        on.spines[:].set_visible(False)
    save_figure(target, figure)


def build_projection(comparison: HandComparison):
    """-> a function from places (N, 3) to the picture (N, 2), metres: seen from before the body, a little from its left."""
    left = (
        comparison.true_joints[comparison.skeleton.find_joint("LeftArm")]
        - comparison.true_joints[comparison.skeleton.find_joint("RightArm")]
    )
    left = left * [1, 0, 1] / np.linalg.norm(left * [1, 0, 1])
    front = np.cross(left, [0.0, 1.0, 0.0])
    across = left * np.cos(VIEW_ANGLE_RAD) - front * np.sin(VIEW_ANGLE_RAD)
    return lambda places: np.stack([places @ across, places[..., 1]], axis=-1)


def draw_bones(axes: Axes, comparison: HandComparison, joints: np.ndarray, colour: str, width: float, **style) -> None:
    """Draw a line from each joint (J, 2) to its parent."""
    child = np.flatnonzero(comparison.skeleton.parents >= 0)
    ends = np.stack([joints[comparison.skeleton.parents[child]], joints[child]])
    axes.plot(ends[..., 0], ends[..., 1], color=colour, linewidth=width, solid_capstyle="round", **style)


def draw_iterations(target: Path, results: dict, default: str) -> None:
    """Draw what `bench.iterations` measured: the default's costs, and every prior's errors. Raises WriteError."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    spent = results["iterations"]
    for (name, curve), colour in zip(results["cost"].items(), (INK_COLOUR, BAD_COLOUR, REPAIRED_COLOUR), strict=True):
        left.semilogy(spent[default], curve, color=colour, label=COST_LABELS[name])
    left.set(title=f"What is minimised: {default}", ylabel="half the sum of squares, in standard deviations")
    for name, curve in results["position_mm"].items():
        right.plot(spent[name], curve, color=PRIOR_COLOURS[name], label=name, linewidth=2.5 if name == default else 1.5)
    right.set(title="Error of all joints", ylabel="mm", ylim=(0, None))
    for on in (left, right):
        on.set(xlabel="iterations", facecolor=PAPER_COLOUR, xlim=(0, None))
        on.grid(color="white", linewidth=1.2)
        on.spines[:].set_visible(False)
        on.legend(frameon=False)
    save_figure(target, figure)


def draw_twists(target: Path, percentiles: dict[str, tuple[float, ...]]) -> None:
    """Draw `bench.twists.distribution`: a row for each joint, left and right beside one another. Raises WriteError."""
    rows = list(dict.fromkeys(split_side(name)[1] for name in percentiles))
    figure = Figure(figsize=(10, 0.8 + 0.42 * len(rows)), layout="constrained")
    on = figure.subplots()
    for name, (low, quarter, median, three, high) in percentiles.items():
        side, joint = split_side(name)
        (colour, shift), row = SIDE_STYLES[side], rows.index(joint)
        on.barh(row + shift, high - low, left=low, height=0.07, color=colour)
        on.barh(row + shift, three - quarter, left=quarter, height=0.28, color=colour, label=side)
        on.plot(
            [median, median], [row + shift - 0.16, row + shift + 0.16], color=TRUTH_COLOUR, linewidth=2, solid_capstyle="butt"
        )
    handles = dict(zip(*reversed(on.get_legend_handles_labels()), strict=True))
    on.legend(
        [handles[side] for side in SIDE_STYLES if side in handles],
        [side for side in SIDE_STYLES if side in handles],
        frameon=False,
    )
    on.set(
        yticks=range(len(rows)),
        yticklabels=rows,
        ylim=(len(rows) - 0.4, -0.6),
        facecolor=PAPER_COLOUR,
        xticks=range(-180, 181, 15),
    )
    least, most = (each([row[at] for row in percentiles.values()]) for each, at in ((min, 0), (max, -1)))
    on.set(xlim=(least - 5, most + 5), xlabel="turn about the bone, degrees: median, middle half, and all but 1 % on either side")
    on.grid(axis="x", color="white", linewidth=1.2)
    on.set_axisbelow(True)
    on.spines[:].set_visible(False)
    on.tick_params(length=0)
    save_figure(target, figure)


def split_side(joint_name: str) -> tuple[str, str]:
    """-> the side that a joint is on, a key of SIDES, and its name without it."""
    if mirror_joint_name(joint_name) == joint_name:
        return "middle", joint_name
    return ("left" if joint_name.startswith("L") else "right"), re.sub("^(Left|Right|L|R)", "", joint_name)


def draw_joint_noise(target: Path, results: dict) -> None:
    """Draw what `bench.jitter` measured: each way's errors over how far joints are off. Raises WriteError."""
    figure = Figure(figsize=(11, 6.5), layout="constrained")
    grid = figure.subplots(2, 3, sharex=True, sharey="row")
    panels = {"jitter_mm": "from the truth", "from_given_mm": "from the joints as given", "wrong_bones_mm": "bones another's"}
    for row, part in zip(grid, ("body", "hands"), strict=True):
        for on, (key, title) in zip(row, panels.items(), strict=True):
            curves = {way: [ways[way][f"{part}_mm"] for ways in results[key].values()] for way in HYBRIK_METHOD_COLOURS}
            amounts = [int(amount) for amount in results[key]]
            for way, colour in HYBRIK_METHOD_COLOURS.items():
                on.plot(amounts, curves[way], "o-", color=colour, label=way, linewidth=2)
            if key != "from_given_mm":
                given = [each[f"{part}_mm"] for each in results["given_mm"].values()]
                on.plot(amounts, given, color=MARKER_COLOUR, label="joints as given", linestyle=(0, (3, 2)))
            on.set_title(f"{part.title()}: {title}", fontsize=11, color=INK_COLOUR, loc="left")
            on.set(facecolor=PAPER_COLOUR, xticks=amounts)
            on.grid(color="white", linewidth=1.2)
            on.spines[:].set_visible(False)
        row[0].set(ylabel="mean error, mm", ylim=(0, None))
    for on in grid[-1]:
        on.set_xlabel("joints given ± mm along each axis")
    grid[0, 0].legend(frameon=False)
    save_figure(target, figure)


def save_figure(target: Path, figure: Figure) -> None:
    with replace_atomically(target) as part:
        figure.savefig(part, format="png", dpi=110)
