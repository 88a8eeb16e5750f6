"""Surface files: STL, OBJ and PLY read."""

import io
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.errors import MeshError
from msdm_core.mesh.surface import merge_vertices
from msdm_core.mesh.tet_mesh import check_indices
from msdm_core.mesh_files.mesh_file import LengthUnit, check_extent, checked_file, metres_per_unit, parsed

SURFACE_SUFFIXES = (".obj", ".ply", ".stl")

_EXPORT = "export it again as STL, OBJ or PLY"


def read_surface(path: str | Path, *, length_unit: LengthUnit) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Vertices [m], shape (n_vertex, 3), and triangles, shape (n_triangle, 3), of an STL, OBJ or PLY file.

    `length_unit` is "m", "cm", "mm" or metres per unit: none of the formats states it. Exactly coinciding vertices are
    merged (STL repeats them per triangle, OBJ along texture seams); triangles that then use a vertex twice have no area
    and are left out, and so are unused vertices.

    Raises:
        ValueError: names an unknown length unit.
        MeshError: names the file and the fault: missing, cut short, not parsable, no triangles, an unlikely extent.

    Warns:
        UserWarning: bytes after the triangles of a binary STL.
    """
    metres = metres_per_unit(length_unit)
    file = checked_file(path, SURFACE_SUFFIXES, "export the surface as STL, OBJ or PLY")
    data = _whole(file, file.read_bytes())
    points, faces = parsed(file, lambda _: _loaded(data, file.suffix.lower()[1:]), _EXPORT)
    if len(faces) == 0:
        raise MeshError(f"{file}: has no triangles ({len(points)} vertices); export a triangulated surface")
    # trimesh cuts the vertices of an OBJ file to the shortest line.
    if points.shape[1] != 3:
        raise MeshError(f"{file}: a vertex has {points.shape[1]} coordinates; the rule is 3: export the surface again")
    check_indices(faces, len(points), f"{file}: triangle", "vertices")
    vertices, triangles = _merged(points, faces)
    if len(triangles) == 0:
        raise MeshError(f"{file}: every triangle uses a vertex twice, so none has an area; export the surface again")
    vertices = vertices * metres
    check_extent(vertices, metres, file)
    return vertices, triangles


def _whole(file: Path, data: bytes) -> bytes:
    """Contents of a file without bytes after the triangles of a binary STL; refuses a file that is cut short."""
    end, noun, promised, there = len(data), "", 0, 0
    head, _, body = data.partition(b"end_header")
    if file.suffix.lower() == ".stl":
        if re.search(rb"(?i)facet\s+normal", data):
            noun = "solids"
            promised, there = (len(re.findall(rb"(?im)^\s*%ssolid\b" % begin, data)) for begin in (b"", b"end"))
        else:
            noun, promised = "triangles", int.from_bytes(data[80:84], "little")
            end = 84 + 50 * promised
            there = min(max(len(data) - 84, 0) // 50, promised)
    elif b"format ascii" in head:
        noun, promised = "vertices, faces and others", sum(map(int, re.findall(rb"(?m)^element\s+\S+\s+(\d+)", head)))
        there = sum(bool(line.strip()) for line in body.splitlines()[1:])
    if promised != there:
        raise MeshError(
            f"{file}: {promised} {noun} are promised and {there} are there: it is cut short, damaged or no "
            f"{file.suffix} at all: {_EXPORT}"
        )
    if end < len(data):
        warnings.warn(f"{file}: {len(data) - end} bytes after its {promised} triangles are left out", stacklevel=3)
    return data[:end]


def _loaded(data: bytes, file_type: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices and triangles of all objects in a file."""
    import trimesh

    # Merging is ours (exact, trimesh rounds); materials would open further files.
    options: dict[str, Any] = {"process": False} | ({"skip_materials": True} if file_type == "obj" else {})
    surface: Any = trimesh.load(io.BytesIO(data), file_type=file_type, force="mesh", **options)
    if not isinstance(surface, trimesh.Trimesh):
        return np.asarray(getattr(surface, "vertices", np.empty((0, 3)))), np.empty((0, 3), dtype=np.int64)
    return np.asarray(surface.vertices, dtype=np.float64), np.asarray(surface.faces, dtype=np.int64)


def _merged(points: NDArray[np.float64], faces: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Points without exact twins and unused points, and the renumbered triangles."""
    vertices, triangles = merge_vertices(points, faces)
    flat = (np.diff(np.sort(triangles, axis=1), axis=1) == 0).any(axis=1)
    if flat.any():
        vertices, triangles = merge_vertices(vertices, triangles[~flat])
    return vertices, triangles.astype(np.int32)
