"""The closed-form part of learned inverse kinematics, compiled: a start pose is brought to given joint positions, bone by bone.

Down the tree, each joint keeps its start rotation relative to its parent and is then swung, by the smallest rotation, until its
bone points to the given position of the bone's end. Root and chest, from which several bones leave, are registered to several
joints. The network corrects what this leaves open: the twist of the bones, noise, and joints that are not given.

Before that, joint positions are smoothed over time: a Kalman filter and the smoother of Rauch, Tung and Striebel. Each coordinate
is an integrated random walk of its velocity, measured with a known standard deviation.
"""

import math
from typing import NamedTuple

import numpy as np

from mocapfix.kernels.compilation import compile_inner_kernel, compile_kernel
from mocapfix.kernels.forward_kinematics import FramePose, compute_forward_kinematics
from mocapfix.kernels.hybrik import compute_swing
from mocapfix.kernels.lie import compute_exponential, orthonormalise_rotation
from mocapfix.kernels.rigid_registration import accumulate_cross_covariance, compute_weighted_means, fit_rotation
from mocapfix.kernels.small_matrices import load_matrix, multiply_matrices, multiply_vector, store_matrix, transpose_matrix

FEATURES_PER_JOINT = 17  # see `_write_features`
START_ROTATION_WEIGHT = 1.0  # 1/rad^2: weight of the start rotation beside measured joints in a registration
CORRECTION_SD_COUNT = 3.0  # standard deviations by which the network may correct a direction that is measured
UNKNOWN_JOINT_SD_M = 0.05  # standard deviation per axis that is assumed of a joint without a given position
MAX_ROOT_SHIFT_M = 0.3  # the largest unit in which the network corrects the root position
SMALLEST_SD_M = 1e-4  # a smaller standard deviation counts as this


class TransferTree(NamedTuple):
    """A skeleton of J joints for the closed form.

    Joint 0 is the root. Of the C clouds, each is the joints by whose positions one joint is registered.
    """

    parents: np.ndarray  # (J,)
    offsets: np.ndarray  # (J, 3) metres, in the parent's axes
    bone_end: np.ndarray  # (J,) the child to which the joint's bone points, -1 for none
    cloud_start: np.ndarray  # (J + 1,) index of each joint's first entry in the arrays of clouds
    cloud_joint: np.ndarray  # (C,) joint
    cloud_variance: np.ndarray  # (C,) m^2 per axis, of the joint about its place in the registered joint's axes
    is_held: np.ndarray  # (J,) bool: joints that keep their start rotation


class TransferredPoses(NamedTuple):
    """The result of the closed form for T frames.

    A direction is 0 where it is not known. `authority` (T, J) scales the network's correction of what is measured.
    """

    root: np.ndarray  # (T, 3) metres
    position: np.ndarray  # (T, J, 3) metres
    rotation: np.ndarray  # (T, J, 3, 3) world
    direction: np.ndarray  # (T, J, 3) unit vectors from each joint to the given position of its bone's end
    authority: np.ndarray  # (T, J)
    root_unit: np.ndarray  # (T,) metres: unit of the network's correction of the root position


