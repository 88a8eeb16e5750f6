"""Quality of a mesh: shapes of its tets, fit to a surface."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msdm_core.arithmetic import arccos, cbrt, dot, norm
from msdm_core.mesh.surface import surface_volume
from msdm_core.mesh.tet_mesh import TET_FACES, FloatArray, TetMesh, area_vectors


@dataclass(frozen=True)
class MeshQuality:
    """Quality figures of a mesh: sizes, the worst tet, and the fit to the surface."""

    node_count: int
    tet_count: int
    boundary_triangle_count: int
    dihedral_smallest_deg: float  # [degrees]; 60 on a BCC lattice
    dihedral_largest_deg: float  # [degrees]; 90 on a BCC lattice
    radius_ratio_smallest: float  # 3 inradius / circumradius: 1 for a regular tet, 0 for a flat one
    volume: float  # [m^3]
    volume_error: float | None  # (mesh - surface) / surface; None without a surface


def mesh_quality(mesh: TetMesh, surface: tuple[ArrayLike, ArrayLike] | None = None) -> MeshQuality:
    """Quality figures of a mesh.

    Args:
        mesh: the mesh.
        surface: vertices [m] (n_vertex, 3) and outward triangles (n_triangle, 3) of the filled surface, if any.
    """
    angles = dihedral_angles(mesh)
    volume = float(mesh.volumes.sum())
    filled = None if surface is None else surface_volume(*surface)
    return MeshQuality(
        node_count=mesh.node_count,
        tet_count=mesh.tet_count,
        boundary_triangle_count=len(mesh.boundary_triangles),
        dihedral_smallest_deg=float(angles.min()),
        dihedral_largest_deg=float(angles.max()),
        radius_ratio_smallest=float(radius_ratios(mesh).min()),
        volume=volume,
        volume_error=None if filled is None else (volume - filled) / filled,
    )


def dihedral_angles(mesh: TetMesh) -> FloatArray:
    """Angle between the faces opposite corners i and j, for ij = 01 02 03 12 13 23 [degrees], shape (n_tet, 6)."""
    return tet_angles(mesh.points, mesh.tets)


def tet_angles(points: FloatArray, tets: NDArray[np.integer]) -> FloatArray:
    """`dihedral_angles` of tets with positive volumes [degrees], shape (n_tet, 6)."""
    normals = area_vectors(points[tets[:, TET_FACES]])
    normals = normals / norm(normals, axis=2, keepdims=True)
    i, j = np.triu_indices(4, k=1)
    cosines = -dot(normals[:, i], normals[:, j])
    return np.degrees(arccos(np.clip(cosines, -1.0, 1.0)))


def radius_ratios(mesh: TetMesh) -> FloatArray:
    """3 r / R with inradius r = 3 V / S and circumradius R = |a^2 b x c + b^2 c x a + c^2 a x b| / (12 V), (n_tet,).

    V is the volume, S the area of the four faces, a, b, c the edges from corner 0 (Liu and Joe 1994).
    """
    area = norm(area_vectors(mesh.points[mesh.tets[:, TET_FACES]]), axis=2).sum(axis=1)
    corners = mesh.points[mesh.tets]
    a, b, c = (corners[:, corner] - corners[:, 0] for corner in (1, 2, 3))
    parts = [(p * p).sum(axis=1, keepdims=True) * np.cross(q, r) for p, q, r in ((a, b, c), (b, c, a), (c, a, b))]
    sums = parts[0] + parts[1] + parts[2]
    circumradius = norm(sums, axis=1) / (12 * mesh.volumes)
    return 3 * (3 * mesh.volumes / area) / circumradius


def surface_cell(mesh: TetMesh, triangles: NDArray[np.int32]) -> float:
    """Cell edge a of the BCC lattice with tets (volume a^3 / 12) of the median volume of those at a surface [m].

    Args:
        mesh: the organ.
        triangles: of its surface, such as the palpable face, shape (n, 3).
    """
    on_surface = np.zeros(mesh.node_count, dtype=bool)
    on_surface[triangles] = True
    touching = on_surface[mesh.tets].any(axis=1)
    return float(cbrt(12.0 * np.median(mesh.volumes[touching])))
