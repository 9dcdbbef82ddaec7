"""Decide the unit, the up axis and the handedness of a file: by the options, by the file, and by the person in it.

This is the one place where positions in the unit and axes of a file become metres with Y up. An option is followed, but --up
and --mirror are refused where they contradict a body that is certain, unless --accept-contradictions is given. What a file
declares is followed unless its markers prove it wrong, which is noted; what they contradict without showing what is right is
refused, with the option that settles it. Animation files declare neither unit nor up axis: all that is assumed is noted.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mocapfix.errors import ReadError
from mocapfix.io.coordinates import (
    METRES_PER_UNIT,
    ROTATIONS_TO_Y_UP,
    BodyEvidence,
    InspectedPoints,
    PointSample,
    collect_body_evidence,
    estimate_sign,
    estimate_up_axis,
    find_standing_axis,
    format_length,
    is_on_floor_along,
    measure_handedness,
    sample_points,
)
from mocapfix.model.animation import FOOT_JOINT_PATTERN, HEAD_JOINT_PATTERN, Animation
from mocapfix.model.take import C3dLayout, TableLayout, Take, UpAxis
from mocapfix.options import ReadOptions

MIRROR_X = np.diag([-1.0, 1.0, 1.0])  # of metres with Y up
CONFUSED_UNIT_FACTORS = (1000.0, 100.0, 10.0, 25.4)  # m for mm, m for cm, cm for mm, inches for mm


class HumanRange(NamedTuple):
    """Distances (m) between the middles of two parts of a body that people have, and of those that are surely people's.

    The second range is narrower than the factor 2.54 between neighbouring units, so that at most one of them fits.
    """

    parts: tuple[int, int]
    possible: tuple[float, float]
    usual: tuple[float, float]


# By the heights of the parts (see `classify_label_height`); the greater distances of a take count. Measured on 34 captures:
# 0.87 to 1.55 m (head and shoulders, feet), 0.78 to 0.90 m (pelvis, feet), 0.45 to 0.49 m (head and shoulders, pelvis).
HUMAN_RANGES = (
    HumanRange((2, 0), (0.35, 2.5), (0.7, 1.75)),
    HumanRange((1, 0), (0.2, 1.5), (0.42, 1.05)),
    HumanRange((2, 1), (0.12, 1.0), (0.28, 0.7)),
)
MIN_PART_MARKERS = 2  # of each part, from whose distance a unit is judged
HEIGHT_QUANTILE = 0.75  # of the distances over the frames: that of upright frames, whatever a quarter of them shows by faults
# Extents (m) of all markers in a frame that are possible without labels that name parts of a body, and those of a person.
POSSIBLE_EXTENT_M = (0.02, 50.0)
USUAL_EXTENT_M = (0.8, 2.0)
MIN_EXTENT_MARKERS = 10  # fewer may be on a prop of any size
# Mean volume of left, up and front (see `measure_handedness`) of a mirrored person is below the negative of this; that of 32
# captures of right-handed ones is 0.34 to 0.99.
MIN_HANDEDNESS = 0.25


@dataclass(frozen=True)
class DeclaredConvention:
    """What a file declares of its coordinates."""

    unit_m: float  # metres per unit, as declared or usual for the format
    default_up_axis: str = "Z"  # up axis of most files of the format
    up_axis: str = ""  # the letter of the axis that the file declares to be up, "" if it declares none
    up_basis: str = ""  # where it is declared, in a few words


@dataclass(frozen=True)
class Convention:
    """The unit and axes of a file."""

    unit_m: float  # metres per unit
    rotation_y_up_file: Float[np.ndarray, "3 3"]  # From file axes to axes with Y up. It is improper if the file is mirrored.
    up_axis: UpAxis  # the up axis
    notes: tuple[str, ...] = ()  # sentences on what differs from what the file declares

    def apply(self, points_file: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Return positions (m, Y up) of points in the unit and axes of the file.

        The rotation is a permutation with signs, and reordering coordinates is many times faster than a matrix product.
        """
        axes = np.abs(self.rotation_y_up_file).argmax(1)
        positions = points_file[..., axes]
        positions *= self.unit_m * self.rotation_y_up_file[np.arange(3), axes]
        return positions


