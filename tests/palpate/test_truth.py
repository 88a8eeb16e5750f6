"""The point from which a lesion is felt most: above it on a flat face, never where no probe presses."""

from dataclasses import replace

import numpy as np
import pytest

from msdm_core.material.regions import Lesion, Material
from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.meshing.lattice_meshing import box_mesh
from surgsim_apps.palpate.truth import felt_weights, is_pressable, seen_from_surface
from surgsim_env.scene.anatomy import Anatomy, anatomy_of
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import Anchor, Ball, Box
from surgsim_env.scene.palpable_surface import contact_radius

SIZE = (0.10, 0.08, 0.05)
PHANTOM = make_scene("phantom")
MARGIN = 0.012
FLOOR = Anchor("floor", box=Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1e-6)))


def block(*anchors: Anchor, slot: float = 0.0) -> Anatomy:
    """A block of 5 mm cells; with a slot [m] from its flank at x = 0, 10 mm high, 10 mm below the top.

    The slot's floor is jagged, its facets inclined by 45 degrees.
    """
    mesh = box_mesh(SIZE, (20, 16, 10))
    if slot > 0.0:
        x, _, z = mesh.points[mesh.tets].mean(axis=1).T
        left = mesh.tets[~((x < slot) & (z > 0.03) & (z < 0.04))]
        used, tets = np.unique(left, return_inverse=True)
        mesh = TetMesh(mesh.points[used], tets.reshape(-1, 4))
    palpation = replace(PHANTOM.palpation, face_margin=MARGIN, face_angle_deg=60.0)
    return anatomy_of(replace(PHANTOM, anchors=(FLOOR, *anchors), palpation=palpation), mesh)


def lesion(*centre: float, radius: float = 0.008) -> Lesion:
    return Lesion(centre=centre, radius=radius, material=Material(40e3, 1060.0, 0.45), name="A")


def test_on_a_flat_face_it_is_right_above_the_centre():
    (truth,) = seen_from_surface([lesion(0.041, 0.037, 0.036)], block())
    np.testing.assert_allclose(truth.point, [0.041, 0.037, 0.05], atol=1e-12)
    np.testing.assert_allclose(truth.normal, [0.0, 0.0, 1.0], atol=1e-12)
    assert (truth.name, truth.radius) == ("A", 0.008)


def test_beside_the_pressable_face_it_is_the_nearest_place_to_press():
    """5 mm from the flank no site lies: the margin is 12 mm. The points tried lie a third of a cell apart."""
    (truth,) = seen_from_surface([lesion(0.005, 0.04, 0.036, radius=0.004)], block())
    assert truth.point[0] == pytest.approx(MARGIN, abs=0.0017) and truth.point[0] >= MARGIN - 1e-12
    np.testing.assert_allclose(truth.point[1:], [0.04, 0.05], atol=0.0017)


def test_it_keeps_away_from_what_holds_the_organ():
    """A fixed ball of nodes on the top around (40, 40) mm: 2 tip radii of 8 mm beside the nearest of them."""
    anatomy = block(Anchor("clamp", ball=Ball((0.04, 0.04, 0.05), 0.006)))
    (truth,) = seen_from_surface([lesion(0.044, 0.04, 0.036)], anatomy)
    held = anatomy.mesh.points[anatomy.anchors]
    away = np.linalg.norm(held - truth.point, axis=1).min()
    assert 0.016 < away < 0.021
    assert truth.point[0] > 0.044


def test_below_an_overhang_nothing_is_pressed():
    """The floor of the slot faces up, but the top is over it: the lesion is felt through the top."""
    anatomy = block(slot=0.06)
    floor, _ = anatomy.face.project([0.03, 0.04, 0.029])
    assert floor[2] < 0.035, "the floor is part of the face"
    assert not anatomy.face.is_open(floor) and not is_pressable(anatomy, floor)
    assert anatomy.face.is_open(np.array([0.04, 0.04, 0.05]))
    (truth,) = seen_from_surface([lesion(0.04, 0.04, 0.018)], anatomy)
    assert truth.point[2] == pytest.approx(0.05)


def test_hidden_lesions_are_drawn_where_a_tool_gets_to():
    face = block(slot=0.06).face
    points = np.array([face.random_point(np.random.default_rng(seed), 0.012)[0] for seed in range(40)])
    np.testing.assert_allclose(points[:, 2], 0.05)


def test_weights_of_a_small_lesion_are_boussinesq_s():
    """(cos(a) / R^2)^2 with R^2 + a^2 for one R^2: a ball of 0.1 mm, to the square of its size over the depth, 1e-4."""
    anatomy, depth, beside = block(), 0.02, 0.015
    points = np.array([[0.05, 0.04, 0.05], [0.05 + beside, 0.04, 0.05]])
    normals = np.tile([0.0, 0.0, 1.0], (2, 1))
    weights = felt_weights(anatomy, lesion(0.05, 0.04, 0.05 - depth, radius=1e-4), points, normals)
    spread = contact_radius(PHANTOM.instrument.tip_radius, PHANTOM.palpation.press_depth) ** 2
    far = depth**2 + beside**2
    expected = depth**2 / far * ((depth**2 + spread) / (far + spread)) ** 2
    assert weights[1] / weights[0] == pytest.approx(expected, rel=1e-3)
