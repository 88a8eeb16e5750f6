"""A folder for numba's compiled code where an installation offers none; importing this module provides it.

numba keeps what `@njit(cache=True)` compiled in the first of three places that can be written: `NUMBA_CACHE_DIR`, the
`__pycache__` beside the source, the user's cache folder. Where none can (a read-only installation, an account
without a home), decorating raises "no locator available" and the package could not even be imported. There, and
only there, a private folder under the temporary one is named instead. It must happen before `kernels` is imported.
"""

import atexit
import os
import shutil
import stat
import tempfile
from pathlib import Path

from numba.core import config
from numba.misc.appdirs import AppDirs


def provide_cache_folder(source_folder: Path) -> Path | None:
    """Make sure that numba can cache functions whose source lies in `source_folder`.

    Returns:
        The temporary folder that numba was given, None where numba finds a place by itself.

    Raises:
        OSError: no folder at all can be written, the temporary one included.
    """
    user_folder = Path(AppDirs(appname="numba", appauthor=False).user_cache_dir)
    # For a user without a home, numba's own folder is a relative "~/.cache": it would litter the working folder.
    places = [source_folder / "__pycache__", *([user_folder] if user_folder.is_absolute() else [])]
    chosen: str = config.CACHE_DIR  # pyright: ignore[reportAttributeAccessIssue]
    if chosen:
        places.insert(0, Path(chosen))
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


def _can_write(folder: Path) -> bool:
    """Try it as numba does: `os.access` would lie to root and on read-only file systems."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def _private_temporary_folder() -> Path:
    """The same folder at every start, as long as nobody else can have put anything in it; else a new one.

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
