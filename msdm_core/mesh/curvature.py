"""Curved surface through the nodes of a triangle mesh: the rise of its edges from the places of the nodes around.

Flat triangles are chords of a dent: pressed by a ball of radius R they push nodes with edges h deeper by about
h^2 / 6R, which makes a press too stiff. A quadratic triangle has a node in the middle of each edge; here that node
follows from the places of the other nodes, by a quadratic fit around the edge.
"""

from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import dot, eigh, norm, solve
from msdm_core.mesh.tet_mesh import FloatArray, IntArray, TetMesh, area_vectors

# Cosine of the largest angle between the normals of an edge and of a triangle of its neighbourhood: the fit does not
# reach across creases.
CREASE_COSINE = 0.8
# Smallest over largest eigenvalue of a fit's normal matrix; poorer edges stay straight.
CONDITION_LEAST = 1e-3
# Coefficients of a quadratic polynomial of two coordinates.
COEFFICIENTS = 6


class EdgeRise(NamedTuple):
    """Rise of the edges of triangles over their chords: sums of the places of the nodes around.

    The middle of the edge opposite to corner k of triangle t lies at the middle of its ends plus
    sum_j weight[t, j, k] x[node[t, j]]. The weights of an edge annihilate linear functions of the place on the surface.

    Fields:
        node: nodes around each triangle, its first corner beyond the last       (n_triangle, n_around)
        weight: their weights, 0 beyond the last                                 (n_triangle, n_around, 3)
    """

    node: IntArray
    weight: FloatArray


_RISES: WeakKeyDictionary[TetMesh, EdgeRise] = WeakKeyDictionary()


def boundary_rise(mesh: TetMesh) -> EdgeRise:
    """Rise of the edges of a mesh's boundary triangles, computed once per mesh."""
    if mesh not in _RISES:
        _RISES[mesh] = edge_rise(mesh.points, mesh.boundary_triangles)
    return _RISES[mesh]


def edge_rise(points: FloatArray, triangles: NDArray[np.integer]) -> EdgeRise:
    """Weights of the rise of edges in a surface, from least squares around each edge.

    A quadratic polynomial is fitted to the nodes of all triangles at both ends, in the plane of the edge and with the
    weight 1 / (l^2 / 4 + r^2) at a distance r from the middle of the edge of length l. Its second derivative f'' along
    the edge gives the rise -f'' l^2 / 8. Edges with too few nodes or at a crease stay straight.

    Args:
        points: nodes [m], shape (n_node, 3).
        triangles: corners in outward order, of a closed surface, shape (n_triangle, 3).
    """
    count = len(points)
    sides = np.sort(triangles[:, [[1, 2], [2, 0], [0, 1]]], axis=2).astype(np.int64)
    keys, edge_of = np.unique(sides[..., 0] * count + sides[..., 1], return_inverse=True)
    edge_of = edge_of.reshape(-1, 3)
    ends = np.stack([keys // count, keys % count], axis=1)
    pair_edge, pair_node, weight = _edge_weights(points, triangles, ends, edge_of)
    # The nodes of a triangle are those around its three edges, corners first in no particular order.
    first = np.searchsorted(pair_edge, np.arange(len(keys) + 1))
    lengths = np.diff(first)[edge_of]
    owner = np.repeat(np.arange(edge_of.size), lengths.ravel())
    entry = np.arange(len(owner)) - np.repeat(np.cumsum(lengths) - lengths.ravel(), lengths.ravel())
    entry += first[edge_of.ravel()[owner]]
    rings, place = np.unique((owner // 3) * count + pair_node[entry], return_inverse=True)
    triangle = rings // count
    slot = np.arange(len(rings)) - np.searchsorted(triangle, np.arange(len(triangles)))[triangle]
    width = _widest(triangles)
    node = np.repeat(triangles[:, :1], width, axis=1).astype(np.int32)
    node[triangle, slot] = rings % count
    weights = np.zeros((len(triangles), width, 3))
    weights[owner // 3, slot[place], owner % 3] = weight[entry]
    return EdgeRise(node, weights)


def _widest(triangles: NDArray[np.integer]) -> int:
    """Largest number of nodes around a triangle, creases left out: the same for all organs of the same tets."""
    corner, around = _triangles_around(triangles, triangles.ravel())
    count = int(triangles.max()) + 1
    pairs = np.unique((corner // 3)[:, None] * count + triangles[around])
    return int(np.bincount(pairs // count).max())


def _triangles_around(
    triangles: NDArray[np.integer], nodes: NDArray[np.integer]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Index into `nodes` and triangle of each pair of one of these nodes and a triangle at it, by nodes in order."""
    order = np.argsort(triangles.ravel(), kind="stable")
    start = np.searchsorted(triangles.ravel()[order], np.arange(int(triangles.max()) + 2))
    lengths = np.diff(start)[nodes]
    owner = np.repeat(np.arange(len(nodes)), lengths)
    offset = np.arange(len(owner)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    return owner, order[np.repeat(start[nodes], lengths) + offset] // 3


def _edge_weights(
    points: FloatArray, triangles: NDArray[np.integer], ends: NDArray[np.int64], edge_of: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray]:
    """Edge, node and weight of each pair of an edge and a node around it, by edges and nodes in order."""
    count, area = len(points), area_vectors(points[triangles])
    unit = area / norm(area, axis=1)[:, None]
    up = np.zeros((len(ends), 3))
    np.add.at(up, edge_of.ravel(), np.repeat(area, 3, axis=0))
    up /= np.maximum(norm(up, axis=1), np.finfo(float).tiny)[:, None]
    # Triangles around the ends of each edge, without those beyond a crease.
    end, around = _triangles_around(triangles, ends.ravel())
    edge = end // 2
    near = dot(unit[around], up[edge]) > CREASE_COSINE
    edge, around = edge[near], around[near]
    pairs = np.unique(edge[:, None] * count + triangles[around])
    edge, node = pairs // count, pairs % count
    # Coordinates in lengths of the edge, along it and across.
    a, b = points[ends[:, 0]], points[ends[:, 1]]
    length = norm(b - a, axis=1)
    along = (b - a) - dot(b - a, up)[:, None] * up
    along /= np.maximum(norm(along, axis=1), np.finfo(float).tiny)[:, None]
    across = np.cross(up, along)
    away = (points[node] - 0.5 * (a + b)[edge]) / length[edge, None]
    u, v = dot(away, along[edge]), dot(away, across[edge])
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    closeness = 1.0 / (0.25 + u * u + v * v)
    normal = np.zeros((len(ends), COEFFICIENTS, COEFFICIENTS))
    np.add.at(normal, edge, (closeness * closeness)[:, None, None] * terms[:, :, None] * terms[:, None, :])
    values, _ = eigh(normal)
    fits = values[:, 0] > CONDITION_LEAST * values[:, -1]
    right = np.zeros((len(ends), COEFFICIENTS, 1))
    right[:, 3] = -0.25
    normal[~fits] = np.eye(COEFFICIENTS)
    right[~fits] = 0.0
    weight = closeness * closeness * dot(terms, solve(normal, right)[edge, :, 0])
    chosen = fits[edge]
    return edge[chosen], node[chosen], weight[chosen]
