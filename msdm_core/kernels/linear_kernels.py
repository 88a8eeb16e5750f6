"""Forces of an organ linearised at rest."""

import numpy as np
from numba import njit

from msdm_core.kernels.option_kernels import KERNEL
from msdm_core.kernels.space_kernels import (
    add_to_row,
    divided,
    edge,
    scalar_product,
    take_from_row,
    times,
    vector_product,
)


@njit(**KERNEL)
def multiply_stiffness(
    rest, nodes, stiffness, tets, rest_volume, bulk, node_rest_volume, node_bulk, displacement, pressure, force
):
    """Internal forces of an organ linearised at rest, K u; see `stability.apply_stiffness`.

    In:  rest: node_rest_position [m] (n_node, 3), nodes (n_spring, 2), stiffness [N/m] (n_spring,), tets (n_tet, 4),
         rest_volume [m^3], bulk [Pa] (n_tet,), node_rest_volume [m^3], node_bulk [Pa] (n_node,), displacement u [m]
         (n_node, 3)
    Out: force [N] (n_node, 3); scratch: pressure (n_node,)
    """
    force[:, :] = 0.0
    pressure[:] = 0.0
    for spring in range(nodes.shape[0]):
        i = np.uint32(nodes[spring, 0])
        j = np.uint32(nodes[spring, 1])
        along = edge(rest, i, j)
        stretch = scalar_product(along, edge(displacement, i, j))
        pull = times(stiffness[spring] * stretch / scalar_product(along, along), along)
        take_from_row(force, i, 0, pull)
        add_to_row(force, j, pull)
    for tet in range(tets.shape[0]):
        change = _volume_change(rest, tets, tet, displacement)
        for corner in range(4):
            pressure[tets[tet, corner]] += 0.25 * change
    for node in range(pressure.shape[0]):
        pressure[node] *= node_bulk[node] / node_rest_volume[node]
    for tet in range(tets.shape[0]):
        a = np.uint32(tets[tet, 0])
        scale = bulk[tet] * _volume_change(rest, tets, tet, displacement) / rest_volume[tet]
        for corner in range(4):
            scale += 0.25 * pressure[tets[tet, corner]]
        for corner in range(1, 4):
            push = times(scale, _corner_gradient(rest, tets, tet, corner))
            add_to_row(force, np.uint32(tets[tet, corner]), push)
            take_from_row(force, a, 0, push)


@njit(cache=True, inline="always", nogil=True, error_model="numpy")
def _volume_change(rest, tets, tet, displacement):
    """Change of one tet's volume to first order in a displacement [m^3]."""
    a = np.uint32(tets[tet, 0])
    change = 0.0
    for corner in range(1, 4):
        along = edge(displacement, a, np.uint32(tets[tet, corner]))
        change += scalar_product(_corner_gradient(rest, tets, tet, corner), along)
    return change


@njit(cache=True, inline="always", nogil=True, error_model="numpy")
def _corner_gradient(position, tets, tet, corner):
    """dV/dx of corner 1, 2 or 3 of one tet [m^2]: a sixth of the cross product of the edges to the next two."""
    a = np.uint32(tets[tet, 0])
    p = np.uint32(tets[tet, 1 + corner % 3])
    q = np.uint32(tets[tet, 1 + (corner + 1) % 3])
    return divided(vector_product(edge(position, a, p), edge(position, a, q)), 6.0)
