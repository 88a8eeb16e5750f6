"""Linearised static stiffness of a body by a sparse direct solve: springs and volume term assembled here, in scipy.

Independent of the kernels: springs from B^T k B, the volume term per tet or from averaged (nodal) volumes.
"""

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu
from scipy.spatial import Delaunay

from msdm_core.mesh.tet_mesh import TetMesh, tet_volumes

FloatArray = NDArray[np.float64]


def gathered(values: FloatArray, nodes: NDArray, node_count: int) -> csr_array:
    """Rows of one vector per node listed, values (n_row, n_corner, 3), as a matrix (n_row, 3 n_node)."""
    columns = (3 * nodes[:, :, None].astype(np.int64) + np.arange(3)).reshape(len(nodes), -1)
    rows = np.broadcast_to(np.arange(len(nodes))[:, None], columns.shape)
    return csr_array((values.ravel(), (rows.ravel(), columns.ravel())), shape=(len(nodes), 3 * node_count))


def spring_matrix(mesh: TetMesh, stiffness: FloatArray) -> csr_array:
    """K = B^T diag(k) B, B the stretch of each spring at rest, n . (u_j - u_i)."""
    span = mesh.points[mesh.edges[:, 1]] - mesh.points[mesh.edges[:, 0]]
    along = span / np.linalg.norm(span, axis=1)[:, None]
    stretch = gathered(np.stack([-along, along], axis=1), mesh.edges, mesh.node_count)
    return csr_array(stretch.T @ diags_array(stiffness) @ stretch)


def corner_gradients(mesh: TetMesh) -> FloatArray:
    """Gradients of the four linear shape functions of each tet [1/m], (n_tet, 4, 3)."""
    corners = mesh.points[mesh.tets]
    inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    return np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)


def nodal_volume_matrix(mesh: TetMesh, bulk: float) -> csr_array:
    """K of sum_i (K_t / 2) V_i (J_i - 1)^2, V_i a quarter of the tets around a node, J_i their volume over V_i."""
    share = csr_array(
        (np.full(4 * mesh.tet_count, 0.25), (mesh.tets.ravel(), np.repeat(np.arange(mesh.tet_count), 4))),
        shape=(mesh.node_count, mesh.tet_count),
    )
    gradient = corner_gradients(mesh) * mesh.volumes[:, None, None]
    change = csr_array(share @ gathered(gradient, mesh.tets, mesh.node_count))
    return csr_array(change.T @ diags_array(bulk / (share @ mesh.volumes)) @ change)


def solid_matrix(mesh: TetMesh, modulus: float, nu: float) -> csr_array:
    """K of linear tets (finite elements of first order), V (B^T D B) in Voigt's notation."""
    g = corner_gradients(mesh)
    zero = np.zeros_like(g[..., 0])
    gx, gy, gz = g[..., 0], g[..., 1], g[..., 2]
    rows = [
        np.stack(row, axis=-1)
        for row in (
            (gx, zero, zero),
            (zero, gy, zero),
            (zero, zero, gz),
            (zero, gz, gy),
            (gz, zero, gx),
            (gy, gx, zero),
        )
    ]
    lame, mu = modulus * nu / ((1 + nu) * (1 - 2 * nu)), modulus / (2 * (1 + nu))
    law = np.diag([2 * mu] * 3 + [mu] * 3) + lame * np.outer([1, 1, 1, 0, 0, 0], [1, 1, 1, 0, 0, 0])
    matrix = csr_array((3 * mesh.node_count, 3 * mesh.node_count))
    parts = [gathered(row, mesh.tets, mesh.node_count) for row in rows]
    for i, j in np.argwhere(law):
        matrix = matrix + parts[i].T @ diags_array(law[i, j] * mesh.volumes) @ parts[j]
    return csr_array(matrix)


def work_of(matrix: csr_array, held: NDArray, value: FloatArray) -> float:
    """u . K u where the held degrees of freedom take their value and the others settle: twice the energy."""
    free = np.setdiff1d(np.arange(matrix.shape[0]), held)
    displacement = np.zeros(matrix.shape[0])
    displacement[held] = value
    rows = csr_array(matrix[free])
    displacement[free] = splu(csc_array(rows[:, free])).solve(-(rows @ displacement))
    return float(displacement @ (matrix @ displacement))


