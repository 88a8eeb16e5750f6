"""Spring stiffness from Young's moduli: formula (6) of Sala et al. 2011, fitted, and a membrane."""

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.arithmetic import norm
from msdm_core.errors import OrganError
from msdm_core.material.fitting import lloyd_share, spring_fit
from msdm_core.mesh.tet_mesh import FloatArray, IntArray, TetMesh

STIFFNESS_RULES = ("lloyd", "fitted")


def spring_network(mesh: TetMesh, youngs_modulus: ArrayLike, *, rule: str = "lloyd") -> tuple[IntArray, FloatArray]:
    """Springs along the mesh edges, with a share of stiffness from each tet in proportion to its modulus.

    * "lloyd": k_ij = sum over tets of (2 sqrt 2 / 25) l_t E_t, l_t = (12 V_t / sqrt 2)^(1/3), the edge of the regular
      tet of the same volume (Sala et al. 2011, eq. 6; Lloyd et al. 2007).
    * "fitted": formula (6) times factors fitted to the mesh, see `msdm_core.material.fitting`; best on blocks of cubic
      cells.

    Args:
        mesh: the organ's tets.
        youngs_modulus: E [Pa], a scalar or a value per tet, shape (n_tet,).
        rule: one of STIFFNESS_RULES.

    Warns:
        UserWarning: "fitted" on a mesh whose network cannot represent the solid; names the residual.

    Returns:
        edges (n_spring, 2) and stiffness [N/m] (n_spring,), in the order of `mesh.edges`.

    Raises:
        OrganError: an unknown rule; lists the known.
    """
    check_stiffness_rule(rule)
    modulus = np.broadcast_to(np.asarray(youngs_modulus, dtype=np.float64), (mesh.tet_count,))
    return mesh.edges, spring_sum(mesh, modulus, rule)


def spring_sum(mesh: TetMesh, modulus: FloatArray, rule: str) -> FloatArray:
    """Stiffness of the springs, k_ij = sum over tets of k_ij,t [N/m], of moduli (n_tet,) [Pa], shape (n_spring,).

    Linear in the moduli: E_t times an amount of each tet gives the amount's sum, weighted by the shares of stiffness.
    """
    share = lloyd_share(mesh, modulus)
    if rule == "fitted":
        share = share * spring_fit(mesh).tet_factor
    stiffness = np.bincount(mesh.tet_edges.ravel(), np.repeat(share, 6), len(mesh.edges)).astype(np.float64)
    return stiffness * spring_fit(mesh).edge_factor if rule == "fitted" else stiffness


def check_stiffness_rule(rule: str) -> None:
    """Raise OrganError unless a rule is one of STIFFNESS_RULES."""
    if rule not in STIFFNESS_RULES:
        raise OrganError(f"stiffness rule {rule!r} is unknown; the rules are {', '.join(STIFFNESS_RULES)}")


def membrane_stiffness(mesh: TetMesh, youngs_modulus: float, thickness: float) -> FloatArray:
    """Stiffness of a thin capsule in the springs of the surface's edges [N/m], shape (n_spring,).

    Each surface triangle of area A and edges l1, l2, l3 gives 3 E_c h_c A / (l1^2 + l2^2 + l3^2) to each of its edges:
    a membrane of stiffness E_c h_c with 2-D Poisson ratio 1/3, equal to (sqrt 3 / 4) E_c h_c on equilateral triangles.
    """
    triangles = mesh.boundary_triangles
    corners = mesh.points[triangles]
    edges = corners[:, [1, 2, 0]] - corners
    area = 0.5 * norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    share = 3.0 * youngs_modulus * thickness * area / (edges * edges).sum(axis=(1, 2))
    pairs = np.sort(np.stack([triangles, triangles[:, [1, 2, 0]]], axis=2).reshape(-1, 2), axis=1).astype(np.int64)
    known = mesh.edges.astype(np.int64)
    index = np.searchsorted(known[:, 0] * mesh.node_count + known[:, 1], pairs[:, 0] * mesh.node_count + pairs[:, 1])
    return np.bincount(index, np.repeat(share, 3), len(mesh.edges)).astype(np.float64)
