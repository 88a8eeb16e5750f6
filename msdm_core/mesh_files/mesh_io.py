"""Reading and writing tetrahedral meshes: vtu, legacy vtk, gmsh 2.2 and 4.1, medit; surfaces are in surface_io.

Two formats are written here rather than by meshio, as text: it drops the physical tags of a gmsh 4.1 file unless every
region owns a node of its own, and writes medit with a Python loop per line. Text with 17 significant digits gives every
float64 back exactly.

Mesh formats have no field for the length unit and most none for region names; these notes are stored so that other
readers skip them:

| format | length unit                                   | region names                                     |
|--------|-----------------------------------------------|--------------------------------------------------|
| vtu    | FieldData array "length_unit_m"               | FieldData arrays "region/NAME" (*), value = tag  |
| vtk    | FIELD array "length_unit_m" after DATASET     | FIELD arrays "region/NAME" (*), value = tag      |
| gmsh   | "surgsim length_unit_m 1.0" in a $Comments    | $PhysicalNames of dimension 3, gmsh's own field; |
|        |                                               | tag 0: "surgsim region 0 NAME" in the $Comments  |
| medit  | comment "# surgsim length_unit_m 1.0"         | comment "# surgsim region TAG NAME"              |

(*) percent-coded, as VTK does itself in legacy files; a file that VTK or ParaView saved again keeps both.
"""

import io
import itertools
import re
import struct
import tempfile
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msdm_core.errors import MeshError
from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.mesh_files.mesh_file import LengthUnit, check_extent, checked_file, metres_per_unit, parsed

# The formats that may be written under each suffix, the first by default.
FORMATS = {".vtu": ("vtu",), ".vtk": ("vtk",), ".msh": ("gmsh", "gmsh22"), ".mesh": ("medit",)}
REGION_KEYS = ("region", "gmsh:physical", "medit:ref")

_CONVERT = "convert it, for instance: meshio convert IN OUT.vtu, or gmsh IN -save -format msh22 -o OUT.msh"
_VOLUME_CELLS = ("tetra", "hexahedron", "wedge", "pyramid", "polyhedron")
_GMSH_TETRA = 4

RegionNames = tuple[tuple[int, str], ...]

UNIT_KEY = "length_unit_m"
_REGION_KEY = "region/"
_HEAD_BYTES = 1 << 20


@dataclass(frozen=True)
class FileNotes:
    """Metres per file unit, None when the file does not say, and the (tag, name) pairs of its regions."""

    metres: float | None = None
    region_names: RegionNames = ()


def read_mesh(path: str | Path, *, length_unit: LengthUnit | None = None, region_key: str | None = None) -> TetMesh:
    """The tetrahedral mesh of a vtu, vtk, gmsh (2.2, 4.1) or medit file, in metres.

    Args:
        path: the file; its suffix (.vtu, .vtk, .msh, .mesh) says the format.
        length_unit: "m", "cm", "mm" or metres per unit. May be left out only for files that `write_mesh` wrote,
            which state it; when given it wins, with a warning if the file states another.
        region_key: the cell data that tags each tet's region; by default the first of REGION_KEYS that is there.

    Raises:
        ValueError: names an unknown length unit.
        MeshError: names the file and the fault: missing, not parsable, no unit, no or curved tets, an unlikely extent,
            parts that share no face, or the first node or tet that TetMesh refuses.
    """
    asked = None if length_unit is None else metres_per_unit(length_unit)
    file = checked_file(path, FORMATS, _CONVERT)
    file_format, data = FORMATS[file.suffix.lower()][0], file.read_bytes()
    _check_header(file, file_format, data)
    reader = _reader(file_format)

    def parse(name: str) -> tuple[Any, FileNotes]:
        raw = reader(name)
        return raw, read_notes(file_format, data, raw.field_data)

    raw, notes = parsed(file, parse, _CONVERT)
    metres = _chosen_unit(file, asked, notes.metres)
    tets = _only_tets(file, raw)
    region = _region_of(file, raw, region_key)
    try:
        mesh = TetMesh(np.asarray(raw.points, dtype=np.float64) * metres, tets, region, notes.region_names)
    except MeshError as error:
        raise MeshError(f"{file}: {error}") from error
    check_extent(mesh.points, metres, file)
    return mesh


