"""Anchors of an organ: fixed nodes and elastic tissue by box, ball and side; sites clear of both; bad input."""

import math
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from msdm_core.meshing.lattice_meshing import box_mesh
from surgsim_env.scene.anatomy import anatomy_of
from surgsim_env.scene.load import make_scene, scene_from_table
from surgsim_env.scene.model import Anchor, Ball, Box, Side
from surgsim_env.scene.save import as_toml

MESH = box_mesh((0.06, 0.05, 0.04), (6, 5, 4))
DOWN = (0.0, 0.0, -1.0)
FAT = {"stiffness": 2e5, "shear_stiffness": 7e4}
SCENE = make_scene("phantom")


def held(*anchors: Anchor):
    return anatomy_of(replace(SCENE, anchors=anchors), MESH)


def test_a_side_is_the_surface_that_faces_that_way():
    """Flanks of a block face neither up nor down; seen from 45 degrees, two faces do."""
    below = MESH.points[:, 2] < 1e-9
    np.testing.assert_array_equal(held(Anchor("a", side=Side(DOWN))).anchors, np.flatnonzero(below))
    two = held(Anchor("a", side=Side((-3.0, 0.0, -3.0), 46.0))).anchors
    x, _, z = MESH.points[two].T
    assert ((x < 1e-9) | (z < 1e-9)).all() and (x < 1e-9).sum() > 10 and (z < 1e-9).sum() > 10


def test_elastic_tissue_holds_by_its_surface_and_fixes_nothing():
    box = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 0.015))
    fixed, elastic = held(Anchor("a", box=box)), held(Anchor("a", box=box, **FAT))
    inside = np.flatnonzero(MESH.points[:, 2] <= 0.015)
    np.testing.assert_array_equal(fixed.anchors, inside)
    assert len(fixed.foundations) == len(elastic.anchors) == 0
    (foundation,) = elastic.foundations
    np.testing.assert_array_equal(foundation.nodes, np.intersect1d(inside, MESH.boundary_nodes))
    assert len(elastic.foundation_nodes) < len(inside)
    model = elastic.organ()
    np.testing.assert_array_equal(model.foundation_nodes, elastic.foundation_nodes)
    assert (model.node_inverse_mass > 0.0).all()


def test_a_node_may_be_held_by_several_tissues():
    ball = Anchor("ligament", ball=Ball((0.03, 0.025, 0.0), 0.012), stiffness=1e6, shear_stiffness=0.0)
    fat = Anchor("fat", box=Box((-1.0, -1.0, -1.0), (1.0, 1.0, 0.004)), **FAT)
    both, alone = held(fat, ball).organ(), held(fat).organ()
    np.testing.assert_array_equal(both.foundation_nodes, alone.foundation_nodes)
    added = (both.foundation_stiffness - alone.foundation_stiffness)[:, 2, 2]
    middle = np.linalg.norm(both.foundation_position - [0.03, 0.025, 0.0], axis=1) <= 0.012
    assert (added[middle] > 0.0).all() and (added[~middle] == 0.0).all()


def test_sites_are_clear_of_what_holds_the_organ():
    """Two tip radii from fixed nodes, one from elastic tissue."""
    tip = SCENE.instrument.tip_radius
    corner = Ball((0.0, 0.0, 0.04), 1e-6)
    points = np.array([[0.9 * tip, 0.0, 0.04], [1.5 * tip, 0.0, 0.04], [2.1 * tip, 0.0, 0.04]])
    floor = Anchor("floor", box=Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1e-6)))
    np.testing.assert_array_equal(held(floor, Anchor("a", ball=corner)).clear_of_supports(points), [False, False, True])
    elastic = held(floor, Anchor("a", ball=corner, **FAT))
    np.testing.assert_array_equal(elastic.clear_of_supports(points), [False, True, True])


def test_a_scene_with_elastic_tissue_is_written_and_read():
    anchors = (Anchor("fat", side=Side(DOWN, 110.0), **FAT), Anchor("a", ball=Ball((0.0, 0.0, 0.0), 0.01)))
    text = as_toml(replace(SCENE, anchors=anchors), comments={"anchors[0].stiffness": "[N/m^3] chosen"})
    assert "# [N/m^3] chosen" in text
    assert scene_from_table(tomllib.loads(text), name="a", folder=Path(".")).anchors == anchors


@pytest.mark.parametrize(
    ("entries", "named"),
    [
        ({"stiffness": 1e5}, "shear_stiffness"),
        ({"stiffness": math.inf, "shear_stiffness": 0.0}, "stiffness is inf"),
        ({"stiffness": 1.0, "shear_stiffness": -1.0}, "shear_stiffness is -1"),
    ],
)
def test_bad_anchors_are_refused(entries, named):
    with pytest.raises(ValueError, match=f"'fat'.*{named}"):
        Anchor("fat", **{"side": Side(DOWN), **entries})
