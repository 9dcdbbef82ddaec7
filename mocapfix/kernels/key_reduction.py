"""Choose the keys of a curve such that interpolation between them stays within a limit of every frame.

From each key the next one is the last frame that can be reached, found by doubling the span and then halving the interval. Every
accepted span was checked at all its frames, so the limit holds whatever was skipped.
Between two keys of rotations a program may interpolate along the arc (slerp, as glTF requires) or linearly in the components of
the quaternions, which are then normalised (Blender, and many engines). The limit holds for both.

Choose the keys of the pelvis and the legs such that standing feet stay where they are.

Errors of rotations that are within the limit for each bone add up along a leg. So while a foot stands, the position and the
rotation of the pelvis and the rotations of the bones of that leg have their keys in the same frames: from each the next one is
the last frame that can be reached with every rotation within its limit and the foot within its own. Common keys need no more
frames than this: between them the errors of the bones of a leg mostly cancel, while those of keys in different frames do not.
Elsewhere each curve has keys of its own (`kernels/py`).

The arrays of the legs, of N bones: the pelvis, the bones from the left leg's first one to the foot, and those of the right leg.
position   (T, 3) m: of the pelvis, in its parent's axes
rotations  (N, T, 4): of the bones, relative to the one before
offsets    (N, 3) m: the head of each bone in the axes of the one before; the one before a leg's first bone is the pelvis
leg_ends   (2,): the bone after each leg's last one
balls      (2, 3) m: the balls of the feet in the axes of the feet; NaN for a foot without
standing   (T, 4): whether the left ankle, the left ball, the right ankle and the right ball stand
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


POINT_COUNT = 4
CONSTANT_CHORD = 1e-12
"""squared distance of quaternions from the first frame, up to which a bone of a leg does not move: 2e-6 rad"""


@compile_kernel
def compute_foot_points(position, rotations, offsets, leg_ends, balls):
    """Return (T, 4, 3): left ankle, left ball, right ankle and right ball, in the axes of the pelvis' parent."""
    points = np.empty((len(position), POINT_COUNT, 3))
    frame = np.empty((len(rotations), 4))
    for t in range(len(position)):
        frame[:] = rotations[:, t]
        _pose_feet(position[t], frame, offsets, leg_ends, balls, points[t])
    return points


@compile_kernel
def measure_standing_error(position, rotations, offsets, leg_ends, balls, standing, points):
    """Return the largest distance of a point from where it is in `points` (T, 4, 3), in frames in which it stands."""
    moved = compute_foot_points(position, rotations, offsets, leg_ends, balls)
    largest = 0.0
    for t in range(len(moved)):
        largest = max(largest, _compute_squared_distance(moved[t], points[t], standing[t]))
    return math.sqrt(largest)


@compile_kernel
def select_leg_keys(
    position, rotations, offsets, leg_ends, balls, standing, points, max_error_rad, max_error_m, max_standing_error_m
):
    """Return (N + 1, T) bool: the frames that are kept, of the N rotations and of the position.

    points  of `compute_foot_points`
    """
    count, frames = len(rotations), len(position)
    legs = offsets, leg_ends, balls, standing, points
    limits = compute_squared_chord(max_error_rad), max_error_m**2, max_standing_error_m**2
    kept, common = np.zeros((count + 1, frames), np.bool_), np.zeros((count + 1, frames), np.bool_)
    in_group = np.zeros(count + 1, np.bool_)
    is_still = np.empty(count, np.bool_)
    for k in range(count):
        is_still[k] = is_constant(rotations[k], CONSTANT_CHORD)
    start = 0
    while start < frames:
        left, right = _does_stand(standing[start], 0), _does_stand(standing[start], 1)
        end = start
        while end < frames - 1 and _does_stand(standing[end + 1], 0) == left and _does_stand(standing[end + 1], 1) == right:
            end += 1
        if left or right:
            in_group[:] = False
            in_group[0], in_group[count] = not is_still[0], True
            for k in range(1, count):
                in_group[k] = (left if k < leg_ends[0] else right) and not is_still[k]
            _add_common_keys(position, rotations, legs, in_group, limits, (max(start - 1, 0), end), kept, common)
        start = end + 1
    for k in range(count):
        _add_own_keys(rotations[k], kept[k], common[k], limits[0], True)
    _add_own_keys(position, kept[count], common[count], limits[1], False)
    return kept


@compile_inner_kernel
def _add_own_keys(values, kept, common, limit, are_rotations):
    """Mark the keys of a curve where it has no common ones. `common` (T,): whether the span after each frame has common keys."""
    last = len(values) - 1
    if are_rotations and not common.any() and is_constant(values, limit):
        kept[0] = True
        return
    first = 0
    while first < last:
        end = first
        while end < last and not common[end]:
            end += 1
        if end > first:
            add_keys(values, kept, first, end, limit, are_rotations)
        first = end + 1 if end < last and common[end] else end
    kept[0], kept[last] = True, True


