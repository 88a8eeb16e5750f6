"""Gradings that cannot be had are refused with the value."""

import numpy as np
import pytest
import trimesh

from msdm_core.errors import MeshError
from msdm_core.meshing.lattice_meshing import mesh_surface


@pytest.mark.parametrize(
    ("graded", "named"),
    [
        ({"coarse_cell_size": 0.03}, "0.03"),
        ({"coarse_cell_size": 0.02, "fine_triangles": np.zeros(20 * 4**4, dtype=bool)}, "chooses no triangle"),
    ],
)
def test_impossible_gradings_are_refused(graded, named):
    solid = trimesh.creation.icosphere(4, 0.08)
    with pytest.raises(MeshError, match=named):
        mesh_surface(solid.vertices, solid.faces, cell_size=0.01, **graded)
