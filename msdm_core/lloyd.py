"""Formula (6) of Sala et al. 2011 (Lloyd et al. 2007): what one tet gives to each of its six springs."""

import math

import numpy as np

from msdm_core.mesh import FloatArray, TetMesh


def lloyd_share(mesh: TetMesh, youngs_modulus: FloatArray) -> FloatArray:
    """Stiffness that a tet gives to each of its edges, (2 sqrt 2 / 25) l_t E_t [N/m], shape (n_tet,).

    l_t = (12 V_t / sqrt 2)^(1/3) is the edge of the regular tet of the same volume; E_t [Pa], shape (n_tet,).
    """
    length = np.cbrt(mesh.volumes * (12.0 / math.sqrt(2.0)))
    return (2.0 * math.sqrt(2.0) / 25.0) * length * youngs_modulus
