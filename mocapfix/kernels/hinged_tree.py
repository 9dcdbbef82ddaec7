"""The quadratic model of frames of a tree of links whose joints have one axis each: robots.

The pose of a frame is a vector of D = 6 + U numbers: the position of the root in metres, a rotation vector in radians after a
reference rotation of the root, and U unknown joint positions, from which those of the N joints follow. So poses over time are
curves in a space of vectors, and splines of them are poses (`solve.trajectory`).

The world has Z up and the floor at height 0. Every term is half a sum of squares in standard deviations.
"""

import math
from typing import NamedTuple

import numpy as np

from mocapfix.kernels.compilation import compile_inner_kernel, compile_kernel
from mocapfix.kernels.lie import assemble_rotation, compute_exponential, compute_logarithm
from mocapfix.kernels.small_matrices import (
    clear_array,
    load_matrix,
    multiply_matrices,
    multiply_vector,
    store_matrix,
    transpose_matrix,
)

ROOT_UNKNOWNS = 6
SEARCH_STEPS = 14  # of a golden section: to 0.1 % of a capsule's length
GOLDEN_SECTION = 0.6180339887498949
MODEL_FASTMATH_FLAGS = {"reassoc", "contract", "nsz", "arcp"}  # the compiler may vectorise sums of products


class HingedTree(NamedTuple):
    """L links, parents first, the root first, and N joints, by the link that they move."""

    parents: np.ndarray  # (L,)
    positions: np.ndarray  # (L, 3) in the parent's axes, metres
    rotations: np.ndarray  # (L, 3, 3) to the parent's axes
    first_joints: np.ndarray  # (L + 1,) the joints of link l are first_joints[l] .. first_joints[l + 1] - 1
    axes: np.ndarray  # (N, 3) in the link's axes
    anchors: np.ndarray  # (N, 3) likewise, metres
    is_slide: np.ndarray  # (N,)
    unknowns: np.ndarray  # (N,) the unknown that each joint follows: its position is offset + factor * unknown
    factors: np.ndarray  # (N,)
    offsets: np.ndarray  # (N,)
    paths: np.ndarray  # (L, N) joints between the root and each link, from the root outwards
    path_lengths: np.ndarray  # (L,)


class TreePose(NamedTuple):
    """Forward kinematics of a frame, in the world."""

    positions: np.ndarray  # (L, 3) metres
    rotations: np.ndarray  # (L, 3, 3)
    axes: np.ndarray  # (N, 3)
    anchors: np.ndarray  # (N, 3) metres
    root_turn: np.ndarray  # (3, 3) angular velocity of the root for the rate of its rotation vector


class PlaceTerm(NamedTuple):
    """Points of links at places, by axis."""

    links: np.ndarray  # (P,)
    offsets: np.ndarray  # (P, 3) in the link's axes, metres
    places: np.ndarray  # (T, P, 3) metres
    weights: np.ndarray  # (T, P, 3) 1 / m^2; 0 for none


class FloorTerm(NamedTuple):
    """Points of links that are not below a height: soles on the floor, the ends of capsules a radius above it."""

    links: np.ndarray  # (F,)
    offsets: np.ndarray  # (F, 3) metres
    heights: np.ndarray  # (F,) metres
    weight: float  # 1 / m^2


class LineTerm(NamedTuple):
    """Directions of lines from a point of a link to a point of a link below it."""

    links: np.ndarray  # (I, 2)
    offsets: np.ndarray  # (I, 2, 3) metres
    directions: np.ndarray  # (T, I, 3) unit vectors
    weights: np.ndarray  # (T, I) 1 / rad^2


class LinkRotationTerm(NamedTuple):
    """Rotations of links in the world."""

    links: np.ndarray  # (O,)
    rotations: np.ndarray  # (T, O, 3, 3)
    weights: np.ndarray  # (T, O) 1 / rad^2


class CollisionTerm(NamedTuple):
    """C capsules and B boxes on links that keep a distance from each other."""

    links: np.ndarray  # (C,)
    ends: np.ndarray  # (C, 2, 3) metres
    radii: np.ndarray  # (C,)
    pairs: np.ndarray  # (P, 2) of capsules
    box_links: np.ndarray  # (B,)
    box_centres: np.ndarray  # (B, 3) metres
    box_rotations: np.ndarray  # (B, 3, 3) box axes to link axes
    box_halves: np.ndarray  # (B, 3) metres
    box_pairs: np.ndarray  # (Q, 2) capsule and box
    distance: float  # metres
    weight: float  # 1 / m^2


