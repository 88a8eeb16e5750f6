"""Results of a command or script, written into a temporary folder beside their places and renamed at the end."""

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
from dataclasses import dataclass
from pathlib import Path

# Prefix of temporary folders.
PART = ".surgsim-part-"


@dataclass(frozen=True)
class OutputFolder:
    """Temporary place of a command's results; made by `output_folder`.

    Fields:
        path: of the results at the end
        part: of the results until then
    """

    path: Path
    part: Path

    def __truediv__(self, name: str) -> Path:
        """Temporary path of a result such as `images/plot.png`."""
        place = self.part / name
        place.parent.mkdir(parents=True, exist_ok=True)
        return place

    def number(self, name: str) -> str:
        """Rename a written result to the first free STEM-NUMBER.SUFFIX; returns that name."""
        numbered = next_free(self.path / name).name
        os.rename(self / name, self / numbered)
        return numbered


@contextlib.contextmanager
def output_folder(
    folder: Path, names: Sequence[str] = (), *, numbered: bool = False, option: str = "--out"
) -> Iterator[OutputFolder]:
    """Folder for results in a `with`: they appear at its end together, after an error none does.

    Args:
        folder: of the results; created if necessary.
        names: of all possible results; older files of these names are removed.
        numbered: use the first free FOLDER-NUMBER.
        option: of the command, for messages.

    Raises:
        OSError: the folder or a result cannot be written, or the disk is full (names the folder or file).
    """
    folder = next_free(folder) if numbered else folder
    # The working folder may change.
    root = folder.absolute()
    is_new = not root.exists()
    try:
        root.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=PART, dir=root))
    except OSError as error:
        raise OSError(f"{option} {folder}: cannot be written ({error.strerror}); choose another folder") from None
    try:
        with _room_in(folder):
            yield OutputFolder(folder, part)
            written = [path.relative_to(part) for path in sorted(part.rglob("*")) if path.is_file()]
            for name in written:
                (root / name).parent.mkdir(parents=True, exist_ok=True)
        # A process killed in between leaves new results without some of the set, but none beside an older one.
        for name in {*map(Path, names), *written}.difference(written[:1]):
            (root / name).unlink(missing_ok=True)
        for name in written:
            os.replace(part / name, root / name)
    finally:
        shutil.rmtree(part, ignore_errors=True)
        if is_new:
            # A folder with results stays.
            with contextlib.suppress(OSError):
                root.rmdir()


@contextlib.contextmanager
def new_folder(folder: Path) -> Iterator[None]:
    """Removal of a new folder, made in a `with`, after an error.

    Raises:
        FileExistsError: the folder exists before.
    """
    if folder.exists():
        raise FileExistsError(f"{folder} is there already: remove it, or name another folder")
    try:
        with _room_in(folder):
            yield
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


@contextlib.contextmanager
def _room_in(folder: Path) -> Iterator[None]:
    """Name the folder, or the file, in the error of a full disk."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        place = error.filename or folder
        raise OSError(f"{place}: {error.strerror}; free disk space, or choose another folder") from None


@contextlib.contextmanager
def interrupts() -> Iterator[None]:
    """SIGTERM, and SIGHUP of a closed terminal, as KeyboardInterrupt within a `with`: it ends as by Ctrl-C."""
    # `nohup` ignores SIGHUP, and only the main thread may handle signals.
    possible = (signal.SIGTERM, signal.SIGHUP) if threading.current_thread() is threading.main_thread() else ()
    signals = [number for number in possible if signal.getsignal(number) is signal.SIG_DFL]

    def interrupt(*_: object) -> None:
        # A session that ends sends more of them, which would interrupt the writing of results.
        for number in signals:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    for number in signals:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number in signals:
            signal.signal(number, signal.SIG_DFL)


@contextlib.contextmanager
def lone_run(result: Path) -> Iterator[None]:
    """The only run that writes a result, in a `with`, and `interrupts`.

    Raises:
        OSError: another run writes it, or its folder cannot be written.
    """
    place = result.resolve()
    place.parent.mkdir(parents=True, exist_ok=True)
    lock = place.with_name(f".{place.name}.lock")
    with interrupts(), lock.open("a") as file:
        try:
            # The system releases it at the end of the process, whatever the end is.
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not os.fstat(file.fileno()).st_nlink:
                # Another run ended after `open`, and a third may have locked a new file.
                raise BlockingIOError
        except BlockingIOError:
            raise OSError(f"{result} is written by another run: end that one, or name another result") from None
        try:
            with _room_in(place.parent):
                yield
        finally:
            lock.unlink(missing_ok=True)


def next_free(path: Path) -> Path:
    """First free STEM-NUMBER.SUFFIX beside a path."""
    numbered = (path.with_name(f"{path.stem}-{number}{path.suffix}") for number in itertools.count(1))
    return next(place for place in numbered if not place.exists())


# Folder of results, written at once or at the end.
AnyFolder = Path | OutputFolder
