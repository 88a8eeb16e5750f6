"""A fine surface moves with the tets that carry it. Needs no OpenGL."""

import numpy as np
import pytest
import trimesh

from msdm_core.errors import MeshError
from msdm_core.meshing.lattice_meshing import box_mesh, mesh_surface
from surgsim_env.rendering.embedding import embedded_surface

RADIUS, CELL = 0.03, 0.006


@pytest.fixture(scope="module")
def ball():
    """A ball of tets, with boundary triangles of 6 mm, and its own surface, with edges of 1.2 to 2.4 mm."""
    fine = trimesh.creation.icosphere(4, RADIUS)
    mesh = mesh_surface(fine.vertices, fine.faces, cell_size=CELL)
    return mesh, embedded_surface(fine.vertices, fine.faces, mesh), np.array(fine.vertices)


def turn(angle, axis):
    """Rodrigues' rotation by an angle [rad] about an axis, (3, 3)."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def test_lies_at_rest_where_the_file_has_it(ball):
    mesh, surface, vertices = ball
    result, normals = surface.follow(mesh.points)
    np.testing.assert_allclose(result, vertices, rtol=0, atol=1e-15)
    # Not on the mesh, whose flat triangles cut the ball.
    assert np.linalg.norm(mesh.points, axis=1).max() < RADIUS * (1.0 + 1e-9)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=0, atol=1e-12)
    assert (normals * vertices / RADIUS).sum(axis=1).min() > 0.999


def test_a_rigid_motion_moves_it_rigidly(ball):
    mesh, surface, vertices = ball
    rotation, shift = turn(1.1, np.array([1.0, -2.0, 0.5])), np.array([0.3, -0.2, 0.1])
    result, normals = surface.follow(mesh.points @ rotation.T + shift)
    np.testing.assert_allclose(result, vertices @ rotation.T + shift, rtol=0, atol=1e-12)
    np.testing.assert_allclose(normals, surface.follow(mesh.points)[1] @ rotation.T, rtol=0, atol=1e-12)


def test_a_linear_motion_moves_it_exactly(ball):
    mesh, surface, vertices = ball
    stretch = np.array([[1.2, 0.3, -0.1], [0.0, 0.8, 0.2], [0.1, -0.2, 1.1]])
    result, _ = surface.follow(mesh.points @ stretch + 0.01)
    np.testing.assert_allclose(result, vertices @ stretch + 0.01, rtol=0, atol=1e-14)


def test_a_bend_moves_it_more_smoothly_than_straight_tets_would():
    """The bottom of a block, bent by z = x^2 / (2 R): flat triangles with edge h err by up to h^2 / (8 R)."""
    mesh, bend = box_mesh((0.06, 0.03, 0.02), (6, 3, 2)), 0.05
    x, y = np.meshgrid(np.linspace(0.012, 0.048, 40), np.linspace(0.012, 0.018, 10), indexing="ij")
    vertices = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    surface = embedded_surface(vertices, np.array([[0, 1, 2]], dtype=np.int32), mesh)

    def bent(points):
        return np.column_stack([points[:, :2], points[:, 2] + points[:, 0] ** 2 / (2.0 * bend)])

    error = np.abs(surface.follow(bent(mesh.points))[0][:, 2] - bent(vertices)[:, 2]).max()
    flat = np.abs(surface.interpolate(bent(mesh.points)[:, 2]) - bent(vertices)[:, 2]).max()
    assert flat == pytest.approx(0.01**2 / (8.0 * bend), rel=0.1)
    assert error < 0.25 * flat


def test_values_at_boundary_nodes_are_mixed_and_never_exceeded(ball):
    """Paint: a constant stays one, a linear function is met but for the gap, unknown inner nodes do not count."""
    mesh, surface, vertices = ball
    values = np.full(mesh.node_count, np.nan)
    values[mesh.boundary_nodes] = mesh.points[mesh.boundary_nodes, 2]
    inner = np.setdiff1d(np.arange(mesh.node_count), mesh.boundary_nodes)
    assert len(inner)
    result = surface.interpolate(np.nan_to_num(values, nan=1e9))
    assert values[mesh.boundary_nodes].min() <= result.min() and result.max() <= values[mesh.boundary_nodes].max()
    # At most the largest gap between ball and mesh, CELL^2 / (8 R) of an edge's middle, doubled for a triangle's.
    assert np.abs(result - vertices[:, 2]).max() < 2.0 * 2.0 * CELL**2 / (8.0 * RADIUS)
    np.testing.assert_allclose(surface.interpolate(np.ones(mesh.node_count)), 1.0)


def test_a_vertex_far_outside_is_refused_by_its_name(ball):
    mesh, surface, vertices = ball
    moved = vertices.copy()
    moved[17] *= 1.5
    with pytest.raises(MeshError, match=r"vertex 17 .* 15(\.\d+)? mm"):
        embedded_surface(moved, surface.faces, mesh)