class BalanceTerm(NamedTuple):
    """The centre of mass of links above places on the floor."""

    links: np.ndarray  # (M,)
    offsets: np.ndarray  # (M, 3) centres of mass of the links, in their axes, metres
    shares: np.ndarray  # (M,) of the mass
    places: np.ndarray  # (T, 2) metres
    weights: np.ndarray  # (T,) 1 / m^2; 0 for none


class HingedTerms(NamedTuple):
    """All terms of a frame."""

    place: PlaceTerm
    floor: FloorTerm
    line: LineTerm
    rotation: LinkRotationTerm
    collision: CollisionTerm
    balance: BalanceTerm


class Columns(NamedTuple):
    """The unknowns on which a row depends, with their velocities or rates."""

    unknowns: np.ndarray  # (D,)
    velocities: np.ndarray  # (D, 3)


@compile_inner_kernel
def allocate_tree_pose(links, joints):
    """Return arrays for a pose."""
    return TreePose(
        np.empty((links, 3)), np.empty((links, 3, 3)), np.empty((joints, 3)), np.empty((joints, 3)), np.empty((1, 3, 3))
    )


@compile_inner_kernel
def pose_tree(tree, reference, unknowns, pose):
    """Write the forward kinematics of the unknowns (D,); `reference` (3, 3) is the root's rotation for a zero vector."""
    x, y, z = unknowns[3], unknowns[4], unknowns[5]
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-8:
        s, c = 0.5 - angle2 / 24, 1 / 6 - angle2 / 120
    else:
        angle = math.sqrt(angle2)
        s, c = (1 - math.cos(angle)) / angle2, (angle - math.sin(angle)) / (angle2 * angle)
    rotation = multiply_matrices(load_matrix(reference, 0), compute_exponential(x, y, z))
    store_matrix(multiply_matrices(rotation, assemble_rotation(x, y, z, -s, c)), pose.root_turn, 0)  # the right Jacobian
    store_matrix(rotation, pose.rotations, 0)
    for a in range(3):
        pose.positions[0, a] = unknowns[a]
    for link in range(len(tree.parents)):
        if link > 0:
            p = tree.parents[link]
            above = load_matrix(pose.rotations, p)
            dx, dy, dz = multiply_vector(above, tree.positions[link, 0], tree.positions[link, 1], tree.positions[link, 2])
            px, py, pz = pose.positions[p, 0] + dx, pose.positions[p, 1] + dy, pose.positions[p, 2] + dz
            rotation = multiply_matrices(above, load_matrix(tree.rotations, link))
        else:
            px, py, pz = pose.positions[0, 0], pose.positions[0, 1], pose.positions[0, 2]
        for j in range(tree.first_joints[link], tree.first_joints[link + 1]):
            value = tree.offsets[j] + tree.factors[j] * unknowns[ROOT_UNKNOWNS + tree.unknowns[j]]
            ax, ay, az = tree.axes[j, 0], tree.axes[j, 1], tree.axes[j, 2]
            rx, ry, rz = tree.anchors[j, 0], tree.anchors[j, 1], tree.anchors[j, 2]
            wx, wy, wz = multiply_vector(rotation, ax, ay, az)
            dx, dy, dz = multiply_vector(rotation, rx, ry, rz)
            px, py, pz = px + dx, py + dy, pz + dz  # the anchor
            pose.axes[j, 0], pose.axes[j, 1], pose.axes[j, 2] = wx, wy, wz
            pose.anchors[j, 0], pose.anchors[j, 1], pose.anchors[j, 2] = px, py, pz
            if tree.is_slide[j]:
                px, py, pz = px + value * wx - dx, py + value * wy - dy, pz + value * wz - dz
            else:
                rotation = multiply_matrices(rotation, assemble_rotation(ax, ay, az, math.sin(value), 1.0 - math.cos(value)))
                dx, dy, dz = multiply_vector(rotation, rx, ry, rz)
                px, py, pz = px - dx, py - dy, pz - dz
        store_matrix(rotation, pose.rotations, link)
        pose.positions[link, 0], pose.positions[link, 1], pose.positions[link, 2] = px, py, pz


