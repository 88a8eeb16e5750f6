"""Rise of edges: closed forms of quadratic surfaces and spheres, what a flat surface and a crease do, rigid motion."""

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from msdm_core.mesh.curvature import CREASE_COSINE, EdgeRise, edge_rise

SPACING, COUNT = 0.005, 8  # [m], squares along a side


def grid(seed: int | None = None) -> tuple[NDArray, NDArray]:
    """Plane nodes and triangles of a square, of a regular grid or with nodes moved by up to a fifth of its spacing."""
    number = np.arange((COUNT + 1) ** 2).reshape(COUNT + 1, COUNT + 1)
    points = np.zeros((number.size, 3))
    points[:, 0], points[:, 1] = (SPACING * axis.ravel() for axis in np.divmod(number, COUNT + 1))
    if seed is not None:
        points[:, :2] += 0.2 * SPACING * np.random.default_rng(seed).uniform(-1.0, 1.0, (number.size, 2))
    a, b, c, d = number[:-1, :-1].ravel(), number[1:, :-1].ravel(), number[1:, 1:].ravel(), number[:-1, 1:].ravel()
    return points, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def rises(rise: EdgeRise, values: NDArray) -> NDArray:
    """Rise of values at the nodes at the middle of each edge, opposite to each corner, (n_triangle, 3, ...)."""
    return np.einsum("tjk,tj...->tk...", rise.weight, values[rise.node])


def edges(triangles: NDArray) -> NDArray:
    """Ends of the edge opposite to each corner, (n_triangle, 3, 2)."""
    return triangles[:, [[1, 2], [2, 0], [0, 1]]]


@pytest.mark.parametrize("seed", [None, 0, 1])
def test_a_quadratic_function_is_met_at_the_middle_of_every_edge(seed: int | None):
    """f(middle) = (f_a + f_b) / 2 + rise: exact at any nodes that a quadratic polynomial is fitted to.

    Of edges with both ends inside the square: at its corners nodes are too few, and edges stay straight.
    """
    points, triangles = grid(seed)
    border = np.bincount(triangles.ravel())[edges(triangles)] < 6
    inner = ~border.any(axis=2)

    def function(place: NDArray) -> NDArray:
        x, y = place[..., 0] / SPACING, place[..., 1] / SPACING
        return 0.3 + 0.7 * x - 1.1 * y + 0.9 * x * x - 1.3 * x * y + 0.4 * y * y

    rise = edge_rise(points, triangles)
    ends = points[edges(triangles)]
    measured = function(ends).mean(axis=2) + rises(rise, function(points))
    scale = np.abs(function(points)).max()
    np.testing.assert_allclose(measured[inner], function(ends.mean(axis=2))[inner], rtol=0, atol=1e-12 * scale)
    assert inner.sum() > 200 and rise.weight.any(axis=1)[inner].all()


@pytest.mark.parametrize("seed", [None, 0])
def test_a_plane_stays_plane(seed: int | None):
    """Weights sum to 0 and annihilate linear functions, of triangles and edges between them alike."""
    points, triangles = grid(seed)
    rise = edge_rise(points, triangles)
    assert np.abs(rise.weight.sum(axis=1)).max() < 1e-13
    assert np.abs(rises(rise, points)).max() < 1e-13 * SPACING * COUNT
    # Both triangles of an edge give it the same rise, of any values.
    values = np.random.default_rng(2).normal(size=len(points))
    ends = np.sort(edges(triangles).reshape(-1, 2), axis=1)
    _, owner = np.unique(ends, axis=0, return_inverse=True)
    measured = rises(rise, values).ravel()
    _, first = np.unique(owner, return_index=True)
    np.testing.assert_allclose(measured, measured[first][owner], rtol=0, atol=1e-13)


def test_a_sphere_rises_by_the_height_of_its_arcs():
    """l^2 / (8 R) along the radius, to second order in l / R: half the edges, a quarter of the error.

    Across the radius it is first order: the normal of an edge is the mean of its two triangles.
    """
    radius, errors = 0.05, []
    for subdivisions in (2, 3, 4):
        ball = trimesh.creation.icosphere(subdivisions, radius)
        points, triangles = np.array(ball.vertices), np.array(ball.faces)
        ends = points[edges(triangles)]
        squared = np.square(ends[:, :, 1] - ends[:, :, 0]).sum(axis=2)
        outward = ends.mean(axis=2) / np.linalg.norm(ends.mean(axis=2), axis=2)[:, :, None]
        height = (rises(edge_rise(points, triangles), points) * outward).sum(axis=2)
        errors.append(float(np.abs(height / (squared / (8.0 * radius)) - 1.0).max()))
    assert errors[0] < 0.1
    assert errors[1] < errors[0] / 3.0 and errors[2] < errors[1] / 3.0


def folded(angle: float) -> tuple[NDArray, NDArray]:
    """The grid folded along its middle line by an angle, its halves plane."""
    points, triangles = grid()
    beyond = points[:, 0] - 0.5 * SPACING * COUNT
    points[:, 0] -= np.where(beyond > 0.0, beyond * (1.0 - np.cos(angle)), 0.0)
    points[:, 2] -= np.where(beyond > 0.0, beyond * np.sin(angle), 0.0)
    return points, triangles


def test_creases_stay_straight():
    """Two plane halves that meet at a right angle: no edge rises. A fold that is no crease bends edges near it."""
    points, triangles = folded(0.5 * np.pi)
    assert np.abs(rises(edge_rise(points, triangles), points)).max() < 1e-13 * SPACING * COUNT
    points, triangles = folded(0.5 * np.arccos(CREASE_COSINE))
    assert np.abs(rises(edge_rise(points, triangles), points)).max() > 0.01 * SPACING


def test_edges_with_too_few_nodes_stay_straight():
    """The four nodes of a square and those of a tetrahedron determine no quadratic polynomial."""
    square = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.1], [1.0, 1.0, 0.0], [0.0, 1.0, 0.1]])
    assert not edge_rise(square, np.array([[0, 1, 2], [0, 2, 3]])).weight.any()
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert not edge_rise(corners, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])).weight.any()


def test_weights_know_no_place_turn_or_size():
    """The same weights for a body moved, turned and scaled, to the rounding of its coordinates."""
    ball = trimesh.creation.icosphere(2, 0.05)
    points, triangles = np.array(ball.vertices) * (1.0, 0.8, 1.3), np.array(ball.faces)
    first = edge_rise(points, triangles)
    turn = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    second = edge_rise(2.5 * points @ turn.T + np.array([0.1, -0.2, 0.05]), triangles)
    np.testing.assert_array_equal(first.node, second.node)
    np.testing.assert_allclose(first.weight, second.weight, rtol=0, atol=1e-11)
