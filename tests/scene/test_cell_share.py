"""Cell over contact radius: what a mesh is against its touch, said in reports, with a warning above 1."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from msdm_core.mesh.quality import surface_cell
from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.meshing.lattice_meshing import box_mesh
from surgsim_env.cli.main import main
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


@pytest.mark.parametrize(
    ("name", "share"), [("phantom", 0.884), ("agarose_prism", 1.291), ("bovine_liver_block", 1.155)]
)
def test_blocks_have_the_shares_that_their_files_state(name: str, share: float):
    scene = make_scene(name)
    radius = contact_radius(scene.instrument.tip_radius, scene.palpation.press_depth)
    assert load_anatomy(scene).palpable_cell / radius == pytest.approx(share, abs=1e-3)


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


@pytest.mark.slow
def test_organ_reports_its_share(tmp_path, capsys):
    path = tmp_path / "ball.stl"
    trimesh.creation.icosphere(subdivisions=3, radius=40.0).export(path)
    # The tip goes with the cells, up to 15 mm.
    for cell, tip, warned in (("0.008", "tip 12.5 mm", False), ("0.020", "tip 15 mm", True)):
        assert main(["organ", str(path), "--length-unit", "mm", "--cell-size", cell]) == 0
        printed = capsys.readouterr()
        assert "cell / contact radius" in printed.out and tip in " ".join(printed.out.replace("│", " ").split())
        assert ("the mesh itself is felt" in printed.err) == warned


@pytest.mark.slow
def test_palpate_reports_its_share(tmp_path, capsys):
    around = "0.03,0.03,0.03,0.006"
    given = ["palpate", "--scene", "phantom", "--spacing", "0.006", "--around", around, "--out", str(tmp_path)]
    assert main(given) == 0
    printed = capsys.readouterr()
    assert "cell / contact radius 0.88 (cell 5 mm" in " ".join(printed.out.split()) and "felt" not in printed.err
    press = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))["press"]
    assert press["cell_m"] == pytest.approx(0.005)
    assert press["cell_over_contact_radius"] == pytest.approx(0.005 / np.sqrt(0.008 * 0.004), rel=1e-6)
    assert main([*given, "--press-depth", "0.003"]) == 0
    printed = capsys.readouterr()
    assert "1.02 (cell 5 mm" in printed.out and "the mesh itself is felt" in " ".join(printed.out.split())
    assert "the mesh itself is felt" in printed.err
