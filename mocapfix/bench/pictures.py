"""The figures of the benchmarks as PNG: errors over iterations, hands before and after cleaning, and distributions of bone
twists."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mocapfix.bench.hands import HandComparison
from mocapfix.files.output_files import replace_atomically
from mocapfix.train.training_poses import mirror_joint_name

VIEW_ANGLE_RAD = np.radians(20)  # rotation of the view from straight ahead towards the body's left
PICTURE_MARGIN_M = 0.15  # around the measured joints
INK_COLOUR = "#38414c"
PAPER_COLOUR = "#f6f7f9"
BONE_COLOUR = "#8fb3dc"
TRUTH_COLOUR = "#1b2a3a"
MARKER_COLOUR = "#5a6470"
BAD_COLOUR = "#d93a3a"
REPAIRED_COLOUR = "#1f9d57"
COST_LABELS = {"total": "total", "given": "given joints", "prior": "prior"}
PRIOR_COLOURS = {
    "none": "#8a94a0",
    "pca": "#e08a00",
    "gaussian": "#1f9d57",
    "mixture": "#7a5bd0",
    "mnn-ik": "#d93a3a",
    "autoencoder": "#2b6cb0",
}
SIDE_STYLES = {"left": ("#2b6cb0", -0.18), "middle": ("#8a94a0", 0.0), "right": ("#e08a00", 0.18)}  # colour, offset in rows
HYBRIK_METHOD_COLOURS = {"naive": "#d93a3a", "adaptive": "#e08a00", "x": "#2b6cb0"}


def draw_hands(target: Path, comparison: HandComparison) -> None:
    """Draw the hands from the damaged markers only, cleaned, and as captured. Raises WriteError if the file cannot be written."""
    project = build_projection(comparison)
    measured = comparison.measured_joints
    shown = project(comparison.true_joints[[*measured, *comparison.skeleton.parents[measured]]])
    (left, low), (right, high) = shown.min(axis=0) - PICTURE_MARGIN_M, shown.max(axis=0) + PICTURE_MARGIN_M
    figure = Figure(figsize=(12, 0.5 + 4 * (high - low) / (right - left)), layout="constrained")
    damaged, cleaned, captured = comparison.damaged_markers, comparison.cleaned_markers, comparison.captured_markers
    panels = (
        (
            f"Before: error of {comparison.markers_only_mm:.0f} mm from these markers only",
            comparison.markers_only_joints,
            damaged,
            captured,
            BAD_COLOUR,
        ),
        (f"After: error of {comparison.cleaned_mm:.0f} mm", comparison.cleaned_joints, cleaned, damaged, REPAIRED_COLOUR),
        ("As captured (dashed and hollow in the others)", comparison.true_joints, captured, captured, MARKER_COLOUR),
    )
    for axes, (title, joints, markers, reference, colour) in zip(figure.subplots(1, 3), panels, strict=True):
        draw_bones(axes, comparison, project(joints), BONE_COLOUR, 12)
        if joints is not comparison.true_joints:
            draw_bones(axes, comparison, project(comparison.true_joints), TRUTH_COLOUR, 1.5, linestyle=(0, (3, 2)))
            x, y = project(captured)[comparison.is_damaged].T
            axes.scatter(x, y, s=130, facecolors="none", edgecolors=TRUTH_COLOUR, zorder=4)
        is_changed = comparison.is_damaged & (markers != reference).any(axis=1)
        x, y = project(markers).T
        axes.scatter(x, y, s=90, c=np.where(is_changed, colour, MARKER_COLOUR), edgecolors="white", zorder=3)
        axes.set_title(title, fontsize=11, color=INK_COLOUR, loc="left")
        axes.set(aspect="equal", facecolor=PAPER_COLOUR, xticks=[], yticks=[], xlim=(left, right), ylim=(low, high))
        axes.spines[:].set_visible(False)
    save_figure(target, figure)


def build_projection(
    comparison: HandComparison,
) -> Callable[[Float[np.ndarray, "N 3"]], Float[np.ndarray, "N 2"]]:
    """Return a function from positions to the picture plane in metres, seen from in front of the body, slightly from its left."""
    skeleton, joints = comparison.skeleton, comparison.true_joints
    left = joints[skeleton.find_joint("LeftArm")] - joints[skeleton.find_joint("RightArm")]
    left = left * [1, 0, 1] / np.linalg.norm(left * [1, 0, 1])
    front = np.cross(left, [0.0, 1.0, 0.0])
    across = left * np.cos(VIEW_ANGLE_RAD) - front * np.sin(VIEW_ANGLE_RAD)
    return lambda positions: np.stack([positions @ across, positions[..., 1]], axis=-1)


def draw_bones(
    axes: Axes, comparison: HandComparison, joints: Float[np.ndarray, "J 2"], colour: str, width: float, **style: Any
) -> None:
    """Draw a line from each joint to its parent."""
    parents = comparison.skeleton.parents
    children = np.flatnonzero(parents >= 0)
    ends = np.stack([joints[parents[children]], joints[children]])
    axes.plot(ends[..., 0], ends[..., 1], color=colour, linewidth=width, solid_capstyle="round", **style)


def draw_iterations(target: Path, results: dict[str, Any], default: str) -> None:
    """Draw the results of `measure_iterations`: the costs of the default prior and the errors of all priors. Raises
    WriteError."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    iterations = results["iterations"]
    for (name, curve), colour in zip(results["cost"].items(), (INK_COLOUR, BAD_COLOUR, REPAIRED_COLOUR), strict=True):
        left.semilogy(iterations[default], curve, color=colour, label=COST_LABELS[name])
    left.set(title=f"Cost with {default}", ylabel="half the sum of squares, in standard deviations")
    for name, curve in results["position_mm"].items():
        width = 2.5 if name == default else 1.5
        right.plot(iterations[name], curve, color=PRIOR_COLOURS[name], label=name, linewidth=width)
    right.set(title="Error of all joints", ylabel="mm", ylim=(0, None))
    for axes in (left, right):
        axes.set(xlabel="iterations", facecolor=PAPER_COLOUR, xlim=(0, None))
        axes.grid(color="white", linewidth=1.2)
        axes.spines[:].set_visible(False)
        axes.legend(frameon=False)
    save_figure(target, figure)


