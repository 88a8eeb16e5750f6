"""Supports of an organ: fat by default, attachments by the organ's name in the axes of a scan."""

import numpy as np
import pytest

from msdm_core.meshing.lattice_meshing import box_mesh
from surgsim_apps.patient.supports import held_text, organ_anchors

MESH = box_mesh((0.06, 0.05, 0.10), (6, 5, 10))
FRONT = (0.0, 1.0, 0.0)


def anchors(name, *, is_scan=True):
    return organ_anchors(name, MESH, FRONT, is_scan=is_scan)


@pytest.mark.parametrize(
    ("name", "tissues"),
    [
        ("liver", ["surrounding fat and wall", "bare area and coronary ligaments", "falciform ligament"]),
        ("Left Kidney", ["perirenal fat and Gerota's fascia", "hilum"]),
        ("spleen", ["surrounding fat and wall", "hilum"]),
        ("pancreas", ["surrounding fat and wall"]),
    ],
)
def test_tissues_go_by_the_organ_s_name(name, tissues):
    supports, sources = anchors(name)
    assert [anchor.name for anchor in supports] == tissues
    assert all(anchor.is_elastic for anchor in supports)
    assert {f"anchors[{number}].stiffness" for number in range(len(supports))} <= set(sources)
    # In axes that mean nothing nobody knows where a hilum is.
    assert [anchor.name for anchor in anchors(name, is_scan=False)[0]] == tissues[:1]


def test_the_hilum_faces_the_spine():
    """x points to the patient's left: the left kidney has its hilum at low x, the right one at high x."""
    names = ("left kidney", "right kidney")
    left, right = (next(anchor.ball for anchor in anchors(name)[0] if anchor.ball) for name in names)
    middle = MESH.points.mean(axis=0)
    assert left.centre[0] < middle[0] - 0.02 and right.centre[0] > middle[0] + 0.02
    assert np.linalg.norm(MESH.points[MESH.boundary_nodes] - left.centre, axis=1).min() < 1e-4


def test_the_bare_area_is_behind_and_above():
    ball = anchors("liver")[0][1].ball
    assert ball.centre[1] > 0.04 and ball.centre[2] > 0.05


def test_the_words_for_a_report_give_both_stiffnesses():
    (fat,) = anchors("pancreas")[0]
    assert f"{fat.stiffness:g}" in held_text(fat) and f"{fat.shear_stiffness:g}" in held_text(fat)
