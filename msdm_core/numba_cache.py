"""Where numba keeps the compiled kernels, and what happens where that place or its content is damaged.

numba keeps what `@njit(cache=True)` compiled in the first of three places that can be written: `NUMBA_CACHE_DIR`, the
`__pycache__` beside the source, the user's cache folder. Where none can (a read-only installation, an account
without a home), decorating raises "no locator available" and the package could not even be imported. There, and
only there, a private folder under the temporary one is named instead. It must happen before `kernels` is imported.

A cache is pickled code, which runs when it is read: a folder that others may write to is never used.

Kernels decorated in `kernel_cache` have a cache that heals (`HealingCache`): a file that is damaged is dropped with a
warning, and its function compiled again; where there is no room to write, functions are compiled and not kept. Files
carry a checksum, as a flipped bit in machine code would run unnoticed.

numba's settings are those of the whole process: they are changed under a lock (`SETTINGS_LOCK`).
"""

import atexit
import functools
import hashlib
import io
import logging
import os
import shutil
import stat
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from numba.core import config
from numba.core.caching import FunctionCache, IndexDataCacheFile, NullCache
from numba.core.registry import CPUDispatcher
from numba.core.runtime.nrt import rtsys
from numba.core.sigutils import normalize_signature
from numba.core.target_extension import dispatcher_registry, target_registry
from numba.misc.appdirs import AppDirs

LOGGER = logging.getLogger("msdm_core")
KERNEL_FILES = "*kernels.py"
FOLDER_PREFIX = "surgsim-kernels-"
STALE_AGE = 7 * 24 * 3600.0  # [s]
# The last bytes of a file of the cache, followed by the SHA-256 of those before; unpickling does not read them.
CHECKSUM_MARK = b"surgsim-sha256:"
CHECKSUM_LENGTH = len(CHECKSUM_MARK) + hashlib.sha256().digest_size
# Held by who changes numba's settings until they are restored; reentrant, as a package may import another inside.
SETTINGS_LOCK = threading.RLock()


def provide_cache_folder(source_folder: Path) -> Path | None:
    """Make sure that numba can cache functions whose source lies in `source_folder`.

    Returns:
        The temporary folder that numba was given, None where numba finds a place by itself, or where no folder at all
        can be written, which is warned of: compiled functions are not kept then.
    """
    with SETTINGS_LOCK:
        places = _places(source_folder)
        if any(_can_write(place) for place in places):
            return None
        try:
            folder = _private_temporary_folder()
        except OSError as error:
            tried = ", ".join(str(place) for place in places)
            warnings.warn(
                f"no folder can be written for numba's compiled code: tried {tried} and the temporary folder "
                f"({error}); every start compiles for minutes: set NUMBA_CACHE_DIR to one that can",
                RuntimeWarning,
                stacklevel=2,
            )
            return None
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
    with SETTINGS_LOCK:
        before: str = config.CACHE_DIR  # pyright: ignore[reportAttributeAccessIssue]
        folder = _kernel_folder(source_folders[0], f"{FOLDER_PREFIX}{digest}")
        if folder is not None:
            _remove_stale(folder.parent, keep=folder.name)
            config.CACHE_DIR = str(folder)  # pyright: ignore[reportAttributeAccessIssue]
        cpu = target_registry["cpu"]
        dispatcher = dispatcher_registry[cpu]
        _register(cpu, UncachedDispatcher if folder is None else HealingDispatcher)
        try:
            yield
        finally:
            _register(cpu, dispatcher)
            config.CACHE_DIR = before  # pyright: ignore[reportAttributeAccessIssue]


def _register(target: Any, dispatcher: Any) -> None:
    """Let numba's decorators make dispatchers of this class.

    The registry by itself takes a class only where it has none, and without one a decorator in another thread fails.
    """
    dict.__setitem__(dispatcher_registry, target, dispatcher)


def _kernel_folder(source_folder: Path, name: str) -> Path | None:
    """The folder of this name in the first place that can be written and where nobody else can write to it."""
    for place in _places(source_folder):
        if _can_write(place) and _is_private(place / name, source_folder):
            # A disk may have room for the file that was tried, and none for a folder.
            with suppress(OSError):
                return _in_use(place / name)
    try:
        return _in_use(_private_temporary_folder() / name)
    except OSError:
        # `provide_cache_folder` has said so.
        return None


def _in_use(folder: Path) -> Path:
    """Make a folder that only its owner may enter; one that is there is renewed, so that nobody takes it for stale."""
    folder.mkdir(mode=0o700, exist_ok=True)
    with suppress(OSError):
        os.utime(folder)
    return folder


