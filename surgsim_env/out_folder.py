"""The folder that a command writes its results to."""

import tempfile
from collections.abc import Sequence
from pathlib import Path


def writable_folder(folder: Path, names: Sequence[str]) -> Path:
    """The folder, made if need be, in which files of these names can be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise ValueError(f"--out {folder}: cannot be written ({error.strerror}); choose another folder") from None
    for name in names:
        if (folder / name).is_dir():
            raise ValueError(f"--out {folder}: {name} is a folder there; choose another place or remove it")
    return folder
