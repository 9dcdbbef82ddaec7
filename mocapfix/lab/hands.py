"""MNN-IK's application to optical capture (5.1) on real takes: a hand with one marker left, and crossing hands with noise.

A sound capture is damaged for a while and cleaned, with the subject calibrated on the sound capture. The result is compared with
that of the sound capture, and with numerical inverse kinematics from the damaged markers only.

The figures of the benchmarks as PNG: errors over iterations, hands before and after cleaning, and distributions of bone
twists.
"""

import re
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import mocapfix
from mocapfix.errors import TakeError
from mocapfix.io import capture
from mocapfix.io.files import replace_atomically
from mocapfix.io.patches import patch_c3d
from mocapfix.lab.compared_priors import place_solved_poses, solve_without_prior
from mocapfix.lab.training_poses import mirror_joint_name
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.result import CleaningResult
from mocapfix.solve import kinematics
from mocapfix.solve.mean_pose import load_mean_pose_prior
from mocapfix.solve.terms import PointTerm

DAMAGE_DURATION_S = 2.0
HAND_NOISE_SD_M = 0.03  # per axis, independent in every frame
HAND_MARKER_SD_M = 0.01  # standard deviation of a marker that inverse kinematics assumes


class HandDamage(NamedTuple):
    """Damage to a sound take around one frame."""

    labels: tuple[str, ...]  # damaged markers
    joints: tuple[str, ...]  # joints whose error is measured
    find_frame: Callable[[Take], int]
    damage_markers: Callable[[np.ndarray], np.ndarray]  # of markers (T, K, 3)


class HandComparison(NamedTuple):
    """The frame in the middle of the damage: joints (J, 3) and markers (M, 3) in metres, NaN where missing."""

    skeleton: Skeleton
    measured_joints: list[int]
    is_damaged: np.ndarray  # (M,) bool
    damaged_markers: np.ndarray
    cleaned_markers: np.ndarray
    captured_markers: np.ndarray
    markers_only_joints: np.ndarray  # from the damaged markers of this frame only
    cleaned_joints: np.ndarray  # from the cleaned take
    true_joints: np.ndarray  # from the sound take, cleaned
    markers_only_mm: float  # mean error of the measured joints over all damaged frames
    cleaned_mm: float


def find_highest_hand_frame(take: Take) -> int:
    """Return the frame in which the right hand is highest."""
    return int(np.nanargmax(get_hand_marker(take, "RFIN")[:, 1]))


def find_nearest_hands_frame(take: Take) -> int:
    """Return the frame in which the hands are closest to each other."""
    return int(np.nanargmin(np.linalg.norm(get_hand_marker(take, "LFIN") - get_hand_marker(take, "RFIN"), axis=1)))


def get_hand_marker(take: Take, label: str) -> Float[np.ndarray, "T 3"]:
    """Return the positions of a marker in metres. Raises TakeError if the take has no such marker or it is never visible."""
    marker = take.markers[:, find_marker_column(take, label)]
    if np.isnan(marker).any(axis=1).all():
        raise TakeError(f"{take.name}: the marker {label} is never visible; give a take in which it is.")
    return marker


def find_marker_column(take: Take, label: str) -> int:
    """Return the index of the marker with a label. Raises TakeError if there is none."""
    if label not in take.bare_labels:
        raise TakeError(f"{take.name}: has no marker {label}; give a take in CMU's 41 markers.")
    return take.bare_labels.index(label)


def remove_samples(markers: Float[np.ndarray, "T K 3"]) -> Float[np.ndarray, "T K 3"]:
    """Return the markers with all samples missing."""
    return np.full_like(markers, np.nan)


def add_noise(markers: Float[np.ndarray, "T K 3"]) -> Float[np.ndarray, "T K 3"]:
    """Return the markers with noise."""
    return markers + np.random.default_rng(0).normal(0, HAND_NOISE_SD_M, markers.shape)


