"""The approach of a scan faces its segmented lesions; a remark names those that it does not face."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.meshing.lattice_meshing import box_mesh
from surgsim_apps.patient.facing import MARGIN_DEG, faced_note, facing_approach
from surgsim_env.scene.load import make_scene

USUAL = (0.0, 0.0, -1.0)
ANGLE = 60.0
SIZE = np.array([0.08, 0.08, 0.08])


def patient(**centres):
    """A cube with balls of 8 mm as regions."""
    mesh = box_mesh(tuple(SIZE), (16, 16, 16))
    middles = mesh.points[mesh.tets].mean(axis=1)
    region = np.ones(mesh.tet_count, dtype=np.int32)
    names = [(1, "liver")]
    for tag, (name, centre) in enumerate(centres.items(), start=2):
        region[np.linalg.norm(middles - np.array(centre), axis=1) < 0.008] = tag
        names.append((tag, name))
    tagged = TetMesh(mesh.points, mesh.tets, region=region, region_names=tuple(names))
    return SimpleNamespace(mesh=tagged, lesions=tuple(centres))


def scene(approach):
    liver = make_scene("liver")
    return replace(liver, instrument=replace(liver.instrument, approach=tuple(approach)))


def angles(approach, *inward):
    return np.degrees(np.arccos(np.clip(np.array(inward) @ approach, -1.0, 1.0)))


@pytest.mark.parametrize("centres", [{}, {"a": (0.04, 0.04, 0.066)}])
def test_the_usual_approach_stays_where_it_faces_them(centres):
    organ = patient(**centres)
    assert facing_approach(organ, USUAL, ANGLE) == USUAL
    assert faced_note(organ, scene(USUAL)) == []


def test_it_turns_to_a_lesion_on_the_flank_but_no_farther_than_needed():
    organ = patient(a=(0.066, 0.04, 0.04))
    approach = np.array(facing_approach(organ, USUAL, ANGLE))
    (angle,) = angles(approach, [-1.0, 0.0, 0.0])
    # The directions that are tried lie 9 degrees apart.
    assert ANGLE - MARGIN_DEG - 12.0 < angle <= ANGLE - MARGIN_DEG
    assert np.linalg.norm(approach) == pytest.approx(1.0)
    assert "does not face a:" in faced_note(organ, scene(USUAL))[0]
    assert faced_note(organ, scene(approach)) == []


def test_it_faces_two_of_three():
    """Above and on one flank, and below: no direction faces above and below."""
    organ = patient(above=(0.04, 0.04, 0.066), flank=(0.066, 0.04, 0.04), below=(0.04, 0.04, 0.014))
    approach = np.array(facing_approach(organ, USUAL, ANGLE))
    above, flank, below = angles(approach, [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    assert above <= ANGLE - MARGIN_DEG + 1e-9 and flank <= ANGLE - MARGIN_DEG + 1e-9 and below > 90.0
    assert [note.split(":")[0].split("face ")[1] for note in faced_note(organ, scene(approach))] == ["below"]
