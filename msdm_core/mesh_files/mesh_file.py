"""Common parts of mesh and surface files: stand-ins, suffix, content, guarded parser, unit of length, extent."""

import contextlib
import io
import math
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from msdm_core.errors import MeshError

LengthUnit = str | float

METRES_PER_UNIT = {"m": 1.0, "cm": 0.01, "mm": 0.001}

# Longest side of an organ's bounding box [m]; beyond, the unit is wrong far more often than the organ.
SMALLEST_EXTENT = 1e-3
LARGEST_EXTENT = 2.0

# First bytes, in lower case, of a file that stands in for the wanted one.
STAND_INS = {
    b"version https://git-lfs.github.com/spec/": "a Git LFS pointer: git lfs pull",
    b"/annex/objects/": "a git-annex pointer: git annex get",
    b"<!doctype html": "a web page: download the file itself",
    b"<html": "a web page: download the file itself",
}

# Beginnings of the formats, tried in this order.
CONTENTS = {
    ".vtu": rb"(?s).*<VTKFile\b[^>]*type=.UnstructuredGrid",
    ".vtp": rb"(?s).*<VTKFile\b[^>]*type=.PolyData",
    ".vtk": rb"# vtk DataFile",
    ".msh": rb"\$(MeshFormat|NOD|Comments)\s",
    ".mesh": rb"(?s).{0,200}?\bMeshVersionFormatted\b",
    ".ply": rb"ply\s",
    ".stl": rb"(?is)\s*solid\b.*?\bfacet\s+normal\b",
    ".obj": rb"(?ms).*?^v\s+[-+\d.]+\S*\s+[-+\d.]+\S*\s+[-+\d.]+.*?^v\s",
}

Parsed = TypeVar("Parsed")


def checked_content(path: Path) -> Path:
    """Path of a file, of any format, with a content of its own; a missing file is left to its reader.

    Raises:
        MeshError: a pointer of Git LFS or git-annex, or a web page, in place of the file.
    """
    with contextlib.suppress(OSError), path.open("rb") as stream:
        head = stream.read(64).lower().lstrip(b"\xef\xbb\xbf \r\n\t")
        for start, content in STAND_INS.items():
            if head.startswith(start):
                raise MeshError(f"{path} is {content}")
    return path


def checked_file(path: str | Path, suffixes: Iterable[str], advice: str) -> Path:
    """Path of an existing file with one of the suffixes.

    Raises:
        MeshError: no such file, an unknown suffix or a content of another; names the path and the known suffixes.
    """
    file = checked_content(Path(path))
    if not file.is_file():
        raise MeshError(f"{file}: no such file; check the path (current folder: {Path.cwd()})")
    known = sorted(suffixes)
    if file.suffix.lower() not in known:
        raise MeshError(f"{file}: unknown extension {file.suffix!r}; known: {', '.join(known)}: {advice}")
    content = _content_suffix(file)
    if content not in (None, file.suffix.lower()):
        raise MeshError(f"{file} is a {content} by its content: rename it")
    return file


def _content_suffix(file: Path) -> str | None:
    """Suffix of the format that a file begins with; None for an unknown one."""
    with file.open("rb") as stream:
        head = stream.read(4096)
    if file.stat().st_size == 84 + 50 * int.from_bytes(head[80:84], "little"):  # a binary STL, of n triangles
        return ".stl"
    return next((suffix for suffix, start in CONTENTS.items() if re.match(start, head)), None)


def parsed(file: Path, parse: Callable[[str], Parsed], advice: str) -> Parsed:
    """Result of `parse`, with exits, prints and errors of any type turned into one MeshError.

    A number beyond the range of its type is an error, too: numpy would change it, with a warning.

    Raises:
        MeshError: names the file and the parser's own reason; a MeshError of `parse` is passed on; a stand-in for the
            file.
    """
    output = io.StringIO()
    checked_content(file)
    try:
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            with np.errstate(over="raise", invalid="raise"):
                return parse(str(file))
    except MeshError:
        raise
    # Malformed files raise anything from KeyError to zlib.error, or SystemExit (meshio).
    except (Exception, SystemExit) as error:
        reasons = [output.getvalue(), f"{type(error).__name__} {error}"]
        reason = "; ".join(" ".join(text.split()) for text in reasons if text.strip())
        raise MeshError(f"{file}: cannot be parsed: {reason}: {advice}") from error


def metres_per_unit(length_unit: LengthUnit) -> float:
    """Metres per file unit, from "m", "cm", "mm" or a positive number of metres [m].

    Raises:
        ValueError: names the unit and the known units.
    """
    if isinstance(length_unit, str):
        if length_unit in METRES_PER_UNIT:
            return METRES_PER_UNIT[length_unit]
        known = ", ".join(f'"{name}"' for name in METRES_PER_UNIT)
        raise ValueError(f"length_unit is {length_unit!r}; it must be {known} or metres per unit")
    metres = float(length_unit)
    if not (math.isfinite(metres) and metres > 0):
        raise ValueError(f"length_unit is {length_unit!r}; metres per unit must be positive and finite (mm: 0.001)")
    return metres


def check_extent(points: NDArray[np.float64], metres: float, path: Path) -> None:
    """Refuse points (n_node, 3) [m], read at `metres` per unit, with an extent of no organ.

    Raises:
        MeshError: names the extent, the rule and fitting units.
    """
    extent = float(np.ptp(points, axis=0).max())
    if SMALLEST_EXTENT <= extent <= LARGEST_EXTENT:
        return
    in_file = extent / metres
    fitting = [
        f'length_unit="{name}" would make it {in_file * scale:.4g} m'
        for name, scale in METRES_PER_UNIT.items()
        if SMALLEST_EXTENT <= in_file * scale <= LARGEST_EXTENT
    ]
    advice = ", ".join(fitting) or "give metres per unit as a number, length_unit=..."
    raise MeshError(
        f"{path}: the body spans {extent:.4g} m ({in_file:.4g} file units of {metres:g} m); "
        f"the rule is {SMALLEST_EXTENT:g} to {LARGEST_EXTENT:g} m: units forgotten? {advice}"
    )
