"""Tetrahedral mesh files: vtu, legacy vtk, gmsh and medit read, vtu written.

A vtu file has no field for the length unit or for region names. The FieldData arrays "length_unit_m" and "region/NAME"
(percent-coded, value = tag) hold them; other readers skip these arrays, and VTK and ParaView keep them.
"""

import re
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msdm_core.errors import MeshError
from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.mesh_files.mesh_file import LengthUnit, check_extent, checked_file, metres_per_unit, parsed

# meshio's name of the format under each suffix.
FORMATS = {".vtu": "vtu", ".vtk": "vtk", ".msh": "gmsh", ".mesh": "medit"}
WRITTEN_SUFFIX = ".vtu"
REGION_KEYS = ("region", "gmsh:physical", "medit:ref")

_CONVERT = "convert it, for instance: meshio convert IN OUT.vtu, or gmsh IN -save -format msh22 -o OUT.msh"
_VOLUME_CELLS = ("tetra", "hexahedron", "wedge", "pyramid", "polyhedron")

UNIT_KEY = "length_unit_m"
_REGION_KEY = "region/"


def read_mesh(path: str | Path, *, length_unit: LengthUnit | None = None) -> TetMesh:
    """Tetrahedral mesh of a vtu, vtk, gmsh (2.2, 4.1) or medit file, in metres.

    Args:
        path: the file, its format by suffix (.vtu, .vtk, .msh, .mesh).
        length_unit: "m", "cm", "mm" or metres per unit. May be left out only for files of `write_mesh`, which state it;
            if given it wins, with a warning if the file states another.

    Raises:
        ValueError: names an unknown length unit.
        MeshError: names the file and the fault: missing, not parsable, no unit, no or curved tets, an unlikely extent,
            parts without a common face, or the first node or tet refused by TetMesh.
    """
    asked = None if length_unit is None else metres_per_unit(length_unit)
    file = checked_file(path, FORMATS, _CONVERT)
    if file.suffix.lower() == ".vtu":
        _check_pieces(file)
    raw = parsed(file, _reader(FORMATS[file.suffix.lower()]), _CONVERT)
    metres = _chosen_unit(file, asked, float(raw.field_data[UNIT_KEY].flat[0]) if UNIT_KEY in raw.field_data else None)
    tets = _only_tets(file, raw)
    try:
        mesh = TetMesh(np.asarray(raw.points, dtype=np.float64) * metres, tets, _region_of(raw), _region_names(raw))
    except MeshError as error:
        raise MeshError(f"{file}: {error}") from error
    check_extent(mesh.points, metres, file)
    return mesh


def write_mesh(path: str | Path, mesh: TetMesh) -> None:
    """Write a mesh in metres as vtu, with its regions and their names; `read_mesh` returns it to the bit.

    Raises:
        ValueError: a suffix other than .vtu.
    """
    import meshio

    file = Path(path)
    if file.suffix.lower() != WRITTEN_SUFFIX:
        raise ValueError(f"{file}: the suffix must be {WRITTEN_SUFFIX}; meshio convert makes other formats of it")
    cell_data: dict[str, list[ArrayLike]] = {"region": [np.array(mesh.region, dtype=np.int64)]}
    out = meshio.Mesh(mesh.points, [("tetra", np.array(mesh.tets))], cell_data=cell_data)
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder) / "mesh"
        meshio.vtu.write(str(scratch), out)
        head, mark, tail = scratch.read_bytes().partition(b"<UnstructuredGrid>")
    file.write_bytes(head + mark + _field_data(mesh) + tail)


def _reader(file_format: str) -> Callable[[str], Any]:
    """The format's own meshio reader; meshio.read would print and call sys.exit on an error."""
    import meshio

    return getattr(meshio, file_format).read


def _check_pieces(file: Path) -> None:
    pieces = len(re.findall(rb"<Piece\b", file.read_bytes()))
    if pieces > 1:
        # meshio 5.3.5 keeps only the cells of the last piece, without a warning.
        raise MeshError(f"{file}: holds {pieces} pieces; the rule is 1: merge them (ParaView: Merge Blocks)")


def _chosen_unit(file: Path, asked: float | None, stated: float | None) -> float:
    """Metres per file unit, by the caller or else by the file."""
    if asked is None:
        if stated is None:
            raise MeshError(
                f'{file}: states no length unit; give "m", "cm", "mm" or metres per unit as length_unit (--length-unit)'
            )
        return metres_per_unit(stated)
    if stated is not None and asked != stated:
        warnings.warn(
            f"{file}: states {stated:g} m per unit, but length_unit says {asked:g}; length_unit is used", stacklevel=3
        )
    return asked


def _region_names(raw: Any) -> tuple[tuple[int, str], ...]:
    """Pairs (tag, name) of a vtu file, or of a gmsh file (there meshio maps names to (tag, dimension))."""
    names = []
    for key, value in raw.field_data.items():
        if key.startswith(_REGION_KEY):
            names.append((int(value.flat[0]), unquote(key[len(_REGION_KEY) :])))
        elif len(value) == 2 and value[1] == 3:
            names.append((int(value[0]), key))
    return tuple(sorted(names))


def _only_tets(file: Path, raw: Any) -> NDArray[np.integer]:
    """Tets of all blocks in file order, shape (n_tet, 4)."""
    counts: dict[str, int] = {}
    for block in raw.cells:
        counts[block.type] = counts.get(block.type, 0) + len(block.data)
    cells = ", ".join(f"{count} {kind}" for kind, count in counts.items()) or "no cells at all"
    if any(kind != "tetra" and name in kind.lower() for kind in counts for name in _VOLUME_CELLS):
        raise MeshError(
            f"{file}: has volume cells that are not linear tets of 4 nodes ({cells}): mesh it anew with tets of order 1"
        )
    if "tetra" not in counts:
        raise MeshError(
            f"{file}: has no tets ({cells}): save a surface as STL, OBJ or PLY, which is filled with tets (ParaView: "
            "Extract Surface, Triangulate, Save Data; or meshio convert IN OUT.stl)"
        )
    return np.concatenate([np.asarray(block.data) for block in raw.cells if block.type == "tetra"])


def _region_of(raw: Any) -> NDArray | None:
    """Region tag of each tet in file order, shape (n_tet,); None if the file has no tags."""
    key = next((key for key in REGION_KEYS if key in raw.cell_data), None)
    if key is None:
        return None
    blocks = zip(raw.cells, raw.cell_data[key], strict=True)
    tags = np.concatenate([np.asarray(values) for block, values in blocks if block.type == "tetra"])
    return tags[:, 0] if tags.ndim == 2 and tags.shape[1] == 1 else tags


def _field_data(mesh: TetMesh) -> bytes:
    arrays = [("Float64", UNIT_KEY, "1.0")]
    arrays += [("Int32", _REGION_KEY + quote(name, safe=" "), str(tag)) for tag, name in mesh.region_names]
    rows = [
        f'<DataArray type="{kind}" Name="{name}" NumberOfTuples="1" format="ascii">{value}</DataArray>\n'
        for kind, name, value in arrays
    ]
    return f"\n<FieldData>\n{''.join(rows)}</FieldData>".encode()
