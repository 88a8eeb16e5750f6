"""Atomic writes of folders and files: written under another name, synced, then renamed."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

UNFINISHED = ".unfinished"


def write_folder(parent: Path, name: str, fill: Callable[[Path], None]) -> Path:
    """Let `fill` write the files of a new folder, which gets its name when all are on the disk.

    After a kill at any moment the folder is complete or absent; the next call removes an unfinished one.
    """
    parent.mkdir(parents=True, exist_ok=True)
    for leftover in parent.glob(f"*{UNFINISHED}"):
        shutil.rmtree(leftover)
    unfinished, finished = parent / f"{name}{UNFINISHED}", parent / name
    unfinished.mkdir()
    fill(unfinished)
    for file in unfinished.iterdir():
        _sync(file)
    _sync(unfinished)
    if finished.exists():
        _remove(finished)
    os.replace(unfinished, finished)
    _sync(parent)
    return finished


def write_file(file: Path, text: str) -> None:
    """Write a file atomically."""
    unfinished = file.with_name(file.name + UNFINISHED)
    unfinished.write_text(text, encoding="utf-8")
    _sync(unfinished)
    os.replace(unfinished, file)


def whole_folders(parent: Path) -> list[Path]:
    """The finished folders, in the order of their names."""
    return sorted(path for path in parent.glob("*") if path.is_dir() and path.suffix != UNFINISHED)


def keep_newest(parent: Path, count: int) -> None:
    """Remove all but the last `count` folders."""
    for old in whole_folders(parent)[:-count]:
        _remove(old)


def _remove(folder: Path) -> None:
    """Remove a folder; it is renamed first, so that no incomplete folder has its name."""
    doomed = folder.with_name(f"{folder.name}.old{UNFINISHED}")
    os.replace(folder, doomed)
    shutil.rmtree(doomed)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
