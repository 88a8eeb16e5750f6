"""The palpable face of the phantom: where sites lie, what is left out, what is drawn."""

from dataclasses import replace

import numpy as np
import pytest
from skfem import MeshTet

from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.meshing.lattice_meshing import box_mesh
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import PalpationSettings
from surgsim_env.scene.palpable_surface import find_palpable_face


@pytest.fixture
def face():
    return load_anatomy(make_scene("phantom")).face


def test_face_is_the_whole_top_and_nothing_else(face):
    corners = face.points[face.triangles]
    assert (corners[..., 2] == 0.03).all()
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert area.sum() == pytest.approx(0.06 * 0.06, rel=1e-12)


def test_rim_is_the_border_of_the_top(face):
    assert face.rim_distance(np.array([0.03, 0.03, 0.03])) == pytest.approx(0.03)
    assert face.rim_distance(np.array([0.004, 0.017, 0.03])) == pytest.approx(0.004)


def test_raster_keeps_its_margin_and_spacing(face):
    points, normals = face.raster(0.005)
    assert points[:, :2].min() >= 0.010 - 1e-9 and points[:, :2].max() <= 0.050 + 1e-9
    np.testing.assert_allclose(normals, np.tile([0.0, 0.0, 1.0], (len(points), 1)), atol=1e-12)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    np.testing.assert_allclose(steps, 0.005, rtol=1e-6)  # boustrophedon: each step to a neighbour


def test_random_points_spread_evenly_and_keep_their_distance(face):
    rng = np.random.default_rng(3)
    points = np.array([face.random_point(rng, 0.012)[0] for _ in range(400)])
    assert points[:, :2].min() >= 0.012 and points[:, :2].max() <= 0.048
    # A uniform square of side 36 mm: mean 30 mm, standard deviation 36 / sqrt(12) = 10.4 mm on each axis.
    np.testing.assert_allclose(points[:, :2].mean(axis=0), 0.03, atol=4 * 0.0104 / 20)
    np.testing.assert_allclose(points[:, :2].std(axis=0), 0.0104, rtol=0.12)
    with pytest.raises(ValueError, match="no point of the palpable face is 40 mm"):
        face.random_point(rng, 0.040)


def test_projection_finds_the_nearest_point_and_its_normal(face):
    point, normal = face.project([0.0213, 0.0377, 0.05])
    np.testing.assert_allclose(point, [0.0213, 0.0377, 0.03], atol=1e-12)
    np.testing.assert_allclose(normal, [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(face.project([-0.01, 0.03, 0.02])[0], [0.0, 0.03, 0.03], atol=1e-12)


def test_thin_places_are_left_out():
    mesh = box_mesh((0.06, 0.06, 0.01), (12, 12, 2))
    palpation = PalpationSettings(press_depth=0.004, thickness_smallest=0.012)
    thin = find_palpable_face(mesh, (0.0, 0.0, -1.0), palpation, 0.004)
    np.testing.assert_allclose(thin.thickness, 0.01, rtol=1e-9)
    assert len(thin.raster(0.01)[0]) == 0
    thick = find_palpable_face(mesh, (0.0, 0.0, -1.0), replace(palpation, thickness_smallest=0.008), 0.004)
    assert len(thick.raster(0.01)[0]) > 20


def test_places_where_the_tool_meets_other_tissue_are_left_out():
    """A floor beside a wall: the tip, 4 mm wide, needs 0.8 of its radius and its shaft 4 mm from the wall."""
    cubes = MeshTet.init_tensor(np.linspace(0.0, 0.06, 31), np.linspace(0.0, 0.06, 31), np.linspace(0.0, 0.04, 21))
    middle = cubes.p[:, cubes.t].mean(axis=1)
    tets = cubes.t.T[(middle[0] > 0.03) | (middle[2] < 0.02)]
    used, numbers = np.unique(tets, return_inverse=True)
    step = TetMesh(cubes.p.T[used], numbers.reshape(tets.shape))
    face = find_palpable_face(step, (0.0, 0.0, -1.0), PalpationSettings(press_depth=0.004, face_margin=0.001), 0.004)
    sites, _ = face.raster(0.001)
    low = sites[sites[:, 2] < 0.021]
    assert 0.0245 < low[:, 0].max() <= 0.026 + 1e-9
    assert sites[:, 0].max() > 0.055
    up = np.array([0.0, 0.0, 1.0])
    assert face.is_clear(np.array([0.02, 0.03, 0.02]), up) and not face.is_clear(np.array([0.027, 0.03, 0.02]), up)
    # On a slope towards the wall the tip clears it, its shaft does not.
    leaning = np.array([-0.6, 0.0, 0.8])
    assert face.is_clear(np.array([0.024, 0.03, 0.02]), leaning)
    assert not face.is_clear(np.array([0.024, 0.03, 0.02]), leaning * [-1.0, 1.0, 1.0])


def test_an_approach_that_nothing_faces_is_refused():
    mesh = box_mesh((0.06, 0.06, 0.01), (6, 6, 1))
    with pytest.raises(ValueError, match="no part of the organ's surface faces"):
        find_palpable_face(mesh, (1.0, 1.0, 1.0), PalpationSettings(press_depth=0.004, face_angle_deg=20.0), 0.004)
