"""Stiffness matrix of an organ at rest, assembled independently of the kernels, and solutions with it."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import cg

from msdm_core.kernels import OrganModel
from msdm_core.material import Damping, Lesion, Material
from msdm_core.mesh import TET_FACES, FloatArray, TetMesh
from msdm_core.organ import OrganSpec, compile_organ

DENSITY = 1060.0  # [kg/m^3]
RESIDUAL = 1e-8  # of the linear solution, relative; energies are then right to its square


def linear_organ(
    mesh: TetMesh,
    youngs_modulus: float,
    poisson_ratio: float = 0.25,
    *,
    lesions: tuple[Lesion, ...] = (),
    stiffness_rule: str = "lloyd",
) -> OrganModel:
    """A free, undamped organ of one tissue."""
    material = Material(youngs_modulus, DENSITY, poisson_ratio)
    still = Damping(alpha=0.0)
    return compile_organ(OrganSpec(mesh, material, lesions=lesions, damping=still, stiffness_rule=stiffness_rule))


def assemble_stiffness(model: OrganModel) -> csr_array:
    """K [N/m] at rest, (3 n_node, 3 n_node): sum_s k n n^T, sum_t (K_t / V_t) g g^T and sum_a (K_a / V_a) g g^T.

    g is dV/dx of a tet's volume, or of the volume averaged at a node: a quarter of the tets around it.
    """
    points = model.node_rest_position
    count = points.size
    matrix = spring_matrix(points, model.spring_nodes, model.spring_stiffness)
    gradient = volume_gradient(points, model.tet_nodes)
    by_tet = gradient * np.sqrt(model.tet_bulk / model.tet_rest_volume)[:, None]
    matrix = matrix + outer_products(model.tet_nodes, by_tet, count)
    if model.node_bulk.any():
        averaged = averaged_gradient(model.tet_nodes, gradient, count)
        matrix = matrix + averaged.T @ averaged.multiply((model.node_bulk / model.node_rest_volume)[:, None]).tocsr()
    return matrix


def spring_matrix(points: FloatArray, nodes: NDArray[np.int32], stiffness: FloatArray) -> csr_array:
    """sum_s k n n^T [N/m] of springs between nodes (n, 2) of stiffness (n,) [N/m], (3 n_node, 3 n_node)."""
    span = points[nodes[:, 1]] - points[nodes[:, 0]]
    direction = span / np.linalg.norm(span, axis=1)[:, None]
    ends = np.concatenate([-direction, direction], axis=1) * np.sqrt(stiffness)[:, None]
    return outer_products(nodes, ends, points.size)


def volume_gradient(points: FloatArray, tets: NDArray[np.int32]) -> FloatArray:
    """dV/dx of each tet's corners [m^2], (n_tet, 12)."""
    corners = points[tets[:, TET_FACES]]
    outward = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0]) / 2.0
    return (-outward / 3.0).reshape(-1, 12)


def averaged_gradient(tets: NDArray[np.int32], gradient: FloatArray, count: int) -> csr_array:
    """dV/dx of the volume averaged at each node [m^2], (n_node, 3 n_node)."""
    columns = node_rows(tets)
    rows = np.repeat(tets, columns.shape[1], axis=1)
    values, places = np.tile(gradient / 4.0, (1, 4)), np.tile(columns, (1, 4))
    return coo_array((values.ravel(), (rows.ravel(), places.ravel())), shape=(count // 3, count)).tocsr()


def outer_products(nodes: NDArray[np.int32], vectors: FloatArray, count: int) -> csr_array:
    """Sum of v v^T over items with the given nodes, with three components of v a node."""
    return block_sum(vectors[:, :, None] * vectors[:, None, :], node_rows(nodes), count).tocsr()


def block_sum(blocks: FloatArray, rows: NDArray[np.int64], count: int) -> coo_array:
    """Sum of the matrices of items (n, m, m) at their rows (n, m), (count, count)."""
    width = rows.shape[1]
    left, right = np.repeat(rows, width, axis=1), np.tile(rows, (1, width))
    return coo_array((blocks.ravel(), (left.ravel(), right.ravel())), shape=(count, count))


def node_rows(nodes: NDArray[np.int32]) -> NDArray[np.int64]:
    """Rows of the displacement of the nodes of items, (n, 3 m) for nodes (n, m)."""
    return (3 * nodes[:, :, None].astype(np.int64) + np.arange(3)).reshape(len(nodes), -1)


def nodes_at(points: FloatArray, height: float, axis: int = 2) -> NDArray[np.intp]:
    """Nodes at a height along an axis [m]."""
    return np.flatnonzero(np.abs(points[:, axis] - height) < 1e-9)


def nodal_dofs(nodes: ArrayLike, axes: tuple[int, ...] = (0, 1, 2)) -> NDArray[np.int64]:
    """Rows of the axes of nodes, node by node."""
    return (3 * np.asarray(nodes, dtype=np.int64)[:, None] + np.asarray(axes)).ravel()


def solve_displacement(
    stiffness: csr_array, held: NDArray[np.int64], value: ArrayLike = 0.0, load: FloatArray | None = None
) -> FloatArray:
    """Solution u of K u = load at free rows, with u = value at held ones (Jacobi-preconditioned CG).

    Free rigid motions do no harm if the load does no work on them.
    """
    count = len(stiffness.indptr) - 1
    displacement = np.zeros(count)
    displacement[held] = value
    free = np.setdiff1d(np.arange(count), held)
    right = -(stiffness @ displacement)[free]
    if load is not None:
        right += load[free]
    inner = csr_array(stiffness[free][:, free])
    jacobi = diags_array(1.0 / np.asarray(inner.diagonal(), dtype=np.float64))
    solution, code = cg(inner, right, rtol=RESIDUAL, maxiter=20000, M=jacobi)
    if code != 0:
        raise ValueError(f"the linear solution did not converge in {code} iterations")
    displacement[free] = solution
    return displacement


def twice_energy(stiffness: csr_array, displacement: FloatArray) -> float:
    """Product u . K u [J]; for a unit displacement of held rows their stiffness."""
    return float(displacement @ (stiffness @ displacement))


def pull_stiffness(mesh: TetMesh, stiffness: csr_array, axis: int = 2) -> float:
    """Force per elongation along an axis of a block with freely sliding ends [N/m]."""
    low, high = (nodes_at(mesh.points, height, axis) for height in (0.0, mesh.points[:, axis].max()))
    held = nodal_dofs(np.concatenate([low, high]), (axis,))
    value = np.repeat([0.0, 1.0], [len(low), len(high)])
    return twice_energy(stiffness, solve_displacement(stiffness, held, value))


def vector_areas(points: FloatArray, triangles: NDArray[np.int32]) -> FloatArray:
    """Area times unit normal of each triangle [m^2], shape (n_triangle, 3)."""
    corners = points[triangles]
    return 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
