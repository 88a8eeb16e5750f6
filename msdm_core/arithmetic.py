"""Elementary functions, products and decompositions with the same rounding on every processor.

IEEE 754 fixes the rounding of + - * / and of the square root. numpy's other functions choose their implementation by
processor (AVX-512 has its own `cbrt`, `exp`, `log`), BLAS and LAPACK choose the order of their sums by processor, and
the C library's functions differ by version. Episodes therefore depend on these functions alone: series and Newton
iterations of numpy's element-wise arithmetic, and sums in an order fixed by the source. All are accurate to a few units
in the last place.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msdm_core.kernels.matrix_kernels import diagonalise, eliminate, multiply, orthogonalise
from msdm_core.kernels.structure_kernels import FloatArray

__all__ = [
    "arccos",
    "arctan2",
    "cbrt",
    "cos",
    "dot",
    "eigh",
    "exp",
    "expm1",
    "log",
    "log1p",
    "lstsq",
    "matmul",
    "norm",
    "power",
    "sin",
    "solve",
    "svd",
]

# ln 2 and pi / 2 in parts; a small integer times any but the last part is exact.
LN2 = (0.693147180369123816490, 1.90821492927058770002e-10)
HALF_PI = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
# Angles up to this can be reduced with HALF_PI [rad].
ANGLE_MOST = 8e5
# arctan of 0, 1/2 and 1.
ARCTANS = np.array([0.0, 0.46364760900080611621, 0.78539816339744830962])
_EXP = [1.0 / math.factorial(k) for k in range(14)]
_SIN = [(-1.0) ** k / math.factorial(2 * k + 1) for k in range(9)]
_COS = [(-1.0) ** k / math.factorial(2 * k) for k in range(9)]
_ARTANH = [1.0 / (2 * k + 1) for k in range(12)]
_ARCTAN = [(-1.0) ** k / (2 * k + 1) for k in range(14)]


# ---- elementary functions --------------------------------------------------------------------------------------------


def exp(x: ArrayLike) -> FloatArray:
    """Exponential of each number: e^x = 2^k e^r with |r| <= ln 2 / 2 and Taylor's series of e^r."""
    x = np.asarray(x, dtype=np.float64)
    # Beyond these limits the result is infinite or 0.
    x = np.clip(x, -800.0, 800.0)
    count = np.rint(x * (1.0 / LN2[0]))
    remainder = (x - count * LN2[0]) - count * LN2[1]
    return np.ldexp(_series(_EXP, remainder), _integer(count))


def log(x: ArrayLike) -> FloatArray:
    """Natural logarithm of each number: x = 2^k m, ln m = 2 artanh((m - 1) / (m + 1)) as a series.

    0 gives -inf and a number below 0 gives nan, as in numpy.
    """
    x = np.asarray(x, dtype=np.float64)
    regular = (x > 0.0) & (x < math.inf)
    mantissa, exponent = np.frexp(np.where(regular, x, 1.0))
    low = mantissa < math.sqrt(0.5)
    mantissa, count = np.where(low, 2.0 * mantissa, mantissa), exponent - low
    ratio = (mantissa - 1.0) / (mantissa + 1.0)
    value = count * LN2[0] + (2.0 * ratio * _series(_ARTANH, ratio * ratio) + count * LN2[1])
    return np.where(regular, value, np.where(x == 0.0, -math.inf, np.where(x > 0.0, x, math.nan)))[()]


def log1p(x: ArrayLike) -> FloatArray:
    """ln(1 + x) of each number, accurate near 0 (Kahan's correction of the rounding of 1 + x)."""
    x = np.asarray(x, dtype=np.float64)
    total = 1.0 + x
    change = total - 1.0
    return np.where(change == 0.0, x, log(total) * (x / np.where(change == 0.0, 1.0, change)))[()]


def expm1(x: ArrayLike) -> FloatArray:
    """e^x - 1 of each number, accurate near 0 (Kahan's correction of the rounding of e^x)."""
    x = np.asarray(x, dtype=np.float64)
    power = exp(x)
    regular = (power != 1.0) & (power > 0.0) & (power < math.inf)
    logarithm = log(np.where(regular, power, 2.0))
    return np.where(regular, (power - 1.0) * (x / logarithm), np.where(power == 1.0, x, power - 1.0))[()]


