"""A read-only installation without a home folder still imports and compiles, in a temporary folder."""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.packaging.conftest import Environment, run

STRANGER = 54321  # an account that no password file knows

COMPILE = """
import sys
sys.stderr = sys.stdout
import msdm_core
import numpy as np
from msdm_core.kernels.load_kernels import fill_volume_ratios
fill_volume_ratios(np.eye(4, 3), np.array([[3, 0, 1, 2]], dtype=np.int32), np.ones(1), np.ones(1))
"""


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


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A temporary folder that any account may enter and write to, as /tmp is (pytest's own are closed)."""
    folder = Path(tempfile.mkdtemp(prefix="surgsim-open-"))
    folder.chmod(0o1777)
    yield folder
    subprocess.run(["chmod", "-R", "u+w", folder], check=False)
    shutil.rmtree(folder, ignore_errors=True)


def test_an_account_without_a_home_compiles_in_a_temporary_folder(wheel, make_environment, open_folder, clean_environ):
    environment: Environment = make_environment(open_folder / "venv")
    environment.install(wheel)
    subprocess.run(["chmod", "-R", "a-w", environment.folder], check=True)
    temporary = open_folder / "temporary"
    temporary.mkdir()
    temporary.chmod(0o1777)
    environ = {key: value for key, value in clean_environ.items() if key not in ("HOME", "XDG_CACHE_HOME")}
    if os.geteuid() != 0:
        environ["HOME"] = "/proc/nowhere"  # our real home can't be taken away
    command = [*as_stranger(), environment.python, "-c", COMPILE]
    text = run(command, cwd="/", env=environ | {"TMPDIR": str(temporary)})
    assert text.count("set NUMBA_CACHE_DIR") == 1
    assert not list(temporary.iterdir()), "the folder of one run is removed at its end"
