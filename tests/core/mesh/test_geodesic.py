"""Distance along a surface against planes, unfolded edges and great circles."""

import numpy as np
import pytest
import trimesh

from msdm_core.mesh.geodesic import NearestTriangle, SurfaceDistance, nearest_weights
from msdm_core.meshing.lattice_meshing import box_mesh

# Paths between Steiner points are never shorter than the geodesic and, over several triangles, at most 2 % longer.
LONGEST = 1.02


def test_on_a_flat_face_it_is_the_straight_line():
    mesh = box_mesh((0.06, 0.06, 0.03), (12, 12, 6))
    rng = np.random.default_rng(0)
    targets = np.column_stack([rng.random((60, 2)) * 0.06, np.full(60, 0.03)])
    source = np.array([0.0312, 0.0287, 0.03])
    ratio = SurfaceDistance(mesh.points, mesh.boundary_triangles)(source, targets)
    ratio /= np.linalg.norm(targets - source, axis=1)
    assert ratio.min() >= 1.0 - 1e-9
    assert ratio.max() <= LONGEST


def test_over_an_edge_it_is_the_unfolded_line():
    mesh = box_mesh((0.06, 0.06, 0.03), (12, 12, 6))
    distance = SurfaceDistance(mesh.points, mesh.boundary_triangles)([0.02, 0.055, 0.03], [[0.03, 0.06, 0.022]])[0]
    unfolded = np.hypot(0.01, 0.005 + 0.008)
    assert unfolded <= distance <= LONGEST * unfolded


def test_on_a_sphere_it_is_the_great_circle():
    sphere = trimesh.creation.icosphere(4, radius=0.05)
    points = np.array(sphere.vertices)
    targets = points[1::40]
    angle = np.arccos(np.clip(targets @ points[0] / 0.05**2, -1.0, 1.0))
    ratio = SurfaceDistance(points, np.array(sphere.faces))(points[0], targets) / (0.05 * angle)
    assert 0.99 <= ratio.min() and ratio.max() <= LONGEST  # facets cut the corner by less than 1 %


def test_the_other_side_of_a_thin_plate_is_far():
    mesh = box_mesh((0.06, 0.06, 0.002), (30, 30, 1))
    distance = SurfaceDistance(mesh.points, mesh.boundary_triangles)([0.03, 0.03, 0.002], [[0.03, 0.03, 0.0]])[0]
    assert 0.06 <= distance <= LONGEST * 0.062


def test_same_point_is_zero_away():
    mesh = box_mesh((0.06, 0.06, 0.03), (6, 6, 3))
    assert SurfaceDistance(mesh.points, mesh.boundary_triangles)([0.02, 0.02, 0.03], [[0.02, 0.02, 0.03]])[0] == 0.0


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.002, 0.2])
def test_balls_exclude_no_nearest_triangle(size):
    """Index and weights equal those of a search of all triangles: from near and far, at centres and corners."""
    rng = np.random.default_rng(4)
    places, sizes = rng.uniform(-0.05, 0.05, (400, 1, 3)), rng.uniform(0.0, 0.02, (400, 1, 1))
    corners = places + sizes * rng.uniform(-1.0, 1.0, (400, 3, 3))
    nearest = NearestTriangle(corners)
    queries = np.concatenate([rng.uniform(-0.2, 0.2, (50, 3)), corners.mean(axis=1)[:30], corners[30:60, 1]])
    for query in queries + size * rng.standard_normal(queries.shape):
        weights = nearest_weights(corners, query)
        squared = ((np.einsum("ti,tij->tj", weights, corners) - query) ** 2).sum(axis=1)
        triangle, weights_there = nearest(query)
        assert triangle == np.argmin(squared)
        np.testing.assert_array_equal(weights_there, weights[triangle])
