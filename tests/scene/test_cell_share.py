"""Cell over contact radius: what a mesh is against its touch, with a warning above 1."""

import warnings
from dataclasses import replace

import pytest

from msdm_core.mesh.quality import surface_cell
from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.meshing.lattice_meshing import box_mesh
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import BlockMesh, MeshSource
from surgsim_env.scene.palpable_surface import contact_radius


def test_a_block_has_the_cells_it_was_made_of():
    """A tet of the lattice is a^3 / 12, wherever it lies; a body twice as large has cells twice as large."""
    mesh = box_mesh((0.06, 0.06, 0.03), (12, 12, 6))
    assert surface_cell(mesh, mesh.boundary_triangles) == pytest.approx(0.005, rel=1e-9)
    larger = TetMesh(2.0 * mesh.points, mesh.tets)
    assert surface_cell(larger, larger.boundary_triangles) == pytest.approx(0.010, rel=1e-9)


def test_only_cells_at_the_surface_count():
    """A block that is coarse below: 5 mm where it is felt, 10 mm at its floor."""
    mesh = box_mesh((0.06, 0.06, 0.06), (12, 12, 12), coarsening=2, fine_depth=0.015)
    heights = mesh.points[mesh.boundary_triangles][:, :, 2]
    top, floor = (heights > 0.06 - 1e-9).all(axis=1), (heights < 1e-9).all(axis=1)
    assert surface_cell(mesh, mesh.boundary_triangles[top]) == pytest.approx(0.005, rel=1e-9)
    assert surface_cell(mesh, mesh.boundary_triangles[floor]) == pytest.approx(0.010, rel=1e-9)


def test_the_liver_is_fine_enough():
    """Its lattice is 9 mm; cut by the surface, its tets there are a little smaller."""
    scene = make_scene("liver")
    assert 0.8 * 0.009 < load_anatomy(scene).palpable_cell < 0.009
    assert 0.009 < contact_radius(scene.instrument.tip_radius, scene.palpation.press_depth)


def test_a_scene_whose_mesh_is_felt_warns_and_a_finer_one_does_not():
    scene = make_scene("phantom")
    coarse = replace(scene, name="coarse", mesh=MeshSource(block=BlockMesh((0.06, 0.06, 0.03), (10, 10, 5))))
    with pytest.warns(UserWarning, match=r"scene 'coarse': cell / contact radius is 1\.06 .*of at most 5\.66 mm"):
        load_anatomy(coarse)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_anatomy(replace(scene, name="fine"))
