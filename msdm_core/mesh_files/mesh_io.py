"""Tetrahedral mesh files: vtu, legacy vtk, gmsh and medit read, vtu written.

A vtu file has no field for the length unit or for region names. The FieldData arrays "length_unit_m" and "region/NAME"
(percent-coded, value = tag) hold them; other readers skip these arrays, and VTK and ParaView keep them.
"""

import re
import tempfile
import warnings
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msdm_core.errors import MeshError
from msdm_core.mesh.tet_mesh import TetMesh, used_nodes
from msdm_core.mesh_files.mesh_file import LengthUnit, check_extent, checked_file, metres_per_unit, parsed

# meshio's name of the format under each suffix.
FORMATS = {".vtu": "vtu", ".vtk": "vtk", ".msh": "gmsh", ".mesh": "medit"}
WRITTEN_SUFFIX = ".vtu"
REGION_KEYS = ("region", "gmsh:physical", "medit:ref")
# Numbers of the CAD model's volumes: tags only when asked for.
_GEOMETRY_KEY = "gmsh:geometrical"
# Most tags of an array of regions; arrays with more number the tets.
TAGS_MOST = 255

_CONVERT = "convert it, for instance: meshio convert IN OUT.vtu, or gmsh IN -save -format msh22 -o OUT.msh"
_SAVE = {".vtu": "save it again as .vtu (ParaView)", ".msh": "write it again: gmsh IN -save -format msh22 -o OUT.msh"}
_SAVE |= {".vtk": _SAVE[".vtu"], ".mesh": _SAVE[".msh"]}
_VOLUME_CELLS = ("tetra", "hexahedron", "wedge", "pyramid", "polyhedron")

UNIT_KEY = "length_unit_m"
_REGION_KEY = "region/"


def read_mesh(path: str | Path, *, length_unit: LengthUnit | None = None, cell_data: str | None = None) -> TetMesh:
    """Tetrahedral mesh of a vtu, vtk, gmsh (2.2, 4.1) or medit file, in metres.

    Args:
        path: the file, its format by suffix (.vtu, .vtk, .msh, .mesh).
        length_unit: "m", "cm", "mm" or metres per unit. May be left out only for files of `write_mesh`, which state it;
            if given it wins, with a warning if the file states another.
        cell_data: name of the array with the tags of the regions. Default: the usual names of the formats, else the
            only array of 2 to 255 different whole numbers, with a warning.

    Warns:
        UserWarning: left out nodes, groups and arrays, and another unit.

    Raises:
        ValueError: names an unknown length unit.
        MeshError: names the file and the fault: missing, not parsable, no unit, no or curved tets, an unlikely extent,
            parts without a common face, several arrays of tags, or the first node or tet refused by TetMesh.
    """
    asked = None if length_unit is None else metres_per_unit(length_unit)
    file = checked_file(path, FORMATS, _CONVERT)
    suffix = file.suffix.lower()
    if suffix == ".vtu":
        _check_pieces(file)
    raw = parsed(file, _read_gmsh if suffix == ".msh" else partial(_read_meshio, FORMATS[suffix]), _SAVE[suffix])
    metres = _chosen_unit(file, asked, float(raw.field_data[UNIT_KEY].flat[0]) if UNIT_KEY in raw.field_data else None)
    tets = _only_tets(file, raw)
    region = _region_of(file, raw, cell_data)
    for entity, tags in (raw.info or {}).items():
        if len(tags) > 1:
            text = ", ".join(map(str, tags))
            warnings.warn(f"{file}: volume {entity} is in the physical groups {text}: {tags[0]} is used", stacklevel=2)
    try:
        points, used = used_nodes(np.asarray(raw.points, dtype=np.float64) * metres, tets)
        mesh = TetMesh(points, used, region, _region_names(raw))
    except MeshError as error:
        raise MeshError(f"{file}: {error}{_repeated(tets, region)}") from error
    if len(points) < len(raw.points):
        warnings.warn(f"{file}: {len(raw.points) - len(points)} nodes of no tet are left out", stacklevel=2)
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


def _read_meshio(file_format: str, path: str) -> Any:
    """Mesh by the format's own meshio reader; meshio.read would print and call sys.exit on an error."""
    import meshio

    return getattr(meshio, file_format).read(path)


