"""Digests of organs, scenes and sources: what a map that is kept, a saved state or a score must agree with."""

import hashlib
import tokenize
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

import msdm_core
from msdm_core.mesh.tet_mesh import TetMesh
from surgsim_env.scene.arm_description import read_description
from surgsim_env.scene.load import pair_names, scenes_folder
from surgsim_env.scene.model import Scene

PACKAGE = Path(__file__).resolve().parents[1]
# Decides where compiled code is kept, and no episode.
NO_PHYSICS = "numba_cache.py"
# What stands before a statement.
STATEMENT_STARTS = (tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)


def content_digest(*parts: object, size: int = 12) -> str:
    """BLAKE2b of parts, one after the other: of an array its bytes, of a file (a Path) its content, else the `repr`.

    Of a Python file, comments, blank lines and the text of docstrings do not count (`code`).

    Args:
        parts: any number.
        size: bytes of the digest, which is twice as many hexadecimal digits.
    """
    digest = hashlib.blake2b(digest_size=size)
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(np.ascontiguousarray(part).data)
        else:
            digest.update(_content(part) if isinstance(part, Path) else repr(part).encode())
    return digest.hexdigest()


def code(path: Path) -> str:
    """The text of a Python file without comments and blank lines; docstrings and other lone strings are empty."""
    with tokenize.open(path) as file:
        text = file.read()
    lines = dict(enumerate(text.splitlines(), start=1))
    tokens = list(tokenize.generate_tokens(iter(text.splitlines(keepends=True)).__next__))
    for token in tokens:
        row, column = token.start
        if token.type == tokenize.COMMENT:
            lines[row] = lines[row][:column].rstrip()
        # Blank lines within a string have no such token.
        elif token.type == tokenize.NL and not lines[row].strip():
            del lines[row]
    parts = [token for token in tokens if token.type not in (tokenize.COMMENT, tokenize.NL)]
    before = tokenize.NEWLINE
    for part, after in pairwise(parts):
        if part.type == tokenize.STRING and after.type == tokenize.NEWLINE and before in STATEMENT_STARTS:
            row, column = part.start
            lines[row] = f'{lines[row][:column]}""'
            for rest in range(row + 1, part.end[0] + 1):
                del lines[rest]
        before = part.type
    return "\n".join(lines.values())


def scene_digest(scene: Scene, mesh: TetMesh, *, size: int = 12) -> str:
    """Digest of a scene and its mesh, wherever its file and its instrument's lie."""
    instrument = replace(scene.instrument, model=" + ".join(Path(name).name for name in _names(scene)))
    return content_digest(mesh.points, mesh.tets, replace(scene, folder=Path(), instrument=instrument), size=size)


def instrument_files(scene: Scene) -> Iterator[Path]:
    """The files that describe a scene's instruments: MJCF, or TOML with the model that it names."""
    for name in _names(scene):
        if name.endswith(".xml"):
            yield scenes_folder() / "instruments" / name
        else:
            arm = read_description(name)
            yield from (arm.folder / f"{arm.name}.toml", arm.folder / arm.model)


def source_files(*rooms: str) -> list[Path]:
    """The Python files of msdm_core and of some rooms of surgsim_env, in order, but NO_PHYSICS."""
    folders = [Path(msdm_core.__file__).parent, *(PACKAGE / room for room in rooms)]
    return [path for folder in folders for path in sorted(folder.rglob("*.py")) if path.name != NO_PHYSICS]


def _content(path: Path) -> bytes:
    return code(path).encode() if path.suffix == ".py" else path.read_bytes()


def _names(scene: Scene) -> tuple[str, ...]:
    return pair_names(scene.instrument.model) or (scene.instrument.model,)