def write_mesh(
    path: str | Path,
    mesh: TetMesh,
    *,
    point_data: Mapping[str, ArrayLike] | None = None,
    cell_data: Mapping[str, ArrayLike] | None = None,
    length_unit: LengthUnit = "m",
    file_format: str | None = None,
) -> None:
    """Write a mesh, its regions and their names, and the length unit, so that `read_mesh` gives it back.

    Coordinates survive exactly with length_unit "m", to rounding with another. The table at the
    top says where each format has the unit and the names.

    Args:
        path: the file; its suffix decides: .vtu, .vtk, .msh (gmsh 4.1; 2.2 with file_format "gmsh22"), .mesh (medit).
        mesh: what to write.
        point_data: named arrays to show on the nodes, shape (n_node,) or (n_node, ...); medit has no room for any.
        cell_data: named arrays to show on the tets, shape (n_tet,) or (n_tet, ...).
        length_unit: the unit of the coordinates in the file.
        file_format: "vtu", "vtk", "gmsh", "gmsh22" or "medit", where the suffix leaves a choice.

    Raises:
        ValueError: names the unknown unit or format, or the data that does not fit the mesh or the format.
        MeshError: names the folder that is missing, or the region that the format cannot hold.
    """
    file, metres = Path(path), metres_per_unit(length_unit)
    chosen = _chosen_format(file, file_format)
    on_points = _checked_data(point_data, mesh.node_count, "point_data", chosen)
    on_tets = _checked_data(cell_data, mesh.tet_count, "cell_data", chosen)
    _check_regions(mesh, chosen)
    points = mesh.points / metres
    if chosen == "medit":
        body = medit_bytes(mesh, points)
    elif chosen == "gmsh":
        body = gmsh41_bytes(mesh, points, on_points, on_tets)
    else:
        body = _meshio_bytes(mesh, points, on_points, on_tets, chosen)
    if not file.parent.is_dir():
        raise MeshError(f"{file}: the folder {file.parent} does not exist; create it first")
    try:
        file.write_bytes(with_notes(chosen, body, FileNotes(metres, mesh.region_names)))
    except OSError as error:
        raise MeshError(f"{file}: cannot be written ({error.strerror}); check the path and its permissions") from error


def _reader(file_format: str) -> Callable[[str], Any]:
    """The format's own meshio reader: meshio.read prints and calls sys.exit when one of these raises."""
    import meshio

    return {
        "vtu": meshio.vtu.read,
        "vtk": meshio.vtk.read,
        "gmsh": meshio.gmsh.read,
        "medit": meshio.medit.read,
    }[file_format]


def _check_header(file: Path, file_format: str, data: bytes) -> None:
    """Refuse files with faults that meshio reports without a reason, or not at all."""
    if file_format == "gmsh":
        start = data[:200].lstrip()
        if start.startswith(b"$NOD"):
            raise MeshError(
                f"{file}: is a gmsh 1 file ($NOD header); 2.2 and 4.1 are read: "
                "convert it with gmsh IN.msh -save -format msh22 -o OUT.msh"
            )
        if not start.startswith((b"$MeshFormat", b"$Comments")):
            raise MeshError(f"{file}: starts with {start[:24]!r}, not $MeshFormat, so it is no gmsh file: {_CONVERT}")
    pieces = len(re.findall(rb"<Piece\b", data)) if file_format == "vtu" else 1
    if pieces > 1:
        # meshio 5.3.5 keeps only the cells of the last piece, without a warning.
        raise MeshError(f"{file}: holds {pieces} pieces; one is the rule: merge them (ParaView: Merge Blocks)")


