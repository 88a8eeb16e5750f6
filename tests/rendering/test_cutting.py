"""A cut-away: section and what is left of the surface close up, and areas are those of geometry. Needs no OpenGL."""

import math

import numpy as np
import pytest

from surgsim_env.rendering.surface import drawn_surface
from surgsim_env.rendering.tissue import Tissue, clip_triangles, cut_plane, cut_tets, most_tets_cut
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene
from tests.rendering.test_surface import area_vectors, bent

TILTED = np.array([0.6, 0.0, 0.8])


def test_section_of_a_block_has_the_rectangles_area():
    """Through the middle of 60 x 60 x 30 mm across x: 60 mm x 30 mm, facing +x."""
    mesh = load_anatomy(make_scene("phantom")).mesh
    mix, faces = cut_tets(mesh, mesh.points[:, 0] - 0.0311)
    vertices = mix @ mesh.points
    np.testing.assert_allclose(vertices[:, 0], 0.0311, atol=1e-15)
    np.testing.assert_allclose(mix.sum(axis=1), 1.0, atol=1e-12)
    vectors = area_vectors(vertices, faces)
    assert (vectors[:, 0] >= -1e-18).all()
    np.testing.assert_allclose(vectors.sum(axis=0), [0.06 * 0.03, 0.0, 0.0], atol=1e-15)


@pytest.mark.parametrize("scene", ["phantom", "liver"])
def test_section_closes_what_is_left_of_the_surface(scene):
    """A closed surface has no total area vector; the liver's drawn surface is bent a little beyond its tets."""
    mesh = load_anatomy(make_scene(scene)).mesh
    through = mesh.points.mean(axis=0) + 0.0011
    surface = drawn_surface(mesh.points, mesh.boundary_triangles)
    vertices, _ = surface.follow(mesh.points)
    values = (vertices - through) @ TILTED
    mix, faces = clip_triangles(surface.faces, values)
    left = mix @ vertices
    assert ((left - through) @ TILTED).max() < 1e-12
    kept = area_vectors(vertices, surface.faces)[(values[surface.faces] < 0.0).all(axis=1)]
    assert len(area_vectors(left, faces)) > len(kept)
    section, section_faces = cut_tets(mesh, (mesh.points - through) @ TILTED)
    total = area_vectors(left, faces).sum(axis=0) + area_vectors(section @ mesh.points, section_faces).sum(axis=0)
    size = np.linalg.norm(area_vectors(left, faces).sum(axis=0))
    assert np.linalg.norm(total) < (1e-12 if scene == "phantom" else 0.01) * size


def test_no_plane_cuts_more_tets_than_the_most():
    mesh = load_anatomy(make_scene("liver")).mesh
    height = (mesh.points @ TILTED)[mesh.tets]
    places = np.linspace(height.min(), height.max(), 400)
    cut = [((height.min(axis=1) < place) & (height.max(axis=1) > place)).sum() for place in places]
    assert 0.9 * most_tets_cut(mesh, TILTED) < max(cut) <= most_tets_cut(mesh, TILTED)


def test_clipping_keeps_all_or_nothing_away_from_the_plane():
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    mix, kept = clip_triangles(faces, np.full(4, -1.0))
    np.testing.assert_array_equal(mix.toarray(), np.eye(4))
    np.testing.assert_array_equal(kept, faces)
    assert len(clip_triangles(faces, np.full(4, 1.0))[1]) == 0


def test_lesion_in_the_section_has_its_circles_area():
    """The plane goes through the lesion's centre: pi r^2, to the fineness of the section's triangles."""
    anatomy = load_anatomy(make_scene("phantom"))
    lesion = anatomy.demonstration_lesions()[0]
    surface = drawn_surface(anatomy.mesh.points, anatomy.mesh.boundary_triangles)
    tissue = Tissue(anatomy, surface, [lesion], True)
    at_rest = tissue.shapes(anatomy.mesh.points)
    area = {name: np.linalg.norm(area_vectors(part.vertices, part.faces).sum(axis=0)) for name, part in at_rest.items()}
    assert area["section_lesion"] == pytest.approx(math.pi * lesion.radius**2, rel=0.003)
    _, towards = cut_plane(anatomy, tissue.lesions)
    for name in ("section", "section_lesion"):
        part = at_rest[name]
        # Slivers of no area, where the plane passes by a node, have no normal.
        large = np.linalg.norm(area_vectors(part.vertices, part.faces), axis=1) > 1e-14
        np.testing.assert_allclose(part.normals[part.faces[large]] @ towards, 1.0, atol=1e-9)
    # The section is made of the tissue's own points: it follows it.
    up = np.array([0.0, 0.0, 0.004])
    moved = tissue.shapes(anatomy.mesh.points + up)["section"]
    np.testing.assert_allclose(moved.vertices, at_rest["section"].vertices + up, atol=1e-15)
    assert np.ptp(tissue.shapes(bent(anatomy.mesh.points))["section"].vertices @ towards) > 1e-3
