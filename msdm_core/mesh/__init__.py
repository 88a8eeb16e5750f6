"""Tetrahedral meshes and triangle surfaces: structure, quality, order, distances along the surface."""

from msdm_core.mesh.carriers import find_carriers, surface_carriers
from msdm_core.mesh.geodesic import NearestTriangle, SurfaceDistance
from msdm_core.mesh.ordering import in_sweep_order
from msdm_core.mesh.quality import dihedral_angles, mesh_quality, surface_cell
from msdm_core.mesh.surface import (
    check_surface,
    line_hits,
    merge_vertices,
    node_normals,
    outward_facing,
    surface_volume,
    triangle_lattice,
)
from msdm_core.mesh.tet_mesh import TET_FACES, FloatArray, IntArray, TetMesh, connected_tets, outer_faces, used_nodes

__all__ = [
    "TET_FACES",
    "FloatArray",
    "IntArray",
    "NearestTriangle",
    "SurfaceDistance",
    "TetMesh",
    "check_surface",
    "connected_tets",
    "dihedral_angles",
    "find_carriers",
    "in_sweep_order",
    "line_hits",
    "merge_vertices",
    "mesh_quality",
    "node_normals",
    "outer_faces",
    "outward_facing",
    "surface_carriers",
    "surface_cell",
    "surface_volume",
    "triangle_lattice",
    "used_nodes",
]
