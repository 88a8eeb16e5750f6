"""The fine surface of a patient's organ: from labels or a file, fitted to the tets, written, read and drawn."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from msdm_core.errors import MeshError
from msdm_core.mesh.carriers import find_carriers
from msdm_core.mesh.surface import check_surface, surface_volume
from msdm_core.meshing.lattice_meshing import mesh_surface
from msdm_core.meshing.segmentation_meshing import smoothed_share
from surgsim_apps.patient.fine_surface import (
    fewer_triangles,
    fitted_surface,
    level_surface,
    split_edges,
    surface_area,
)
from surgsim_apps.reports.surface_drawing import organ_patches
from surgsim_env.rendering.embedding import EmbeddedSurface, organ_surface
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import load_scene
from surgsim_env.scene.model import FineSurface
from tests.patient.scans import AXES, MIDDLE, ORGAN_VOLUME

RADIUS = 0.03


def longest_edge(vertices, triangles):
    return np.linalg.norm(vertices[triangles] - vertices[np.roll(triangles, 1, axis=1)], axis=2).max()


@pytest.fixture(scope="module")
def voxel_ball():
    """A ball of voxels of 1 x 1 x 2.5 mm, smoothed, its centre, and its volume."""
    step, shape = np.array([0.001, 0.001, 0.0025]), (81, 81, 35)
    centre = 0.5 * (np.array(shape) - 1) * step
    places = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1) * step
    organ = np.linalg.norm(places - centre, axis=-1) <= RADIUS
    field = smoothed_share(organ, np.zeros(3, dtype=np.int64), step, 0.006)
    return field, centre, float(np.count_nonzero(organ) * step.prod())


def test_the_surface_of_labels_is_closed_outward_and_has_their_volume_and_place(voxel_ball):
    field, centre, volume = voxel_ball
    vertices, triangles = level_surface(field, volume, 4.0 * np.pi * RADIUS**2, 20_000)
    check_surface(vertices, triangles)
    assert len(triangles) == pytest.approx(20_000, rel=0.1)
    assert surface_volume(vertices, triangles) == pytest.approx(volume, rel=0.005)
    distance = np.linalg.norm(vertices - centre, axis=1)
    # Slices of 2.5 mm, whose steps reach half a slice, are smoothed to a quarter of one.
    assert np.abs(distance - RADIUS).max() < 0.25 * 0.0025 + 0.0006
    assert distance.std() < 0.0002


def test_vertices_lie_on_the_level(voxel_ball):
    field, _, volume = voxel_ball
    vertices, _ = level_surface(field, volume, 4.0 * np.pi * RADIUS**2, 5_000)
    assert np.abs(field.at(vertices) - field.level_of(volume)).max() < 1e-3


def test_a_surface_with_too_many_triangles_keeps_shape_and_side():
    ball = trimesh.creation.icosphere(5, RADIUS)
    vertices, triangles = fewer_triangles(np.array(ball.vertices), np.array(ball.faces), 3_000)
    assert 2_000 < len(triangles) <= 3_000
    check_surface(vertices, triangles)
    assert surface_volume(vertices, triangles) == pytest.approx(4.0 / 3.0 * np.pi * RADIUS**3, rel=0.02)
    same, kept = fewer_triangles(ball.vertices, ball.faces, len(ball.faces))
    assert same is ball.vertices and kept is ball.faces


def test_long_edges_are_halved_without_cracks_and_a_box_stays_a_box():
    box = trimesh.creation.box((0.06, 0.04, 0.02))
    vertices, triangles = split_edges(np.array(box.vertices), np.array(box.faces), 0.004)
    check_surface(vertices, triangles)
    assert longest_edge(vertices, triangles) <= 0.004
    assert surface_volume(vertices, triangles) == pytest.approx(0.06 * 0.04 * 0.02, rel=1e-12)
    assert surface_area(vertices, triangles) == pytest.approx(box.area, rel=1e-12)


def test_halves_of_a_smooth_surface_lie_nearer_to_it_than_flat_triangles():
    ball = trimesh.creation.icosphere(2, RADIUS)
    vertices, triangles = split_edges(np.array(ball.vertices), np.array(ball.faces), 0.005)
    check_surface(vertices, triangles)
    flat = RADIUS - np.linalg.norm(ball.vertices[ball.edges_unique].mean(axis=1), axis=1).min()
    assert np.abs(np.linalg.norm(vertices, axis=1) - RADIUS).max() < 0.6 * flat


def test_parts_without_tets_are_drawn_on_the_boundary_and_counted():
    """A ball with a thin spike of 20 mm, which no cell of 6 mm holds."""
    ball = trimesh.creation.icosphere(4, RADIUS)
    spiked = np.array(ball.vertices)
    top = int(spiked[:, 2].argmax())
    spiked[top, 2] += 0.02
    mesh = mesh_surface(ball.vertices, ball.faces, cell_size=0.006)
    fit = fitted_surface(spiked, np.array(ball.faces), mesh, 0.006)
    carriers = find_carriers(fit.vertices, mesh)
    assert not carriers.beyond.any() and fit.moved > 0
    assert np.count_nonzero(carriers.distance < 1e-12) == fit.moved
    assert fit.vertices[:, 2].max() < RADIUS + carriers.reach.max() < spiked[top, 2]
    assert f"{fit.moved} vertices that were farther" in fit.text
    assert fitted_surface(np.array(ball.vertices), np.array(ball.faces), mesh, 0.006).moved == 0


def test_the_reach_does_not_depend_on_which_of_equally_near_triangles_is_found():
    """Above an edge two triangles are equally near, and tets of different sizes lie behind them."""
    ball = trimesh.creation.icosphere(4, RADIUS)
    mesh = mesh_surface(ball.vertices, ball.faces, cell_size=0.006)
    above = 1.1 * mesh.points[mesh.boundary_triangles[:, :2]].mean(axis=1)
    rng = np.random.default_rng(0)
    carriers = [find_carriers(above + rng.normal(0.0, 1e-9, above.shape), mesh) for _ in range(4)]
    assert (np.ptp([carrier.triangle for carrier in carriers], axis=0) > 0).any()
    reaches = np.array([carrier.reach for carrier in carriers])
    assert np.ptp(reaches, axis=0).max() < 1e-5 * reaches.min()
    assert np.ptp(reaches[0]) > 0.1 * reaches[0].mean()


def test_a_scan_s_surface_is_written_named_and_drawn(written):
    """Its vertices lie on the ellipsoid of the scan, in the patient's axes."""
    anatomy = load_anatomy(load_scene(written / "patient.toml"))
    assert anatomy.scene.mesh.fine_surface == FineSurface("patient_surface.ply", "m")
    vertices, triangles = anatomy.fine_surface
    check_surface(vertices, triangles)
    assert surface_volume(vertices, triangles) == pytest.approx(ORGAN_VOLUME, rel=0.015)

    def off(points):
        return np.abs(np.linalg.norm((1e3 * points - MIDDLE) / AXES, axis=1) - 1.0)

    # A voxel of 1.5 x 1.5 x 2.5 mm cannot say more than its half diagonal.
    assert off(vertices).max() < 0.5 * np.linalg.norm([1.5, 1.5, 2.5]) / AXES.min()
    assert np.median(off(vertices)) < 0.005
    drawn = organ_surface(anatomy)
    assert isinstance(drawn, EmbeddedSurface) and drawn.vertex_count == len(vertices)
    np.testing.assert_allclose(drawn.follow(anatomy.mesh.points)[0], vertices, rtol=0, atol=1e-12)


def test_a_surface_of_another_organ_or_unit_is_refused_when_it_is_drawn(written):
    scene = load_scene(written / "patient.toml")
    other = FineSurface(file="patient_surface.ply", length_unit=0.8)
    anatomy = load_anatomy(replace(scene, mesh=replace(scene.mesh, fine_surface=other)))
    for draw in (organ_surface, organ_patches):
        with pytest.raises(MeshError, match=r"vertex \d+"):
            draw(anatomy)
