"""Fresh environments to install surgsim into, without a network: they see this interpreter's other packages."""

import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
BUILD_INPUTS = (
    "pyproject.toml",
    "hatch_build.py",
    "README.md",
    "LICENSE",
    "msdm_core",
    "surgsim_env",
    "surgsim_apps",
    "scenes",
    "agents",
)


@dataclass(frozen=True)
class Environment:
    """A virtual environment with its own surgsim; numpy, mujoco and the rest come from the interpreter that tests."""

    folder: Path

    @property
    def python(self) -> Path:
        return self.folder / "bin" / "python"

    @property
    def site_packages(self) -> Path:
        (packages,) = self.folder.glob("lib/python*/site-packages")
        return packages

    def install(self, *arguments: str | Path) -> None:
        pip = [
            sys.executable,
            "-m",
            "pip",
            "--python",
            self.python,
            "--quiet",
            "--disable-pip-version-check",
            "install",
        ]
        run([*pip, "--no-index", "--no-deps", "--no-build-isolation", *arguments])


def run(command: list[str | Path], *, expect: int = 0, **options) -> str:
    """Standard output of a command, which shows all it printed where it ends otherwise than expected."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, **options)
    assert done.returncode == expect, f"{command} ended with {done.returncode}:\n{done.stdout}\n{done.stderr}"
    return done.stdout


def copy_of_project(target: Path) -> Path:
    """Copy of a build's inputs, for a test to change."""
    target.mkdir(parents=True)
    for name in BUILD_INPUTS:
        source = REPOSITORY / name
        if source.is_dir():
            shutil.copytree(source, target / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, target / name)
    return target


@pytest.fixture(scope="session")
def clean_environ(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment variables that do not point at this checkout or a numba cache, with an empty user's cache."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "NUMBA_", "PYTEST_"))}
    return kept | {"XDG_CACHE_HOME": str(tmp_path_factory.mktemp("cache"))}


@pytest.fixture(scope="session")
def make_environment() -> Callable[[Path], Environment]:
    def make(folder: Path) -> Environment:
        run([sys.executable, "-m", "venv", "--without-pip", folder])
        environment = Environment(folder)
        # A plain line in a .pth adds the folder, but not the .pth files in it: surgsim itself stays unseen.
        dependencies = sysconfig.get_path("purelib")
        (environment.site_packages / "dependencies.pth").write_text(f"{dependencies}\n")
        return environment

    return make


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel built by way of the source archive, as for a release."""
    folder = tmp_path_factory.mktemp("build")
    project = copy_of_project(folder / "project")
    for leftover in ("surgsim_env/__pycache__/env.pyc", "scenes/meshes/__pycache__/make.pyc"):
        (project / leftover).parent.mkdir(exist_ok=True)
        (project / leftover).write_text("must not ship")
    run([sys.executable, "-m", "build", "--no-isolation", "--outdir", folder / "dist", project])
    (built,) = (folder / "dist").glob("surgsim-*.whl")
    return built
