"""Properties that animation files do not give: unit of length and up axis. All assumptions are noted."""

from dataclasses import replace

import numpy as np

from mocapfix.errors import ReadError
from mocapfix.io.coordinates import METRES_PER_UNIT, ROTATIONS_TO_Y_UP, format_length
from mocapfix.model.animation import FOOT_JOINT_PATTERN, HEAD_JOINT_PATTERN, Animation
from mocapfix.options import ReadOptions

PERSON_HEIGHT_RANGE_M = (1.2, 2.2)
FIGURE_HEIGHT_RANGE_M = (0.3, 4.0)  # of figures in no known unit: children, animals and giants
REACH_TO_HEIGHT_RATIO = 1.42  # longest path along a person's bones, from finger tips to toes, divided by the height
# Metres per unit, in the order in which units are tried.
CANDIDATE_UNITS_M = {
    "centimetres": 0.01,
    "metres": 1.0,
    "millimetres": 0.001,
    "CMU's units of 1/0.45 inch": 0.0254 / 0.45,
    "inches": 0.0254,
    "feet": 0.3048,
}
MIN_UP_AXIS_COSINE = 0.8  # of the angle between an axis and the vector from feet to head of a standing figure
MAX_PAIR_DIFFERENCE_SHARE = 0.05  # difference of the distances of two tips from the body root, as a share of one
MAX_INSPECTED_POSES = 200  # poses from which the up axis is inferred


def infer_conventions(animation: Animation, options: ReadOptions) -> Animation:
    """Return the animation with its unit and its up axis: those of the options, or else as its figure shows them.

    Raises:
        ReadError: If the figure is not as tall as any person in any unit, or is to be mirrored, which only markers can be.
    """
    if options.mirror:
        raise ReadError(f"{animation.path}: --mirror is for markers; an animation has rotations, which cannot be mirrored.")
    if options.up_axis is not None:
        animation = replace(animation, rotation_y_up_file=ROTATIONS_TO_Y_UP[options.up_axis])
    else:
        animation = infer_up_axis(animation)
    if options.unit is not None:
        return replace(animation, unit_m=METRES_PER_UNIT[options.unit])
    animation = infer_unit(animation)
    height_m = estimate_height(animation)
    if options.accept_contradictions or not height_m or FIGURE_HEIGHT_RANGE_M[0] <= height_m <= FIGURE_HEIGHT_RANGE_M[1]:
        return animation
    raise ReadError(
        f"{animation.path}: its figure is {format_length(height_m)} tall, and no usual unit makes it as tall as a person; "
        f"give the unit with --unit, one of {', '.join(METRES_PER_UNIT)}, or add --accept-contradictions."
    )


def infer_unit(animation: Animation) -> Animation:
    """Return the animation with a unit of length by which its figure is as tall as people are, and a note on a changed unit.

    This is its own unit if that fits, else the first of CANDIDATE_UNITS_M that does, else its own.
    """
    lowest, highest = PERSON_HEIGHT_RANGE_M
    if lowest <= estimate_height(animation) <= highest:
        return animation
    for name, unit_m in CANDIDATE_UNITS_M.items():
        scaled = replace(animation, unit_m=unit_m)
        if lowest <= (height_m := estimate_height(scaled)) <= highest:
            note = f"Lengths are assumed to be {name}; the figure is {height_m:.2f} m tall."
            return replace(scaled, notes=(*animation.notes, note))
    height, unit = format_length(estimate_height(animation)), f"{animation.unit_m * 100:.4g} cm"
    note = f"The file gives no unit of length; {unit} is assumed, and the figure is {height} tall (--unit sets it)."
    return replace(animation, notes=(*animation.notes, note))


def estimate_height(animation: Animation) -> float:
    """Return the height in metres of a person whose bones are as long as those of the figure."""
    return compute_reach(animation) * animation.unit_m / REACH_TO_HEIGHT_RATIO


def compute_reach(animation: Animation) -> float:
    """Return the longest path along the bones from one tip of the body to another, in file units.

    The bones are those of the posed figure, below its body root: a reference node above the hips is no part of it. Nor is what
    one side alone carries, such as a sword in a hand: a tip is left out if no other is about as far from the body root.
    """
    lengths = np.linalg.norm(animation.bone_offsets, axis=1)
    ends = np.array([np.linalg.norm(sites, axis=1).max(initial=0.0) for sites in animation.end_sites])
    distance = np.zeros(len(ends))
    for joint in np.flatnonzero(animation.is_below_body_root).tolist():
        distance[joint] = distance[animation.parents[joint]] + lengths[joint]
    tips = np.setdiff1d(np.flatnonzero(animation.is_below_body_root), animation.parents)
    tip_distance = (distance + ends)[tips]
    is_similar = np.abs(tip_distance[:, None] - tip_distance) <= MAX_PAIR_DIFFERENCE_SHARE * tip_distance
    is_left_out = np.zeros(len(ends), bool)
    is_left_out[tips] = (is_similar.sum(1) == 1) & (is_similar.sum(1).max(initial=0) > 1)
    depth, longest = np.where(is_left_out, -np.inf, ends), np.where(is_left_out, 0.0, ends)
    for joint in np.flatnonzero(animation.is_below_body_root)[::-1].tolist():
        parent, path_length = animation.parents[joint], depth[joint] + lengths[joint]
        longest[parent] = max(longest[parent], longest[joint], depth[parent] + path_length)
        depth[parent] = max(depth[parent], path_length)
    return float(longest[animation.body_root])


def infer_up_axis(animation: Animation) -> Animation:
    """Return the animation with its up axis, and a note if that is not Y.

    Y is up in most files. Z, or an axis that points down, is up if the head is above the feet along it in most of the motion; Z
    also if the figure does not stand for most of the motion, but does along Z in the rest pose.
    """
    head = [j for j, name in enumerate(animation.names) if HEAD_JOINT_PATTERN.search(name)][:1]
    feet = [j for j, name in enumerate(animation.names) if FOOT_JOINT_PATTERN.search(name)]
    if not head or not feet:
        return animation
    inspected = animation.replace_values(animation.values[:: max(1, animation.frame_count // MAX_INSPECTED_POSES)])
    for positions, letters in (
        (inspected.compute_world_poses()[0], ("Y", "Z", "-Y", "-Z")),
        (animation.skeleton.rest_positions[None], ("Y", "Z")),
    ):
        head_above_feet = positions[:, head[0]] - positions[:, feet].mean(1)
        total = head_above_feet[np.isfinite(head_above_feet).all(1)].sum(0)
        direction = total / max(np.linalg.norm(total), 1e-9)
        upright = [letter for letter in letters if (ROTATIONS_TO_Y_UP[letter] @ direction)[1] > MIN_UP_AXIS_COSINE]
        if upright:
            if upright == ["Y"]:
                return animation
            note = f"The {upright[0]} axis points up, because the head is above the feet along it (--up sets it)."
            return replace(animation, rotation_y_up_file=ROTATIONS_TO_Y_UP[upright[0]], notes=(*animation.notes, note))
    return animation