def _is_private(folder: Path, source_folder: Path) -> bool:
    """Whether a folder and those in it are absent, or of who runs this, of root or of the source's owner, alone.

    A group may write where it is that of who runs this: with the umask 002 of many systems it has no other member.
    """
    if not hasattr(os, "geteuid"):
        return True
    owners = {os.geteuid(), 0, source_folder.stat().st_uid}
    with suppress(FileNotFoundError):
        for path in (folder, *(folder.iterdir() if folder.is_dir() else ())):
            found = path.lstat()
            shared = found.st_mode & 0o002 or (found.st_mode & 0o020 and found.st_gid != os.getegid())
            if found.st_uid not in owners or shared or not stat.S_ISDIR(folder.lstat().st_mode):
                warnings.warn(
                    f"{folder} is not used for numba's compiled code, which would run what others may have written "
                    f"there ({path.name} belongs to user {found.st_uid}, mode {stat.filemode(found.st_mode)}): remove "
                    "it, or set NUMBA_CACHE_DIR to a folder of your own",
                    RuntimeWarning,
                    stacklevel=2,
                )
                return False
    return True


# ---- a cache that heals ---------------------------------------------------------------------------------------------


class CheckedCacheFile(IndexDataCacheFile):
    """numba's index and data files of a function; a damaged one is dropped with a warning and counts as absent.

    Files that numba wrote by itself have no checksum: of those, damage is noticed only where unpickling fails.
    """

    def __init__(self, **arguments: Any) -> None:
        super().__init__(**arguments)
        # Files that could not be removed: the index is read once more before it is written.
        self._stuck: set[str] = set()

    def save(self, key: Any, data: Any) -> None:
        """Keep a compiled function in a file that is named after its key.

        numba takes the first number that the index leaves free: two processes that compile one function for different
        signatures at the same time take the same, and an index that names the other's file may remain. Here, the one
        that writes the index first may lose its entry, and its function is compiled once more.
        """
        name = self._data_name(int.from_bytes(hashlib.sha256(repr(key).encode()).digest()[:16], "big"))
        overloads = self._load_index()
        if overloads.get(key) != name:
            self._save_index({**overloads, key: name})
        self._save_data(name, data)

    def drop_data(self, key: Any, error: Exception) -> None:
        """Drop the data file of an index entry, from which no compiled function could be made."""
        name = self._load_index().get(key)
        if name is not None:
            self._drop(self._data_path(name), error)

    def _load_index(self) -> dict[Any, str]:
        try:
            _verify(self._index_path)
            overloads = super()._load_index()
            if not isinstance(overloads, dict) or not all(isinstance(name, str) for name in overloads.values()):
                raise ValueError("it holds no index")
        except FileNotFoundError:
            return {}
        except Exception as error:  # unpickling damaged bytes may raise anything
            self._drop(self._index_path, error)
            return {}
        return overloads

    def _load_data(self, name: str) -> Any:
        path = self._data_path(name)
        try:
            _verify(path)
            return super()._load_data(name)
        except FileNotFoundError:
            raise
        except Exception as error:
            self._drop(path, error)
            # numba compiles again where a file of the index is absent.
            raise FileNotFoundError(path) from error

    def _drop(self, path: str, error: Exception) -> None:
        """Remove a damaged file, or an empty folder in its place, and warn of it."""
        outcome = "it is dropped and its function compiled again"
        try:
            os.rmdir(path) if os.path.isdir(path) else os.unlink(path)
        except FileNotFoundError:
            pass  # another process was faster
        except OSError as why:
            if path in self._stuck:
                return
            self._stuck.add(path)
            outcome = f"its function is compiled again at each start, as it cannot be removed ({why.strerror})"
        said = " ".join(str(error).split()) or "nothing said"
        warnings.warn(
            f"{path} of numba's cache is damaged ({type(error).__name__}: {said}): {outcome}",
            RuntimeWarning,
            stacklevel=2,
        )

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[Any]:
        with super()._open_for_write(filepath) as file:
            yield (content := io.BytesIO())
            file.write(content.getvalue() + CHECKSUM_MARK + hashlib.sha256(content.getvalue()).digest())


