"""Forces of an organ linearised at rest."""

import numpy as np
from numba import njit

from msdm_core.kernels.element_kernels import corner_gradient, edge
from msdm_core.kernels.option_kernels import KERNEL


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
        dx, dy, dz = edge(rest, i, j)
        stretch = (
            dx * (displacement[j, 0] - displacement[i, 0])
            + dy * (displacement[j, 1] - displacement[i, 1])
            + dz * (displacement[j, 2] - displacement[i, 2])
        )
        scale = stiffness[spring] * stretch / (dx * dx + dy * dy + dz * dz)
        force[i, 0] -= scale * dx
        force[i, 1] -= scale * dy
        force[i, 2] -= scale * dz
        force[j, 0] += scale * dx
        force[j, 1] += scale * dy
        force[j, 2] += scale * dz
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
            gx, gy, gz = _corner_gradient(rest, tets, tet, corner)
            node = np.uint32(tets[tet, corner])
            force[node, 0] += scale * gx
            force[node, 1] += scale * gy
            force[node, 2] += scale * gz
            force[a, 0] -= scale * gx
            force[a, 1] -= scale * gy
            force[a, 2] -= scale * gz


@njit(cache=True, inline="always", nogil=True, error_model="numpy")
def _volume_change(rest, tets, tet, displacement):
    """Change of one tet's volume to first order in a displacement [m^3]."""
    a = np.uint32(tets[tet, 0])
    change = 0.0
    for corner in range(1, 4):
        gx, gy, gz = _corner_gradient(rest, tets, tet, corner)
        node = np.uint32(tets[tet, corner])
        change += (
            gx * (displacement[node, 0] - displacement[a, 0])
            + gy * (displacement[node, 1] - displacement[a, 1])
            + gz * (displacement[node, 2] - displacement[a, 2])
        )
    return change


@njit(cache=True, inline="always", nogil=True, error_model="numpy")
def _corner_gradient(position, tets, tet, corner):
    """dV/dx of corner 1, 2 or 3 of one tet [m^2]: a sixth of the cross product of the edges to the next two."""
    a = np.uint32(tets[tet, 0])
    p = np.uint32(tets[tet, 1 + corner % 3])
    q = np.uint32(tets[tet, 1 + (corner + 1) % 3])
    x, y, z = corner_gradient(edge(position, a, p), edge(position, a, q))
    return x / 6.0, y / 6.0, z / 6.0
