"""Load of the tissue: contact pressure, deformation gradients, virials, principal values.

Values at single quadrature points and tets depend on the mesh: a ball rests on the nodes below it first. At a cell /
contact radius of 0.6 averages at nodes are within 11 % of axisymmetric finite elements, values at points and tets up to
50 % too large.
"""

import math

from numba import njit

from msdm_core.kernels.contact_kernels import (
    QUADRATURE_BARYCENTRIC,
    QUADRATURE_COUNT,
    QUADRATURE_WEIGHT,
    closest_on_core,
    rise_of,
    risen,
)
from msdm_core.kernels.element_kernels import tet_shape
from msdm_core.kernels.option_kernels import INLINED, KERNEL
from msdm_core.kernels.space_kernels import (
    add_to_row,
    divided,
    edge,
    length_of,
    minus,
    row_of,
    scalar_product,
    set_row,
    shifted,
    times,
    vector_product,
)


@njit(**KERNEL)
def add_pressures(model, state, shapes, stiffness, push):
    """Contact force of each node as if along the normal: sum of w A k_p g (`add_contact_forces`).

    Model: model: surface_triangles (n_surface, 3), surface_rest_area [m^2] (n_surface,), surface_around,
           surface_rise
    In:    state: node_position [m] (n_node, 3), contact_engaged (n_shape, n_surface * 4); shapes, stiffness k_p [N/m^3]
    Out:   push, added to [N] (n_node,)
    """
    position, engaged, surface = state.node_position, state.contact_engaged, model.surface_triangles
    area = model.surface_rest_area
    for shape in range(shapes.shape_radius.shape[0]):
        radius = shapes.shape_radius[shape]
        for item in range(engaged.shape[1]):
            if not engaged[shape, item]:
                continue
            triangle, point = item // QUADRATURE_COUNT, item % QUADRATURE_COUNT
            a, b, c = row_of(surface, triangle)
            b_edge, c_edge = edge(position, a, b), edge(position, a, c)
            normal = vector_product(b_edge, c_edge)
            wb, wc = QUADRATURE_BARYCENTRIC[point, 1], QUADRATURE_BARYCENTRIC[point, 2]
            place = shifted(shifted(row_of(position, a), wb, b_edge), wc, c_edge)
            place = risen(place, rise_of(position, model, triangle), point)
            out = minus(place, closest_on_core(shapes, shape, place))
            t = scalar_product(out, normal) / length_of(normal)
            chord_squared = radius * radius - (scalar_product(out, out) - t * t)
            if chord_squared > 0.0:
                s = math.sqrt(chord_squared)
                force = QUADRATURE_WEIGHT * area[triangle] * stiffness * s * max(s + t, 0.0) / radius
                push[a] += (1.0 - wb - wc) * force
                push[b] += wb * force
                push[c] += wc * force


@njit(**INLINED)
def _volume_gradient(rest, position, tets, tet):
    """Rows of the deformation gradient dx/dX of a tet times its rest volume V [m^3], and V."""
    i, j, k, m = tets[tet, 0], tets[tet, 1], tets[tet, 2], tets[tet, 3]
    a, b, c = edge(rest, i, j), edge(rest, i, k), edge(rest, i, m)
    # Six times V times the inverse of the rest edges: their cofactors.
    u, v, w = vector_product(b, c), vector_product(c, a), vector_product(a, b)
    volume = scalar_product(a, u) / 6.0
    u, v, w = divided(u, 6.0), divided(v, 6.0), divided(w, 6.0)
    a, b, c = edge(position, i, j), edge(position, i, k), edge(position, i, m)
    x = shifted(shifted(times(a[0], u), b[0], v), c[0], w)
    y = shifted(shifted(times(a[1], u), b[1], v), c[1], w)
    z = shifted(shifted(times(a[2], u), b[2], v), c[2], w)
    return x, y, z, volume


@njit(**KERNEL)
def add_gradients(rest, position, tets, gradient):
    """Deformation gradient of every tet times its rest volume, added to each of its nodes.

    In:  rest, position: of the nodes [m] (n_node, 3), tets (n_tet, 4)
    Out: gradient, added to: sum of V F [m^3] (n_node, 3, 3)
    """
    for tet in range(tets.shape[0]):
        x, y, z, _ = _volume_gradient(rest, position, tets, tet)
        for corner in range(4):
            node = tets[tet, corner]
            add_to_row(gradient[node], 0, x)
            add_to_row(gradient[node], 1, y)
            add_to_row(gradient[node], 2, z)