class HealingCache(FunctionCache):
    """numba's cache of a function, which outlives damaged files and a place without room."""

    def __init__(self, py_func: Any) -> None:
        super().__init__(py_func)
        self._cache_file = CheckedCacheFile(
            cache_path=self._cache_path,
            filename_base=self._impl.filename_base,
            source_stamp=self._impl.locator.get_source_stamp(),
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled function of a signature; None where it is to be compiled."""
        try:
            # Unlike numba's own, without `target_context.refresh`: it imports for a tenth of a second what compiling
            # needs and running does not, and numba calls it before it compiles. Symbols of LAPACK and of numba's random
            # numbers come with it: kernels have neither.
            rtsys.initialize(target_context)
            with self._guard_against_spurious_io_errors():
                found = self._load_overload(sig, target_context)
            arguments, _ = normalize_signature(sig)
            if found is not None and tuple(found.signature.args) != arguments:
                raise ValueError(f"it holds the function for {found.signature.args}, not for {arguments}")
            return found
        except Exception as error:  # what was unpickled is no compiled function, or not this one
            self._cache_file.drop_data(self._index_key(sig, target_context.codegen()), error)
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled function, or warn once that there is no room."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            self.disable()
            _warn_of_no_room(str(Path(self._cache_path).parents[1]), error.strerror or str(error))


class KernelDispatcher(CPUDispatcher):
    """A compiled function that says when compiling takes long, and refuses calls from Python if it has no wrapper."""

    def __init__(self, py_func: Any, *given: Any, **options: Any) -> None:
        super().__init__(py_func, *given, **options)
        if self.targetoptions.get("no_cpython_wrapper"):
            self.__class__ = {HealingDispatcher: InnerHealing, UncachedDispatcher: InnerUncached}[type(self)]

    def compile(self, sig: Any) -> Any:
        """Load or compile the function for a signature."""
        with COMPILING.one():
            return super().compile(sig)


class HealingDispatcher(KernelDispatcher):
    """A compiled function with a `HealingCache`."""

    def enable_caching(self) -> None:
        """Keep what is compiled; called by numba's decorators for `cache=True`."""
        try:
            self._cache = HealingCache(self.py_func)
        except (OSError, RuntimeError) as error:
            # The folder was there a moment ago; numba finds no other.
            self._cache = NullCache()
            _warn_of_no_room(str(Path(config.CACHE_DIR).parent), str(error))  # pyright: ignore[reportAttributeAccessIssue]


class UncachedDispatcher(KernelDispatcher):
    """A compiled function that is not kept, although it was declared with `cache=True`."""

    def enable_caching(self) -> None:
        """Keep nothing."""


class _Inner:
    """A compiled function without a wrapper for Python: numba's own call would jump to address 0."""

    def __call__(self, *given: Any, **named: Any) -> Any:
        raise TypeError(
            f"{self.__name__} is called by compiled code alone (no_cpython_wrapper): decorate it with KERNEL or "  # type: ignore[attr-defined]
            "INLINED_KERNEL of msdm_core/kernels/option_kernels.py to call it from Python"
        )


class InnerHealing(_Inner, HealingDispatcher):
    """`HealingDispatcher` of a function that compiled code alone calls."""


class InnerUncached(_Inner, UncachedDispatcher):
    """`UncachedDispatcher` of a function that compiled code alone calls."""


class Compiling:
    """Functions that are being compiled, by any thread.

    Logs once that they are, when that has taken longer than `patience` [s], and when it is over.
    """

    def __init__(self, patience: float) -> None:
        self._patience = patience
        # Held to count, not while compiling: a thread may hold numba's lock when it comes here, or take it afterwards.
        self._lock = threading.RLock()
        self._depth, self._begin, self._said = 0, 0.0, False

    @contextmanager
    def one(self) -> Iterator[None]:
        """Around the compiling of one function, with all that it calls."""
        with self._lock:
            if self._depth == 0:
                self._begin, self._said = time.monotonic(), False
            self._depth += 1
        try:
            yield
        finally:
            with self._lock:
                self._depth -= 1
                spent = time.monotonic() - self._begin
                if spent > self._patience and not self._said:
                    self._said = True
                    LOGGER.warning("surgsim: compiling for this processor, once: up to a minute ...")
                if self._depth == 0 and self._said:
                    LOGGER.warning("surgsim: compiled in %.0f s", spent)


def _verify(path: str) -> None:
    """Raise ValueError where a file's bytes are not those that its checksum was computed from."""
    content = Path(path).read_bytes()
    body, end = content[:-CHECKSUM_LENGTH], content[-CHECKSUM_LENGTH:]
    if end.startswith(CHECKSUM_MARK) and hashlib.sha256(body).digest() != end[len(CHECKSUM_MARK) :]:
        raise ValueError("its checksum is wrong")


@functools.cache
def _warn_of_no_room(place: str, reason: str) -> None:
    """Warn once of a place, not for each of the functions."""
    warnings.warn(
        f"numba's compiled code cannot be kept in {place} ({reason}): every start compiles for minutes; make room, or "
        "set NUMBA_CACHE_DIR to a folder that has some",
        RuntimeWarning,
        stacklevel=2,
    )


# ---- places ---------------------------------------------------------------------------------------------------------


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
        # Another process may remove it at the same time.
        with suppress(FileNotFoundError):
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


# Anything that takes more than 2 s says so.
COMPILING = Compiling(2.0)
CACHE_FOLDER = provide_cache_folder(Path(__file__).resolve().parent)
