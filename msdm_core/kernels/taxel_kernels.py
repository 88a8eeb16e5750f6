"""Taxels: forces of the tissue on the cells of a rectangular patch of a contact shape."""

import math

from numba import njit

from msdm_core.kernels.contact_kernels import (
    QUADRATURE_BARYCENTRIC,
    QUADRATURE_COUNT,
    ROW_AREA,
    ROW_MORE,
    ROW_PRESSURE,
    ROW_STRETCH,
    end_of,
    slope_of,
)
from msdm_core.kernels.option_kernels import INLINED, INNER
from msdm_core.kernels.space_kernels import (
    add_to_row,
    minus,
    part_of_row,
    plus,
    row_of,
    scalar_product,
    shifted,
    times,
)


@njit(**INLINED)
def _cell_of(along, count):
    """Lower of two neighbouring cells around a coordinate in pitches from the patch's middle, and the upper's share."""
    step = min(max(along + 0.5 * (count - 1), 0.0), count - 1.0)
    low = min(math.floor(step), max(count - 2, 0))
    return low, step - low


@njit(**INLINED)
def spread_force(shapes, shape, place, force):
    """Add a force [N] at a place [m] to the taxels of a shape, by area.

    A square of one pitch around the place shares the force by its overlap with the cells (cloud in cell, Birdsall and
    Fuss 1969): weights (1 - s, s) on each axis, with sum 1 and the place as their mean. Beyond the outer cells' middles
    the nearest cells take all.

    Out: shapes: taxel_force, added to [N] (n_taxel, 3)
    """
    for patch in range(shapes.patch_layout.shape[0]):
        if shapes.patch_layout[patch, 0] != shape:
            continue
        rows, columns = shapes.patch_layout[patch, 1], shapes.patch_layout[patch, 2]
        frame, first = shapes.patch_frame[patch], shapes.patch_layout[patch, 3]
        away = minus(minus(place, end_of(shapes, shape, 0)), row_of(frame, 0))
        column, across = _cell_of(scalar_product(away, row_of(frame, 1)), columns)
        row, along = _cell_of(scalar_product(away, row_of(frame, 2)), rows)
        for i in range(min(2, rows)):
            for j in range(min(2, columns)):
                weight = (along if i else 1.0 - along) * (across if j else 1.0 - across)
                add_to_row(shapes.taxel_force, first + (row + i) * columns + column + j, times(weight, force))


@njit(**INNER)
def add_taxel_forces(state, shapes, law, row_count):
    """Forces of the contact points at the end of a substep, after `hold_contact`, on the taxels.

    In:  state: node_position [m] (n_node, 3), contact_rows, contact_places, row_count
    Out: shapes: taxel_force, added to [N] (n_taxel, 3)
    """
    position, rows, places = state.node_position, state.contact_rows, state.contact_places
    for number in range(row_count):
        point = places[number, 1] % QUADRATURE_COUNT
        place = times(QUADRATURE_BARYCENTRIC[point, 0], row_of(position, places[number, 2]))
        for corner in range(1, 3):
            corner_place = row_of(position, places[number, 2 + corner])
            place = shifted(place, QUADRATURE_BARYCENTRIC[point, corner], corner_place)
        stretch = plus(part_of_row(rows, number, ROW_STRETCH), part_of_row(rows, number, ROW_MORE + 1))
        force = times(rows[number, ROW_PRESSURE] + rows[number, ROW_MORE], slope_of(rows, number))
        force = shifted(force, law.tangential_stiffness, stretch)
        spread_force(shapes, places[number, 0], place, times(rows[number, ROW_AREA], force))
