"""The two mesh formats written here rather than by meshio: gmsh 4.1 and medit, as text.

meshio drops the physical tags of a gmsh 4.1 file unless every region owns a node of its own, and writes medit with a
Python loop per line. Text with 17 significant digits gives every float64 back exactly.
"""

import io
import itertools
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.mesh_files.mesh_notes import physical_names

_GMSH_TETRA = 4


def gmsh41_bytes(
    mesh: TetMesh,
    points: NDArray[np.float64],
    point_data: Mapping[str, NDArray],
    cell_data: Mapping[str, NDArray],
) -> bytes:
    """A gmsh 4.1 text file: one volume entity and one physical group per region; points in file units (n_node, 3)."""
    out = io.BytesIO()
    out.write(b"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n")
    names = physical_names(mesh.region_names)
    if names:
        rows = "".join(f'3 {tag} "{name}"\n' for tag, name in names)
        out.write(f"$PhysicalNames\n{len(names)}\n{rows}$EndPhysicalNames\n".encode())
    tags, entity = np.unique(np.asarray(mesh.region), return_inverse=True)
    _write_entities(out, points, tags)
    node_count = len(points)
    # Any one volume may own the nodes: readers look a tet's region up through the tet's entity.
    out.write(f"$Nodes\n1 {node_count} 1 {node_count}\n3 1 0 {node_count}\n".encode())
    np.savetxt(out, np.arange(1, node_count + 1), fmt="%d")
    np.savetxt(out, points, fmt="%.17g")
    out.write(b"$EndNodes\n")
    _write_elements(out, mesh.tets, entity + 1)
    for name, values in point_data.items():
        _write_data(out, "NodeData", name, values)
    for name, values in cell_data.items():
        _write_data(out, "ElementData", name, values)
    return out.getvalue()


def medit_bytes(mesh: TetMesh, points: NDArray[np.float64]) -> bytes:
    """A medit text file with each tet's region as its reference; points in file units (n_node, 3)."""
    out = io.BytesIO()
    out.write(f"MeshVersionFormatted 2\nDimension 3\n\nVertices\n{len(points)}\n".encode())
    np.savetxt(out, np.column_stack([points, np.zeros(len(points))]), fmt="%.17g %.17g %.17g %d")
    out.write(f"\nTetrahedra\n{mesh.tet_count}\n".encode())
    np.savetxt(out, np.column_stack([mesh.tets + 1, np.asarray(mesh.region)]), fmt="%d")
    out.write(b"\nEnd\n")
    return out.getvalue()


def _write_entities(out: io.BytesIO, points: NDArray[np.float64], tags: NDArray[np.int32]) -> None:
    low, high = (" ".join(f"{value:.17g}" for value in bound) for bound in (points.min(axis=0), points.max(axis=0)))
    rows = "".join(f"{entity} {low} {high} 1 {tag} 0\n" for entity, tag in enumerate(tags, start=1))
    out.write(f"$Entities\n0 0 0 {len(tags)}\n{rows}$EndEntities\n".encode())


def _write_elements(out: io.BytesIO, tets: NDArray[np.int32], entity: NDArray[np.integer]) -> None:
    """Blocks are runs of tets of one region, not whole regions, so that the tets come back in the same order."""
    starts = np.concatenate([[0], np.flatnonzero(np.diff(entity)) + 1, [len(tets)]])
    rows = np.column_stack([np.arange(1, len(tets) + 1), tets + 1])
    out.write(f"$Elements\n{len(starts) - 1} {len(tets)} 1 {len(tets)}\n".encode())
    for start, stop in itertools.pairwise(starts):
        out.write(f"3 {entity[start]} {_GMSH_TETRA} {stop - start}\n".encode())
        np.savetxt(out, rows[start:stop], fmt="%d")
    out.write(b"$EndElements\n")


def _write_data(out: io.BytesIO, section: str, name: str, values: NDArray) -> None:
    """One named array, shape (n,) or (n, components), as a gmsh view: one text tag, one time, three integers."""
    columns = values.reshape(len(values), -1)
    out.write(f'${section}\n1\n"{name}"\n1\n0.0\n3\n0\n{columns.shape[1]}\n{len(columns)}\n'.encode())
    np.savetxt(
        out,
        np.column_stack([np.arange(1, len(columns) + 1), columns]),
        fmt=" ".join(["%d"] + ["%.17g"] * columns.shape[1]),
    )
    out.write(f"$End{section}\n".encode())
