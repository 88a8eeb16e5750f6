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
    plus,
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
    Out: squared (3, 3, n_tet), row by row at and above the diagonal
    """
    for tet in range(tets.shape[0]):
        x, y, z, volume = _volume_gradient(rest, position, tets, tet)
        share = 1.0 / (volume * volume)
        for row in range(3):
            part = shifted(shifted(times(x[row], x), y[row], y), z[row], z)
            for column in range(row, 3):
                squared[row, column, tet] = share * part[column]


@njit(**KERNEL)
def fill_lengths(position, springs, length):
    """Distance of the ends of each spring: position (n_node, 3), springs (n_spring, 2); out: length (n_spring,)."""
    for spring in range(springs.shape[0]):
        length[spring] = length_of(edge(position, springs[spring, 0], springs[spring, 1]))


@njit(**KERNEL)
def add_to_corners(nodes, value, total):
    """Value of each item added to each of its nodes: nodes (n, m), value (n,), total (n_node,)."""
    for item in range(nodes.shape[0]):
        for corner in range(nodes.shape[1]):
            total[nodes[item, corner]] += value[item]


@njit(**KERNEL)
def fill_corner_means(nodes, value, mean):
    """Mean of a value of the nodes (n_node,) over the nodes (n, m) of each item; out: mean (n,)."""
    for item in range(nodes.shape[0]):
        total = value[nodes[item, 0]]
        for corner in range(1, nodes.shape[1]):
            total += value[nodes[item, corner]]
        mean[item] = total / nodes.shape[1]


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
        mean, own = 0.25 * quarter[tet], quarter[tet] * pull[tet]
        x = _corner_sum(spring_stress, a, b, c, d, 0)
        y = _corner_sum(spring_stress, a, b, c, d, 1)
        z = _corner_sum(spring_stress, a, b, c, d, 2)
        x, y, z = times(mean, x), times(mean, y), times(mean, z)
        x, y, z = (x[0] + own, x[1], x[2]), (y[0], y[1] + own, y[2]), (z[0], z[1], z[2] + own)
        for node in (a, b, c, d):
            add_to_row(virial[node], 0, x)
            add_to_row(virial[node], 1, y)
            add_to_row(virial[node], 2, z)


@njit(**INLINED)
def _corner_sum(stress, a, b, c, d, row):
    """Sum of one row of the stresses of four nodes."""
    total = plus(row_of(stress[a], row), row_of(stress[b], row))
    return plus(plus(total, row_of(stress[c], row)), row_of(stress[d], row))


@njit(**KERNEL)
def fill_normals(position, triangles, normal, area):
    """Unit normal and area of each triangle.

    In:  position: of the nodes [m] (n_node, 3), triangles (n, 3)
    Out: normal (n, 3), area [m^2] (n,)
    """
    for triangle in range(triangles.shape[0]):
        a, b, c = row_of(triangles, triangle)
        across = vector_product(edge(position, a, b), edge(position, a, c))
        twice = length_of(across)
        set_row(normal, triangle, 0, divided(across, twice))
        area[triangle] = 0.5 * twice


@njit(**KERNEL)
def fill_principal_values(matrices, values):
    """Eigenvalues of symmetric matrices, descending: m + p x with x^3 - 3 x = det(A - m 1) / p^3 (Smith 1961).

    m is a third of the trace, 6 p^2 the square of A - m 1. The root x farthest from 0 follows by Newton's method from
    its chord over the determinant, where three rounds reach rounding; the others are those of its quadratic factor.

    The loop has no branch and reads each entry in a row, so that it runs in registers of several numbers.

    In:  matrices (3, 3, n), read at and above the diagonal
    Out: values (3, n)
    """
    least = math.sqrt(3.0)  # of the positive root, at a determinant of 0
    for number in range(matrices.shape[2]):
        yz, zx, xy = matrices[1, 2, number], matrices[0, 2, number], matrices[0, 1, number]
        x, y, z = matrices[0, 0, number], matrices[1, 1, number], matrices[2, 2, number]
        mean = (x + y + z) / 3.0
        x, y, z = x - mean, y - mean, z - mean
        size = math.sqrt((0.5 * (x * x + y * y + z * z) + (yz * yz + zx * zx + xy * xy)) / 3.0)
        cube = size * size * size
        determinant = x * (y * z - yz * yz) - xy * (xy * z - yz * zx) + zx * (xy * yz - y * zx)
        share = determinant / (cube if cube > 0.0 else 1.0)
        twice = min(abs(share), 2.0)
        root = least + twice * (1.0 - 0.5 * least)
        for _ in range(3):
            square = root * root
            root = (2.0 * root * square + twice) / (3.0 * square - 3.0)
        apart = math.sqrt(max(3.0 * (2.0 - root) * (2.0 + root), 0.0))
        middle, lowest = 0.5 * (apart - root), -0.5 * (apart + root)
        negative = share < 0.0
        values[0, number] = mean + size * (-lowest if negative else root)
        values[1, number] = mean + size * (-middle if negative else middle)
        values[2, number] = mean + size * (-root if negative else lowest)


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