@compile_inner_kernel
def _add_common_keys(position, rotations, legs, in_group, limits, frames, kept, common):
    """Mark the common keys of a group of curves from the first to the last of some frames, and the spans between them."""
    first, end = frames
    blend = np.empty((len(rotations), 4)), np.empty(len(rotations)), np.empty(3), np.empty((POINT_COUNT, 3))
    _mark(kept, in_group, first, first + 1)
    _mark(common, in_group, first, end)
    while first < end:
        last, too_far, span = first + 1, end + 1, 2
        while last < end and too_far > end:
            candidate = min(first + span, end)
            if _is_group_within(position, rotations, legs, in_group, limits, (first, candidate), blend):
                last = candidate
                span *= 2
            else:
                too_far = candidate
        while too_far <= end and too_far - last > 1:
            candidate = (last + too_far) // 2
            if _is_group_within(position, rotations, legs, in_group, limits, (first, candidate), blend):
                last = candidate
            else:
                too_far = candidate
        _mark(kept, in_group, last, last + 1)
        first = last


@compile_inner_kernel
def _mark(flags, in_group, start, stop):
    for k in range(len(in_group)):
        if in_group[k]:
            flags[k, start:stop] = True


@compile_inner_kernel
def _is_group_within(position, rotations, legs, in_group, limits, span, blend):
    """Return whether all curves of a group, and the standing feet, are within their limits between two keys."""
    first, last = span
    count = len(rotations)
    middle = (first + last) // 2
    angles = blend[1]
    for k in range(count):
        angles[k] = 0.0
        if in_group[k]:
            cosine = compute_cosine(rotations[k], first, last)
            if cosine < MIN_KEY_COSINE:
                return False
            angles[k] = math.acos(min(cosine, 1.0))
    if not _are_feet_within(position, rotations, legs, in_group, limits[2], (first, last, middle), blend):
        return False
    for k in range(count):
        if in_group[k] and not is_span_within(rotations[k], first, last, limits[0], True):
            return False
    if not is_span_within(position, first, last, limits[1], False):
        return False
    for t in range(first + 1, last):
        if not _are_feet_within(position, rotations, legs, in_group, limits[2], (first, last, t), blend):
            return False
    return True


@compile_inner_kernel
def _are_feet_within(position, rotations, legs, in_group, limit, frames, blend):
    """Return whether the standing feet are within a squared distance in a frame between two keys, for both interpolations."""
    offsets, leg_ends, balls, standing, points = legs
    first, last, t = frames
    frame, angles, place, moved = blend
    share = (t - first) / (last - first)
    for a in range(3):
        place[a] = position[first, a] + share * (position[last, a] - position[first, a])
    for on_arc in (True, False):
        for k in range(len(rotations)):
            before, after = 1 - share, share
            sine = math.sin(angles[k])
            if on_arc and sine >= MIN_ARC_SINE:
                before, after = math.sin(before * angles[k]) / sine, math.sin(after * angles[k]) / sine
            for a in range(4):
                if in_group[k]:
                    frame[k, a] = before * rotations[k, first, a] + after * rotations[k, last, a]
                else:
                    frame[k, a] = rotations[k, t, a]
        _pose_feet(place, frame, offsets, leg_ends, balls, moved)
        if _compute_squared_distance(moved, points[t], standing[t]) > limit:
            return False
    return True


@compile_inner_kernel
def _does_stand(standing, leg):
    return standing[2 * leg] or standing[2 * leg + 1]


@compile_inner_kernel
def _compute_squared_distance(moved, points, standing):
    """Return the largest squared distance of the points of a frame that stand; that of a missing ball, NaN, does not count."""
    largest = 0.0
    for point in range(POINT_COUNT):
        if standing[point]:
            squared = 0.0
            for a in range(3):
                squared += (moved[point, a] - points[point, a]) ** 2
            if squared > largest:
                largest = squared
    return largest


@compile_inner_kernel
def _pose_feet(place, frame, offsets, leg_ends, balls, out):
    """Store ankles and balls (4, 3) of one frame, with quaternions (N, 4) of any length but 0."""
    bone = 1
    for leg in range(2):
        turn = _normalise(frame[0])
        x, y, z = place[0], place[1], place[2]
        while bone < leg_ends[leg]:
            dx, dy, dz = _rotate(turn, offsets[bone])
            x, y, z = x + dx, y + dy, z + dz
            turn = _multiply(turn, _normalise(frame[bone]))
            bone += 1
        out[2 * leg, 0], out[2 * leg, 1], out[2 * leg, 2] = x, y, z
        dx, dy, dz = _rotate(turn, balls[leg])
        out[2 * leg + 1, 0], out[2 * leg + 1, 1], out[2 * leg + 1, 2] = x + dx, y + dy, z + dz


@compile_inner_kernel
def _normalise(q):
    length = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return q[0] / length, q[1] / length, q[2] / length, q[3] / length


@compile_inner_kernel
def _multiply(p, q):
    return (
        p[3] * q[0] + p[0] * q[3] + p[1] * q[2] - p[2] * q[1],
        p[3] * q[1] - p[0] * q[2] + p[1] * q[3] + p[2] * q[0],
        p[3] * q[2] + p[0] * q[1] - p[1] * q[0] + p[2] * q[3],
        p[3] * q[3] - p[0] * q[0] - p[1] * q[1] - p[2] * q[2],
    )


@compile_inner_kernel
def _rotate(q, v):
    """Return a vector turned by a unit quaternion: v + 2 w (u x v) + 2 u x (u x v)."""
    x, y, z = q[1] * v[2] - q[2] * v[1], q[2] * v[0] - q[0] * v[2], q[0] * v[1] - q[1] * v[0]
    return (
        v[0] + 2 * (q[3] * x + q[1] * z - q[2] * y),
        v[1] + 2 * (q[3] * y + q[2] * x - q[0] * z),
        v[2] + 2 * (q[3] * z + q[0] * y - q[1] * x),
    )