def _chosen_unit(file: Path, asked: float | None, stated: float | None) -> float:
    """Metres per file unit, from what the caller asked and the file states."""
    if stated is not None:
        stated = metres_per_unit(stated)
    if asked is None and stated is None:
        raise MeshError(
            f'{file}: states no length unit; give "m", "cm", "mm" or metres per unit as length_unit (--length-unit)'
        )
    if asked is not None and stated is not None and abs(asked - stated) > 1e-12 * stated:
        warnings.warn(
            f"{file}: states {stated:g} m per unit, but length_unit says {asked:g}; length_unit is used", stacklevel=3
        )
    return stated if asked is None else asked  # type: ignore[return-value]  # one of them is not None


def _only_tets(file: Path, raw: Any) -> NDArray[np.integer]:
    """The tets of every block in file order, shape (n_tet, 4)."""
    counts: dict[str, int] = {}
    for block in raw.cells:
        counts[block.type] = counts.get(block.type, 0) + len(block.data)
    there = ", ".join(f"{count} {kind}" for kind, count in counts.items()) or "no cells at all"
    wrong = [kind for kind in counts if kind != "tetra" and any(name in kind.lower() for name in _VOLUME_CELLS)]
    curved = [kind for kind in wrong if "tetra" in kind.lower()]
    if curved:
        raise MeshError(
            f"{file}: has quadratic or higher tets ({there}); linear tets of 4 nodes are the rule: "
            "mesh with order 1, or gmsh IN -save -order 1 -o OUT.msh"
        )
    if wrong:
        raise MeshError(f"{file}: has volume cells that are not tets ({there}); split them into tets first")
    if set(counts) & {"triangle", "quad", "polygon"} and "tetra" not in counts:
        raise MeshError(
            f"{file}: holds a surface ({there}), and no tets: save it as STL, OBJ or PLY (ParaView: Extract Surface, "
            "Triangulate, Save Data; or meshio convert IN OUT.stl), which is filled with tets"
        )
    if "tetra" not in counts:
        raise MeshError(f"{file}: has no tets ({there}); mesh the volume first, for instance with mesh_surface")
    return np.concatenate([np.asarray(block.data) for block in raw.cells if block.type == "tetra"])


def _region_of(file: Path, raw: Any, region_key: str | None) -> NDArray | None:
    """Region tag of each tet in file order, shape (n_tet,); None when the file has none."""
    if region_key is not None and region_key not in raw.cell_data:
        there = ", ".join(raw.cell_data) or "none"
        raise MeshError(f"{file}: has no cell data {region_key!r}; the cell data there is: {there}")
    keys = [region_key] if region_key is not None else [key for key in REGION_KEYS if key in raw.cell_data]
    if not keys:
        return None
    blocks = zip(raw.cells, raw.cell_data[keys[0]], strict=True)
    tags = np.concatenate([np.asarray(values) for block, values in blocks if block.type == "tetra"])
    return tags[:, 0] if tags.ndim == 2 and tags.shape[1] == 1 else tags


def _chosen_format(file: Path, file_format: str | None) -> str:
    formats = FORMATS.get(file.suffix.lower())
    if formats is None:
        raise ValueError(f"{file}: unknown extension {file.suffix!r}; known: {', '.join(FORMATS)}")
    if file_format is not None and file_format not in formats:
        raise ValueError(f"{file}: file_format {file_format!r} does not fit {file.suffix}; use {' or '.join(formats)}")
    return file_format or formats[0]


def _checked_data(data: Mapping[str, ArrayLike] | None, count: int, what: str, file_format: str) -> dict[str, NDArray]:
    """The arrays as float64 or int64, shape (count,) or (count, components)."""
    if data and file_format == "medit":
        raise ValueError(f"{what} {list(data)} has no room in a medit file; write a .vtu")
    checked = {}
    for name, values in (data or {}).items():
        if not re.fullmatch(r"[\w.+/-]+", name, re.ASCII) or name in ("region", "cell_tags"):
            raise ValueError(f'{what} name {name!r} must be letters, digits, "_.+/-", and not region or cell_tags')
        array = np.asarray(values)
        if array.dtype.kind not in "biuf" or array.ndim == 0 or len(array) != count or array.size == 0:
            raise ValueError(
                f"{what} {name!r} has shape {array.shape}, dtype {array.dtype}; the rule is ({count}, ...)"
            )
        array = array.astype(np.float64 if array.dtype.kind == "f" else np.int64).reshape(count, -1)
        if file_format != "vtu" and array.shape[1] not in (1, 3, 9):
            raise ValueError(
                f"{what} {name!r} has {array.shape[1]} components; {file_format} holds 1, 3 or 9: use .vtu"
            )
        checked[name] = array[:, 0] if array.shape[1] == 1 else array
    return checked


