"""The built site, once for all tests of a run."""

import fcntl
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
Build = Callable[..., subprocess.CompletedProcess]


def run_mkdocs(folder: Path, configuration: Path = ROOT / "mkdocs.yml") -> subprocess.CompletedProcess:
    """The site as `make docs` builds it, in a folder."""
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    settings = {**os.environ, "PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1", "NO_COLOR": "1"}
    command += ["--config-file", str(configuration)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, env=settings)


@pytest.fixture(scope="session")
def build() -> Build:
    return run_mkdocs


@pytest.fixture(scope="session")
def site_folder(build, tmp_path_factory) -> Path:
    """Where the project's site was built, without a warning; workers side by side share it."""
    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent
    folder, said = shared / "site", shared / "site.txt"
    with (shared / "site.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not said.exists():
            done = build(folder)
            said.write_text(f"{done.returncode}\n{done.stderr}", encoding="utf-8")
    text = said.read_text(encoding="utf-8")
    assert text.startswith("0\n"), text
    assert "WARNING" not in text
    return folder