def end_nodes(mesh: TetMesh, axis: int) -> tuple[NDArray, NDArray]:
    place = mesh.points[:, axis]
    return np.flatnonzero(place < place.min() + 1e-9), np.flatnonzero(place > place.max() - 1e-9)


def uniaxial_modulus(mesh: TetMesh, matrix: csr_array, axis: int = 2) -> float:
    """E = F L / (A d) of a block pulled along an axis by frictionless ends [Pa]."""
    low, high = end_nodes(mesh, axis)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    # Three pins at one end stop it from sliding and turning about the axis, and bear nothing.
    corner = low[np.argmin(mesh.points[low, first] + mesh.points[low, second])]
    beside = low[np.argmax(mesh.points[low, first] - mesh.points[low, second])]
    pins = np.array([3 * corner + first, 3 * corner + second, 3 * beside + second])
    held = np.concatenate([3 * low + axis, pins, 3 * high + axis])
    value = np.concatenate([np.zeros(len(low) + 3), np.ones(len(high))])
    length = float(np.ptp(mesh.points[:, axis]))
    return work_of(matrix, held, value) * length**2 / float(mesh.volumes.sum())


def clamped_torsion(mesh: TetMesh, matrix: csr_array, axis: int = 2) -> float:
    """Torque per angle of a bar whose ends are clamped and one turned [N m/rad]."""
    low, high = end_nodes(mesh, axis)
    arm = mesh.points[high] - 0.5 * (mesh.points.min(axis=0) + mesh.points.max(axis=0))
    turn = np.cross(np.eye(3)[axis], arm)
    held = (3 * np.concatenate([low, high])[:, None] + np.arange(3)).ravel()
    return work_of(matrix, held, np.concatenate([np.zeros(3 * len(low)), turn.ravel()]))


def point_stiffness(mesh: TetMesh, matrix: csr_array, nodes: NDArray) -> FloatArray:
    """Stiffness of single nodes along z [N/m], the lowest face held, shape of `nodes`."""
    low, _ = end_nodes(mesh, 2)
    free = np.setdiff1d(np.arange(matrix.shape[0]), (3 * low[:, None] + np.arange(3)).ravel())
    places = np.searchsorted(free, 3 * nodes + 2)
    push = np.zeros((len(free), len(nodes)))
    push[places, np.arange(len(nodes))] = 1.0
    return 1.0 / np.diag(splu(csc_array(csr_array(matrix[free])[:, free])).solve(push)[places])


def kuhn_mesh(size: tuple[float, float, float], cells: tuple[int, int, int]) -> TetMesh:
    """A block of cubes cut into six tets each, along the same diagonal (Kuhn)."""
    counts = np.array(cells)
    node = np.arange(np.prod(counts + 1)).reshape(counts + 1)
    place = np.stack(np.unravel_index(np.arange(node.size), node.shape), axis=1) / counts * np.array(size)
    base = np.stack(np.unravel_index(np.arange(np.prod(counts)), cells), axis=1)
    tets = []
    for order in itertools.permutations(range(3)):
        path = np.concatenate([np.zeros((1, 3), int), np.cumsum(np.eye(3, dtype=int)[list(order)], axis=0)])
        tets.append(np.stack([node[tuple((base + corner).T)] for corner in path], axis=1))
    return TetMesh(place, np.concatenate(tets))


def jittered_mesh(edge: float, cells: int, jitter: float) -> TetMesh:
    """A Delaunay mesh of a cube whose inner nodes are moved at random by up to `jitter` cells, without slivers."""
    grid = np.stack(np.meshgrid(*[np.arange(cells + 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    moved = np.random.default_rng(0).uniform(-jitter, jitter, grid.shape)
    place = (grid + np.where((grid > 0) & (grid < cells), moved, 0.0)) * edge / cells
    tets = Delaunay(place, qhull_options="QJ Pp").simplices
    return TetMesh(place, tets[np.abs(tet_volumes(place, tets)) > 1e-3 * (edge / cells) ** 3])