def _check_regions(mesh: TetMesh, file_format: str) -> None:
    names = [name for _, name in mesh.region_names]
    for tag, name in mesh.region_names:
        if not name.isprintable() or not name or name != name.strip() or set(name) & set('"\\'):
            raise MeshError(f"region {tag} is named {name!r}; to be written it needs printable letters, no quotes")
        if names.count(name) > 1:
            raise MeshError(f"region name {name!r} is given to more than one tag; names must differ to be written")
    lowest = min([int(np.min(np.asarray(mesh.region))), *(tag for tag, _ in mesh.region_names)])
    if lowest < 0 and file_format in ("gmsh", "gmsh22"):
        raise MeshError(f"region tag {lowest} is negative; gmsh needs tags of 0 and above: renumber, or write a .vtu")


def _meshio_bytes(
    mesh: TetMesh,
    points: NDArray[np.float64],
    point_data: dict[str, Any],
    cell_data: dict[str, Any],
    file_format: str,
) -> bytes:
    """What meshio writes as vtu, vtk or gmsh22 (all binary), through a temporary file, which it requires."""
    import meshio

    # int64: VTK itself does not know the name that meshio gives to 32-bit integers in a legacy file.
    region = np.array(mesh.region, dtype=np.int64)
    tags: dict[str, Any]
    if file_format == "gmsh22":
        _, entity = np.unique(region, return_inverse=True)
        tags = {"gmsh:physical": [region], "gmsh:geometrical": [(entity + 1).astype(np.int32)]}
        names = {name: np.array([tag, 3]) for tag, name in physical_names(mesh.region_names)}
    else:
        tags, names = {"region": [region]}, {}
    out = meshio.Mesh(
        points,
        [("tetra", np.array(mesh.tets))],
        point_data=point_data,
        cell_data=tags | {name: [values] for name, values in cell_data.items()},
        field_data=names,
    )
    writer = {"vtu": meshio.vtu.write, "vtk": meshio.vtk.write, "gmsh22": _write_gmsh22}[file_format]
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder) / "mesh"
        writer(str(scratch), out)
        return scratch.read_bytes()


def _write_gmsh22(path: str, out: Any) -> None:
    import meshio

    meshio.gmsh.write(path, out, fmt_version="2.2")


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


def read_notes(file_format: str, data: bytes, field_data: Mapping[str, Any]) -> FileNotes:
    """The notes in a file's bytes and in the field data that meshio found in it."""
    head = data[:_HEAD_BYTES]
    if file_format == "vtu":
        metres = float(field_data[UNIT_KEY].flat[0]) if UNIT_KEY in field_data else None
        regions = [(key, values) for key, values in field_data.items() if key.startswith(_REGION_KEY)]
        names = [(values.flat[0], unquote(key[len(_REGION_KEY) :])) for key, values in regions]
    elif file_format == "vtk":
        metres, names = _read_vtk(head)
    elif file_format == "gmsh":
        metres = _read_line_unit(head, b"")
        # meshio maps each physical name to (tag, dimension); those of surfaces name no tets.
        names = [(value[0], name) for name, value in field_data.items() if len(value) == 2 and value[1] == 3]
        names += _read_line_names(head, b"")
    else:
        metres, names = _read_line_unit(head, b"# "), _read_line_names(head, b"# ")
    return FileNotes(metres, tuple(sorted((int(tag), name) for tag, name in names)))


