"""The folder that numba keeps compiled kernels in, and the message that they are being compiled.

numba sees edits of a function's own file only, so the folder is named after the text of all files of kernels. It lies
in `NUMBA_CACHE_DIR` if that is set, else in the user's cache folder. Nobody else may enter it: a cache is pickled code,
which runs when it is read.
"""

import atexit
import functools
import hashlib
import logging
import os
import shutil
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import platformdirs
from numba.core import config, dispatcher, event
from numba.core.caching import FunctionCache

__all__ = ["FOLDER_PREFIX", "kernel_cache"]

LOGGER = logging.getLogger("msdm_core")
KERNEL_FILES = "*kernels.py"
FOLDER_PREFIX = "surgsim-kernels-"
UNUSED_AGE = 7 * 24 * 3600.0  # [s]
# Anything that takes longer says so [s].
PATIENCE = 2.0
# Held while numba's settings, which are those of the whole process, are changed; reentrant, as a package may import
# another inside.
SETTINGS_LOCK = threading.RLock()


@contextmanager
def kernel_cache(*source_folders: Path) -> Iterator[None]:
    """Cache functions decorated inside in a folder of their own, a new one whenever a file of kernels has changed.

    Args:
        source_folders: folders whose KERNEL_FILES are compiled together.
    """
    files = sorted(file for folder in source_folders for file in folder.rglob(KERNEL_FILES))
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:12]
    with SETTINGS_LOCK:
        settings: Any = config
        decorators: Any = dispatcher
        place, cache = settings.CACHE_DIR, decorators.FunctionCache
        settings.CACHE_DIR = str(_cache_folder(place, f"{FOLDER_PREFIX}{digest}"))
        decorators.FunctionCache = KernelCache
        try:
            yield
        finally:
            settings.CACHE_DIR, decorators.FunctionCache = place, cache


def _cache_folder(chosen: str, name: str) -> Path:
    """The folder of this name in the chosen place, else in the user's cache folder; a temporary one if it fails."""
    try:
        # An account without a home has "~/.cache", or none.
        folder = Path(chosen or platformdirs.user_cache_dir("surgsim")).expanduser() / name
        folder.mkdir(parents=True, exist_ok=True)
        folder.chmod(0o700)
        # Nobody takes it for unused.
        os.utime(folder)
        # `os.access` would lie to root and on read-only file systems.
        tempfile.TemporaryFile(dir=folder).close()
    except (OSError, RuntimeError) as error:
        warnings.warn(
            f"no folder can be written for compiled kernels ({error}): they are lost at the end of this process, and "
            "each start compiles for a minute; set NUMBA_CACHE_DIR to a folder that can be written",
            RuntimeWarning,
            stacklevel=2,
        )
        folder = Path(tempfile.mkdtemp(prefix=FOLDER_PREFIX))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        return folder
    _remove_unused(folder.parent)
    return folder


def _remove_unused(place: Path) -> None:
    """Remove the folders of earlier texts that no process has begun to use for UNUSED_AGE."""
    for folder in place.glob(f"{FOLDER_PREFIX}*"):
        # Another process may remove it at the same time.
        with suppress(OSError):
            if time.time() - folder.stat().st_mtime > UNUSED_AGE:
                shutil.rmtree(folder, ignore_errors=True)


class KernelCache(FunctionCache):
    """numba's cache of one function; damage, or a lack of room, is warned of, and the function compiled."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled function for argument types; None where it is to be compiled."""
        try:
            loaded = super().load_overload(sig, target_context)
            # Two processes that compile a function for different types at once may leave an index that names one file
            # for both: the code of the other types would run.
            if loaded is not None and tuple(loaded.signature.args) != tuple(sig):
                raise ValueError(f"a function for {loaded.signature.args} is filed under {sig}")
        except Exception as error:  # unpickling damaged bytes may raise anything
            folder = Path(self.cache_path).parent
            warnings.warn(
                f"{folder}, numba's cache, is damaged ({type(error).__name__}: {error}): it is removed, and its "
                "functions are compiled again",
                RuntimeWarning,
                stacklevel=2,
            )
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(mode=0o700, exist_ok=True)
            return None
        return loaded

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled function."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _warn_of_no_room(Path(self.cache_path).parent, error.strerror)


@functools.cache
def _warn_of_no_room(folder: Path, reason: str) -> None:
    """Warn once, not for each of the functions."""
    warnings.warn(
        f"compiled kernels cannot be kept in {folder} ({reason}): each start compiles for a minute; make room, or set "
        "NUMBA_CACHE_DIR to a folder that has some",
        RuntimeWarning,
        stacklevel=2,
    )


class CompileMessage(event.Listener):
    """Logs once that kernels are being compiled, when that has taken longer than PATIENCE, and when it is over.

    numba calls it before and after each function, which may be one that another calls, under its compiler's lock.
    """

    def __init__(self) -> None:
        self._depth, self._begin, self._logged = 0, 0.0, False

    def on_start(self, event: Any) -> None:
        """Before a function is compiled."""
        if not _is_kernel(event):
            return
        if self._depth == 0:
            self._begin, self._logged = time.monotonic(), False
        self._depth += 1

    def on_end(self, event: Any) -> None:
        """After a function is compiled."""
        if not _is_kernel(event):
            return
        self._depth -= 1
        spent = time.monotonic() - self._begin
        if spent > PATIENCE and not self._logged:
            self._logged = True
            LOGGER.warning("surgsim: compiling for this processor, once: up to a minute ...")
        if self._depth == 0 and self._logged:
            LOGGER.warning("surgsim: compiled in %.0f s", spent)


def _is_kernel(event: Any) -> bool:
    """Whether a function is one of ours, not one of the program that imports us."""
    return event.data["dispatcher"].py_func.__module__.startswith(("msdm_core.", "surgsim_env."))


event.register("numba:compile", CompileMessage())
