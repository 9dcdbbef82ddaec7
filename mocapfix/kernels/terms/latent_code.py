"""Joint rotations that a decoder makes of a latent code, the code an unknown of the solve.

An autoencoder's code is a number or P that all joints share, as SCOPE's shape is: every residual touches one joint and
the code, so the sweep stays exact and linear in the joints. A decoder that is not linear is handed in as its values and
Jacobian at a code and asked again between solves; a linear one is probabilistic principal components.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.kernels.lie import compute_left_jacobian_inverse, compute_logarithm, compute_tilt
from mocapfix.kernels.small_matrices import load_matrix, multiply_matrices, multiply_rows, multiply_vector, transpose_matrix
from mocapfix.kernels.terms.contract import register_term, select_frame

MIN_CODE_STEP_SQUARED = 1e-8  # square of a step of the code from which nothing is learned but a network's rounding


class LatentCodeTerm(NamedTuple):
    """Residuals: the rotation vector from the middle to each joint, in its parent's axes, less what the decoder says; and the
    code itself, in its own standard deviations.

    The root's is its tilt, whatever it is heading for. The code is all of the shared unknowns; a tree whose shape is unknown
    too cannot have one.
    """

    reference: np.ndarray  # (J, 3, 3) rotations; the root's counts as the identity
    decoded: np.ndarray  # (D, J, 3) radians, at the code `at`
    jacobian: np.ndarray  # (D, J, 3, P) radians: how that changes with the code
    code: np.ndarray  # (D, P)
    information: np.ndarray  # (J, 3, 3) 1 / rad^2, symmetric; zero for a joint that is not free or the decoder does not know
    curvature: np.ndarray  # (D, P, P) 1 / squared deviations, symmetric: what `curve` writes
    code_weight: (
        np.ndarray
    )  # (D,) how strongly the code is held `at` where the decoder was asked, for only near there it is right
    linearisation: np.ndarray  # (1 or T,) which of the D linearisations is the frame's

    @classmethod
    def build(cls, reference, decoded, jacobian, code, information, code_weight, linearisation) -> "LatentCodeTerm":
        """-> the term with its curvature; arguments as its fields, laid out in memory in any way."""
        size, given = code.shape[1], (reference, decoded, jacobian, code, information)
        reference, decoded, jacobian, code, information = (np.ascontiguousarray(each) for each in given)
        term = cls(reference, decoded, jacobian, code, information, np.zeros((len(code), size, size)), code_weight, linearisation)
        update_code_curvature(term, np.arange(len(code)), size)
        return term


@njit(cache=True)
def compute_deviation(term, tree, pose, j):
    """-> joint j's rotation vector from the middle, and the matrix of its derivative to the joint's turn in world axes."""
    if j == 0:
        x, z, slopes = compute_tilt(load_matrix(pose.local, 0))
        return x, 0.0, z, multiply_matrices(slopes, transpose_matrix(load_matrix(pose.local, 0)))
    x, y, z, c = compute_logarithm(
        multiply_matrices(load_matrix(pose.local, j), transpose_matrix(load_matrix(term.reference, j)))
    )
    back = transpose_matrix(load_matrix(pose.rotation, tree.parents[j]))
    return x, y, z, multiply_matrices(compute_left_jacobian_inverse(x, y, z, c), back)


@register_term(LatentCodeTerm)
def add_latent_code_term(term, t, scale2, tree, pose, system):
    """Add the pull between each free joint's own turn and the code. -> cost"""
    row = select_frame(term.linearisation, t)
    decoded, slopes, at = term.decoded[row], term.jacobian[row], term.at[row]
    cost, size = 0.0, len(at)
    for j in range(len(tree.parents)):
        information = load_matrix(term.information, j)
        if information[0] + information[4] + information[8] == 0.0:
            continue
        x, y, z, through = compute_deviation(term, tree, pose, j)
        begun, come = multiply_rows(slopes[j], at), multiply_rows(slopes[j], pose.shared)
        x += begun[0] - decoded[j, 0] - come[0]
        y += begun[1] - decoded[j, 1] - come[1]
        z += begun[2] - decoded[j, 2] - come[2]
        px, py, pz = multiply_vector(information, x, y, z)
        cost += 0.5 * (px * x + py * y + pz * z)
        held = multiply_matrices(transpose_matrix(through), information)
        curvature, (bx, by, bz) = multiply_matrices(held, through), multiply_vector(transpose_matrix(through), px, py, pz)
        system.b[j, 0] += bx
        system.b[j, 1] += by
        system.b[j, 2] += bz
        for a in range(3):
            for d in range(3):
                system.own[j, a, d] += curvature[3 * a + d]
        for a in range(3):
            h0, h1, h2 = held[3 * a], held[3 * a + 1], held[3 * a + 2]
            for p in range(size):
                system.own_cross[j, a, p] -= h0 * slopes[j, 0, p] + h1 * slopes[j, 1, p] + h2 * slopes[j, 2, p]
        for p in range(size):
            system.g_shared[p] -= slopes[j, 0, p] * px + slopes[j, 1, p] * py + slopes[j, 2, p] * pz
    for p in range(size):
        code, step, hold = pose.shared[p], pose.shared[p] - at[p], term.code_weight[row]
        for q in range(p + 1):
            system.shared[p, q] += term.curvature[row, p, q]
        cost += 0.5 * (code * code + hold * step * step)
        system.g_shared[p] += code + hold * step
        system.shared[p, p] += 1.0 + hold
    return cost


@njit(cache=True, nogil=True)
def update_code_curvature(term, rows, bent):
    """Write the curvature that linearisations `rows` give the code, the sum over joints of slopes' information slopes: of the
    first `bent` numbers, with all others; the rest stays as it is.
    """
    for row in rows:
        curvature = term.curvature[row]
        curvature[:bent].fill(0)
        for j in range(len(term.information)):
            slopes, information = term.jacobian[row, j], load_matrix(term.information, j)
            for p in range(bent):  # along rows, that is in the upper triangle, the fastest
                x, y, z = multiply_vector(information, slopes[0, p], slopes[1, p], slopes[2, p])
                for q in range(len(curvature)):
                    curvature[p, q] += x * slopes[0, q] + y * slopes[1, q] + z * slopes[2, q]
        curvature[bent:, :bent] = curvature[:bent, bent:].T


@njit(cache=True, nogil=True)
def update_linearisations(term, rows, at, decoded, bent):
    """Move linearisations `rows` to codes `at` (B, P), which are known to mean `decoded` (B, J, 3).

    The derivative to the first `bent` numbers changes by the least that makes it agree with the step there (Broyden 1965); the
    others' is as it was.
    """
    for i in range(len(rows)):
        row, there, means = rows[i], at[i], decoded[i]
        said, step = term.decoded[row], there[:bent] - term.at[row, :bent]
        square = max((step**2).sum(), MIN_CODE_STEP_SQUARED)
        for j in range(len(said)):
            begun, come = multiply_rows(term.jacobian[row, j], term.at[row]), multiply_rows(term.jacobian[row, j], there)
            for a in range(3):
                missed = (means[j, a] - said[j, a] - come[a] + begun[a]) / square
                for p in range(bent):
                    term.jacobian[row, j, a, p] += missed * step[p]
        term.at[row], term.decoded[row] = there, means
    update_code_curvature(term, rows, bent)
