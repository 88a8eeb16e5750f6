"""A folder for numba's compiled code where an installation offers none; importing this module provides it.

numba keeps what `@njit(cache=True)` compiled in the first of three places that can be written: `NUMBA_CACHE_DIR`, the
`__pycache__` beside the source, the user's cache folder. Where none can (a read-only installation, an account
without a home), decorating raises "no locator available" and the package could not even be imported. There, and
only there, a private folder under the temporary one is named instead. It must happen before `kernels` is imported.
"""

import atexit
import hashlib
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from numba.core import config
from numba.misc.appdirs import AppDirs

KERNEL_FILES = "*kernels.py"
FOLDER_PREFIX = "surgsim-kernels-"
STALE_AGE = 7 * 24 * 3600.0  # [s]


def provide_cache_folder(source_folder: Path) -> Path | None:
    """Make sure that numba can cache functions whose source lies in `source_folder`.

    Returns:
        The temporary folder that numba was given, None where numba finds a place by itself.

    Raises:
        OSError: no folder at all can be written, the temporary one included.
    """
    places = _places(source_folder)
    if any(_can_write(place) for place in places):
        return None
    try:
        folder = _private_temporary_folder()
    except OSError as error:
        tried = ", ".join(str(place) for place in places)
        raise OSError(
            f"no folder can be written for numba's compiled code: tried {tried} and the temporary folder ({error}); "
            "set NUMBA_CACHE_DIR to one that can"
        ) from error
    config.CACHE_DIR = str(folder)  # pyright: ignore[reportAttributeAccessIssue]
    return folder


@contextmanager
def kernel_cache(*source_folders: Path) -> Iterator[None]:
    """Cache functions decorated inside in a folder of their own, a new one whenever a compiled file has changed.

    Args:
        source_folders: folders whose KERNEL_FILES are compiled together; the cache lies in the first.
    """
    files = sorted(file for folder in source_folders for file in folder.rglob(KERNEL_FILES))
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:12]
    before: str = config.CACHE_DIR  # pyright: ignore[reportAttributeAccessIssue]
    place = next(place for place in _places(source_folders[0]) if _can_write(place))
    _remove_stale(place, keep=f"{FOLDER_PREFIX}{digest}")
    folder = place / f"{FOLDER_PREFIX}{digest}"
    if folder.is_dir():
        # In use: another package whose folder lies here too must not take it for stale.
        os.utime(folder)
    config.CACHE_DIR = str(folder)  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        config.CACHE_DIR = before  # pyright: ignore[reportAttributeAccessIssue]


def _places(source_folder: Path) -> list[Path]:
    """Folders in which numba may keep compiled code, in its own order."""
    user_folder = Path(AppDirs(appname="numba", appauthor=False).user_cache_dir)
    # For a user without a home, numba's own folder is a relative "~/.cache": it would litter the working folder.
    places = [source_folder / "__pycache__", *([user_folder] if user_folder.is_absolute() else [])]
    chosen: str = config.CACHE_DIR  # pyright: ignore[reportAttributeAccessIssue]
    return [Path(chosen), *places] if chosen else places


def _remove_stale(place: Path, *, keep: str) -> None:
    """Remove folders of earlier texts that nobody has used for STALE_AGE."""
    for folder in place.glob(f"{FOLDER_PREFIX}*"):
        if folder.name != keep and time.time() - folder.stat().st_mtime > STALE_AGE:
            shutil.rmtree(folder, ignore_errors=True)


def _can_write(folder: Path) -> bool:
    """Try it as numba does: `os.access` would lie to root and on read-only file systems."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def _private_temporary_folder() -> Path:
    """The same folder at every start, as long as no other user can write to it; else a new one.

    numba unpickles what it finds, so a folder that another user owns or may write to is never used.
    """
    if hasattr(os, "geteuid"):
        folder = Path(tempfile.gettempdir(), f"surgsim-numba-{os.geteuid()}")
        try:
            folder.mkdir(mode=0o700, exist_ok=True)
            found = folder.lstat()
        except OSError:
            pass
        else:
            private = found.st_uid == os.geteuid() and not found.st_mode & 0o077
            if stat.S_ISDIR(found.st_mode) and private and _can_write(folder):
                return folder
    folder = Path(tempfile.mkdtemp(prefix="surgsim-numba-"))
    atexit.register(_remove, folder, os.getpid())
    return folder


def _remove(folder: Path, maker: int) -> None:
    """Remove a folder at the end of the process that made it, not of one forked from it."""
    if os.getpid() == maker:
        shutil.rmtree(folder, ignore_errors=True)


CACHE_FOLDER = provide_cache_folder(Path(__file__).resolve().parent)
