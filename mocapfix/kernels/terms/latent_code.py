"""Joint rotations decoded from a latent code, the code an unknown of the solve.

An autoencoder's code is a vector of P numbers that all joints share, as SCOPE's shape is: every residual depends on one joint and
the code, so the sweep stays exact and linear in the joints. A nonlinear decoder is given by its values and Jacobian at a code and
evaluated again between solves; a linear one is probabilistic principal components.
"""

from typing import NamedTuple

import numpy as np

from mocapfix.kernels.compilation import compile_inner_kernel, compile_kernel
from mocapfix.kernels.lie import compute_left_jacobian_inverse, compute_logarithm, compute_tilt
from mocapfix.kernels.small_matrices import load_matrix, multiply_matrices, multiply_rows, multiply_vector, transpose_matrix
from mocapfix.kernels.terms.contract import register_term, select_frame

MIN_CODE_STEP_SQUARED = 1e-8  # a smaller step of the code shows only the rounding error of a network, not its derivative


class LatentCodeTerm(NamedTuple):
    """Residuals: the rotation vector from the reference to each joint, in its parent's axes, minus the decoded one; and the code
    itself, in its own standard deviations.

    The root's rotation vector is that of its tilt, without its heading. The code is all of the shared unknowns; a tree of
    unknown shape cannot have one.
    """

    reference: np.ndarray  # (J, 3, 3) local rotations; the root's is ignored (identity)
    decoded: np.ndarray  # (D, J, 3) radians, at `code`
    jacobian: np.ndarray  # (D, J, 3, P) radians: the derivative of `decoded` to the code
    code: np.ndarray  # (D, P) where the decoder was linearised
    information: np.ndarray  # (J, 3, 3) 1 / rad^2, symmetric; zero for a joint that is not free or not decoded
    curvature: np.ndarray  # (D, P, P) 1 / squared deviations, symmetric, from `update_code_curvature`
    code_weight: np.ndarray  # (D,) weight that keeps the solved code near `code`, where the linearisation is valid
    linearisation: np.ndarray  # (1 or T,) index of each frame's linearisation among the D

    @classmethod
    def build(cls, reference, decoded, jacobian, code, information, code_weight, linearisation) -> "LatentCodeTerm":
        """Return the term with its curvature; arguments as its fields, in any memory layout."""
        size, arrays = code.shape[1], (reference, decoded, jacobian, code, information)
        reference, decoded, jacobian, code, information = (np.ascontiguousarray(each) for each in arrays)
        curvature = np.zeros((len(code), size, size))
        term = cls(reference, decoded, jacobian, code, information, curvature, code_weight, linearisation)
        update_code_curvature(term, np.arange(len(code)), size)
        return term


@compile_inner_kernel
def compute_deviation(term, tree, pose, j):
    """Return joint j's rotation vector from the reference, and its derivative to the joint's rotation in world axes."""
    if j == 0:
        x, z, jacobian = compute_tilt(load_matrix(pose.local, 0))
        return x, 0.0, z, multiply_matrices(jacobian, transpose_matrix(load_matrix(pose.local, 0)))
    error = multiply_matrices(load_matrix(pose.local, j), transpose_matrix(load_matrix(term.reference, j)))
    x, y, z, c = compute_logarithm(error)
    to_parent = transpose_matrix(load_matrix(pose.rotation, tree.parents[j]))
    return x, y, z, multiply_matrices(compute_left_jacobian_inverse(x, y, z, c), to_parent)


