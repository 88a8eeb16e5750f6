"""`msdm_core.arithmetic` against numpy's functions, LAPACK and the values at the ends of each domain."""

import math

import numpy as np
import pytest

from msdm_core import arithmetic

RNG = np.random.default_rng(4)
# Ours are within 4 units in the last place, numpy's within 4 (its own statement for AVX-512).
ULPS = 8.0
WIDE = np.exp(RNG.uniform(-300.0, 300.0, 3000))
NEAR_ZERO = np.concatenate([RNG.uniform(-0.9, 5.0, 2000), 10.0 ** RNG.uniform(-20.0, 0.0, 2000)])
ARGUMENTS = {
    "exp": [RNG.uniform(-700.0, 700.0, 3000)],
    "expm1": [NEAR_ZERO],
    "log": [np.concatenate([WIDE, RNG.uniform(0.5, 2.0, 3000)])],
    "log1p": [NEAR_ZERO],
    "cbrt": [np.concatenate([WIDE, -WIDE])],
    "arctan2": list(RNG.normal(size=(2, 3000))),
    "arccos": [RNG.uniform(-1.0, 1.0, 3000)],
}


def ulps(values, expected):
    return float((np.abs(values - expected) / np.spacing(np.abs(expected))).max())


@pytest.mark.parametrize("name", ARGUMENTS)
def test_as_accurate_as_numpy(name):
    values = getattr(arithmetic, name)(*ARGUMENTS[name])
    assert ulps(values, getattr(np, name)(*ARGUMENTS[name])) <= ULPS


@pytest.mark.parametrize("name", ["sin", "cos"])
def test_circular_functions(name):
    """In absolute terms, as near a zero all digits come from the rest of whole quarters."""
    angle = np.concatenate([RNG.uniform(-10.0, 10.0, 3000), RNG.uniform(-8e5, 8e5, 3000)])
    assert np.abs(getattr(arithmetic, name)(angle) - getattr(np, name)(angle)).max() <= 3e-16


def test_power():
    """e^(y ln x) loses as many digits as y ln x has before the point."""
    base, exponent = RNG.uniform(0.01, 100.0, 3000), RNG.uniform(-3.0, 3.0, 3000)
    assert arithmetic.power(base, exponent) == pytest.approx(base**exponent, rel=5e-15)


@pytest.mark.parametrize(
    ("name", "arguments", "expected"),
    [
        ("exp", (-math.inf,), 0.0),
        ("exp", (-745.0,), 5e-324),
        ("exp", (0.0,), 1.0),
        ("log", (0.0,), -math.inf),
        ("log", (-1.0,), math.nan),
        ("log", (math.inf,), math.inf),
        ("log", (8.0,), 3.0 * math.log(2.0)),
        ("log1p", (-1.0,), -math.inf),
        ("log1p", (0.0,), 0.0),
        ("expm1", (-math.inf,), -1.0),
        ("expm1", (0.0,), 0.0),
        ("cbrt", (0.0,), 0.0),
        ("cbrt", (-27.0,), -3.0),
        ("cbrt", (math.inf,), math.inf),
        ("power", (0.0, 0.0), 1.0),
        ("power", (0.0, 2.0), 0.0),
        ("arctan2", (0.0, 0.0), 0.0),
        ("arctan2", (0.0, -1.0), math.pi),
        ("arctan2", (-0.0, -1.0), -math.pi),
        ("arctan2", (-2.0, 0.0), -0.5 * math.pi),
        ("arccos", (1.0,), 0.0),
        ("arccos", (-1.0,), math.pi),
        ("sin", (math.nan,), math.nan),
    ],
)
def test_ends_of_a_domain(name, arguments, expected):
    value = getattr(arithmetic, name)(*arguments)
    assert isinstance(value, float)
    assert value == pytest.approx(expected, rel=1e-15, abs=0.0, nan_ok=True)


@pytest.mark.parametrize(
    ("a", "b"),
    [
        ((3,), (3,)), ((3, 3), (3,)), ((3,), (3, 4)), ((7, 3), (3, 5)), ((6, 4, 3), (3,)), ((6, 4, 3), (6, 3, 2)),
        ((4, 3), (6, 3, 2)), ((3,), (6, 3, 2)), ((2, 40), (40,)), ((40,), (40, 3)), ((2, 0), (0, 3)), ((0, 3), (3,)),
    ],
)  # fmt: skip
def test_matmul_is_numpys(a, b):
    a, b = RNG.normal(size=a), RNG.normal(size=b)
    product = arithmetic.matmul(a, b)
    assert product.shape == (a @ b).shape
    assert product == pytest.approx(a @ b, abs=1e-13)


