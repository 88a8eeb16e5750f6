"""Length unit and region names, for which mesh formats have no field, stored so that other readers skip them.

| format | length unit                                   | region names                                     |
|--------|-----------------------------------------------|--------------------------------------------------|
| vtu    | FieldData array "length_unit_m"               | FieldData arrays "region/NAME" (*), value = tag  |
| vtk    | FIELD array "length_unit_m" after DATASET     | FIELD arrays "region/NAME" (*), value = tag      |
| gmsh   | "surgsim length_unit_m 1.0" in a $Comments    | $PhysicalNames of dimension 3, gmsh's own field; |
|        |                                               | tag 0: "surgsim region 0 NAME" in the $Comments  |
| medit  | comment "# surgsim length_unit_m 1.0"         | comment "# surgsim region TAG NAME"              |

(*) percent-coded, as VTK does itself in legacy files; a file that VTK or ParaView saved again keeps both.
"""

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote, unquote

RegionNames = tuple[tuple[int, str], ...]

UNIT_KEY = "length_unit_m"
_REGION_KEY = "region/"
_HEAD_BYTES = 1 << 20


@dataclass(frozen=True)
class FileNotes:
    """Metres per file unit, None when the file does not say, and the (tag, name) pairs of its regions."""

    metres: float | None = None
    region_names: RegionNames = ()


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