@register_term(LatentCodeTerm)
def add_latent_code_term(term, t, scale2, tree, pose, equations):
    """Add the coupling between each free joint's own rotation and the code. Returns the cost."""
    row = select_frame(term.linearisation, t)
    decoded, slopes, start = term.decoded[row], term.jacobian[row], term.code[row]
    cost, size = 0.0, len(start)
    h_joint_shared, g_shared, h_shared = equations.h_joint_shared, equations.g_shared, equations.h_shared
    for j in range(len(tree.parents)):
        information = load_matrix(term.information, j)
        if information[0] + information[4] + information[8] == 0.0:
            continue
        x, y, z, jacobian = compute_deviation(term, tree, pose, j)
        at_start, at_code = multiply_rows(slopes[j], start), multiply_rows(slopes[j], pose.shared)
        x += at_start[0] - decoded[j, 0] - at_code[0]
        y += at_start[1] - decoded[j, 1] - at_code[1]
        z += at_start[2] - decoded[j, 2] - at_code[2]
        px, py, pz = multiply_vector(information, x, y, z)
        cost += 0.5 * (px * x + py * y + pz * z)
        weighted = multiply_matrices(transpose_matrix(jacobian), information)
        curvature = multiply_matrices(weighted, jacobian)
        gx, gy, gz = multiply_vector(transpose_matrix(jacobian), px, py, pz)
        equations.g_joint[j, 0] += gx
        equations.g_joint[j, 1] += gy
        equations.g_joint[j, 2] += gz
        for a in range(3):
            for d in range(3):
                equations.h_joint[j, a, d] += curvature[3 * a + d]
        for a in range(3):
            h0, h1, h2 = weighted[3 * a], weighted[3 * a + 1], weighted[3 * a + 2]
            for p in range(size):
                h_joint_shared[j, a, p] -= h0 * slopes[j, 0, p] + h1 * slopes[j, 1, p] + h2 * slopes[j, 2, p]
        for p in range(size):
            g_shared[p] -= slopes[j, 0, p] * px + slopes[j, 1, p] * py + slopes[j, 2, p] * pz
    for p in range(size):
        code, step, weight = pose.shared[p], pose.shared[p] - start[p], term.code_weight[row]
        for q in range(p + 1):
            h_shared[p, q] += term.curvature[row, p, q]
        cost += 0.5 * (code * code + weight * step * step)
        g_shared[p] += code + weight * step
        h_shared[p, p] += 1.0 + weight
    return cost


@compile_kernel(nogil=True)
def update_code_curvature(term, rows, updated):
    """Write the curvature of the code in linearisations `rows`: the sum over joints of jacobian' information jacobian.

    Only the rows and columns of the code's first `updated` numbers are computed; the rest stays as it is.
    """
    for row in rows:
        curvature = term.curvature[row]
        curvature[:updated].fill(0)
        for j in range(len(term.information)):
            slopes, information = term.jacobian[row, j], load_matrix(term.information, j)
            for p in range(updated):  # along rows, that is in the upper triangle, which is fastest
                x, y, z = multiply_vector(information, slopes[0, p], slopes[1, p], slopes[2, p])
                for q in range(len(curvature)):
                    curvature[p, q] += x * slopes[0, q] + y * slopes[1, q] + z * slopes[2, q]
        curvature[updated:, :updated] = curvature[:updated, updated:].T


@compile_kernel(nogil=True)
def update_linearisations(term, rows, codes, decoded, updated):
    """Move linearisations `rows` to `codes` (B, P), whose decoded values are `decoded` (B, J, 3).

    The derivative to the code's first `updated` numbers gets the smallest change that makes it agree with the step (Broyden
    1965); the derivative to the others stays.
    """
    for i in range(len(rows)):
        row, code, value = rows[i], codes[i], decoded[i]
        old_value, step = term.decoded[row], code[:updated] - term.code[row, :updated]
        square = max((step**2).sum(), MIN_CODE_STEP_SQUARED)
        for j in range(len(old_value)):
            at_start, at_code = multiply_rows(term.jacobian[row, j], term.code[row]), multiply_rows(term.jacobian[row, j], code)
            for a in range(3):
                correction = (value[j, a] - old_value[j, a] - at_code[a] + at_start[a]) / square
                for p in range(updated):
                    term.jacobian[row, j, a, p] += correction * step[p]
        term.code[row], term.decoded[row] = code, value
    update_code_curvature(term, rows, updated)
