"""A read-only installation without a home folder still imports, and keeps what numba compiled."""

import os
import shutil
import stat
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numba
import pytest

from msdm_core import numba_cache
from tests.packaging.conftest import Environment, run

STRANGER = 54321  # an account that no password file knows

PROBE = """
import numba

@numba.njit(cache=True)
def double(x):
    return 2.0 * x
"""
USE_PROBE = (
    "import probe_kernels; print(probe_kernels.double(2.0), sum(probe_kernels.double.stats.cache_hits.values()))"
)
USE_PACKAGE = f"import msdm_core; {USE_PROBE}"
USE_KERNELS = "import msdm_core.kernels.substep_kernels"


def as_stranger() -> list[str | Path]:
    """Run as an account that may read anything and owns nothing; nothing to do where we are not root ourselves.

    Root writes through read-only bits, so only another account proves anything; reading is kept because the
    interpreter may lie in root's home.
    """
    if os.geteuid() != 0:
        return []
    setpriv = shutil.which("setpriv")
    if setpriv is None:
        pytest.skip("root without setpriv (util-linux): no other account can be taken to show this")
    keep = "-all,+dac_read_search"
    prefix = [setpriv, f"--reuid={STRANGER}", f"--regid={STRANGER}", "--clear-groups"]
    prefix += [f"--inh-caps={keep}", "--ambient-caps=+dac_read_search", f"--bounding-set={keep}"]
    if subprocess.run([*prefix, "true"], capture_output=True).returncode:
        pytest.skip("root without the right to become another account")
    return prefix


@pytest.fixture(scope="module")
def open_folder() -> Iterator[Path]:
    """A temporary folder that any account may enter and write to, as /tmp is (pytest's own are closed)."""
    folder = Path(tempfile.mkdtemp(prefix="surgsim-open-"))
    folder.chmod(0o1777)
    yield folder
    subprocess.run(["chmod", "-R", "u+w", folder], check=False)
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module")
def installation(wheel, make_environment, open_folder) -> Environment:
    """An installation that nobody may write to."""
    environment: Environment = make_environment(open_folder / "venv")
    environment.install(wheel)
    (environment.site_packages / "probe_kernels.py").write_text(PROBE)
    subprocess.run(["chmod", "-R", "a-w", environment.folder], check=True)
    return environment


@pytest.fixture
def read_only(installation, open_folder, clean_environ):
    """Runs a line of Python in that installation, by an account without a home and with an empty temporary folder."""
    temporary = Path(tempfile.mkdtemp(dir=open_folder))
    temporary.chmod(0o1777)
    environ = {key: value for key, value in clean_environ.items() if key not in ("HOME", "XDG_CACHE_HOME")}
    environ["TMPDIR"] = str(temporary)
    if os.geteuid() != 0:
        environ["HOME"] = environ["XDG_CACHE_HOME"] = "/proc/nowhere"  # our real home can't be taken away
    prefix = as_stranger()

    def python(code: str, *, expect: int = 0) -> str:
        return run([*prefix, installation.python, "-c", code], expect=expect, cwd="/", env=environ)

    return python, temporary


@pytest.mark.slow
def test_numba_alone_can_not_import_there(read_only):
    """The control: without the package's help, numba refuses."""
    python, _ = read_only
    python(USE_PROBE, expect=1)


def test_import_without_a_place_to_write(read_only):
    python, temporary = read_only
    assert python(USE_PACKAGE).split() == ["4.0", "0"]
    (folder,) = temporary.iterdir()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert python(USE_PACKAGE).split() == ["4.0", "1"], "the second start compiled again"
    python(USE_KERNELS)


def test_a_folder_of_another_account_is_not_used(read_only):
    """Planted compiled code would be run: a folder that others may write to is passed over."""
    python, temporary = read_only
    account = STRANGER if os.geteuid() == 0 else os.geteuid()
    planted = temporary / f"surgsim-numba-{account}"
    planted.mkdir()
    planted.chmod(0o777)
    assert python(USE_PACKAGE).split() == ["4.0", "0"]
    assert not any(planted.iterdir())
    assert list(temporary.iterdir()) == [planted], "the folder of one run is removed at its end"


def test_a_writable_installation_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    assert numba_cache.provide_cache_folder(tmp_path) is None
    assert numba.config.CACHE_DIR == ""
