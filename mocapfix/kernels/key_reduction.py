"""Choose the keys of a curve such that interpolation between them stays within a limit of every frame.

From each key the next one is the last frame that can be reached, found by doubling the span and then halving the interval. Every
accepted span was checked at all its frames, so the limit holds whatever was skipped.
Between two keys of rotations a program may interpolate along the arc (slerp, as glTF requires) or linearly in the components of
the quaternions, which are then normalised (Blender, and many engines). The limit holds for both.
"""

import math

import numpy as np

from mocapfix.kernels.compilation_cache import compile_inner_kernel, compile_kernel

MIN_KEY_COSINE = 0.5
"""of half the angle between two neighbouring keys: keys are less than 120 degrees apart, so that there is one shortest arc"""
MIN_ARC_SINE = 1e-6
"""of half the angle between two keys, below which linear interpolation and slerp are the same"""


@compile_kernel
def select_rotation_keys(quaternions, max_error_rad):
    """Return (T,) bool: the frames of unit quaternions (T, 4) without sign flips that are kept.

    The first and the last frame are kept, or only the first if all frames are within the limit of it.
    """
    return _select_keys(quaternions, compute_squared_chord(max_error_rad), True)


@compile_kernel
def select_position_keys(positions, max_error):
    """Return (T,) bool: the frames of points (T, 3) that are kept. The first and the last frame are always kept."""
    return _select_keys(positions, max_error * max_error, False)


@compile_inner_kernel
def compute_squared_chord(angle_rad):
    """Return the squared distance of two unit quaternions whose rotations differ by an angle."""
    chord = 2 * math.sin(min(angle_rad, np.pi) / 4)
    return chord * chord


@compile_inner_kernel
def _select_keys(values, limit, are_rotations):
    frames = len(values)
    kept = np.zeros(frames, np.bool_)
    kept[0] = True
    if are_rotations and is_constant(values, limit):
        return kept
    add_keys(values, kept, 0, frames - 1, limit, are_rotations)
    return kept


@compile_inner_kernel
def add_keys(values, kept, first, end, limit, are_rotations):
    """Mark the keys of a curve (T, D) from the frame `first` to the frame `end`, which are keys themselves."""
    kept[first], kept[end] = True, True
    while first < end:
        last, too_far, span = first + 1, end + 1, 2
        while last < end and too_far > end:
            candidate = min(first + span, end)
            if is_span_within(values, first, candidate, limit, are_rotations):
                last = candidate
                span *= 2
            else:
                too_far = candidate
        while too_far <= end and too_far - last > 1:
            candidate = (last + too_far) // 2
            if is_span_within(values, first, candidate, limit, are_rotations):
                last = candidate
            else:
                too_far = candidate
        kept[last] = True
        first = last


@compile_inner_kernel
def is_constant(values, limit):
    """Return whether all frames are within the limit, a squared distance, of the first."""
    for t in range(1, len(values)):
        total = 0.0
        for a in range(values.shape[1]):
            total += (values[t, a] - values[0, a]) ** 2
        if total > limit:
            return False
    return True


@compile_inner_kernel
def is_span_within(values, first, last, limit, are_rotations):
    """Return whether the frames between two keys are within the limit; the middle one, where most fail, is checked first."""
    angle = 0.0
    if are_rotations:
        cosine = compute_cosine(values, first, last)
        if cosine < MIN_KEY_COSINE:
            return False
        angle = math.acos(min(cosine, 1.0))
    middle = (first + last) // 2
    if _compute_squared_error(values, first, last, middle, angle, are_rotations) > limit:
        return False
    t = first + 1
    while t < last and _compute_squared_error(values, first, last, t, angle, are_rotations) <= limit:
        t += 1
    return t >= last


@compile_inner_kernel
def compute_cosine(values, first, last):
    """Return the cosine of half the angle between two frames of quaternions."""
    total = 0.0
    for a in range(values.shape[1]):
        total += values[first, a] * values[last, a]
    return total


@compile_inner_kernel
def _compute_squared_error(values, first, last, t, angle, are_rotations):
    """Return the squared distance of frame t from the interpolation between two keys, the larger one of both kinds."""
    share = (t - first) / (last - first)
    width = values.shape[1]
    linear, length = 0.0, 0.0
    for a in range(width):
        value = values[first, a] + share * (values[last, a] - values[first, a])
        length += value * value
        linear += (value - values[t, a]) ** 2
    if not are_rotations:
        return linear
    length = math.sqrt(length)
    # |v / |v| - q|^2 = |v - q|^2 / |v| - (1 - |v|)^2 / |v|, which loses no digits where both are close
    linear = (linear - (1 - length) ** 2) / length
    sine = math.sin(angle)
    if sine < MIN_ARC_SINE:
        return linear
    before, after = math.sin((1 - share) * angle) / sine, math.sin(share * angle) / sine
    arc = 0.0
    for a in range(width):
        arc += (before * values[first, a] + after * values[last, a] - values[t, a]) ** 2
    return max(arc, linear)


@compile_kernel
def measure_key_error(values, kept, are_rotations):
    """Return the largest error of interpolation between kept frames: radians for quaternions (T, 4), else the points' unit.

    Of rotations it is that of the worse one of slerp and normalised linear interpolation. After the last key a curve is constant.
    """
    largest = 0.0
    first = 0
    for last in range(1, len(values)):
        if not kept[last]:
            continue
        angle = math.acos(min(compute_cosine(values, first, last), 1.0)) if are_rotations else 0.0
        for t in range(first + 1, last):
            largest = max(largest, _compute_squared_error(values, first, last, t, angle, are_rotations))
        first = last
    for t in range(first + 1, len(values)):
        total = 0.0
        for a in range(values.shape[1]):
            total += (values[t, a] - values[first, a]) ** 2
        largest = max(largest, total)
    return 4 * math.asin(min(math.sqrt(largest) / 2, 1.0)) if are_rotations else math.sqrt(largest)


@compile_kernel
def interpolate_keys(values, kept, on_arc):
    """Return curves like `values` (T, D) between the kept frames, constant after the last one.

    on_arc  values are quaternions, and interpolation is slerp; otherwise it is linear, and quaternions are not normalised
    """
    out = values.copy()
    first = 0
    for last in range(1, len(values)):
        if not kept[last]:
            continue
        angle = math.acos(min(compute_cosine(values, first, last), 1.0)) if on_arc else 0.0
        sine = math.sin(angle)
        for t in range(first + 1, last):
            after = (t - first) / (last - first)
            before = 1 - after
            if sine >= MIN_ARC_SINE:
                before, after = math.sin(before * angle) / sine, math.sin(after * angle) / sine
            for a in range(values.shape[1]):
                out[t, a] = before * values[first, a] + after * values[last, a]
        first = last
    for t in range(first + 1, len(values)):
        for a in range(values.shape[1]):
            out[t, a] = values[first, a]
    return out
