"""Carriers of points near a body's boundary (nearest boundary points), and gradients at nodes."""

import numpy as np
import pytest

from msdm_core.mesh.carriers import REACH, find_carriers, node_gradients
from msdm_core.mesh.geodesic import NearestTriangle
from msdm_core.meshing.lattice_meshing import box_mesh
from tests.patient.organs import kidney

GRADED = box_mesh((0.04, 0.04, 0.04), (16, 16, 16), coarsening=4, fine_depth=0.008)


@pytest.mark.parametrize("mesh", [GRADED, kidney(0.008)], ids=["graded", "kidney"])
def test_nearest_boundary_points_are_those_of_all_triangles(mesh):
    rng = np.random.default_rng(0)
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    points = rng.uniform(low - 0.01, high + 0.01, (200, 3))
    carriers = find_carriers(points, mesh)
    corners = mesh.points[mesh.boundary_triangles]
    np.testing.assert_allclose(carriers.distance, NearestTriangle(corners).distances(points), rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.einsum("pi,pij->pj", carriers.weights, corners[carriers.triangle]), carriers.nearest)
    assert (carriers.weights >= 0.0).all()
    np.testing.assert_allclose(carriers.weights.sum(axis=1), 1.0)


def test_a_point_is_carried_to_a_share_of_the_longest_edges_around_it():
    """Of the mean around each node, interpolated in the nearest triangle."""
    mesh = box_mesh((0.04, 0.04, 0.04), (4, 4, 4))
    longest = [max(np.linalg.norm(a - b) for a in corners for b in corners) for corners in mesh.points[mesh.tets]]
    above = np.array([[0.021, 0.017, 0.04]])
    nearest = find_carriers(above, mesh)
    around = [
        np.mean([length for length, tet in zip(longest, mesh.tets, strict=True) if node in tet])
        for node in mesh.boundary_triangles[nearest.triangle[0]]
    ]
    gaps = REACH * float(nearest.weights[0] @ around) * np.array([0.99, 1.01])
    carriers = find_carriers(above + gaps[:, None] * np.array([0.0, 0.0, 1.0]), mesh)
    np.testing.assert_allclose(carriers.distance, gaps)
    assert carriers.beyond.tolist() == [False, True]


def test_gradients_of_a_linear_function_are_exact_at_every_node():
    mesh = kidney(0.008)
    slope = np.array([[1.5, -0.3, 0.2], [0.1, 0.7, -0.9], [-0.4, 0.6, 1.1]])
    nodes = mesh.boundary_nodes[::3]
    gradients = (node_gradients(mesh, nodes) @ (mesh.points @ slope + 0.02)).reshape(-1, 3, 3)
    np.testing.assert_allclose(gradients, np.broadcast_to(slope, gradients.shape), rtol=0, atol=1e-12)
