"""A sparse convex quadratic with a lower bound on every unknown, minimised by projected Newton steps; repeatable."""

import numpy as np
from scipy.sparse import csr_array

from msdm_core.errors import OrganError
from msdm_core.mesh import FloatArray

ROUNDS = 60
TOLERANCE = 1e-6


def minimise_bounded(matrix: csr_array, right: FloatArray, start: FloatArray, lower: float) -> FloatArray:
    """The x >= lower that minimises x . H x / 2 - c . x, for a symmetric positive definite H, shape (n,).

    Unknowns at the bound that the gradient holds there are set aside; the rest take the Newton step, found by
    conjugate gradients, bent at the bound and halved until the sum falls enough (Bertsekas 1982). It ends where no
    free unknown would move by more than TOLERANCE on its own, |g_i| / H_ii.

    Args:
        matrix: H, (n, n).
        right: c, (n,).
        start: where to begin, at least `lower`, (n,).
        lower: the bound.

    Raises:
        OrganError: it does not converge; names what is left.
    """
    diagonal, found = np.asarray(matrix.diagonal(), dtype=np.float64), start
    left = np.inf
    for turn in range(ROUNDS):
        gradient = matrix @ found - right
        free = np.flatnonzero((found > lower) | (gradient < 0.0))
        left = float(np.abs(gradient[free] / diagonal[free]).max(initial=0.0))
        if left <= TOLERANCE:
            return found
        accuracy = 1e-3 if turn < 3 else 1e-6
        step = np.zeros_like(found)
        step[free] = _conjugate_gradients(matrix[free][:, free], -gradient[free], diagonal[free], accuracy)
        found = _descend(matrix, found, gradient, step, lower)
    raise OrganError(
        f"fitting springs to this mesh did not converge in {ROUNDS} rounds (largest step left {left:.2g}, the rule is "
        f'at most {TOLERANCE:g}): use stiffness_rule="lloyd", or remesh'
    )


def _descend(matrix: csr_array, found: FloatArray, gradient: FloatArray, step: FloatArray, lower: float) -> FloatArray:
    """Go along a step bent at the bound; the sum changes by g . d + d . H d / 2 for a change d."""
    length = 1.0
    for _ in range(40):
        moved = np.maximum(found + length * step, lower)
        change = moved - found
        slope = dot(gradient, change)
        if slope + 0.5 * dot(change, matrix @ change) <= 1e-4 * slope:
            return moved
        length *= 0.5
    return found


def _conjugate_gradients(matrix: csr_array, right: FloatArray, diagonal: FloatArray, accuracy: float) -> FloatArray:
    """Solve M x = b for a symmetric positive M with Jacobi's preconditioner, to a relative accuracy."""
    solution, residual = np.zeros_like(right), right.copy()
    scaled = residual / diagonal
    direction = scaled.copy()
    power = start = dot(residual, scaled)
    for _ in range(1000):
        if power <= accuracy * accuracy * start:
            break
        product = matrix @ direction
        length = power / dot(direction, product)
        solution += length * direction
        residual -= length * product
        scaled = residual / diagonal
        power, before = dot(residual, scaled), power
        direction = scaled + (power / before) * direction
    return solution


def dot(left: FloatArray, right: FloatArray) -> float:
    """A sum whose order does not depend on the number of threads, as BLAS's may."""
    return float((left * right).sum())
