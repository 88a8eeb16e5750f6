"""Load of the tissue, contact pressure and principal strain, averaged at nodes.

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
from msdm_core.kernels.option_kernels import KERNEL
from msdm_core.kernels.space_kernels import (
    add_to_row,
    divided,
    edge,
    length_of,
    minus,
    row_of,
    scalar_product,
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


@njit(**KERNEL)
def add_gradients(rest, position, tets, gradient):
    """Deformation gradient of every tet times its rest volume, added to each of its nodes.

    In:  rest, position: of the nodes [m] (n_node, 3), tets (n_tet, 4)
    Out: gradient, added to: sum of V F [m^3] (n_node, 3, 3)
    """
    for tet in range(tets.shape[0]):
        i, j, k, m = tets[tet, 0], tets[tet, 1], tets[tet, 2], tets[tet, 3]
        a, b, c = edge(rest, i, j), edge(rest, i, k), edge(rest, i, m)
        # Six times V times the inverse of the rest edges: their cofactors.
        u, v, w = vector_product(b, c), vector_product(c, a), vector_product(a, b)
        u, v, w = divided(u, 6.0), divided(v, 6.0), divided(w, 6.0)
        for row in range(3):
            part = times(position[j, row] - position[i, row], u)
            part = shifted(part, position[k, row] - position[i, row], v)
            part = shifted(part, position[m, row] - position[i, row], w)
            for corner in range(4):
                add_to_row(gradient[tets[tet, corner]], row, part)


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