def decide_convention(path: Path, points: InspectedPoints, declared: DeclaredConvention, options: ReadOptions) -> Convention:
    """Return the unit and axes of a file.

    Args:
        points: The markers of the file, in metres by the unit that it declares, and in its axes.
        options: What the user knows.

    Raises:
        ReadError: If the markers contradict the unit, the up axis or the handedness, and the options accept no contradiction.
    """
    body, sample = collect_body_evidence(points), sample_points(points)
    unit_m, notes = _decide_unit(path, body, sample, declared, options)
    factor = unit_m / declared.unit_m
    body, sample = body.scale(factor), sample._replace(frames=sample.frames * factor, falling=sample.falling * factor)
    up_axis, up_notes = _decide_up_axis(path, body, sample, declared, options)
    _check_handedness(path, body, options)
    rotation = ROTATIONS_TO_Y_UP[up_axis.letter]
    return Convention(unit_m, MIRROR_X @ rotation if options.mirror else rotation, up_axis, (*notes, *up_notes))


def change_convention(take: Take, unit_m: float, rotation_y_up_file: Float[np.ndarray, "3 3"], up_axis: UpAxis | None) -> Take:
    """Return the take as it reads if its file has another unit and other axes."""
    # Without a layout the file axes are Y up, in metres.
    layout: C3dLayout | TableLayout | None = take.layout
    change = rotation_y_up_file if layout is None else rotation_y_up_file @ layout.rotation_y_up_file.T
    factor = unit_m / (1.0 if layout is None else layout.unit_m)
    if factor == 1.0 and np.array_equal(change, np.eye(3)):
        return replace(take, up_axis=up_axis)

    def convert(markers: Float[np.ndarray, "T K 3"]) -> Float[np.ndarray, "T K 3"]:
        return markers @ change.T * factor

    unlabelled, computed = take.unlabelled, take.computed_points
    return replace(
        take,
        markers=convert(take.markers),
        up_axis=up_axis,
        layout=layout and replace(layout, unit_m=unit_m, rotation_y_up_file=rotation_y_up_file),
        unlabelled=unlabelled and replace(unlabelled, markers=convert(unlabelled.markers)),
        computed_points=computed and replace(computed, take=replace(computed.take, markers=convert(computed.take.markers))),
    )


def _decide_unit(
    path: Path, body: BodyEvidence, sample: PointSample, declared: DeclaredConvention, options: ReadOptions
) -> tuple[float, tuple[str, ...]]:
    """Return metres per unit, and a note if it is not the declared one."""
    if options.unit is not None:
        return METRES_PER_UNIT[options.unit], ()
    measured = _measure_size(body, sample)
    if measured is None:
        return declared.unit_m, ()
    (size_m, part), possible, usual = measured
    where = f"In its unit, {_name_unit(declared.unit_m)},"
    if not size_m or usual[0] <= size_m <= usual[1]:
        return declared.unit_m, ()
    if possible[0] <= size_m <= possible[1]:
        note = f"{where} {part} {size_m:.2f} m; if that is wrong, give the unit with --unit."
        return declared.unit_m, () if possible == POSSIBLE_EXTENT_M else (note,)
    factors = [1 / factor for factor in CONFUSED_UNIT_FACTORS] + list(CONFUSED_UNIT_FACTORS)
    fitting = [factor for factor in factors if usual[0] <= size_m * factor <= usual[1]]
    if len(fitting) != 1:
        if options.accept_contradictions:
            return declared.unit_m, ()
        raise ReadError(
            f"{path}: {where.lower()} {part} {format_length(size_m)}, as of no person; give the unit with --unit, "
            f"one of {', '.join(METRES_PER_UNIT)} (--accept-contradictions cleans it as it is)."
        )
    rounded = declared.unit_m * fitting[0]
    unit_m = next((metres for metres in METRES_PER_UNIT.values() if abs(rounded / metres - 1) < 1e-6), rounded)
    return unit_m, (
        f"{where} {part} {format_length(size_m)}; coordinates are taken as {_name_unit(unit_m)}, which makes that "
        f"{size_m * fitting[0]:.2f} m (--unit sets the unit).",
    )