def with_notes(file_format: str, data: bytes, notes: FileNotes) -> bytes:
    """The bytes of a mesh file with the notes at the places of the table above."""
    if file_format == "vtu":
        return _after(data, b"<UnstructuredGrid>", _vtu_field_data(notes))
    if file_format == "vtk":
        return _after(data, b"DATASET UNSTRUCTURED_GRID\n", _vtk_field_data(notes))
    lines = [f"surgsim {UNIT_KEY} {notes.metres!r}"]
    if file_format in ("gmsh", "gmsh22"):
        rest = set(notes.region_names) - set(physical_names(notes.region_names))
        lines += [f"surgsim region {tag} {name}" for tag, name in rest]
        return _after(data, b"$EndMeshFormat\n", "\n".join(["$Comments", *lines, "$EndComments\n"]).encode())
    lines += [f"surgsim region {tag} {name}" for tag, name in notes.region_names]
    return _after(data, b"Dimension 3\n", "".join(f"# {line}\n" for line in lines).encode())


def physical_names(region_names: RegionNames) -> RegionNames:
    """The names that gmsh can hold itself, by tag: it takes tag 0 for "no tag" and gives its name to another region."""
    return tuple(sorted((tag, name) for tag, name in region_names if tag > 0))


def _after(data: bytes, mark: bytes, addition: bytes) -> bytes:
    before, found, rest = data.partition(mark)
    assert found, f"the writer left out {mark!r}"
    return before + found + addition + rest


def _read_line_unit(head: bytes, prefix: bytes) -> float | None:
    found = re.search(rb"^" + prefix + rb"surgsim " + UNIT_KEY.encode() + rb" (\S+)\s*$", head, re.MULTILINE)
    return float(found[1]) if found else None


def _read_line_names(head: bytes, prefix: bytes) -> list[tuple[Any, str]]:
    found = re.findall(rb"^" + prefix + rb"surgsim region (-?\d+) (.+?)\r?$", head, re.MULTILINE)
    return [(tag, name.decode()) for tag, name in found]


def _vtu_field_data(notes: FileNotes) -> bytes:
    arrays = [("Float64", UNIT_KEY, repr(notes.metres))]
    arrays += [("Int32", _REGION_KEY + quote(name, safe=" "), str(tag)) for tag, name in notes.region_names]
    rows = [
        f'<DataArray type="{kind}" Name="{name}" NumberOfTuples="1" format="ascii">{value}</DataArray>\n'
        for kind, name, value in arrays
    ]
    return f"\n<FieldData>\n{''.join(rows)}</FieldData>".encode()


def _vtk_field_data(notes: FileNotes) -> bytes:
    # 64 bits: meshio takes the 4 bytes of a VTK "int" for 8.
    arrays = [f"{UNIT_KEY} 1 1 double\n".encode() + struct.pack(">d", notes.metres)]
    arrays += [
        f"{_REGION_KEY}{quote(name, safe='')} 1 1 vtktypeint64\n".encode() + struct.pack(">q", tag)
        for tag, name in notes.region_names
    ]
    return f"FIELD FieldData {len(arrays)}\n".encode() + b"".join(array + b"\n" for array in arrays)


def _read_vtk(head: bytes) -> tuple[float | None, list[tuple[Any, str]]]:
    """The field block is read from the bytes: meshio does not return what precedes POINTS."""
    block = head.partition(b"\nPOINTS ")[0]
    as_text = b"\nASCII" in block[:600]
    value = rb"(\S+) *" if as_text else rb"(.{8})"
    unit = re.search(rb"\n" + UNIT_KEY.encode() + rb" 1 1 double\n" + value + rb"(?=\n|$)", block, re.DOTALL)
    pattern = rb"\n" + _REGION_KEY.encode() + rb"(\S+) 1 1 vtktypeint64\n" + value + rb"(?=\n|$)"
    names = [(_number(tag, as_text, "q"), name) for name, tag in re.findall(pattern, block, re.DOTALL)]
    metres = _number(unit[1], as_text, "d") if unit else None
    return metres, [(tag, unquote(name.decode())) for tag, name in names]


def _number(value: bytes, as_text: bool, kind: str) -> float:
    return float(value) if as_text else struct.unpack(">" + kind, value)[0]