def test_matmul_takes_views_as_they_are():
    """The order of a sum does not depend on where the numbers lie."""
    a, b = RNG.normal(size=(5, 30)), RNG.normal(size=(30, 7))
    plain = arithmetic.matmul(a, b)
    assert np.array_equal(arithmetic.matmul(np.asfortranarray(a), np.asfortranarray(b)), plain)
    assert np.array_equal(arithmetic.matmul(np.repeat(a, 2, axis=1)[:, ::2], b), plain)


def test_solve():
    matrix, right = RNG.normal(size=(5, 9, 9)), RNG.normal(size=(5, 9, 2))
    kept = matrix.copy()
    assert arithmetic.solve(matrix, right) == pytest.approx(np.linalg.solve(matrix, right), rel=1e-9, abs=1e-12)
    assert arithmetic.solve(matrix[0], right[0, :, 0]) == pytest.approx(arithmetic.solve(matrix, right)[0, :, 0])
    assert np.array_equal(matrix, kept)


def test_solve_changes_rows_where_a_pivot_is_zero():
    assert arithmetic.solve([[0.0, 2.0], [4.0, 0.0]], [2.0, 8.0]).tolist() == [2.0, 1.0]


def test_solve_refuses_a_singular_matrix():
    with pytest.raises(ValueError, match="matrix 1 of 2 is singular"):
        arithmetic.solve([np.eye(2), np.ones((2, 2))], np.ones((2, 2, 1)))


@pytest.mark.parametrize("size", [1, 3, 12, 50])
def test_eigh(size):
    matrix = RNG.normal(size=(4, size, size))
    matrix = matrix + np.swapaxes(matrix, 1, 2)
    values, vectors = arithmetic.eigh(matrix)
    assert values == pytest.approx(np.linalg.eigvalsh(matrix), abs=1e-13 * size)
    assert matrix @ vectors == pytest.approx(vectors * values[:, None], abs=1e-13 * size)
    assert np.swapaxes(vectors, 1, 2) @ vectors == pytest.approx(np.broadcast_to(np.eye(size), matrix.shape), abs=1e-13)


def test_eigh_of_a_diagonal_and_a_rank_one_matrix():
    assert arithmetic.eigh(np.diag([3.0, 1.0, 2.0]))[0].tolist() == [1.0, 2.0, 3.0]
    assert arithmetic.eigh(np.ones((3, 3)))[0] == pytest.approx([0.0, 0.0, 3.0], abs=1e-15)


@pytest.mark.parametrize("shape", [(3, 7), (2, 6), (6, 3), (40, 8), (3, 3)])
def test_svd(shape):
    matrix = RNG.normal(size=shape)
    left, size, right = arithmetic.svd(matrix)
    assert size == pytest.approx(np.linalg.svd(matrix, compute_uv=False), rel=1e-13)
    assert left * size @ right == pytest.approx(matrix, abs=1e-14)
    assert left.T @ left == pytest.approx(np.eye(min(shape)), abs=1e-14)
    assert right @ right.T == pytest.approx(np.eye(min(shape)), abs=1e-14)


def test_svd_of_lower_rank():
    matrix = np.outer([1.0, 2.0, 2.0], [0.0, 3.0, 4.0, 0.0])
    left, size, right = arithmetic.svd(matrix)
    assert size == pytest.approx([15.0, 0.0, 0.0], abs=1e-14)
    assert left * size @ right == pytest.approx(matrix, abs=1e-14)


def test_lstsq():
    matrix, right = RNG.normal(size=(40, 6)), RNG.normal(size=40)
    assert arithmetic.lstsq(matrix, right) == pytest.approx(np.linalg.lstsq(matrix, right, rcond=None)[0], rel=1e-10)
    # Of all that fit, the shortest.
    assert arithmetic.lstsq([[1.0, 1.0], [2.0, 2.0]], [2.0, 4.0]) == pytest.approx([1.0, 1.0])
