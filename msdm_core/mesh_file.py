"""What every mesh or surface file must pass before it is parsed, and the parsing that cannot exit or print."""

import contextlib
import io
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from msdm_core.errors import MeshError

Parsed = TypeVar("Parsed")


def checked_file(path: str | Path, suffixes: Iterable[str], advice: str) -> Path:
    """The path of a readable, non-empty file with one of the suffixes.

    Raises:
        MeshError: names the path, what is wrong with it and, for an unknown suffix, those there are.
    """
    file = Path(path)
    if file.is_dir():
        raise MeshError(f"{file}: is a directory; give the path of a file in it")
    if not file.exists():
        raise MeshError(f"{file}: no such file; check the path (current folder: {Path.cwd()})")
    known = sorted(suffixes)
    if file.suffix.lower() not in known:
        raise MeshError(f"{file}: unknown extension {file.suffix!r}; known: {', '.join(known)}: {advice}")
    try:
        with file.open("rb") as stream:
            empty = not stream.read(1)
    except OSError as error:
        raise MeshError(f"{file}: cannot be read ({error.strerror}); check its permissions") from error
    if empty:
        raise MeshError(f"{file}: is empty (0 bytes); export it again")
    return file


def parsed(file: Path, parse: Callable[[str], Parsed], advice: str) -> Parsed:
    """What `parse` makes of the file, its exits, prints and errors of any type turned into one MeshError.

    Raises:
        MeshError: names the file and the parser's own reason.
    """
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            return parse(str(file))
    # A parser that meets a malformed file raises anything from KeyError to zlib.error, or SystemExit (meshio).
    except (Exception, SystemExit) as error:
        reasons = [" ".join(said.getvalue().split()), f"{type(error).__name__} {error}".strip()]
        raise MeshError(f"{file}: cannot be parsed: {'; '.join(filter(None, reasons))}: {advice}") from error