def _read_gmsh(path: str) -> Any:
    """Mesh of a gmsh file, of version 4.1 with the physical groups of each volume as `info`.

    meshio alone takes the first of several groups, and refuses a file with some volumes in no group.
    """
    from meshio.gmsh._gmsh41 import _read_entities

    head, _, rest = Path(path).read_bytes().partition(b"$Entities")
    version = re.search(rb"\$MeshFormat\s+4(?:\.1)?\s+(\d)\s+(\d+)", head)
    if not (version and rest):
        return _read_meshio("gmsh", path)
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder) / "part.msh"
        scratch.write_bytes(rest)
        with scratch.open("rb") as stream:
            stream.readline()
            _, _, _, groups = _read_entities(stream, version[1] == b"0", int(version[2]))[0]
        scratch.write_bytes(head + rest.partition(b"$EndEntities")[2])
        raw = _read_meshio("gmsh", str(scratch))
    raw.info = groups
    if any(groups.values()):
        raw.cell_data["gmsh:physical"] = [
            # A block is of one volume.
            np.full(len(volume), next(iter(groups[volume[0]]), 0) if block.type == "tetra" else 0)
            for block, volume in zip(raw.cells, raw.cell_data[_GEOMETRY_KEY], strict=True)
        ]
    return raw


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


def _region_of(file: Path, raw: Any, asked: str | None) -> NDArray | None:
    """Region tag of each tet in file order, shape (n_tet,); None if the file has no tags."""
    arrays = {
        name: np.concatenate([own for block, own in zip(raw.cells, blocks, strict=True) if block.type == "tetra"])
        for name, blocks in raw.cell_data.items()
    }
    tags = _tags_in(arrays)
    if asked is None:
        chosen = [name for name in REGION_KEYS if name in tags] or [name for name in tags if name != _GEOMETRY_KEY]
        if len(chosen) > 1:
            raise MeshError(
                f"{file}: which cell data are the regions? Give cell_data (--cell-data): {', '.join(tags.values())}"
            )
        asked = next(iter(chosen or [name for name in REGION_KEYS if name in arrays]), None)
        usual = (*REGION_KEYS, _GEOMETRY_KEY)
        others: list[str] = [tags.get(name) or name for name in arrays if name in tags or name not in usual]
        convert = "of the nodes (ParaView: Point Data to Cell Data, Categorical Data)"
        others += [f"{text} {convert}" for text in _tags_in(raw.point_data).values()]
        if chosen and asked not in REGION_KEYS:
            warnings.warn(f"{file}: the regions are the cell data {tags[chosen[0]]}", stacklevel=3)
        if not chosen and others:
            warnings.warn(
                f"{file}: not read as regions: {', '.join(others)}: name cell data with cell_data (--cell-data)",
                stacklevel=3,
            )
        if asked is None:
            return None
    if asked not in arrays:
        raise MeshError(f"{file}: has no cell data {asked!r}; there are {', '.join(arrays) or 'none'}")
    values = arrays[asked]
    return values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values


def _tags_in(arrays: Mapping[str, NDArray]) -> dict[str, str]:
    """Arrays of 2 to TAGS_MOST different whole numbers, each with a text such as "labels (0, 1, 2)"."""
    tags = {}
    for name, array in arrays.items():
        known = np.unique(array)
        if array.size == len(array) and 1 < len(known) <= TAGS_MOST and (known == np.rint(known)).all():
            tags[name] = f"{name} ({', '.join(f'{tag:g}' for tag in known[:10])}{', ...' if len(known) > 10 else ''})"
    return tags


def _repeated(tets: NDArray[np.integer], region: NDArray | None) -> str:
    """Remark on tets that are in the file several times, as gmsh 2.2 writes those of several groups."""
    _, of_tet, count = np.unique(np.sort(tets, axis=1), axis=0, return_inverse=True, return_counts=True)
    if region is None or count.max() == 1:
        return ""
    tags = ", ".join(map(str, region[of_tet.ravel() == np.argmax(count)]))
    return f"; {np.count_nonzero(count > 1)} tets are there several times, one with the tags {tags}"


def _field_data(mesh: TetMesh) -> bytes:
    arrays = [("Float64", UNIT_KEY, "1.0")]
    arrays += [("Int32", _REGION_KEY + quote(name, safe=" "), str(tag)) for tag, name in mesh.region_names]
    rows = [
        f'<DataArray type="{kind}" Name="{name}" NumberOfTuples="1" format="ascii">{value}</DataArray>\n'
        for kind, name, value in arrays
    ]
    return f"\n<FieldData>\n{''.join(rows)}</FieldData>".encode()
