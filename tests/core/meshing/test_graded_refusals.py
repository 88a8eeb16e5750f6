"""Gradings that cannot be had are refused with the value, the rule and the way out."""

import numpy as np
import pytest
import trimesh

from msdm_core.errors import MeshError
from msdm_core.meshing.lattice_meshing import mesh_surface


@pytest.mark.parametrize(
    ("graded", "words"),
    [
        ({"coarse_cell_size": 0.03}, r"0\.03 m is 3 times cell_size 0\.01 m.*1, 2 or 4.*use 0\.02 or 0\.04 m"),
        ({"coarse_cell_size": np.nan}, "1, 2 or 4 times"),
        ({"fine_triangles": [0]}, "without a coarse_cell_size"),
        ({"fine_depth": 0.01}, "without a coarse_cell_size"),
        ({"coarse_cell_size": 0.02, "fine_depth": -1.0}, r"fine_depth is -1\.0"),
        ({"coarse_cell_size": 0.02, "fine_triangles": []}, "chooses no triangle"),
        ({"coarse_cell_size": 0.02, "fine_triangles": [99999]}, r"names triangle 99999; indices lie in 0\.\.5119"),
        ({"coarse_cell_size": 0.02, "fine_triangles": [True]}, "one bool per triangle"),
        ({"coarse_cell_size": 0.02, "fine_triangles": [0.5]}, "dtype float64"),
    ],
)
def test_impossible_gradings_are_refused(graded, words):
    solid = trimesh.creation.icosphere(4, 0.08)
    with pytest.raises(MeshError, match=words):
        mesh_surface(solid.vertices, solid.faces, cell_size=0.01, **graded)
