"""Which share of the volume term stays with each tet, and which is averaged at nodes."""

import numpy as np

from msdm_core.mesh import FloatArray, TetMesh

# Up to this Poisson's ratio the volume term belongs to each tet. Above it tets lock under loads that bend (a cosine
# load on few cells: 1.48 x too stiff at 0.49 where 0.25 is 1.17 x), so what is above is averaged at nodes.
POISSON_RATIO_PER_TET = 0.40


def averaged_volume_modulus(spring_modulus: FloatArray, volume_modulus: FloatArray) -> FloatArray:
    """Share of each tet's volume modulus that is averaged at nodes, max(0, K_t - 3 mu) [Pa], shape (n_tet,).

    K_t / mu = (4 nu - 1) / (1 - 2 nu), which is 3 at nu = 0.4, and mu = (2/5) E_s: up to 0.4 the share is nothing.

    Args:
        spring_modulus: E_s of each tet [Pa], shape (n_tet,).
        volume_modulus: K_t of each tet [Pa], shape (n_tet,).
    """
    nu = POISSON_RATIO_PER_TET
    most = 0.4 * spring_modulus * ((4.0 * nu - 1.0) / (1.0 - 2.0 * nu))
    # Rounding must not make an organ of just that ratio pay for averaging.
    return np.where(volume_modulus > most * (1.0 + 1e-9), volume_modulus - most, 0.0)


def nodal_average(mesh: TetMesh, tet_modulus: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Volume [m^3] and modulus [Pa] that each node has from a quarter of each tet around it, both (n_node,).

    V_a = sum_t V_t / 4 and K_a = sum_t (V_t / 4) K_t / V_a (averaged volumes: Bonet and Burton 1998).
    """
    corners = mesh.tets.ravel()
    volume = np.bincount(corners, np.repeat(mesh.volumes / 4.0, 4), mesh.node_count).astype(np.float64)
    modulus = np.bincount(corners, np.repeat(mesh.volumes / 4.0 * tet_modulus, 4), mesh.node_count) / volume
    return volume, modulus