@njit(**KERNEL)
def fill_squared_stretches(rest, position, tets, squared):
    """F^T F of each tet, with its deformation gradient F = dx/dX.

    In:  rest, position: of the nodes [m] (n_node, 3), tets (n_tet, 4)
    Out: squared (n_tet, 3, 3)
    """
    for tet in range(tets.shape[0]):
        x, y, z, volume = _volume_gradient(rest, position, tets, tet)
        x, y, z = divided(x, volume), divided(y, volume), divided(z, volume)
        for row in range(3):
            part = shifted(shifted(times(x[row], x), y[row], y), z[row], z)
            set_row(squared[tet], row, 0, part)


@njit(**KERNEL)
def add_spring_virials(position, springs, half, virial):
    """Virial of springs, (T / 2 l) d d added to both ends, d from end to end.

    In:  position: of the nodes [m] (n_node, 3), springs (n_spring, 2), half T / 2 l [N/m] (n_spring,)
    Out: virial, added to [J] (n_node, 3, 3)
    """
    for spring in range(springs.shape[0]):
        first, second = springs[spring, 0], springs[spring, 1]
        along = edge(position, first, second)
        for row in range(3):
            part = times(half[spring] * along[row], along)
            add_to_row(virial[first], row, part)
            add_to_row(virial[second], row, part)


@njit(**KERNEL)
def add_tet_stresses(tets, quarter, pull, spring_stress, virial):
    """Stress of each tet times a quarter of its volume, added to its corners: q 1 + mean of the springs at its corners.

    In:  tets (n_tet, 4), quarter of the volume [m^3], pull q [Pa] (n_tet,), spring_stress [Pa] (n_node, 3, 3)
    Out: virial, added to [J] (n_node, 3, 3)
    """
    for tet in range(tets.shape[0]):
        a, b, c, d = tets[tet, 0], tets[tet, 1], tets[tet, 2], tets[tet, 3]
        mean = 0.25 * quarter[tet]
        for row in range(3):
            for column in range(row, 3):
                part = spring_stress[a, row, column] + spring_stress[b, row, column]
                part += spring_stress[c, row, column] + spring_stress[d, row, column]
                part *= mean
                if row == column:
                    part += quarter[tet] * pull[tet]
                for corner in range(4):
                    virial[tets[tet, corner], row, column] += part
    for node in range(virial.shape[0]):
        for row in range(3):
            for column in range(row):
                virial[node, row, column] = virial[node, column, row]


@njit(**KERNEL)
def fill_principal_values(matrices, values):
    """Eigenvalues of symmetric matrices, descending: m + p x with x^3 - 3 x = det(A - m 1) / p^3 (Smith 1961).

    m is a third of the trace, 6 p^2 the square of A - m 1. The root x farthest from 0 follows by Newton's method from
    its chord over the determinant, where three rounds reach rounding; the others are those of its quadratic factor.

    In:  matrices (n, 3, 3)
    Out: values (n, 3)
    """
    least = math.sqrt(3.0)  # of the positive root, at a determinant of 0
    for number in range(matrices.shape[0]):
        a = matrices[number]
        yz, zx, xy = a[1, 2], a[2, 0], a[0, 1]
        mean = (a[0, 0] + a[1, 1] + a[2, 2]) / 3.0
        x, y, z = a[0, 0] - mean, a[1, 1] - mean, a[2, 2] - mean
        size = math.sqrt((0.5 * (x * x + y * y + z * z) + (yz * yz + zx * zx + xy * xy)) / 3.0)
        cube = size * size * size
        share = 0.0
        if cube > 0.0:
            share = (x * (y * z - yz * yz) - xy * (xy * z - yz * zx) + zx * (xy * yz - y * zx)) / cube
        twice = min(abs(share), 2.0)
        root = least + twice * (1.0 - 0.5 * least)
        for _ in range(3):
            square = root * root
            root = (2.0 * root * square + twice) / (3.0 * square - 3.0)
        apart = math.sqrt(max(3.0 * (2.0 - root) * (2.0 + root), 0.0))
        middle = 0.5 * (apart - root)
        lowest = -0.5 * (apart + root)
        if share < 0.0:
            root, middle, lowest = -lowest, -middle, -root
        values[number, 0] = mean + size * root
        values[number, 1] = mean + size * middle
        values[number, 2] = mean + size * lowest


@njit(**KERNEL)
def fill_volume_ratios(position, tets, rest_volume, ratio):
    """Volume of each tet over its volume at rest, negative for a tet inside out.

    In:  position: of the nodes [m] (n_node, 3), tets (n_tet, 4), rest_volume [m^3] (n_tet,)
    Out: ratio (n_tet,)
    """
    for tet in range(tets.shape[0]):
        i, j, k, m = tets[tet, 0], tets[tet, 1], tets[tet, 2], tets[tet, 3]
        _, six = tet_shape(edge(position, i, j), edge(position, i, k), edge(position, i, m))
        ratio[tet] = six / 6.0 / rest_volume[tet]
