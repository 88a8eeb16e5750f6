"""Compiled code is taken from disk, and made anew when a file of kernels has changed or the cache is damaged."""

import importlib
import importlib.util
import os
import pickle
import pkgutil
import shutil
import stat
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numba
import pytest
from numba.core import dispatcher
from numba.core.caching import FunctionCache, NullCache
from numba.core.registry import CPUDispatcher

import msdm_core
import surgsim_env
from msdm_core import numba_cache

TOTAL_FORCE = """
import numpy as np
from surgsim_env.coupling.haptic_kernels import total_force
total_force(np.full((1, 6), 2.0))
print(sum(total_force.stats.cache_hits.values()))
"""


def test_an_edit_in_another_package_is_seen(tmp_path):
    """The environments' kernels call the organ's: both packages' files name the folder, which is the user's."""
    environment = {"PATH": "/usr/bin:/bin", "PYTHONPATH": str(tmp_path), "HOME": str(tmp_path)}
    for package in (msdm_core, surgsim_env):
        source = Path(package.__file__).parent
        shutil.copytree(source, tmp_path / source.name, ignore=shutil.ignore_patterns("__pycache__"))

    def hits() -> str:
        command = [sys.executable, "-c", TOTAL_FORCE]
        return subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=True).stdout

    assert hits() == "0\n"
    assert hits() == "1\n", "the second start compiled again"
    with (tmp_path / "msdm_core" / "kernels" / "element_kernels.py").open("a", encoding="utf-8") as equations:
        equations.write("# edited\n")
    assert hits() == "0\n", "stale machine code would be run"
    folders = list((tmp_path / ".cache" / "surgsim").iterdir())
    assert len(folders) == 4 and {stat.S_IMODE(folder.stat().st_mode) for folder in folders} == {0o700}


def test_every_function_that_is_kept_is_decorated_within_kernel_cache():
    """A file that is first imported elsewhere would have numba's own cache."""
    for package in (msdm_core, surgsim_env):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if module.name.endswith("_kernels"):
                for name, function in vars(importlib.import_module(module.name)).items():
                    if isinstance(function, CPUDispatcher):
                        assert type(function._cache) in (numba_cache.KernelCache, NullCache), f"{module.name}.{name}"


# ---- two tiny kernels -----------------------------------------------------------------------------------------------

TINY = """
import numba

@numba.njit(cache=True)
def double(x):
    return 2.0 * x

@numba.njit(cache=True)
def half(x):
    return 0.5 * x
"""


@pytest.fixture
def source(tmp_path: Path, monkeypatch) -> Path:
    """A folder with a file of two tiny kernels, cached in `tmp_path/cache`."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    folder = tmp_path / "source"
    folder.mkdir()
    (folder / "tiny_kernels.py").write_text(TINY)
    return folder


def kernels(folder: Path) -> ModuleType:
    """The module of the tiny kernels, as a new process imports it."""
    spec = importlib.util.spec_from_file_location("tiny_kernels", folder / "tiny_kernels.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    with numba_cache.kernel_cache(folder):
        spec.loader.exec_module(module)
    return module


def used(folder: Path) -> tuple[int, list[str]]:
    """Import the kernels and use both: how many came from the cache, and the warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        module = kernels(folder)
        assert (module.double(21.0), module.half(42.0)) == (42.0, 21.0)
    hits = sum(len(function.stats.cache_hits) for function in (module.double, module.half))
    return hits, [str(warning.message) for warning in caught]


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "emptied": lambda content: b"",
    "cut": lambda content: content[: len(content) // 2],
    "another pickle": lambda content: pickle.dumps(numba.__version__) + pickle.dumps("text"),
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
def test_a_damaged_cache_is_removed_and_made_anew(source: Path, suffix: str, damage: str):
    assert used(source) == (0, [])
    assert used(source) == (2, [])
    (file,) = (source.parent / "cache").rglob(f"*double*{suffix}")
    file.write_bytes(DAMAGES[damage](file.read_bytes()))
    hits, (warning,) = used(source)
    assert hits == 0 and f"{file.parents[1]}, numba's cache, is damaged (" in warning
    assert stat.S_IMODE(file.parents[1].stat().st_mode) == 0o700
    assert used(source) == (2, [])


def test_an_index_that_names_a_file_for_other_types_is_noticed(source: Path):
    """Of two processes that compile for different types at once, numba may leave it."""
    first = kernels(source)
    assert (first.double(1.5), first.double(21)) == (3.0, 42.0)
    first_file, second_file = sorted((source.parent / "cache").rglob("*double*.nbc"))
    shutil.copy(first_file, second_file)
    later = kernels(source)
    assert later.double(1.5) == 3.0
    with pytest.warns(RuntimeWarning, match=r"a function for \(float64,\) is filed under \(int64,\)"):
        assert later.double(21) == 42.0


def test_without_room_functions_are_compiled_and_one_warning_says_so(source: Path, monkeypatch):
    def full(*given) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(FunctionCache, "save_overload", full)
    hits, (warning,) = used(source)
    assert hits == 0 and "No space left on device" in warning and "NUMBA_CACHE_DIR" in warning


def test_where_nothing_can_be_written_a_temporary_folder_is_used(source: Path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", "/proc/nowhere")
    hits, (warning,) = used(source)
    assert hits == 0 and "'/proc/nowhere'" in warning and "NUMBA_CACHE_DIR" in warning


def test_folders_of_old_texts_are_removed_in_time(source: Path):
    used(source)
    (old,) = (source.parent / "cache").iterdir()
    (source / "tiny_kernels.py").write_text(f"{TINY}# edited\n")
    assert used(source) == (0, [])
    assert old.is_dir(), "another process may still use it"
    for folder in old.parent.iterdir():
        os.utime(folder, (time.time() - 2.0 * numba_cache.UNUSED_AGE,) * 2)
    assert used(source) == (2, []), "a folder in use is not taken for old"
    assert not old.exists()


def test_an_error_leaves_numbas_settings_as_they_were(source: Path):
    before = numba.config.CACHE_DIR, dispatcher.FunctionCache
    with pytest.raises(KeyboardInterrupt), numba_cache.kernel_cache(source):
        assert dispatcher.FunctionCache is numba_cache.KernelCache
        raise KeyboardInterrupt
    assert (numba.config.CACHE_DIR, dispatcher.FunctionCache) == before


@pytest.mark.parametrize(
    ("patience", "module", "count"), [(0.0, "msdm_core.x", 2), (60.0, "msdm_core.x", 0), (0.0, "x", 0)]
)
def test_compiling_that_takes_long_says_so_once(caplog, monkeypatch, patience: float, module: str, count: int):
    monkeypatch.setattr(numba_cache, "PATIENCE", patience)
    function = SimpleNamespace(py_func=SimpleNamespace(__module__=module))
    event, message = SimpleNamespace(data={"dispatcher": function}), numba_cache.CompileMessage()
    # A function that calls two others.
    message.on_start(event)
    for _ in range(2):
        message.on_start(event)
        time.sleep(0.001)
        message.on_end(event)
    message.on_end(event)
    expected = ["once: up to a minute", "compiled in 0 s"][:count]
    assert len(caplog.messages) == count
    assert all(text in line for text, line in zip(expected, caplog.messages, strict=True))
