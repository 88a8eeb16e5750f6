"""Results of a command: written into a hidden folder beside their places, and put there together when all are whole.

The hidden folder lies in the folder of the results, so that a file is put in its place by a rename, whatever file
systems are mounted. Its process holds a lock on it: a hidden folder without one was left by a process that was killed,
and the next run removes it.
"""

import contextlib
import errno
import fcntl
import itertools
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

# Names of the hidden folders begin with this; the number of the process follows.
PART = ".surgsim-part-"
# In a hidden folder: results that are being written; results that are whole; what they replace.
_NEW, _READY, _OLD = "new", "ready", "old"
# Errors of a write, which do not name their file.
_WRITE_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS}
# A file system without locks, such as some of a network.
_NO_LOCKS = {errno.ENOLCK, errno.EBADF, errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS}


class OutputError(OSError):
    """Results that cannot be written: one line with the folder, the file, the reason and the way out."""


class OutputFolder:
    """Where a command writes its results until they are whole; made by `output_folder`.

    Fields:
        path: the folder in which the results appear at the end
    """

    def __init__(self, path: Path, part: Path) -> None:
        self.path = path
        # The working folder may change.
        self._root, self._part, self._last = path.absolute(), part, ""
        self._held, self._has_lock = contextlib.ExitStack(), False
        (part / _NEW).mkdir()

    def __truediv__(self, name: str) -> Path:
        """Temporary path of a result such as `images/plot.png`; an error of a write names the last one."""
        place = self._part / _NEW / name
        place.parent.mkdir(parents=True, exist_ok=True)
        self._last = name
        return place

    def number(self, name: str) -> str:
        """Rename a written result to the first free STEM-NUMBER.SUFFIX; no other run takes that name meanwhile.

        Args:
            name: of the result.

        Returns:
            The new name.
        """
        self._lock()
        stem, suffix = Path(name).stem, Path(name).suffix
        numbered = (f"{stem}-{number}{suffix}" for number in itertools.count(1))
        free = next(one for one in numbered if not os.path.lexists(self._root / one))
        os.rename(self / name, self / free)
        return free

    def _lock(self) -> None:
        """Exclude other runs from the folder until the end."""
        if not self._has_lock:
            self._held.callback(os.close, _locked(self._root, wait=True))
            self._has_lock = True

    def _commit(self, names: Sequence[str]) -> None:
        """Put all results in their places, and remove older ones of these names; all or nothing."""
        written = _files(self._part / _NEW)
        for name in written:
            self._last = name
            _sync(self._part / _NEW / name)
        self._lock()
        with _uninterrupted():
            # A set that is whole is put in its place even where its process was killed meanwhile.
            _recover(self._root)
            os.rename(self._part / _NEW, self._part / _READY)
            _place(self._root, self._part, [name for name in names if name not in written])

    def _named(self, error: Exception) -> OutputError | None:
        """An error of writing a result, with its name; None for any other error."""
        cause = error if isinstance(error, OSError) else error.__cause__
        if isinstance(cause, OutputError) or not isinstance(cause, OSError):
            return None
        if isinstance(cause.filename, str | os.PathLike):
            place = Path(cause.filename)
            if not place.is_relative_to(self._part):
                return None
            name = Path(*place.relative_to(self._part).parts[1:]).as_posix()
        # Pillow tells no number where its encoder cannot write.
        elif self._last and (cause.errno in _WRITE_ERRORS or (cause.errno is None and "writing" in str(cause))):
            name = self._last
        else:
            return None
        return OutputError(
            f"--out {self.path}: {name} cannot be written ({cause.strerror or cause}), and nothing there was changed; "
            "make room or choose another folder"
        )