@compile_kernel(nogil=True)
def transfer_pose_frames(tree, start_root, start_local, target, sd, scale, out, features, first, stop):
    """Bring start poses to joint positions and write the network's inputs, in the frames first..stop - 1.

    Args:
        start_root, start_local: (T, 3) metres and (T, J, 3, 3).
        target: (T, J, 3) metres, NaN where not given.
        sd: (T, J) metres per axis.
        scale: Metres: the length by which positions are divided.
        features: (T, FEATURES_PER_JOINT J), single precision, out.
    """
    joints = len(tree.parents)
    no_shared, start_rotation, start_position = np.empty(0), np.empty((joints, 3, 3)), np.empty((joints, 3))
    inherited, weight = np.empty((joints, 3, 3)), np.empty(joints)
    model, measured, cloud_weight = np.empty((joints, 3)), np.empty((joints, 3)), np.empty(joints)
    cross, mean_points, mean_model = np.empty((3, 3)), np.empty(3), np.empty(3)
    symmetric, vectors, fitted = np.empty((4, 4)), np.empty((4, 4)), np.empty((3, 3))
    for t in range(first, stop):
        compute_forward_kinematics(tree, FramePose(start_root[t], start_local[t], no_shared, start_position, start_rotation))
        for j in range(joints):
            is_given = not math.isnan(target[t, j, 0] + target[t, j, 1] + target[t, j, 2])
            weight[j] = 1.0 / max(sd[t, j], SMALLEST_SD_M) ** 2 if is_given else 0.0
        for j in range(joints):
            p = tree.parents[j]
            if j == 0:
                store_matrix(load_matrix(start_rotation, 0), inherited, 0)
            else:
                parent_rotation = load_matrix(out.rotation[t], p)
                store_matrix(multiply_matrices(parent_rotation, load_matrix(start_local[t], j)), inherited, j)
                x, y, z = multiply_vector(parent_rotation, tree.offsets[j, 0], tree.offsets[j, 1], tree.offsets[j, 2])
                out.position[t, j, 0] = out.position[t, p, 0] + x
                out.position[t, j, 1] = out.position[t, p, 1] + y
                out.position[t, j, 2] = out.position[t, p, 2] + z
            out.authority[t, j] = 0.0 if tree.is_held[j] else 1.0
            for a in range(3):
                out.direction[t, j, a] = 0.0
            rotation = load_matrix(inherited, j)
            if tree.cloud_start[j + 1] > tree.cloud_start[j]:
                count, total = tree.cloud_start[j + 1] - tree.cloud_start[j], 0.0
                to_joint = transpose_matrix(load_matrix(start_rotation, j))
                for i in range(count):
                    k = tree.cloud_joint[tree.cloud_start[j] + i]
                    one, other = start_position[j], start_position[k]
                    x, y, z = multiply_vector(to_joint, other[0] - one[0], other[1] - one[1], other[2] - one[2])
                    model[i, 0], model[i, 1], model[i, 2] = x, y, z
                    variance = tree.cloud_variance[tree.cloud_start[j] + i]
                    cloud_weight[i] = 1.0 / (1.0 / weight[k] + variance) if weight[k] > 0.0 else 0.0
                    total += cloud_weight[i]
                    for a in range(3):
                        measured[i, a] = target[t, k, a]
                if j == 0:
                    compute_weighted_means(measured[:count], model[:count], cloud_weight[:count], mean_points, mean_model)
                else:
                    for a in range(3):
                        mean_points[a], mean_model[a] = out.position[t, j, a], 0.0
                if total > 0.0:
                    accumulate_cross_covariance(
                        measured[:count], model[:count], cloud_weight[:count], mean_points, mean_model, cross
                    )
                    information = START_ROTATION_WEIGHT
                    for i in range(count):
                        for a in range(3):
                            information += cloud_weight[i] * (model[i, a] - mean_model[a]) ** 2
                    for a in range(3):
                        for b in range(3):
                            cross[a, b] += START_ROTATION_WEIGHT * inherited[j, a, b]
                    rotation = fit_rotation(cross, symmetric, vectors, fitted)
                    out.authority[t, j] *= min(1.0, CORRECTION_SD_COUNT / math.sqrt(information))
                if j == 0:
                    x, y, z = multiply_vector(rotation, mean_model[0], mean_model[1], mean_model[2])
                    unit = CORRECTION_SD_COUNT / math.sqrt(total) if total > 0.0 else MAX_ROOT_SHIFT_M
                    out.root_unit[t] = min(MAX_ROOT_SHIFT_M, unit)
                    shift = x, y, z
                    for a in range(3):
                        out.root[t, a] = mean_points[a] - shift[a] if total > 0.0 else start_root[t, a]
                        out.position[t, 0, a] = out.root[t, a]
            elif tree.bone_end[j] >= 0 and weight[tree.bone_end[j]] > 0.0:
                end = tree.bone_end[j]
                goal, origin = target[t, end], out.position[t, j]
                x, y, z = goal[0] - origin[0], goal[1] - origin[1], goal[2] - origin[2]
                length = math.sqrt(x * x + y * y + z * z)
                if length > SMALLEST_SD_M:
                    direction = x / length, y / length, z / length
                    bone = tree.offsets[end, 0], tree.offsets[end, 1], tree.offsets[end, 2]
                    rotation = multiply_matrices(compute_swing(multiply_vector(rotation, *bone), direction), rotation)
                    variance = 1.0 / weight[end] + (1.0 / weight[j] if weight[j] > 0.0 else UNKNOWN_JOINT_SD_M**2)
                    bone_length = math.sqrt(bone[0] ** 2 + bone[1] ** 2 + bone[2] ** 2)
                    out.authority[t, j] *= min(1.0, CORRECTION_SD_COUNT * math.sqrt(variance) / bone_length)
                    for a in range(3):
                        out.direction[t, j, a] = direction[a]
            store_matrix(rotation, out.rotation[t], j)
        for j in range(joints):
            _write_features(tree, t, j, target, weight, scale, inherited, out, features)