@compile_inner_kernel
def place_point(pose, link, offset):
    """Return where a point of a link is, in the world, in metres."""
    x, y, z = multiply_vector(load_matrix(pose.rotations, link), offset[0], offset[1], offset[2])
    return pose.positions[link, 0] + x, pose.positions[link, 1] + y, pose.positions[link, 2] + z


@compile_inner_kernel
def write_velocities(tree, pose, link, x, y, z, columns):
    """Write how the unknowns move the point (x, y, z) on a link. Returns the number of columns."""
    unknowns, velocities = columns.unknowns, columns.velocities
    px, py, pz = x - pose.positions[0, 0], y - pose.positions[0, 1], z - pose.positions[0, 2]
    for a in range(3):
        unknowns[a], unknowns[3 + a] = a, 3 + a
        velocities[a, 0], velocities[a, 1], velocities[a, 2] = 0.0, 0.0, 0.0
        velocities[a, a] = 1.0
        wx, wy, wz = pose.root_turn[0, 0, a], pose.root_turn[0, 1, a], pose.root_turn[0, 2, a]
        velocities[3 + a, 0] = wy * pz - wz * py
        velocities[3 + a, 1] = wz * px - wx * pz
        velocities[3 + a, 2] = wx * py - wy * px
    for k in range(tree.path_lengths[link]):
        j, n, factor = tree.paths[link, k], ROOT_UNKNOWNS + k, tree.factors[tree.paths[link, k]]
        unknowns[n] = ROOT_UNKNOWNS + tree.unknowns[j]
        wx, wy, wz = factor * pose.axes[j, 0], factor * pose.axes[j, 1], factor * pose.axes[j, 2]
        if tree.is_slide[j]:
            velocities[n, 0], velocities[n, 1], velocities[n, 2] = wx, wy, wz
        else:
            px, py, pz = x - pose.anchors[j, 0], y - pose.anchors[j, 1], z - pose.anchors[j, 2]
            velocities[n, 0] = wy * pz - wz * py
            velocities[n, 1] = wz * px - wx * pz
            velocities[n, 2] = wx * py - wy * px
    return ROOT_UNKNOWNS + tree.path_lengths[link]


@compile_inner_kernel(fastmath=MODEL_FASTMATH_FLAGS)
def add_point_rows(columns, first, count, weights, errors, curvature, gradient):
    """Add three rows with `weights` and `errors` (three numbers each) over the columns first..count - 1 to a frame's model.

    Only the lower triangle of the curvature (D, D) is written.
    """
    unknowns, velocities = columns.unknowns, columns.velocities
    for i in range(first, count):
        row = unknowns[i]
        a, b, c = weights[0] * velocities[i, 0], weights[1] * velocities[i, 1], weights[2] * velocities[i, 2]
        gradient[row] += a * errors[0] + b * errors[1] + c * errors[2]
        for k in range(first, i + 1):
            column = unknowns[k]
            product = a * velocities[k, 0] + b * velocities[k, 1] + c * velocities[k, 2]
            if column == row and k != i:  # two joints that follow one unknown
                product *= 2.0
            curvature[max(row, column), min(row, column)] += product


@compile_inner_kernel
def add_place_term(tree, pose, term, t, with_model, columns, curvature, gradient):
    """Add the places of points to a frame's model. Returns the cost."""
    cost = 0.0
    for k in range(len(term.links)):
        weights = term.weights[t, k, 0], term.weights[t, k, 1], term.weights[t, k, 2]
        if weights[0] == 0.0 and weights[1] == 0.0 and weights[2] == 0.0:
            continue
        x, y, z = place_point(pose, term.links[k], term.offsets[k])
        errors = x - term.places[t, k, 0], y - term.places[t, k, 1], z - term.places[t, k, 2]
        cost += 0.5 * (weights[0] * errors[0] ** 2 + weights[1] * errors[1] ** 2 + weights[2] * errors[2] ** 2)
        if with_model:
            count = write_velocities(tree, pose, term.links[k], x, y, z, columns)
            add_point_rows(columns, 0, count, weights, errors, curvature, gradient)
    return cost


