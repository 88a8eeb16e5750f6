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
)
from msdm_core.kernels.element_kernels import corner_gradient, edge, tet_shape
from msdm_core.kernels.option_kernels import KERNEL


@njit(**KERNEL)
def add_pressures(model, state, shapes, stiffness, push):
    """Contact force of each node as if along the normal: sum of w A k_p g (`add_contact_forces`).

    Model: model: surface_triangles (n_surface, 3), surface_rest_area [m^2] (n_surface,)
    In:    state: node_position [m] (n_node, 3), contact_engaged (n_shape, n_surface * 4); shapes, stiffness k_p [N/m^3]
    Out:   push, added to [N] (n_node,)
    """
    position, engaged, surface = state.node_position, state.contact_engaged, model.surface_triangles
    ends, spans, area = shapes.shape_ends, shapes.shape_span, model.surface_rest_area
    for shape in range(shapes.shape_radius.shape[0]):
        radius = shapes.shape_radius[shape]
        for item in range(engaged.shape[1]):
            if not engaged[shape, item]:
                continue
            triangle, point = item // QUADRATURE_COUNT, item % QUADRATURE_COUNT
            a, b, c = surface[triangle, 0], surface[triangle, 1], surface[triangle, 2]
            b_edge, c_edge = edge(position, a, b), edge(position, a, c)
            bx, by, bz = b_edge
            cx, cy, cz = c_edge
            nx, ny, nz = corner_gradient(b_edge, c_edge)
            size = math.sqrt(nx * nx + ny * ny + nz * nz)
            wb, wc = QUADRATURE_BARYCENTRIC[point, 1], QUADRATURE_BARYCENTRIC[point, 2]
            x = position[a, 0] + wb * bx + wc * cx
            y = position[a, 1] + wb * by + wc * cy
            z = position[a, 2] + wb * bz + wc * cz
            px, py, pz = closest_on_core(ends, spans, shape, x, y, z)
            x, y, z = x - px, y - py, z - pz
            t = (x * nx + y * ny + z * nz) / size
            chord_squared = radius * radius - (x * x + y * y + z * z - t * t)
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
        u, v, w = corner_gradient(b, c), corner_gradient(c, a), corner_gradient(a, b)
        for row in range(3):
            along_a = position[j, row] - position[i, row]
            along_b = position[k, row] - position[i, row]
            along_c = position[m, row] - position[i, row]
            x = along_a * (u[0] / 6.0) + along_b * (v[0] / 6.0) + along_c * (w[0] / 6.0)
            y = along_a * (u[1] / 6.0) + along_b * (v[1] / 6.0) + along_c * (w[1] / 6.0)
            z = along_a * (u[2] / 6.0) + along_b * (v[2] / 6.0) + along_c * (w[2] / 6.0)
            for corner in range(4):
                node = tets[tet, corner]
                gradient[node, row, 0] += x
                gradient[node, row, 1] += y
                gradient[node, row, 2] += z


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