def draw_twists(target: Path, percentiles: dict[str, tuple[float, ...]]) -> None:
    """Draw the results of `compute_twist_distribution`, a row for each joint, left and right together. Raises WriteError."""
    rows = list(dict.fromkeys(split_side(name)[1] for name in percentiles))
    figure = Figure(figsize=(10, 0.8 + 0.42 * len(rows)), layout="constrained")
    axes = figure.subplots()
    for name, (low, first_quartile, median, third_quartile, high) in percentiles.items():
        side, joint = split_side(name)
        colour, offset = SIDE_STYLES[side]
        y = rows.index(joint) + offset
        axes.barh(y, high - low, left=low, height=0.07, color=colour)
        axes.barh(y, third_quartile - first_quartile, left=first_quartile, height=0.28, color=colour, label=side)
        axes.plot([median, median], [y - 0.16, y + 0.16], color=TRUTH_COLOUR, linewidth=2, solid_capstyle="butt")
    handles = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    sides = [side for side in SIDE_STYLES if side in handles]
    axes.legend([handles[side] for side in sides], sides, frameon=False)
    axes.set(yticks=range(len(rows)), yticklabels=rows, ylim=(len(rows) - 0.4, -0.6), facecolor=PAPER_COLOUR)
    lowest, highest = min(row[0] for row in percentiles.values()), max(row[-1] for row in percentiles.values())
    axes.set(xticks=range(-180, 181, 15), xlim=(lowest - 5, highest + 5))
    axes.set_xlabel("twist of the bone in degrees: median, quartiles, and 1st to 99th percentile")
    axes.grid(axis="x", color="white", linewidth=1.2)
    axes.set_axisbelow(True)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    save_figure(target, figure)


def split_side(joint_name: str) -> tuple[str, str]:
    """Return the side of a joint, a key of SIDE_STYLES, and its name without the side."""
    if mirror_joint_name(joint_name) == joint_name:
        return "middle", joint_name
    return ("left" if joint_name.startswith("L") else "right"), re.sub("^(Left|Right|L|R)", "", joint_name)


def draw_joint_noise(target: Path, results: dict[str, Any]) -> None:
    """Draw the results of `measure_joint_noise`: the errors of each variant over the noise. Raises WriteError."""
    figure = Figure(figsize=(11, 6.5), layout="constrained")
    grid = figure.subplots(2, 3, sharex=True, sharey="row")
    panels = {
        "jitter_mm": "from the truth",
        "from_given_mm": "from the given joints",
        "wrong_bones_mm": "wrong bones",
    }
    for row, part in zip(grid, ("body", "hands"), strict=True):
        for axes, (key, title) in zip(row, panels.items(), strict=True):
            noise_mm = [int(each) for each in results[key]]
            for variant, colour in HYBRIK_METHOD_COLOURS.items():
                curve = [variants[variant][f"{part}_mm"] for variants in results[key].values()]
                axes.plot(noise_mm, curve, "o-", color=colour, label=variant, linewidth=2)
            if key != "from_given_mm":
                given = [each[f"{part}_mm"] for each in results["given_mm"].values()]
                axes.plot(noise_mm, given, color=MARKER_COLOUR, label="given joints", linestyle=(0, (3, 2)))
            axes.set_title(f"{part.title()}: {title}", fontsize=11, color=INK_COLOUR, loc="left")
            axes.set(facecolor=PAPER_COLOUR, xticks=noise_mm)
            axes.grid(color="white", linewidth=1.2)
            axes.spines[:].set_visible(False)
        row[0].set(ylabel="mean error, mm", ylim=(0, None))
    for axes in grid[-1]:
        axes.set_xlabel("joint noise ± mm along each axis")
    grid[0, 0].legend(frameon=False)
    save_figure(target, figure)


def save_figure(target: Path, figure: Figure) -> None:
    """Write a figure as PNG, replacing the file atomically. Raises WriteError if it cannot be written."""
    with replace_atomically(target) as temporary:
        figure.savefig(temporary, format="png", dpi=110)
