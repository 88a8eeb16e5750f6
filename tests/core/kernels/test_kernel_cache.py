"""Compiled code is taken from disk, and made anew when any compiled file has changed, not only the function's own."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import msdm_core
import surgsim_env
from msdm_core import numba_cache

USE = """
import msdm_core
from msdm_core.kernels.tissue_kernels import set_node_tension
import numpy as np
total = np.array([48.0])
set_node_tension((), total, np.ones(1), np.ones(1))
print(total[0], sum(set_node_tension.stats.cache_hits.values()))
"""


USE_HAPTIC = """
import numpy as np
from surgsim_env.coupling.haptic_kernels import total_force
print(total_force(np.full((1, 6), 2.0)) ** 2, sum(total_force.stats.cache_hits.values()))
"""


def run(folder: Path, use: str = USE) -> list[str]:
    environment = {"PATH": "/usr/bin:/bin", "PYTHONPATH": str(folder), "HOME": str(folder)}
    done = subprocess.run(
        [sys.executable, "-c", use], env=environment, cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_an_edit_in_another_file_is_seen(tmp_path):
    """`set_node_tension` stands in one file; the equation it calls, in another, is the one that changes."""
    package = tmp_path / "msdm_core"
    shutil.copytree(Path(msdm_core.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    # (48 / 24 - 1) is the strain of a volume twice as large as at rest.
    assert run(tmp_path) == ["1.0", "0"]
    assert run(tmp_path) == ["1.0", "1"], "the second start compiled again"
    equations = package / "kernels" / "element_kernels.py"
    text = equations.read_text(encoding="utf-8")
    assert text.count("24.0)) - 1.0)") == 1
    equations.write_text(text.replace("24.0)) - 1.0)", "24.0)) - 0.5)"), encoding="utf-8")
    assert run(tmp_path) == ["1.5", "0"], "stale machine code was run"


def test_the_environments_kernels_see_an_edit_in_the_organs(tmp_path):
    """What steps MuJoCo calls the organ's kernels: both packages' files name its folder."""
    for package in (msdm_core, surgsim_env):
        source = Path(package.__file__).parent
        shutil.copytree(source, tmp_path / source.name, ignore=shutil.ignore_patterns("__pycache__"))
    assert run(tmp_path, USE_HAPTIC)[1] == "0"
    assert run(tmp_path, USE_HAPTIC)[1] == "1", "the second start compiled again"
    with (tmp_path / "msdm_core" / "kernels" / "element_kernels.py").open("a", encoding="utf-8") as equations:
        equations.write("# edited\n")
    assert run(tmp_path, USE_HAPTIC)[1] == "0", "stale machine code would be run"


def test_a_folder_in_use_is_not_taken_for_stale(tmp_path):
    """Two packages' folders may lie in one place: each start renews its own."""
    (tmp_path / "kernels.py").write_text("# nothing")
    with numba_cache.kernel_cache(tmp_path):
        folder = Path(numba_cache.config.CACHE_DIR)
    folder.mkdir(parents=True, exist_ok=True)
    os.utime(folder, (time.time() - 2.0 * numba_cache.STALE_AGE,) * 2)
    with numba_cache.kernel_cache(tmp_path):
        pass
    numba_cache._remove_stale(folder.parent, keep="another")
    assert folder.is_dir()
    shutil.rmtree(folder)


def test_folders_of_old_texts_are_removed_in_time(tmp_path):
    old, new = tmp_path / f"{numba_cache.FOLDER_PREFIX}old", tmp_path / f"{numba_cache.FOLDER_PREFIX}new"
    for folder in (old, new):
        folder.mkdir()
    numba_cache._remove_stale(tmp_path, keep=new.name)
    assert old.is_dir(), "another process may still use it"
    for folder in (old, new):
        os.utime(folder, (time.time() - 2.0 * numba_cache.STALE_AGE,) * 2)
    numba_cache._remove_stale(tmp_path, keep=new.name)
    assert not old.exists() and new.is_dir()
