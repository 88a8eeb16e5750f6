"""The built site, once for all tests of a run."""

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
    for module in ("material", "mkdocstrings", "latex2mathml"):
        pytest.importorskip(module, reason="needs the `docs` extra")
    return run_mkdocs


@pytest.fixture(scope="session")
def site_folder(build, tmp_path_factory) -> Path:
    """Where the project's site was built, without a warning."""
    folder = tmp_path_factory.mktemp("site")
    done = build(folder)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    return folder
