"""Stiffness of a membrane capsule's springs alone as a sheet, with nodes free to move along the surface."""

import numpy as np
from scipy.sparse import block_diag, csr_array

from msdm_core.material.stiffness import membrane_stiffness
from msdm_core.mesh.tet_mesh import FloatArray, IntArray, TetMesh
from surgsim_env.validation.statics import nodal_dofs, outer_products, solve_displacement

MODULUS, THICKNESS = 1.0e6, 2.0e-5  # [Pa], [m]: those of the scene `liver`
DIRECTIONS = 12  # in half a turn
PATCH_RINGS = 3  # of triangles around the one in the middle

# Twice the energy per area of a sheet E h of 2-D Poisson's ratio 1/3, over E h e^2: 2 / (1 - nu), 1 / (1 - nu^2).
TWICE_ENERGY: dict[str, float] = {"equibiaxial": 3.0, "along one direction": 9.0 / 8.0}


def inflated(mesh: TetMesh) -> float:
    """E_c h_c of a whole surface by u = e x, which is equibiaxial everywhere [N/m].

    A sheet does not slide along the surface then, because its tension is uniform; springs may.
    """
    points = mesh.points
    matrix = _membrane_matrix(mesh)
    nodes = mesh.boundary_nodes
    rows = nodal_dofs(nodes)
    vector_area = vector_areas(points, mesh.boundary_triangles)
    normal = np.zeros_like(points)
    np.add.at(normal, mesh.boundary_triangles.ravel(), np.repeat(vector_area, 3, axis=0))
    along = csr_array(block_diag(list(tangents(normal[nodes])), format="csr"))
    inner = csr_array(matrix[rows][:, rows])
    place = points[nodes].ravel()
    pull = -(along.T @ (inner @ place))
    slid = solve_displacement(csr_array(along.T @ inner @ along), np.zeros(0, dtype=np.int64), 0.0, pull)
    twice = float(place @ (inner @ place) - pull @ slid)
    return twice / (TWICE_ENERGY["equibiaxial"] * float(np.linalg.norm(vector_area, axis=1).sum()))


def patch_stiffness(mesh: TetMesh, triangles: IntArray) -> tuple[float, FloatArray]:
    """E_c h_c of some boundary triangles (n, 3): equibiaxial, and along DIRECTIONS directions [N/m].

    The patch is laid flat, its rim held in the strain; springs on the rim belong to it by half.
    """
    vector_area = vector_areas(mesh.points, triangles)
    plane = tangents(vector_area.sum(axis=0)[None])[0]
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, uses = np.unique(sides, axis=0, return_counts=True)
    nodes, ends = np.unique(edges, return_inverse=True)
    ends = ends.reshape(-1, 2)
    step = mesh.points[edges[:, 1]] - mesh.points[edges[:, 0]]
    along = step @ plane
    along /= np.linalg.norm(along, axis=1)[:, None]
    span = along * np.linalg.norm(step, axis=1)[:, None]
    stiffness = _springs_of(mesh, edges) * np.where(uses == 1, 0.5, 1.0)
    # Stretch of each spring per displacement in the plane, and those of the nodes that may move.
    stretch = np.zeros((len(edges), len(nodes), 2))
    for side, sign in ((0, -1.0), (1, 1.0)):
        stretch[np.arange(len(edges)), ends[:, side]] += sign * along
    free = np.setdiff1d(np.arange(len(nodes)), ends[uses == 1])
    moved = stretch[:, free].reshape(len(edges), -1) * np.sqrt(stiffness)[:, None]
    turn = np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    strains = [np.eye(2), *(np.outer(v, v) for v in np.stack([np.cos(turn), np.sin(turn)], axis=1))]
    # The stretches of the affine strain that remain after the free nodes have relaxed (least squares).
    wanted = np.stack([np.einsum("ei,ij,ej->e", along, strain, span) for strain in strains], axis=1)
    wanted *= np.sqrt(stiffness)[:, None]
    left = wanted - moved @ np.linalg.lstsq(moved, wanted, rcond=None)[0]
    twice = (left**2).sum(axis=0) / float(np.linalg.norm(vector_area, axis=1).sum())
    return float(twice[0] / TWICE_ENERGY["equibiaxial"]), twice[1:] / TWICE_ENERGY["along one direction"]


def patch_around(triangles: IntArray, middle: int) -> IntArray:
    """PATCH_RINGS rings of triangles around one of them, about 40 with it (n, 3)."""
    chosen = triangles[[middle]]
    for _ in range(PATCH_RINGS):
        chosen = triangles[np.isin(triangles, chosen).any(axis=1)]
    return chosen


def vector_areas(points: FloatArray, triangles: IntArray) -> FloatArray:
    """Area times unit normal of each triangle [m^2], shape (n_triangle, 3)."""
    corners = points[triangles]
    return 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def tangents(normal: FloatArray) -> FloatArray:
    """Two unit vectors across each normal (n, 3), as columns (n, 3, 2)."""
    return np.linalg.svd(normal[:, None, :])[2][:, 1:].transpose(0, 2, 1)


def _membrane_matrix(mesh: TetMesh) -> csr_array:
    stiffness = membrane_stiffness(mesh, MODULUS, THICKNESS)
    springs = np.flatnonzero(stiffness > 0.0)
    edges = mesh.edges[springs]
    span = mesh.points[edges[:, 1]] - mesh.points[edges[:, 0]]
    along = span / np.linalg.norm(span, axis=1)[:, None]
    vectors = np.concatenate([-along, along], axis=1) * np.sqrt(stiffness[springs])[:, None]
    return outer_products(edges, vectors, mesh.points.size)


def _springs_of(mesh: TetMesh, edges: IntArray) -> FloatArray:
    number = np.array([mesh.node_count, 1])
    place = np.searchsorted(mesh.edges.astype(np.int64) @ number, edges.astype(np.int64) @ number)
    return membrane_stiffness(mesh, MODULUS, THICKNESS)[place]
