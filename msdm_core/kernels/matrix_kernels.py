"""Products and decompositions of dense matrices in a fixed order of operations, unlike BLAS and LAPACK."""

import numpy as np
from numba import njit

from msdm_core.kernels.option_kernels import INLINED, KERNEL

# Largest off-diagonal elements, as a share of the norm, and angles between rows that count as zero.
ZERO_SHARE = 1e-17
ANGLE_LEAST = 1e-15
# Jacobi's method converges quadratically, here in six to ten sweeps.
SWEEPS_MOST = 60


@njit(**KERNEL)
def multiply(a, b, product):
    """Fill `product` (n, m) with a b, for a (n, k) and b (k, m), summed in the order of k."""
    product[:, :] = 0.0
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            factor = a[i, k]
            for j in range(b.shape[1]):
                product[i, j] += factor * b[k, j]


@njit(**KERNEL)
def eliminate(matrices, right):
    """Solve A x = b for a stack of systems by Gauss elimination with partial pivoting, in place.

    In:      matrices A (s, n, n), destroyed
    In, out: right: b, then x (s, n, m)

    Returns:
        Index of the first singular matrix, else -1.
    """
    count, size, width = right.shape
    for system in range(count):
        a = matrices[system]
        x = right[system]
        for column in range(size):
            pivot = column
            for row in range(column + 1, size):
                if abs(a[row, column]) > abs(a[pivot, column]):
                    pivot = row
            if not abs(a[pivot, column]) > 0.0:
                return system
            if pivot != column:
                for k in range(size):
                    a[column, k], a[pivot, k] = a[pivot, k], a[column, k]
                for k in range(width):
                    x[column, k], x[pivot, k] = x[pivot, k], x[column, k]
            for row in range(column + 1, size):
                factor = a[row, column] / a[column, column]
                if factor != 0.0:
                    for k in range(column + 1, size):
                        a[row, k] -= factor * a[column, k]
                    for k in range(width):
                        x[row, k] -= factor * x[column, k]
        for row in range(size - 1, -1, -1):
            for column in range(row + 1, size):
                for k in range(width):
                    x[row, k] -= a[row, column] * x[column, k]
            for k in range(width):
                x[row, k] /= a[row, row]
    return -1


@njit(**INLINED)
def _rotation(first, second, between):
    """Cosine and sine of Jacobi's rotation, which makes [[first, between], [between, second]] diagonal."""
    tau = (second - first) / (2.0 * between)
    tangent = 1.0 / (abs(tau) + np.sqrt(1.0 + tau * tau))
    if tau < 0.0:
        tangent = -tangent
    cosine = 1.0 / np.sqrt(1.0 + tangent * tangent)
    return cosine, tangent * cosine


@njit(**INLINED)
def _rotate(rows, p, q, cosine, sine):
    """Rotate two rows of an array (m, n) in their plane."""
    for k in range(rows.shape[1]):
        first, second = rows[p, k], rows[q, k]
        rows[p, k] = cosine * first - sine * second
        rows[q, k] = sine * first + cosine * second


@njit(**KERNEL)
def diagonalise(matrices, vectors):
    """Make a stack of symmetric matrices diagonal by cyclic rotations (Jacobi 1846), in place.

    In, out: matrices (s, n, n), then their eigenvalues on the diagonal
    Out:     vectors: the eigenvectors as rows (s, n, n)
    """
    count, size = matrices.shape[0], matrices.shape[1]
    for system in range(count):
        a = matrices[system]
        v = vectors[system]
        norm = 0.0
        for i in range(size):
            for j in range(size):
                v[i, j] = 1.0 if i == j else 0.0
                norm += a[i, j] * a[i, j]
        least = ZERO_SHARE * np.sqrt(norm)
        for _ in range(SWEEPS_MOST):
            rotated = False
            for p in range(size - 1):
                for q in range(p + 1, size):
                    if not abs(a[p, q]) > least:
                        continue
                    rotated = True
                    cosine, sine = _rotation(a[p, p], a[q, q], a[p, q])
                    for k in range(size):
                        first, second = a[k, p], a[k, q]
                        a[k, p] = cosine * first - sine * second
                        a[k, q] = sine * first + cosine * second
                    _rotate(a, p, q, cosine, sine)
                    _rotate(v, p, q, cosine, sine)
            if not rotated:
                break


@njit(**KERNEL)
def orthogonalise(rows, turns):
    """Rotate pairs of rows until all are orthogonal, in place (Hestenes 1958, one-sided Jacobi).

    In, out: rows (m, n), then turns times rows
    Out:     turns: an orthogonal matrix (m, m)
    """
    count, width = rows.shape
    for i in range(count):
        for j in range(count):
            turns[i, j] = 1.0 if i == j else 0.0
    for _ in range(SWEEPS_MOST):
        rotated = False
        for p in range(count - 1):
            for q in range(p + 1, count):
                alpha = beta = gamma = 0.0
                for k in range(width):
                    alpha += rows[p, k] * rows[p, k]
                    beta += rows[q, k] * rows[q, k]
                    gamma += rows[p, k] * rows[q, k]
                if not abs(gamma) > ANGLE_LEAST * np.sqrt(alpha) * np.sqrt(beta):
                    continue
                rotated = True
                cosine, sine = _rotation(alpha, beta, gamma)
                _rotate(rows, p, q, cosine, sine)
                _rotate(turns, p, q, cosine, sine)
        if not rotated:
            break