@contextlib.contextmanager
def output_folder(folder: Path, names: Sequence[str] = (), *, numbered: bool = False) -> Iterator[OutputFolder]:
    """Where results are written in a `with`; at its end they appear in a folder together, after an error none does.

    Of two runs with one folder, the files of the last to end are there; other files in the folder stay.

    Args:
        folder: of the results; created if necessary, and removed after an error if it was created.
        names: of all results that the command can write; older files of these names are removed with the set.
        numbered: whether to create the first free FOLDER-NUMBER.

    Raises:
        OutputError: the folder or a result cannot be written, or a folder has the name of a result.
    """
    made = False
    try:
        if numbered:
            folder = _next_free(folder)
            made = True
        else:
            made = _make(folder)
        root = folder.absolute()
        lock = _locked(root, wait=True)
        try:
            _recover(root)
            part = Path(tempfile.mkdtemp(prefix=f"{PART}{os.getpid()}-", dir=root))
            alive = _locked(part, wait=True)
        finally:
            os.close(lock)
    except OSError as error:
        if made:
            _remove_empty(folder)
        if isinstance(error, OutputError):
            raise
        raise OutputError(f"--out {folder}: cannot be written ({error.strerror}); choose another folder") from None
    done = False
    try:
        for name in names:
            _refuse_folder(folder, name)
        outputs = OutputFolder(folder, part)
        with outputs._held:
            try:
                yield outputs
                outputs._commit(names)
                done = True
            except (OSError, ValueError) as error:
                named = outputs._named(error)
                if named is None:
                    raise
                raise named from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
        os.close(alive)
        if made and not done:
            _remove_empty(folder)


def _make(folder: Path) -> bool:
    """Create a folder; whether it was not there."""
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        if not folder.is_dir():
            raise
        return False
    return True


def _next_free(folder: Path) -> Path:
    """Create the first FOLDER-NUMBER that is not there; two runs never get the same."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    for number in itertools.count(1):
        path = folder.with_name(f"{folder.name}-{number}")
        with contextlib.suppress(FileExistsError):
            path.mkdir()
            return path
    raise AssertionError("the numbers have no end")


def _remove_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):
        folder.rmdir()


def _locked(folder: Path, *, wait: bool) -> int:
    """A descriptor that locks a folder until it is closed, or the process ends.

    On a file system without locks it locks nothing where it would wait: each result is whole there too, but two runs
    that end at the same moment may mix their sets.

    Raises:
        OSError: the folder cannot be opened; without `wait`, it is locked, or it is not known whether it is.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BaseException as error:
        if wait and isinstance(error, OSError) and error.errno in _NO_LOCKS:
            return descriptor
        os.close(descriptor)
        raise
    return descriptor


def _recover(root: Path) -> None:
    """Complete the set of a process that was killed while it put it in its place; remove what killed ones left."""
    for part in sorted(root.glob(f"{PART}*")):
        try:
            descriptor = _locked(part, wait=False)
        except OSError:
            # Its process is running, or belongs to somebody else.
            continue
        try:
            if (part / _READY).is_dir():
                _place(root, part, ())
            shutil.rmtree(part, ignore_errors=True)
        finally:
            os.close(descriptor)


def _place(root: Path, part: Path, stale: Sequence[str]) -> None:
    """Move the whole results of a hidden folder to their places, and stale ones away; an error undoes all of it."""
    written = _files(part / _READY)
    kept: list[str] = []
    placed: list[str] = []
    try:
        for name in (*stale, *written):
            _refuse_folder(root, name)
            if os.path.lexists(root / name):
                (part / _OLD / name).parent.mkdir(parents=True, exist_ok=True)
                os.rename(root / name, part / _OLD / name)
                kept.append(name)
            if name in stale:
                continue
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            os.rename(part / _READY / name, root / name)
            placed.append(name)
    except BaseException:
        for name in placed:
            os.rename(root / name, part / _READY / name)
        for name in kept:
            os.rename(part / _OLD / name, root / name)
        raise


def _refuse_folder(root: Path, name: str) -> None:
    if (root / name).is_dir():
        raise OutputError(f"--out {root}: {name} is a folder there; choose another place or remove it")


def _files(folder: Path) -> list[str]:
    """Names of all files below a folder."""
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir())


def _sync(path: Path) -> None:
    """Have the file on the disk before it replaces another; a disk may tell only now that it is full."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """Ctrl-C has its effect at the end."""
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before is None:
        yield
        return
    came: list[int] = []
    signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if came:
            signal.raise_signal(signal.SIGINT)


# What results are written into: as a set, or by code of your own into any folder.
AnyFolder = Path | OutputFolder
