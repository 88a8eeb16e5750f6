"""Gradings that cannot be had are refused with the value."""

import pytest
import trimesh

from msdm_core.errors import MeshError
from msdm_core.meshing.lattice_meshing import mesh_surface


@pytest.mark.parametrize(
    ("graded", "named"),
    [
        ({"coarse_cell_size": 0.03}, "0.03"),
        ({"fine_depth": 0.01}, "coarse_cell_size"),
        ({"coarse_cell_size": 0.02, "fine_depth": -1.0}, "-1"),
        ({"coarse_cell_size": 0.02, "fine_triangles": [99999]}, "99999"),
        ({"coarse_cell_size": 0.02, "fine_triangles": [True]}, "bool"),
    ],
)
def test_impossible_gradings_are_refused(graded, named):
    solid = trimesh.creation.icosphere(4, 0.08)
    with pytest.raises(MeshError, match=named):
        mesh_surface(solid.vertices, solid.faces, cell_size=0.01, **graded)