@compile_inner_kernel
def add_floor_term(tree, pose, term, with_model, columns, curvature, gradient):
    """Add the points that are too low to a frame's model. Returns the cost."""
    cost = 0.0
    for k in range(len(term.links)):
        x, y, z = place_point(pose, term.links[k], term.offsets[k])
        error = z - term.heights[k]
        if error < 0.0:
            cost += 0.5 * term.weight * error * error
            if with_model:
                count = write_velocities(tree, pose, term.links[k], x, y, z, columns)
                add_point_rows(columns, 0, count, (0.0, 0.0, term.weight), (0.0, 0.0, error), curvature, gradient)
    return cost


@compile_inner_kernel
def add_line_term(tree, pose, term, t, with_model, columns, other, curvature, gradient):
    """Add the directions of lines to a frame's model: the root's position does not change them. Returns the cost."""
    cost, velocities = 0.0, columns.velocities
    for k in range(len(term.links)):
        weight = term.weights[t, k]
        if weight == 0.0:
            continue
        near, far = term.links[k, 0], term.links[k, 1]
        nx, ny, nz = place_point(pose, near, term.offsets[k, 0])
        fx, fy, fz = place_point(pose, far, term.offsets[k, 1])
        dx, dy, dz = fx - nx, fy - ny, fz - nz
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        dx, dy, dz = dx / length, dy / length, dz / length
        errors = dx - term.directions[t, k, 0], dy - term.directions[t, k, 1], dz - term.directions[t, k, 2]
        cost += 0.5 * weight * (errors[0] ** 2 + errors[1] ** 2 + errors[2] ** 2)
        if with_model:
            count = write_velocities(tree, pose, far, fx, fy, fz, columns)
            shared = write_velocities(tree, pose, near, nx, ny, nz, other)  # the path of `near` begins that of `far`
            for i in range(3, count):
                if i < shared:
                    for a in range(3):
                        velocities[i, a] -= other.velocities[i, a]
                along = velocities[i, 0] * dx + velocities[i, 1] * dy + velocities[i, 2] * dz
                velocities[i, 0] = (velocities[i, 0] - along * dx) / length
                velocities[i, 1] = (velocities[i, 1] - along * dy) / length
                velocities[i, 2] = (velocities[i, 2] - along * dz) / length
            add_point_rows(columns, 3, count, (weight, weight, weight), errors, curvature, gradient)
    return cost


@compile_inner_kernel
def add_link_rotation_term(tree, pose, term, t, with_model, columns, curvature, gradient):
    """Add the rotations of links to a frame's model, with the derivative of small errors. Returns the cost."""
    cost, unknowns, velocities = 0.0, columns.unknowns, columns.velocities
    for k in range(len(term.links)):
        weight, link = term.weights[t, k], term.links[k]
        if weight == 0.0:
            continue
        wanted = transpose_matrix(load_matrix(term.rotations[t], k))
        x, y, z, _ = compute_logarithm(multiply_matrices(load_matrix(pose.rotations, link), wanted))
        cost += 0.5 * weight * (x * x + y * y + z * z)
        if with_model:
            for a in range(3):
                unknowns[a] = 3 + a
                for c in range(3):
                    velocities[a, c] = pose.root_turn[0, c, a]
            count = 3
            for i in range(tree.path_lengths[link]):
                j = tree.paths[link, i]
                if not tree.is_slide[j]:
                    unknowns[count] = ROOT_UNKNOWNS + tree.unknowns[j]
                    for c in range(3):
                        velocities[count, c] = tree.factors[j] * pose.axes[j, c]
                    count += 1
            add_point_rows(columns, 0, count, (weight, weight, weight), (x, y, z), curvature, gradient)
    return cost


@compile_inner_kernel
def find_nearest_on_segments(p, q):
    """Return how far along two segments (2, 3) their nearest points are, from 0 to 1 (Ericson 2005, section 5.1.9)."""
    a, e, f, c, b = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        d1, d2, r = p[1, k] - p[0, k], q[1, k] - q[0, k], p[0, k] - q[0, k]
        a += d1 * d1
        e += d2 * d2
        f += d2 * r
        c += d1 * r
        b += d1 * d2
    if a < 1e-12 and e < 1e-12:
        return 0.0, 0.0
    if a < 1e-12:
        return 0.0, min(max(f / e, 0.0), 1.0)
    if e < 1e-12:
        return min(max(-c / a, 0.0), 1.0), 0.0
    scale = a * e - b * b
    s = min(max((b * f - c * e) / scale, 0.0), 1.0) if scale > 1e-9 * a * e else 0.5
    t = (b * s + f) / e
    if t < 0.0:
        return min(max(-c / a, 0.0), 1.0), 0.0
    if t > 1.0:
        return min(max((b - c) / a, 0.0), 1.0), 1.0
    return s, t


