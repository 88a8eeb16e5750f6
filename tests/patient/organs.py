"""Organs of this project's own making, as surfaces in metres: shapes that sway, and that hide lesions."""

import numpy as np
import trimesh

from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.meshing.lattice_meshing import mesh_surface


def kidney_surface() -> trimesh.Trimesh:
    """A kidney-like bean 110 mm long, its long axis along x, its hilum towards -y, its poles raised.

    An ellipsoid, bent by x^2 towards -y and z: it lies on the middle of its back and rocks.
    """
    ball = trimesh.creation.icosphere(3, 1.0)
    x, y, z = (ball.vertices * [0.055, 0.027, 0.018]).T
    bend = (x / 0.055) ** 2
    return trimesh.Trimesh(np.column_stack([x, y - 0.012 * bend, z + 0.012 * bend]), ball.faces, process=False)


def kidney(cell: float = 0.006) -> TetMesh:
    """That bean, filled."""
    surface = kidney_surface()
    return mesh_surface(surface.vertices, surface.faces, cell_size=cell)