def _measure_size(
    body: BodyEvidence, sample: PointSample
) -> tuple[tuple[float, str], tuple[float, float], tuple[float, float]] | None:
    """Return the size of the person (m) with its description, and the possible and the usual sizes (m)."""
    names = {2: "head", 1: "pelvis", 0: "feet"}
    for human in HUMAN_RANGES:
        high, low = human.parts
        parts = body.select_height(high), body.select_height(low)
        length = np.linalg.norm(body.compute_direction(*parts), axis=-1)
        if min(part.sum() for part in parts) >= MIN_PART_MARKERS and np.isfinite(length).any():
            text = f"the distance of {names[high]} and {names[low]} is"
            return (float(np.nanquantile(length, HEIGHT_QUANTILE)), text), human.possible, human.usual
    frames = sample.frames[(~np.isnan(sample.frames[..., 0])).sum(1) >= MIN_EXTENT_MARKERS]
    if not len(frames):
        return None
    extent = float(np.median((np.nanmax(frames, axis=1) - np.nanmin(frames, axis=1)).max(1)))
    return (extent, "the extent of the markers is"), POSSIBLE_EXTENT_M, USUAL_EXTENT_M


def _decide_up_axis(
    path: Path, body: BodyEvidence, points: PointSample, declared: DeclaredConvention, options: ReadOptions
) -> tuple[UpAxis, tuple[str, ...]]:
    """Return the up axis, and a note if it is not the declared one."""
    if options.up_axis is not None:
        standing = find_standing_axis(body)
        is_wrong = standing is not None and standing.is_certain and standing.axis != options.up_axis
        if standing is not None and is_wrong and not options.accept_contradictions:
            raise ReadError(
                f"{path}: --up {options.up_axis} contradicts its markers: the feet stand and the head is above them along "
                f"{standing.axis}. Leave out --up, or add --accept-contradictions."
            )
        return UpAxis(options.up_axis, "the option --up"), ()
    if not declared.up_axis:
        found = estimate_up_axis(body, points, declared.default_up_axis)
        return found, _describe_down_axis(found.letter)
    standing, letter = find_standing_axis(body), estimate_sign(declared.up_axis, body, points)
    if standing is None or standing.axis.lstrip("-") == declared.up_axis:
        return UpAxis(letter, f"{declared.up_basis} of the file"), _describe_down_axis(letter)
    if standing.is_certain:
        note = (
            f"{declared.up_basis} declares {declared.up_axis} to be vertical, but the feet stand and the head is above them "
            f"along {standing.axis}, which is taken as up (--up sets it)."
        )
        return UpAxis(standing.axis, "standing feet, head and sides"), (note,)
    if is_on_floor_along(letter, points) or options.accept_contradictions:
        return UpAxis(letter, f"{declared.up_basis} of the file", is_certain=False), ()
    raise ReadError(
        f"{path}: {declared.up_basis} declares {declared.up_axis} to be vertical, but the person seems to stand along "
        f"{standing.axis}; give the up axis with --up {standing.axis}, or --up {letter} if the person lies."
    )


def _describe_down_axis(letter: str) -> tuple[str, ...]:
    """Return a note if the vertical axis points down."""
    return (f"The {letter[1:]} axis of the file points down, by its markers (--up sets it).",) if letter.startswith("-") else ()


def _check_handedness(path: Path, body: BodyEvidence, options: ReadOptions) -> None:
    """Raise ReadError if left, up and front of the person contradict the handedness of the file."""
    found = np.array(measure_handedness(body)) * (-1.0 if options.mirror else 1.0)
    if options.accept_contradictions or not len(found) or found.max() >= 0 or found.mean() > -MIN_HANDEDNESS:
        return
    if options.mirror:
        raise ReadError(f"{path}: --mirror makes it left-handed: its left, up and front are right as they are. Leave it out.")
    raise ReadError(
        f"{path}: its axes are left-handed, or all labels of left and right are exchanged: --mirror mirrors it; "
        "exchange the labels otherwise (--accept-contradictions cleans it as it is)."
    )


def _name_unit(unit_m: float) -> str:
    return next((name for name, metres in METRES_PER_UNIT.items() if metres == unit_m), f"units of {unit_m * 1e3:.4g} mm")


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