@compile_inner_kernel
def measure_box_distance(ends, share, halves):
    """Return the signed distance from a box about the origin to the point at `share` of a segment (2, 3), and its normal."""
    nearest, deepest, inside = 0, -math.inf, 0.0
    x = ends[0, 0] + share * (ends[1, 0] - ends[0, 0])
    y = ends[0, 1] + share * (ends[1, 1] - ends[0, 1])
    z = ends[0, 2] + share * (ends[1, 2] - ends[0, 2])
    beyond = abs(x) - halves[0], abs(y) - halves[1], abs(z) - halves[2]
    for k in range(3):
        if beyond[k] > deepest:
            nearest, deepest = k, beyond[k]
        inside += max(beyond[k], 0.0) ** 2
    sx, sy, sz = math.copysign(1.0, x), math.copysign(1.0, y), math.copysign(1.0, z)
    if deepest <= 0.0:
        return deepest, sx if nearest == 0 else 0.0, sy if nearest == 1 else 0.0, sz if nearest == 2 else 0.0
    distance = math.sqrt(inside)
    scale = 1.0 / distance
    return distance, scale * sx * max(beyond[0], 0.0), scale * sy * max(beyond[1], 0.0), scale * sz * max(beyond[2], 0.0)


@compile_inner_kernel
def find_nearest_to_box(ends, halves):
    """Return how far along a segment (2, 3), in the box's axes, it is nearest to the box: the distance is convex along it."""
    low, high = 0.0, 1.0
    first, second = 1.0 - GOLDEN_SECTION, GOLDEN_SECTION
    at_first, at_second = measure_box_distance(ends, first, halves)[0], measure_box_distance(ends, second, halves)[0]
    for _ in range(SEARCH_STEPS):
        if at_first < at_second:
            high, second, at_second = second, first, at_first
            first = high - GOLDEN_SECTION * (high - low)
            at_first = measure_box_distance(ends, first, halves)[0]
        else:
            low, first, at_first = first, second, at_second
            second = low + GOLDEN_SECTION * (high - low)
            at_second = measure_box_distance(ends, second, halves)[0]
    return 0.5 * (low + high)


@compile_inner_kernel
def add_contact(tree, pose, links, points, normal, weight, error, columns, other, dense, curvature, gradient):
    """Add the distance between points of two links along a normal, from the second to the first, to a frame's model."""
    count = write_velocities(tree, pose, links[0], points[0], points[1], points[2], columns)
    other_count = write_velocities(tree, pose, links[1], points[3], points[4], points[5], other)
    for i in range(ROOT_UNKNOWNS, count):
        v = columns.velocities[i]
        dense[columns.unknowns[i]] += v[0] * normal[0] + v[1] * normal[1] + v[2] * normal[2]
    for i in range(ROOT_UNKNOWNS, other_count):
        v = other.velocities[i]
        dense[other.unknowns[i]] -= v[0] * normal[0] + v[1] * normal[1] + v[2] * normal[2]
    count = 0  # the root moves both
    for i in range(ROOT_UNKNOWNS, len(dense)):
        if dense[i] != 0.0:
            columns.unknowns[count] = i
            columns.velocities[count, 0], columns.velocities[count, 1], columns.velocities[count, 2] = dense[i], 0.0, 0.0
            dense[i] = 0.0
            count += 1
    add_point_rows(columns, 0, count, (weight, 0.0, 0.0), (error, 0.0, 0.0), curvature, gradient)