@compile_inner_kernel
def _write_features(tree, t, j, target, weight, scale, inherited, out, features):
    """Write the inputs of one joint: all are in the body's own axes, so that they do not depend on its place and heading.

    - `0-2`: given position from the root, in the root's axes; 0 if not given
    - `3-8`: first two columns of the local rotation, less those of the identity; of the root 0
    - `9-11`: given position from that of the closed form, in the parent's axes; 0 if not given
    - `12-14`: sine and axis of the swing, in the joint's axes
    - `15-16`: whether the position is given; if so, the decimal logarithm of its standard deviation in millimetres
    """
    p, base = max(tree.parents[j], 0), FEATURES_PER_JOINT * j
    is_given = weight[j] > 0.0
    for i in range(3):
        features[t, base + i], features[t, base + 9 + i] = 0.0, 0.0
    if is_given:
        d = target[t, j, 0] - out.root[t, 0], target[t, j, 1] - out.root[t, 1], target[t, j, 2] - out.root[t, 2]
        x, y, z = multiply_vector(transpose_matrix(load_matrix(out.rotation[t], 0)), *d)
        features[t, base], features[t, base + 1], features[t, base + 2] = x / scale, y / scale, z / scale
        given, fitted = target[t, j], out.position[t, j]
        d = given[0] - fitted[0], given[1] - fitted[1], given[2] - fitted[2]
        x, y, z = multiply_vector(transpose_matrix(load_matrix(out.rotation[t], p)), *d)
        features[t, base + 9], features[t, base + 10], features[t, base + 11] = x / scale, y / scale, z / scale
    own = load_matrix(out.rotation[t], j)
    to_own = transpose_matrix(own)
    local = multiply_matrices(transpose_matrix(load_matrix(out.rotation[t], p)), own)  # the root: the identity
    features[t, base + 3], features[t, base + 4], features[t, base + 5] = local[0] - 1.0, local[3], local[6]
    features[t, base + 6], features[t, base + 7], features[t, base + 8] = local[1], local[4] - 1.0, local[7]
    change = multiply_matrices(to_own, load_matrix(inherited, j))
    features[t, base + 12] = 0.5 * (change[5] - change[7])
    features[t, base + 13] = 0.5 * (change[6] - change[2])
    features[t, base + 14] = 0.5 * (change[1] - change[3])
    features[t, base + 15] = 1.0 if is_given else 0.0
    features[t, base + 16] = -0.5 * math.log10(weight[j]) + 3.0 if is_given else 0.0


@compile_kernel(nogil=True)
def correct_pose_frames(tree, start_local, transferred, corrections, root, local, first, stop):
    """Write poses, the closed form corrected by the network, in the frames first..stop - 1.

    Args:
        corrections: (T, 3 J + 3) rotation vectors of the joints in their own axes, in radians, whose part across a measured bone
            is scaled by the authority; then the shift of the root, in its axes and in its unit.
        root, local: (T, 3) metres and (T, J, 3, 3), out.
    """
    joints = len(tree.parents)
    rotation = np.empty((joints, 3, 3))
    for t in range(first, stop):
        for j in range(joints):
            current = load_matrix(transferred.rotation[t], j)
            x, y, z = corrections[t, 3 * j], corrections[t, 3 * j + 1], corrections[t, 3 * j + 2]
            authority = transferred.authority[t, j]
            direction = transferred.direction[t, j, 0], transferred.direction[t, j, 1], transferred.direction[t, j, 2]
            end, along = tree.bone_end[j], 0.0
            bone = (0.0, 0.0, 0.0)
            has_direction = direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2 > 0.5
            is_cloud = tree.cloud_start[j + 1] > tree.cloud_start[j] and (j == 0 or authority < 1.0)
            if not is_cloud:
                parent_rotation = load_matrix(rotation, tree.parents[j])
                current = multiply_matrices(parent_rotation, load_matrix(start_local[t], j))
            if has_direction:
                bone = tree.offsets[end, 0], tree.offsets[end, 1], tree.offsets[end, 2]
                current = multiply_matrices(compute_swing(multiply_vector(current, *bone), direction), current)
                length = math.sqrt(bone[0] ** 2 + bone[1] ** 2 + bone[2] ** 2)
                bone = bone[0] / length, bone[1] / length, bone[2] / length
                along = (1.0 - authority) * (x * bone[0] + y * bone[1] + z * bone[2])
            if not tree.is_held[j]:
                x, y, z = authority * x + along * bone[0], authority * y + along * bone[1], authority * z + along * bone[2]
                current = multiply_matrices(current, compute_exponential(x, y, z))
            current = orthonormalise_rotation(current)  # errors of rounding would grow from frame to frame of a take
            store_matrix(current, rotation, j)
            if j == 0:
                store_matrix(current, local[t], 0)
            else:
                to_parent = transpose_matrix(load_matrix(rotation, tree.parents[j]))
                store_matrix(multiply_matrices(to_parent, current), local[t], j)
        shift = corrections[t, 3 * joints], corrections[t, 3 * joints + 1], corrections[t, 3 * joints + 2]
        x, y, z = multiply_vector(load_matrix(transferred.rotation[t], 0), shift[0], shift[1], shift[2])
        unit = transferred.root_unit[t]
        root[t, 0] = transferred.root[t, 0] + unit * x
        root[t, 1] = transferred.root[t, 1] + unit * y
        root[t, 2] = transferred.root[t, 2] + unit * z


