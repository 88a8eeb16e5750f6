"""Cache folder of compiled kernels, and the message during their compilation.

numba notices edits of a function's own file only, so the folder's name is a digest of all files of kernels. It lies in
`NUMBA_CACHE_DIR` if set, else in the user's cache folder, closed to other users: a cache is pickled code, which runs
when it is read.
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

__all__ = ["FOLDER_PREFIX", "NUMBA_CONFIG", "kernel_cache"]

LOGGER = logging.getLogger("msdm_core")
# Untyped: its names are made when it is imported.
NUMBA_CONFIG: Any = config
KERNEL_FILES = "*kernels.py"
FOLDER_PREFIX = "surgsim-kernels-"
UNUSED_AGE = 7 * 24 * 3600.0  # [s]
PATIENCE = 2.0  # time of compiling without a message [s]
# For changes of numba's settings, which hold for the whole process; reentrant, as a package may import another inside.
SETTINGS_LOCK = threading.RLock()


@contextmanager
def kernel_cache(*source_folders: Path) -> Iterator[None]:
    """Cache the functions decorated inside in a folder of their own, new after any change of a file of kernels.

    Args:
        source_folders: folders of KERNEL_FILES compiled together.
    """
    files = sorted(file for folder in source_folders for file in folder.rglob(KERNEL_FILES))
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:12]
    with SETTINGS_LOCK:
        decorators: Any = dispatcher
        place, cache, disabled = NUMBA_CONFIG.CACHE_DIR, decorators.FunctionCache, NUMBA_CONFIG.DISABLE_JIT
        NUMBA_CONFIG.CACHE_DIR = str(_cache_folder(place, f"{FOLDER_PREFIX}{digest}"))
        decorators.FunctionCache = KernelCache
        # Vector code has no form in Python: NUMBA_DISABLE_JIT is for other functions, and for the loop of haptic steps.
        NUMBA_CONFIG.DISABLE_JIT = 0
        try:
            yield
        finally:
            NUMBA_CONFIG.CACHE_DIR, decorators.FunctionCache, NUMBA_CONFIG.DISABLE_JIT = place, cache, disabled


def _cache_folder(chosen: str, name: str) -> Path:
    """Folder of this name in the chosen place, else in the user's cache folder; a temporary folder if that fails."""
    try:
        # An account without a home has "~/.cache", or none.
        folder = Path(chosen or platformdirs.user_cache_dir("surgsim")).expanduser() / name
        folder.mkdir(parents=True, exist_ok=True)
        folder.chmod(0o700)
        # Now in use, see `_remove_unused`.
        os.utime(folder)
        # `os.access` is wrong for root and on read-only file systems.
        tempfile.TemporaryFile(dir=folder).close()
    except (OSError, RuntimeError) as error:
        warnings.warn(
            f"no writable folder for compiled kernels ({error}): they are lost at the end of this process, and each "
            "start compiles for a minute; set NUMBA_CACHE_DIR to a writable folder",
            RuntimeWarning,
            stacklevel=2,
        )
        folder = Path(tempfile.mkdtemp(prefix=FOLDER_PREFIX))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        return folder
    _remove_unused(folder.parent)
    return folder


def _remove_unused(place: Path) -> None:
    """Remove folders of other digests without a new process for UNUSED_AGE."""
    for folder in place.glob(f"{FOLDER_PREFIX}*"):
        # Another process may remove it at the same time.
        with suppress(OSError):
            if time.time() - folder.stat().st_mtime > UNUSED_AGE:
                shutil.rmtree(folder, ignore_errors=True)


class KernelCache(FunctionCache):
    """numba's cache of one function, with a warning and recompilation after damage or without disk space."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Compiled function for argument types; None if it has to be compiled."""
        try:
            loaded = super().load_overload(sig, target_context)
            # Two processes compiling a function for different types at once may leave an index with one file for both:
            # the code for the other types would run.
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
        """Save a compiled function."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _warn_of_no_room(Path(self.cache_path).parent, error.strerror)


@functools.cache
def _warn_of_no_room(folder: Path, reason: str) -> None:
    """Warn once for all functions."""
    warnings.warn(
        f"compiled kernels cannot be saved in {folder} ({reason}): each start compiles for a minute; free disk space, "
        "or set NUMBA_CACHE_DIR to another folder",
        RuntimeWarning,
        stacklevel=2,
    )


class CompileMessage(event.Listener):
    """Log messages during a compilation of kernels longer than PATIENCE and at its end; NUMBA_DISABLE_JIT rests in it.

    numba calls it under its compiler's lock, before and after each function; compilations of callees are nested.
    """

    def __init__(self) -> None:
        self._depth, self._begin, self._logged, self._disabled = 0, 0.0, False, 0

    def on_start(self, event: Any) -> None:
        """Before a function is compiled."""
        if not _is_kernel(event):
            return
        if self._depth == 0:
            self._begin, self._logged = time.monotonic(), False
            self._disabled, NUMBA_CONFIG.DISABLE_JIT = NUMBA_CONFIG.DISABLE_JIT, 0
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
        if self._depth == 0:
            NUMBA_CONFIG.DISABLE_JIT = self._disabled
        if self._depth == 0 and self._logged:
            LOGGER.warning("surgsim: compiled in %.0f s", spent)


def _is_kernel(event: Any) -> bool:
    """True for a function of this project, False for others in the process."""
    return event.data["dispatcher"].py_func.__module__.startswith(("msdm_core.", "surgsim_env."))


event.register("numba:compile", CompileMessage())
