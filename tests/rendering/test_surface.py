"""The drawn surface: follows the nodes, unit normals outward, creases kept, no cracks. Needs no OpenGL."""

import numpy as np
import pytest

from surgsim_env.rendering.surface import BEND_MOST, drawn_surface, smooth_normals
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene


@pytest.fixture(params=["phantom", "liver"])
def mesh(request):
    return load_anatomy(make_scene(request.param)).mesh


def area_vectors(vertices, faces):
    corners = vertices[faces]
    return 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def bent(points):
    """A smooth displacement of up to 5 mm."""
    return points + 0.005 * np.sin(40.0 * points[:, [1, 2, 0]])


def test_normals_are_unit_and_point_outward(mesh):
    surface = drawn_surface(mesh.points, mesh.boundary_triangles)
    for points in (mesh.points, bent(mesh.points)):
        vertices, normals = surface.follow(points)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)
        # Each vertex's normal is on the outer side of every small triangle around it.
        outward = np.einsum("fx,fkx->fk", area_vectors(vertices, surface.faces), normals[surface.faces])
        assert (outward > 0.0).mean() > 0.9999
    # Outward of the body, not inward: the divergence theorem gives its volume with the right sign.
    corners = vertices[surface.faces]
    volume = np.einsum("fi,fi->", corners.mean(axis=1), area_vectors(vertices, surface.faces)) / 3.0
    tets = points[mesh.tets]
    exact = np.abs(np.linalg.det(tets[:, 1:] - tets[:, :1])).sum() / 6.0
    assert volume == pytest.approx(exact, rel=0.015)


def test_passes_through_every_surface_node(mesh):
    """A corner of a triangle is a vertex: p - BEND n n . (p - x) = x where p = x."""
    surface = drawn_surface(mesh.points, mesh.boundary_triangles)
    points = bent(mesh.points)
    vertices, _ = surface.follow(points)
    single = np.diff(surface.weights.indptr) == 1
    nodes = surface.corner_node[surface.weights.indices[surface.weights.indptr[:-1][single]]]
    assert set(nodes) == set(mesh.boundary_nodes)
    np.testing.assert_allclose(vertices[single], points[nodes], atol=1e-15)


def test_has_no_crack_also_when_it_is_bent(mesh):
    """Each small edge has a neighbour the other way round at the same place, crease or not."""
    surface = drawn_surface(mesh.points, mesh.boundary_triangles)
    vertices, _ = surface.follow(bent(mesh.points))
    _, place = np.unique(np.round(vertices / 1e-9), axis=0, return_inverse=True)
    faces = place.ravel()[surface.faces]
    half = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert {tuple(edge) for edge in half.tolist()} == {tuple(edge[::-1]) for edge in half.tolist()}


def test_keeps_the_creases_of_a_block_and_rounds_an_organ():
    """Normals of a block at rest are those of its six faces; those of a liver differ from its flat triangles'."""
    block = load_anatomy(make_scene("phantom")).mesh
    vertices, normals = drawn_surface(block.points, block.boundary_triangles).follow(block.points)
    np.testing.assert_allclose(np.abs(normals).max(axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(vertices.max(axis=0), [0.06, 0.06, 0.03], atol=1e-12)
    liver = load_anatomy(make_scene("liver")).mesh
    surface = drawn_surface(liver.points, liver.boundary_triangles)
    flat = surface.weights @ liver.points[surface.corner_node]
    rounded, _ = surface.follow(liver.points)
    moved = np.linalg.norm(rounded - flat, axis=1)
    assert 1e-4 < moved.max() <= BEND_MOST * 1.000001


def test_one_moved_node_moves_its_neighbourhood_alone(mesh):
    surface = drawn_surface(mesh.points, mesh.boundary_triangles)
    before, _ = surface.follow(mesh.points)
    node = mesh.boundary_triangles[7, 0]
    points = mesh.points.copy()
    points[node] += [0.0, 0.0, 0.003]
    after, _ = surface.follow(points)
    moved = np.linalg.norm(after - before, axis=1)
    near = np.linalg.norm(before - mesh.points[node], axis=1) < 0.05
    assert moved.max() == pytest.approx(0.003, rel=0.2)
    assert (moved[~near] == 0.0).all()


def test_smooth_normals_of_a_plane_are_the_planes():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], dtype=float)
    normals = smooth_normals(vertices, np.array([[0, 1, 2], [1, 3, 2]]))
    np.testing.assert_allclose(normals, np.tile([0.0, 0.0, 1.0], (4, 1)), atol=1e-15)