START_VARIANCE_M2 = 1e4  # of a position before the first measurement
START_VELOCITY_VARIANCE = 1e2  # m^2/s^2, of a velocity before the first measurement


@compile_kernel(nogil=True)
def smooth_position_joints(positions, sd, walk_density, interval_s, smoothed, smoothed_sd, first, stop):
    """Write smoothed positions (T, J, 3) and standard deviations (T, J) of the joints first..stop - 1.

    Args:
        positions: (T, J, 3) metres, NaN where not given.
        sd: (T, J) metres per axis.
        walk_density: (J,) m^2/s^3: variance per second that a velocity gains.
    """
    frames = len(positions)
    mean, predicted_mean = np.empty((frames, 3, 2)), np.empty((frames, 3, 2))
    variance, predicted_variance = np.empty((frames, 3)), np.empty((frames, 3))  # of position, both, and velocity
    dt = interval_s
    for j in range(first, stop):
        q = walk_density[j]
        pp, pv, vv = START_VARIANCE_M2, 0.0, START_VELOCITY_VARIANCE
        for t in range(frames):
            if t > 0:
                pp, pv = pp + 2 * dt * pv + dt * dt * vv + q * dt**3 / 3, pv + dt * vv + q * dt * dt / 2
                vv += q * dt
            predicted_variance[t, 0], predicted_variance[t, 1], predicted_variance[t, 2] = pp, pv, vv
            is_given = not math.isnan(positions[t, j, 0])
            gain_p, gain_v = 0.0, 0.0
            if is_given:
                total = pp + sd[t, j] ** 2
                gain_p, gain_v = pp / total, pv / total
            for a in range(3):
                x = mean[t - 1, a, 0] + dt * mean[t - 1, a, 1] if t > 0 else 0.0
                v = mean[t - 1, a, 1] if t > 0 else 0.0
                predicted_mean[t, a, 0], predicted_mean[t, a, 1] = x, v
                if is_given:
                    rest = positions[t, j, a] - x
                    x += gain_p * rest
                    v += gain_v * rest
                mean[t, a, 0], mean[t, a, 1] = x, v
            pp, pv, vv = (1 - gain_p) * pp, (1 - gain_p) * pv, vv - gain_v * pv
            variance[t, 0], variance[t, 1], variance[t, 2] = pp, pv, vv
        for t in range(frames - 1, -1, -1):
            if t < frames - 1:
                fp, fpv, fv = variance[t, 0], variance[t, 1], variance[t, 2]
                np_, npv, nv = predicted_variance[t + 1, 0], predicted_variance[t + 1, 1], predicted_variance[t + 1, 2]
                det = np_ * nv - npv * npv
                c00, c01 = fp + dt * fpv, fpv  # covariance of this frame with the next
                c10, c11 = fpv + dt * fv, fv
                g00, g01 = (c00 * nv - c01 * npv) / det, (c01 * np_ - c00 * npv) / det
                g10, g11 = (c10 * nv - c11 * npv) / det, (c11 * np_ - c10 * npv) / det
                d0, d1, d2 = pp - np_, pv - npv, vv - nv
                pp = fp + g00 * (g00 * d0 + g01 * d1) + g01 * (g00 * d1 + g01 * d2)
                pv = fpv + g10 * (g00 * d0 + g01 * d1) + g11 * (g00 * d1 + g01 * d2)
                vv = fv + g10 * (g10 * d0 + g11 * d1) + g11 * (g10 * d1 + g11 * d2)
                for a in range(3):
                    x, v = mean[t + 1, a, 0] - predicted_mean[t + 1, a, 0], mean[t + 1, a, 1] - predicted_mean[t + 1, a, 1]
                    mean[t, a, 0] += g00 * x + g01 * v
                    mean[t, a, 1] += g10 * x + g11 * v
            smoothed_sd[t, j] = math.sqrt(max(pp, 0.0))
            for a in range(3):
                smoothed[t, j, a] = mean[t, a, 0]
