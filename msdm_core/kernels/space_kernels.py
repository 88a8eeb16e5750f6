"""Algebra of vectors in space, as x, y and z: of numbers, or of registers with a number of each lane or item."""

import math

from numba import njit

from msdm_core.kernels.option_kernels import INLINED


@njit(**INLINED)
def row_of(values, row):
    """First three numbers of a row."""
    return values[row, 0], values[row, 1], values[row, 2]


@njit(**INLINED)
def part_of_row(values, row, first):
    """Three numbers of a row, from one column on."""
    return values[row, first], values[row, first + 1], values[row, first + 2]


@njit(**INLINED)
def set_row(values, row, first, vector):
    """Write what `part_of_row` reads."""
    values[row, first] = vector[0]
    values[row, first + 1] = vector[1]
    values[row, first + 2] = vector[2]


@njit(**INLINED)
def add_to_row(values, row, vector):
    """Add to what `row_of` reads."""
    values[row, 0] += vector[0]
    values[row, 1] += vector[1]
    values[row, 2] += vector[2]


@njit(**INLINED)
def take_from_row(values, row, first, vector):
    """Subtract from what `part_of_row` reads."""
    values[row, first] -= vector[0]
    values[row, first + 1] -= vector[1]
    values[row, first + 2] -= vector[2]


@njit(**INLINED)
def edge(position, a, b):
    """Vector from one node to another, of positions (n_node, 3) [m]."""
    return minus(row_of(position, b), row_of(position, a))


@njit(**INLINED)
def plus(a, b):
    """Sum a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@njit(**INLINED)
def minus(a, b):
    """Difference a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(**INLINED)
def opposite(a):
    """Vector -a, of the type of a."""
    return -a[0], -a[1], -a[2]


@njit(**INLINED)
def times(number, a):
    """Product of a number and a vector."""
    return number * a[0], number * a[1], number * a[2]


@njit(**INLINED)
def divided(a, number):
    """Quotient of a vector and a number."""
    return a[0] / number, a[1] / number, a[2] / number


@njit(**INLINED)
def shifted(place, multiple, direction):
    """Place plus a multiple of a direction."""
    return plus(place, times(multiple, direction))


@njit(**INLINED)
def scalar_product(a, b):
    """Scalar product a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(**INLINED)
def vector_product(a, b):
    """Vector product a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(**INLINED)
def length_of(a):
    """Length of a vector of numbers."""
    return math.sqrt(scalar_product(a, a))
