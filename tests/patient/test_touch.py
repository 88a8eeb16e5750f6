"""Tip, cells and their cost, and hidden lesions that fit: `surgsim organ` before and after it makes a mesh."""

from dataclasses import replace

import numpy as np
import pytest

from msdm_core.mesh.surface import outward_facing
from msdm_core.meshing.segmentation_meshing import FineFace, fill_labels
from surgsim_apps.cli.main import main
from surgsim_apps.palpate.scene_options import SceneOptions
from surgsim_apps.patient.lesion_room import lack_of_room, sample_face
from surgsim_apps.patient.meshers import Cells, mesh_surfaces, read_surfaces
from surgsim_apps.patient.touch import plan_touch
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import LesionDraw
from surgsim_env.scene.palpable_surface import contact_radius
from tests.patient.surfaces import ball

TROCAR_RADIUS = 0.006
BALL = 4.0 / 3.0 * np.pi * 0.03**3


@pytest.mark.parametrize("volume", [50e-6, 200e-6, 2000e-6])
def test_a_default_tip_passes_a_trocar_of_12_mm(volume):
    plan = plan_touch(volume, SceneOptions(), cell_size=None, graded=True)
    assert 0.004 <= plan.tip_radius <= TROCAR_RADIUS
    assert plan.cell_size < 0.9 * contact_radius(plan.tip_radius, plan.press_depth) + 1e-5


@pytest.mark.parametrize("way", ["surface", "labels"])
def test_cells_are_fine_at_the_pressed_face_and_as_many_as_was_said(way, tmp_path):
    plan = plan_touch(BALL, SceneOptions(), cell_size=None, graded=True)
    assert plan.coarsening > 1
    approach = (0.0, 0.0, -1.0)
    if way == "surface":
        cells = Cells(plan.cell_size, True, plan.coarsening, plan.fine_depth, approach, 60.0)
        mesh = mesh_surfaces(
            read_surfaces([ball(tmp_path / "liver.stl")], "mm", mend=False), cells=cells, mesher="lattice"
        ).mesh
    else:
        axis = np.arange(-33.0, 34.0, 1.5)
        inside = (np.stack(np.meshgrid(axis, axis, axis)) ** 2).sum(axis=0) <= 30.0**2
        face = FineFace(approach, 60.0, plan.fine_depth, plan.coarsening)
        names = {1: "liver"}
        filled = fill_labels(
            inside.astype(np.uint8), (0.0015,) * 3, cell_size=plan.cell_size, region_names=names, fine_face=face
        )
        mesh = filled.mesh
        assert abs(filled.volume_error) < 0.005
    triangles = mesh.boundary_triangles
    side = np.linalg.norm(mesh.points[triangles] - mesh.points[triangles[:, [1, 2, 0]]], axis=2).mean(axis=1)
    pressed = outward_facing(mesh.points, triangles, approach, 50.0)
    behind = outward_facing(mesh.points, triangles, (0.0, 0.0, 1.0), 50.0)
    # Triangles of cut cells are smaller than the cells, by the same factor at both sides on average.
    assert side[behind].mean() > 0.8 * plan.coarsening * side[pressed].mean()
    # What `plan_touch` states of its estimate.
    assert mesh.node_count == pytest.approx(plan.node_count, rel=0.3)


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (["--tip-radius", "0"], "--tip-radius is 0 m; it must be finite and above 0"),
        (["--press-depth", "inf"], "--press-depth is inf m; it must be finite"),
        (["--remesh"], "--remesh goes with a file of tets"),
    ],
)
def test_touches_that_are_impossible(option, words, tmp_path, refusal):
    assert words in refusal("organ", ball(tmp_path / "liver.stl"), "--length-unit", "mm", *option)


def test_the_plan_is_said_with_a_coarser_choice_before_the_mesh(tmp_path, capsys):
    """The cells of this tip are finer than any mesh may have, so that the command ends there."""
    given = ["organ", str(ball(tmp_path / "liver.stl")), "--length-unit", "mm", "--tip-radius", "0.00012"]
    assert main(given) == 2
    printed = capsys.readouterr()
    assert "nodes" in printed.out and "times real time" in printed.out and "coarser: --tip-radius" in printed.out
    assert "filling it with tets" in printed.out


@pytest.fixture(scope="module")
def phantom():
    return sample_face(load_anatomy(make_scene("phantom")))


def test_lesions_that_a_scene_draws_find_room_in_it(phantom):
    assert lack_of_room(phantom, phantom.anatomy.scene.lesion) == ""


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rim_distance": 0.029}, "points of the palpable face"),
        ({"cover": (0.02, 0.03)}, "under 30 mm of tissue fits"),
        ({"radius": (0.0115, 0.0125)}, "balls of"),
    ],
)
def test_why_lesions_do_not_fit(changes, words, phantom):
    """The border, the depth of 30 mm, and three of them beside each other on 60 mm are in the way."""
    draw: LesionDraw = replace(phantom.anatomy.scene.lesion, **changes)
    assert words in lack_of_room(phantom, draw)