RIGHT_HAND_JOINTS = ("RightForeArm", "RightHand", "RightFingerBase")
LEFT_HAND_JOINTS = ("LeftForeArm", "LeftHand", "LeftFingerBase")
# RFIN remains on the right hand.
ONE_MARKER_DAMAGE = HandDamage(("RFRM", "RWRA", "RWRB"), RIGHT_HAND_JOINTS, find_highest_hand_frame, remove_samples)
CROSSED_HANDS_DAMAGE = HandDamage(
    tuple(side + name for side in "LR" for name in ("FRM", "WRA", "WRB", "FIN")),
    LEFT_HAND_JOINTS + RIGHT_HAND_JOINTS,
    find_nearest_hands_frame,
    add_noise,
)


def compare_hands(path: Path, damage: HandDamage) -> HandComparison:
    """Return the comparison of a damaged capture with the sound one.

    Raises ReadError if the file cannot be read, TakeError if markers are missing or no body could be solved.
    """
    take, sound = capture.read_take(path), mocapfix.clean(path)
    middle, half = damage.find_frame(take), round(DAMAGE_DURATION_S / 2 * take.rate)
    columns = [find_marker_column(take, label) for label in damage.labels]
    damaged_frames, markers = slice(max(middle - half, 0), middle + half), take.markers.copy()
    markers[damaged_frames, columns] = damage.damage_markers(markers[damaged_frames, columns])
    with TemporaryDirectory() as folder:
        damaged_path = Path(folder) / path.name
        patch_c3d(damaged_path, take, take.replace_markers(markers))
        result = mocapfix.clean(damaged_path, subject=sound.subject)
    subject, motion = result.subject, result.motion
    cleaned, true = result.joint_position_world, sound.joint_position_world
    if subject is None or motion is None or cleaned is None or true is None:
        raise TakeError(f"{take.name}: no body could be solved; give a take in CMU's 41 markers.")
    frames = np.arange(len(markers))[damaged_frames]
    markers_only = solve_markers_only(result, subject, motion, frames)
    cleaned, true = cleaned[damaged_frames], true[damaged_frames]
    joints, row = [subject.skeleton.find_joint(name) for name in damage.joints], int(np.flatnonzero(frames == middle)[0])
    markers_only_mm, cleaned_mm = (
        1e3 * float(np.linalg.norm(each - true, axis=2)[:, joints].mean()) for each in (markers_only, cleaned)
    )
    return HandComparison(
        subject.skeleton,
        joints,
        is_damaged=np.isin(np.arange(len(take.labels)), columns),
        damaged_markers=markers[middle],
        cleaned_markers=result.take.markers[middle],
        captured_markers=sound.take.markers[middle],
        markers_only_joints=markers_only[row],
        cleaned_joints=cleaned[row],
        true_joints=true[row],
        markers_only_mm=markers_only_mm,
        cleaned_mm=cleaned_mm,
    )


def solve_markers_only(
    result: CleaningResult, subject: Subject, motion: Motion, frames: Int[np.ndarray, " N"]
) -> Float[np.ndarray, "N J 3"]:
    """Return the joint positions in metres from the damaged markers of each frame only, started at the mean pose."""
    take, skeleton = result.input_take, subject.skeleton
    columns = np.array([take.bare_labels.index(label) if label in take.bare_labels else -1 for label in subject.labels])
    measured = np.ascontiguousarray(take.select(columns, take.visible).markers[frames])
    weight = ~np.isnan(measured[..., 0]) / HAND_MARKER_SD_M**2
    points = PointTerm(subject.joints, subject.marker_offsets, np.nan_to_num(measured), weight)
    start = np.tile(load_mean_pose_prior("mean-pose", skeleton).mean_rotations, (len(frames), 1, 1, 1))
    start[:, 0] = motion.local_rotations[frames, 0]
    tree = kinematics.build_kinematic_tree(skeleton)
    solution = solve_without_prior(tree, points, motion.root_position[frames], start)
    return place_solved_poses(skeleton, solution).joint_positions


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