def power(x: ArrayLike, exponent: ArrayLike) -> FloatArray:
    """x^exponent of numbers from 0 on, as e^(exponent ln x); a number below 0 gives nan."""
    exponent = np.asarray(exponent, dtype=np.float64)
    return exp(np.where(exponent == 0.0, 0.0, exponent * log(np.where(exponent == 0.0, 1.0, x))))


def cbrt(x: ArrayLike) -> FloatArray:
    """Cube root of each number, by Newton's method from the exponent's third."""
    x = np.asarray(x, dtype=np.float64)
    regular = np.isfinite(x) & (x != 0.0)
    mantissa, exponent = np.frexp(np.where(regular, np.abs(x), 1.0))
    third = -(-exponent // 3)
    scaled = np.ldexp(mantissa, exponent - 3 * third)  # in [1/8, 1)
    root = 0.45 + 0.6 * scaled
    for _ in range(6):
        root = root - (root - scaled / (root * root)) / 3.0
    return np.where(regular, np.copysign(np.ldexp(root, third), x), x)[()]


def sin(angle: ArrayLike) -> FloatArray:
    """Sine of each angle [rad].

    Raises:
        ValueError: an angle beyond ANGLE_MOST; names it.
    """
    return _circular(angle, 0)


def cos(angle: ArrayLike) -> FloatArray:
    """Cosine of each angle [rad].

    Raises:
        ValueError: an angle beyond ANGLE_MOST; names it.
    """
    return _circular(angle, 1)


def _circular(angle: ArrayLike, quarter: int) -> FloatArray:
    """sin(angle + quarter pi / 2), by Taylor's series of the remainder of whole quarters."""
    angle = np.asarray(angle, dtype=np.float64)
    if np.any(np.abs(angle) > ANGLE_MOST):
        raise ValueError(
            f"angle is {np.abs(angle).max():g} rad; it must be at most {ANGLE_MOST:g} rad: subtract multiples of 2 pi"
        )
    count = np.rint(angle * (2.0 / math.pi))
    remainder = ((angle - count * HALF_PI[0]) - count * HALF_PI[1]) - count * HALF_PI[2]
    square = remainder * remainder
    turn = (_integer(count) + quarter) % 4
    value = np.where(turn % 2 == 0, remainder * _series(_SIN, square), _series(_COS, square))
    return np.where(turn < 2, value, -value)[()]


def arctan2(y: ArrayLike, x: ArrayLike) -> FloatArray:
    """Angle of each point (x, y) from the x axis, in [-pi, pi] [rad]; 0 for the origin."""
    y, x = np.asarray(y, dtype=np.float64), np.asarray(x, dtype=np.float64)
    small, large = np.minimum(np.abs(y), np.abs(x)), np.maximum(np.abs(y), np.abs(x))
    ratio = small / np.where(large == 0.0, 1.0, large)
    # arctan r = arctan c + arctan((r - c) / (1 + r c)) with c the nearest of 0, 1/2 and 1.
    step = _integer(np.rint(2.0 * ratio))
    near = 0.5 * step
    offset = (ratio - near) / (1.0 + ratio * near)
    angle = ARCTANS[step] + offset * _series(_ARCTAN, offset * offset)
    angle = np.where(np.abs(y) > np.abs(x), 0.5 * math.pi - angle, angle)
    return np.copysign(np.where(x < 0.0, math.pi - angle, angle), y)


def arccos(cosine: ArrayLike) -> FloatArray:
    """Angle in [0, pi] of each cosine [rad]."""
    cosine = np.asarray(cosine, dtype=np.float64)
    return 2.0 * arctan2(np.sqrt(1.0 - cosine), np.sqrt(1.0 + cosine))


def _series(coefficients: list[float], x: FloatArray) -> FloatArray:
    """Polynomial by Horner's rule, the constant first."""
    value = np.full_like(x, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        value = value * x + coefficient
    return value


def _integer(count: FloatArray) -> NDArray[np.int64]:
    """Whole numbers as integers, nan as 0 (their results are nan anyway)."""
    return np.where(np.isfinite(count), count, 0.0).astype(np.int64)


# ---- products --------------------------------------------------------------------------------------------------------


def dot(a: ArrayLike, b: ArrayLike) -> FloatArray:
    """Scalar products of the vectors along the last axis of a and b."""
    return np.add.reduce(np.multiply(a, b), axis=-1)


def norm(vectors: ArrayLike, axis: int | tuple[int, ...] | None = None, keepdims: bool = False) -> FloatArray:
    """Euclidean norm along an axis, by default of all numbers."""
    vectors = np.asarray(vectors, dtype=np.float64)
    return np.sqrt(np.add.reduce(vectors * vectors, axis=axis, keepdims=keepdims))


def matmul(a: ArrayLike, b: ArrayLike) -> FloatArray:
    """Matrix product a @ b, summed in the order of the common axis; a (..., n, k) or (k,), b (..., k, m) or (k,).

    Raises:
        ValueError: common axes of two lengths.
    """
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if a.ndim == 1 and b.ndim == 1:
        return dot(a, b)
    count = a.shape[-1]
    if count != b.shape[-2 if b.ndim > 1 else 0]:
        raise ValueError(f"shapes {a.shape} and {b.shape}: the last axis of a must be as long as b's last but one")
    left = a[None] if a.ndim == 1 else a
    right = b[:, None] if b.ndim == 1 else b
    if right.ndim == 2:
        rows = np.ascontiguousarray(left).reshape(math.prod(left.shape[:-1]), count)
        total = np.empty((len(rows), right.shape[1]))
        multiply(rows, np.ascontiguousarray(right), total)
        total = total.reshape(*left.shape[:-1], right.shape[1])
    else:
        total = np.zeros(np.broadcast_shapes((*left.shape[:-1], 1), (*right.shape[:-2], 1, right.shape[-1])))
        for k in range(count):
            total += left[..., :, k, None] * right[..., None, k, :]
    if a.ndim == 1:
        return total[..., 0, :]
    return total[..., 0] if b.ndim == 1 else total


# ---- decompositions --------------------------------------------------------------------------------------------------


def solve(matrices: ArrayLike, right: ArrayLike) -> FloatArray:
    """Solution x of A x = b, by Gauss elimination with partial pivoting.

    Args:
        matrices: A (..., n, n).
        right: b (..., n, m), or (n,) with a single matrix.

    Raises:
        ValueError: a singular matrix.
    """
    a, b = np.array(matrices, dtype=np.float64, order="C"), np.array(right, dtype=np.float64, order="C")
    size = a.shape[-1]
    solution = b.reshape(-1, size, 1) if b.ndim == 1 else b.reshape(-1, *b.shape[-2:])
    singular = eliminate(a.reshape(-1, size, size), solution)
    if singular >= 0:
        raise ValueError(f"matrix {singular} of {a.size // size**2} is singular")
    return solution.reshape(b.shape)


def eigh(matrices: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues of symmetric matrices (..., n, n) in ascending order (..., n), and eigenvectors as columns."""
    a = np.array(matrices, dtype=np.float64, order="C")
    size = a.shape[-1]
    flat = a.reshape(-1, size, size)
    vectors = np.empty_like(flat)
    diagonalise(flat, vectors)
    values = np.diagonal(flat, axis1=1, axis2=2)
    order = np.argsort(values, axis=1, kind="stable")
    values = np.take_along_axis(values, order, axis=1)
    vectors = np.take_along_axis(np.swapaxes(vectors, 1, 2), order[:, None], axis=2)
    return values.reshape(a.shape[:-1]), vectors.reshape(a.shape)


def svd(matrix: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Singular value decomposition A = U diag(s) V of a matrix (m, n).

    U is (m, k), s (k,) descending, V (k, n), with k = min(m, n). Vectors of vanishing singular values are 0 on the
    longer side.
    """
    a = np.array(matrix, dtype=np.float64, order="C")
    if a.shape[0] > a.shape[1]:
        left, size, right = svd(a.T)
        return right.T, size, left.T
    turns = np.empty((len(a), len(a)))
    orthogonalise(a, turns)
    size = norm(a, axis=1)
    order = np.argsort(-size, kind="stable")
    right = a / np.where(size > 0.0, size, 1.0)[:, None]
    return turns[order].T, size[order], right[order]


def lstsq(matrix: ArrayLike, right: ArrayLike) -> FloatArray:
    """Least-squares solution x (n,) of A x = b, A (m, n), b (m,); of least |x| if A has not full rank."""
    left, size, across = svd(matrix)
    least = np.finfo(np.float64).eps * max(np.shape(matrix)) * size.max(initial=0.0)
    kept = size > least
    return matmul((matmul(right, left[:, kept]) / size[kept]), across[kept])