@compile_inner_kernel
def add_collision_term(tree, pose, term, with_model, ends, box_ends, columns, other, dense, curvature, gradient):
    """Add the primitives that are too near to each other to a frame's model. Returns the cost."""
    cost = 0.0
    if len(term.pairs) + len(term.box_pairs) == 0:
        return cost
    for c in range(len(term.links)):
        for k in range(2):
            ends[c, k, 0], ends[c, k, 1], ends[c, k, 2] = place_point(pose, term.links[c], term.ends[c, k])
    for k in range(len(term.pairs)):
        c, d = term.pairs[k, 0], term.pairs[k, 1]
        p, q, reach = ends[c], ends[d], term.radii[c] + term.radii[d] + term.distance
        is_far = False
        for a in range(3):
            low, high = max(min(p[0, a], p[1, a]), min(q[0, a], q[1, a])), min(max(p[0, a], p[1, a]), max(q[0, a], q[1, a]))
            is_far = is_far or low - high > reach
        if is_far:
            continue
        s, u = find_nearest_on_segments(p, q)
        px, py, pz = p[0, 0] + s * (p[1, 0] - p[0, 0]), p[0, 1] + s * (p[1, 1] - p[0, 1]), p[0, 2] + s * (p[1, 2] - p[0, 2])
        qx, qy, qz = q[0, 0] + u * (q[1, 0] - q[0, 0]), q[0, 1] + u * (q[1, 1] - q[0, 1]), q[0, 2] + u * (q[1, 2] - q[0, 2])
        distance = math.sqrt((px - qx) ** 2 + (py - qy) ** 2 + (pz - qz) ** 2)
        error = distance - reach
        if error < 0.0 and distance > 0.0:
            cost += 0.5 * term.weight * error * error
            if with_model:
                normal = (px - qx) / distance, (py - qy) / distance, (pz - qz) / distance
                links, points = (term.links[c], term.links[d]), (px, py, pz, qx, qy, qz)
                add_contact(tree, pose, links, points, normal, term.weight, error, columns, other, dense, curvature, gradient)
    for k in range(len(term.box_pairs)):
        c, b = term.box_pairs[k, 0], term.box_pairs[k, 1]
        link, halves, reach = term.box_links[b], term.box_halves[b], term.radii[c] + term.distance
        turn = multiply_matrices(load_matrix(pose.rotations, link), load_matrix(term.box_rotations, b))
        cx, cy, cz = place_point(pose, link, term.box_centres[b])
        inverse = transpose_matrix(turn)
        for i in range(2):
            box_ends[i, 0], box_ends[i, 1], box_ends[i, 2] = multiply_vector(
                inverse, ends[c, i, 0] - cx, ends[c, i, 1] - cy, ends[c, i, 2] - cz
            )
        is_far = False
        for a in range(3):
            low, high = min(box_ends[0, a], box_ends[1, a]), max(box_ends[0, a], box_ends[1, a])
            is_far = is_far or low > halves[a] + reach or high < -halves[a] - reach
        if is_far:
            continue
        share = find_nearest_to_box(box_ends, halves)
        distance, nx, ny, nz = measure_box_distance(box_ends, share, halves)
        error = distance - reach
        if error < 0.0:
            cost += 0.5 * term.weight * error * error
            if with_model:
                normal = multiply_vector(turn, nx, ny, nz)
                p = ends[c]
                px, py = p[0, 0] + share * (p[1, 0] - p[0, 0]), p[0, 1] + share * (p[1, 1] - p[0, 1])
                pz = p[0, 2] + share * (p[1, 2] - p[0, 2])
                points = (px, py, pz, px - distance * normal[0], py - distance * normal[1], pz - distance * normal[2])
                links = (term.links[c], link)
                add_contact(tree, pose, links, points, normal, term.weight, error, columns, other, dense, curvature, gradient)
    return cost


@compile_inner_kernel
def add_balance_term(tree, pose, term, t, with_model, columns, other, curvature, gradient):
    """Add the centre of mass to a frame's model: all unknowns move it. Returns the cost."""
    weight, x, y = term.weights[t], 0.0, 0.0
    if weight == 0.0:
        return 0.0
    size, velocities = len(gradient), other.velocities
    for i in range(size):
        other.unknowns[i] = i
        velocities[i, 0], velocities[i, 1], velocities[i, 2] = 0.0, 0.0, 0.0
    for k in range(len(term.links)):
        share = term.shares[k]
        px, py, pz = place_point(pose, term.links[k], term.offsets[k])
        x, y = x + share * px, y + share * py
        for i in range(write_velocities(tree, pose, term.links[k], px, py, pz, columns) if with_model else 0):
            for a in range(2):
                velocities[columns.unknowns[i], a] += share * columns.velocities[i, a]
    errors = x - term.places[t, 0], y - term.places[t, 1], 0.0
    if with_model:
        add_point_rows(other, 0, size, (weight, weight, 0.0), errors, curvature, gradient)
    return 0.5 * weight * (errors[0] ** 2 + errors[1] ** 2)


