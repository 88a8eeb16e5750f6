"""Results of a command, written into a temporary folder beside their places and renamed at the end."""

import contextlib
import errno
import itertools
import os
import shutil
import tempfile
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
        OSError: the folder or a result cannot be written.
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
        try:
            yield OutputFolder(folder, part)
        except OSError as error:
            if error.errno != errno.ENOSPC:
                raise
            raise OSError(f"{option} {folder}: its disk is full; free some space, or choose another folder") from None
        written = [path.relative_to(part) for path in sorted(part.rglob("*")) if path.is_file()]
        for name in written:
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(part / name, root / name)
        for name in {Path(name) for name in names}.difference(written):
            (root / name).unlink(missing_ok=True)
    finally:
        shutil.rmtree(part, ignore_errors=True)
        if is_new:
            # A folder with results stays.
            with contextlib.suppress(OSError):
                root.rmdir()


def next_free(path: Path) -> Path:
    """First free STEM-NUMBER.SUFFIX beside a path."""
    numbered = (path.with_name(f"{path.stem}-{number}{path.suffix}") for number in itertools.count(1))
    return next(place for place in numbered if not place.exists())


# Folder of results, written at once or at the end.
AnyFolder = Path | OutputFolder