@compile_kernel(nogil=True)
def linearise_hinged_frames(tree, terms, frames, references, unknowns, with_model, curvatures, gradients):
    """Write the models of some `frames` (F,) of T into `curvatures` (F, D, D), lower triangles, and `gradients` (F, D).

    Args:
        references: (T, 3, 3) rotations of the root for zero rotation vectors.
        unknowns: (T, D).
        with_model: Whether the models are written, otherwise only the cost is computed.

    Returns:
        The sum of the costs.
    """
    size, links = unknowns.shape[1], len(tree.parents)
    pose = allocate_tree_pose(links, len(tree.axes))
    columns = Columns(np.empty(size + links, np.int64), np.empty((size + links, 3)))
    other = Columns(np.empty(size + links, np.int64), np.empty((size + links, 3)))
    dense, ends, box_ends = np.zeros(size), np.empty((len(terms.collision.links), 2, 3)), np.empty((2, 3))
    cost = 0.0
    for i in range(len(frames)):
        t, h, g = frames[i], curvatures[i], gradients[i]
        if with_model:
            clear_array(h)
            clear_array(g)
        pose_tree(tree, references[t : t + 1], unknowns[t], pose)
        cost += add_place_term(tree, pose, terms.place, t, with_model, columns, h, g)
        cost += add_floor_term(tree, pose, terms.floor, with_model, columns, h, g)
        cost += add_line_term(tree, pose, terms.line, t, with_model, columns, other, h, g)
        cost += add_link_rotation_term(tree, pose, terms.rotation, t, with_model, columns, h, g)
        cost += add_collision_term(tree, pose, terms.collision, with_model, ends, box_ends, columns, other, dense, h, g)
        cost += add_balance_term(tree, pose, terms.balance, t, with_model, columns, other, h, g)
    return cost


@compile_kernel(nogil=True, fastmath=MODEL_FASTMATH_FLAGS)
def add_models_to_spline(frames, segments, weights, curvatures, gradients, factor, band, gradient):
    """Add the models of frames, times a factor, to that of the control points of a cubic spline.

    Args:
        frames: (F,) frames that the models are of.
        segments: (T,) index of the first of the four control points on which a frame depends.
        weights: (T, 4) by which it depends on them.
        curvatures: (F, D, D) lower triangles; gradients (F, D).
        band: (K D, width) curvature of the K control points: [column, row - column] for rows from the column on.
        gradient: (K D,).
    """
    size = gradients.shape[1]
    for i in range(len(frames)):
        t, h, g = frames[i], curvatures[i], gradients[i]
        first = segments[t] * size
        for a in range(4):
            weight = factor * weights[t, a]
            for r in range(size):
                gradient[first + a * size + r] += weight * g[r]
        for c in range(size):
            for b in range(4):
                column = band[first + b * size + c]
                weight = factor * weights[t, b] * weights[t, b]
                for r in range(c, size):
                    column[r - c] += weight * h[r, c]
                for a in range(b + 1, 4):
                    weight, start = factor * weights[t, a] * weights[t, b], (a - b) * size - c
                    for r in range(c):
                        column[start + r] += weight * h[c, r]
                    for r in range(c, size):
                        column[start + r] += weight * h[r, c]


@compile_kernel(nogil=True)
def place_points_of_frames(tree, references, unknowns, links, offsets, places, rotations):
    """Write where points are over T frames: `places` (T, P, 3) in metres, and the `rotations` (T, P, 3, 3) of their links."""
    pose = allocate_tree_pose(len(tree.parents), len(tree.axes))
    for t in range(len(unknowns)):
        pose_tree(tree, references[t : t + 1], unknowns[t], pose)
        for k in range(len(links)):
            places[t, k, 0], places[t, k, 1], places[t, k, 2] = place_point(pose, links[k], offsets[k])
            store_matrix(load_matrix(pose.rotations, links[k]), rotations[t], k)
