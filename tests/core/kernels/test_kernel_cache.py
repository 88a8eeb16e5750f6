"""Compiled code is taken from disk, and made anew when a compiled file has changed or one of the cache is damaged."""

import importlib
import importlib.util
import itertools
import os
import pickle
import pkgutil
import shutil
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.registry import CPUDispatcher
from numba.core.target_extension import dispatcher_registry, target_registry

import msdm_core
import surgsim_env
from msdm_core import numba_cache
from msdm_core.kernels import guard_kernels
from msdm_core.kernels.tissue_kernels import set_node_tension

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


@pytest.mark.slow
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


# ---- damage ---------------------------------------------------------------------------------------------------------

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
    """A folder with a file of two tiny kernels, cached in its `__pycache__`."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    # The next place; the one after it would be the temporary folder.
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    numba_cache._warn_of_no_room.cache_clear()
    folder = tmp_path / "source"
    folder.mkdir()
    (folder / "tiny_kernels.py").write_text(TINY)
    return folder


def executed(folder: Path) -> Any:
    """The module of the tiny kernels, as a new process imports it."""
    spec = importlib.util.spec_from_file_location("tiny_kernels", folder / "tiny_kernels.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def started(folder: Path) -> tuple[bool, list[str]]:
    """Import the kernels and use one: whether it came from the cache, and what was warned of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with numba_cache.kernel_cache(folder):
            module = executed(folder)
        assert module.double(21.0) == 42.0
    return bool(module.double.stats.cache_hits), [str(warning.message) for warning in caught]


def cached(folder: Path, suffix: str) -> Path:
    (file,) = folder.rglob(f"*double*{suffix}")
    return file


def flipped(content: bytes) -> bytes:
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "emptied": lambda content: b"",
    "cut": lambda content: content[: len(content) // 2],
    "zeroed": lambda content: bytes(len(content)),
    "flipped": flipped,
    "no pickle": lambda content: b"text",
    "another pickle": lambda content: pickle.dumps(numba.__version__) + pickle.dumps("text"),
    "folder": lambda content: b"",
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
def test_a_damaged_file_is_dropped_and_made_anew(source: Path, suffix: str, damage: str):
    assert started(source) == (False, [])
    assert started(source) == (True, [])
    file = cached(source, suffix)
    if damage == "folder":
        file.unlink()
        file.mkdir()
    else:
        file.write_bytes(DAMAGES[damage](file.read_bytes()))
    hit, said = started(source)
    assert not hit
    assert len(said) == 1 and f"{file} of numba's cache is damaged (" in said[0] and "\n" not in said[0]
    assert started(source) == (True, []), "it healed"


def doubled(source: Path) -> Any:
    """The kernel `double` of a new process, with the healing cache."""
    with numba_cache.kernel_cache(source):
        return executed(source).double


def test_two_processes_that_compile_for_two_types_at_once_keep_apart(source: Path, monkeypatch):
    """Both read the index before either writes it, and one writes its data last."""
    one, other = doubled(source), doubled(source)
    save_data = one._cache._cache_file._save_data

    def overtaken(name: str, data: Any) -> None:
        with monkeypatch.context() as patched:
            patched.setattr(other._cache._cache_file, "_load_index", lambda: {})
            assert other(1j) == 2j
        save_data(name, data)

    monkeypatch.setattr(one._cache._cache_file, "_save_data", overtaken)
    assert one(1.5) == 3.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for hits in (1, 2):
            later = doubled(source)
            assert (later(1.5), later(1j)) == (3.0, 2j)
            assert sum(later.stats.cache_hits.values()) == hits


def test_an_index_that_names_a_file_for_other_types_is_healed(source: Path):
    """As plain numba's names of data files, by number, can leave it."""
    first = doubled(source)
    assert (first(1.5), first(21)) == (3.0, 42.0)
    one, other = (first._cache._cache_file._data_path(name) for name in first._cache._cache_file._load_index().values())
    shutil.copy(one, other)
    with pytest.warns(RuntimeWarning, match=r"it holds the function for \(float64,\), not for \(int64,\)"):
        later = doubled(source)
        assert (later(1.5), later(21)) == (3.0, 42.0)
    healed = doubled(source)
    assert (healed(1.5), healed(21)) == (3.0, 42.0) and sum(healed.stats.cache_hits.values()) == 2


def test_files_have_a_checksum_that_plain_numba_does_not_mind(source: Path):
    started(source)
    for suffix in (".nbi", ".nbc"):
        assert cached(source, suffix).read_bytes()[-numba_cache.CHECKSUM_LENGTH :].startswith(b"surgsim-sha256:")
    numba.config.CACHE_DIR = str(cached(source, ".nbi").parents[1])
    plain = executed(source)
    assert plain.double(21.0) == 42.0 and plain.double.stats.cache_hits
    # Nor does this mind files without one, as an earlier version left them.
    shutil.rmtree(cached(source, ".nbi").parent)
    assert executed(source).double(21.0) == 42.0
    assert not cached(source, ".nbc").read_bytes()[-numba_cache.CHECKSUM_LENGTH :].startswith(b"surgsim-sha256:")
    numba.config.CACHE_DIR = ""
    assert started(source) == (True, [])


def test_what_cannot_be_removed_is_not_in_the_way(source: Path):
    started(source)
    file = cached(source, ".nbi")
    file.unlink()
    (file / "kept").mkdir(parents=True)
    for _ in range(2):
        hit, (damaged, no_room) = started(source)
        assert not hit and "as it cannot be removed (Directory not empty)" in damaged
        assert "cannot be kept in" in no_room
        numba_cache._warn_of_no_room.cache_clear()


def test_without_room_functions_are_compiled_and_one_warning_says_so(source: Path, monkeypatch):
    def full(file: Any, name: str, data: Any) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched, warnings.catch_warnings(record=True) as caught:
        patched.setattr(numba_cache.CheckedCacheFile, "_save_data", full)
        warnings.simplefilter("always")
        with numba_cache.kernel_cache(source):
            module = executed(source)
        assert (module.double(21.0), module.half(42.0)) == (42.0, 21.0)
    (said,) = [str(warning.message) for warning in caught]
    assert "No space left on device" in said and str(source / "__pycache__") in said and "NUMBA_CACHE_DIR" in said
    # The index names a data file that was never written.
    assert started(source) == (False, []) and started(source) == (True, [])


def test_without_a_folder_functions_are_compiled_and_one_warning_says_so(source: Path, monkeypatch):
    def full() -> Path:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(numba_cache, "_can_write", lambda folder: False)
    monkeypatch.setattr(numba_cache, "_private_temporary_folder", full)
    with pytest.warns(RuntimeWarning, match=r"no folder can be written .*: set NUMBA_CACHE_DIR to one that can"):
        assert numba_cache.provide_cache_folder(source) is None
    assert started(source) == (False, []) and started(source) == (False, [])
    assert not list(source.rglob("*.nbi"))


@pytest.mark.parametrize("inside", [False, True])
def test_a_folder_that_others_may_write_to_is_not_used(source: Path, tmp_path: Path, inside: bool):
    """What lies there is pickled code of anybody; another folder is used, whose content is kept."""
    started(source)
    folder = cached(source, ".nbi").parent
    open_to_all = folder if inside else folder.parent
    open_to_all.chmod(0o777)
    for kept in (False, True):
        hit, (said,) = started(source)
        assert hit == kept and f"{folder.parent} is not used" in said and "drwxrwxrwx" in said
    assert list((tmp_path / "home").rglob("*double*.nbi"))


def test_the_kernels_have_a_cache_that_heals_and_others_are_left_alone():
    """Fails where numba's internals move: the registry, the dispatcher's `_cache`, the two kinds of files."""
    assert type(set_node_tension) is numba_cache.HealingDispatcher
    assert type(set_node_tension._cache) is numba_cache.HealingCache
    assert type(set_node_tension._cache._cache_file) is numba_cache.CheckedCacheFile
    assert dispatcher_registry[target_registry["cpu"]] is CPUDispatcher
    with pytest.raises(KeyboardInterrupt), numba_cache.kernel_cache(Path(__file__).parent):
        raise KeyboardInterrupt
    assert dispatcher_registry[target_registry["cpu"]] is CPUDispatcher
    shutil.rmtree(Path(__file__).parent / "__pycache__", ignore_errors=True)


def test_every_file_of_kernels_is_decorated_where_the_cache_heals():
    """A file that is first imported elsewhere would have numba's own cache."""
    plain = []
    for package in (msdm_core, surgsim_env):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if module.name.endswith("_kernels"):
                for name, found in vars(importlib.import_module(module.name)).items():
                    if isinstance(found, CPUDispatcher) and not isinstance(found, numba_cache.KernelDispatcher):
                        plain.append(f"{module.name}.{name}")
    assert not plain


FIRST_STEP = """
import sys
import threading
import gymnasium
import surgsim_env
from surgsim_env.coupling.haptic_kernels import advance_haptic_steps
env = gymnasium.make("SurgSim/Palpate-v0", scene="phantom_small")
env.reset(seed=0)
env.step(env.action_space.sample())
print(sum(advance_haptic_steps.stats.cache_hits.values()))
print(*(name for name in ("numba.cpython.unicode", "numba.np.arrayobj", "scipy.optimize") if name in sys.modules))
"""


def test_a_warm_start_imports_no_compiler():
    """What numba lowers functions with, and scipy.optimize, take a third of a second to import."""
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", FIRST_STEP], capture_output=True, text=True, check=True)
        hits, loaded = done.stdout.splitlines()
        if hits == "1":
            assert loaded == ""
            return
    pytest.fail("the second start compiled again")


def test_a_cache_that_another_process_removes_meanwhile_is_no_error(source: Path, monkeypatch):
    (stale := source / f"{numba_cache.FOLDER_PREFIX}gone").symlink_to(source / "nowhere")
    numba_cache._remove_stale(source, keep="another")
    stale.unlink()
    started(source)
    file = cached(source, ".nbc")
    verify = numba_cache._verify

    def overtaken(path: str) -> None:
        verify(path)
        if path == str(file):
            file.unlink()
            raise ValueError("damaged")

    monkeypatch.setattr(numba_cache, "_verify", overtaken)
    hit, (said,) = started(source)
    assert not hit and "it is dropped" in said


def test_a_function_without_a_wrapper_refuses_python():
    """numba would jump to address 0."""
    assert type(guard_kernels._foot) is numba_cache.InnerHealing
    with pytest.raises(TypeError, match=r"_foot is called by compiled code alone .* decorate it with KERNEL"):
        guard_kernels._foot(np.zeros(3))


def test_compiling_that_takes_long_says_so_once(caplog):
    for patience, lines in ((0.0, ["once: up to a minute", "compiled in 0 s"]), (60.0, [])):
        message = numba_cache.Compiling(patience)
        caplog.clear()
        # A function that calls two others, of which the first takes long.
        with message.one():
            for pause in (0.002, 0.0):
                with message.one():
                    time.sleep(pause)
        assert len(caplog.messages) == len(lines)
        assert all(text in said for text, said in zip(lines, caplog.messages, strict=True))


# ---- several threads ------------------------------------------------------------------------------------------------


class WatchedLock:
    """A lock that sets an event when a thread finds it taken, and waits then."""

    def __init__(self, taken: threading.Event) -> None:
        self._lock, self._taken = threading.RLock(), taken

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            self._taken.set()
            self._lock.acquire()

    def __exit__(self, *given: object) -> None:
        self._lock.release()


def finish(*threads: threading.Thread) -> None:
    for thread in threads:
        thread.join(60.0)
        assert not thread.is_alive(), "threads wait for each other"


@pytest.mark.parametrize("other", ["kernel_cache", "provide_cache_folder"])
def test_two_threads_leave_numbas_settings_as_they_were(source: Path, tmp_path: Path, monkeypatch, other: str):
    """The second thread comes while the first is inside, and ends last: without a lock it restores the first's."""
    inside, came, first_left = threading.Event(), threading.Event(), threading.Event()
    monkeypatch.setattr(numba_cache, "SETTINGS_LOCK", WatchedLock(came))
    monkeypatch.setattr(numba_cache, "_private_temporary_folder", lambda: tmp_path)
    seen: list[str] = []

    def first() -> None:
        with numba_cache.kernel_cache(source):
            monkeypatch.setattr(numba_cache, "_can_write", lambda folder: False)
            inside.set()
            assert came.wait(60.0)
            seen.append(Path(numba.config.CACHE_DIR).parent.name)
        first_left.set()

    def second() -> None:
        assert inside.wait(60.0)
        if other == "provide_cache_folder":
            assert numba_cache.provide_cache_folder(source) == tmp_path
            came.set()
            return
        with numba_cache.kernel_cache(source):
            came.set()
            assert first_left.wait(60.0)
            seen.append(Path(numba.config.CACHE_DIR).parent.name)

    threads = [threading.Thread(target=one, daemon=True) for one in (first, second)]
    for thread in threads:
        thread.start()
    finish(*threads)
    assert seen == ["__pycache__", tmp_path.name][: len(seen)] and seen
    assert dispatcher_registry[target_registry["cpu"]] is CPUDispatcher
    assert numba.config.CACHE_DIR == (str(tmp_path) if other == "provide_cache_folder" else "")


IMPORT_IN_TWO_THREADS = """
import importlib, os, threading
from numba.core import config
from numba.core.registry import CPUDispatcher
from numba.core.target_extension import dispatcher_registry, target_registry
before, both = config.CACHE_DIR, threading.Barrier(2)
def load(name):
    both.wait()
    importlib.import_module(name)
threads = [threading.Thread(target=load, args=(name,), daemon=True) for name in ("surgsim_env", "msdm_core")]
for thread in threads: thread.start()
for thread in threads: thread.join(60.0)
if any(thread.is_alive() for thread in threads): os._exit(1)
from surgsim_env.coupling.haptic_kernels import total_force
print(type(total_force).__name__)
print(dispatcher_registry[target_registry["cpu"]] is CPUDispatcher, config.CACHE_DIR == before)
"""


def test_both_packages_can_be_imported_by_two_threads_at_once():
    done = subprocess.run([sys.executable, "-c", IMPORT_IN_TWO_THREADS], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr or "the threads wait for each other"
    assert done.stdout.split() == ["HealingDispatcher", "True", "True"]


def test_two_threads_that_compile_at_once_say_so_once(caplog, monkeypatch):
    """The second ends while the first, having counted itself out, reads the clock: without a lock both say the end."""
    compiling = numba_cache.Compiling(0.0)
    second_inside, first_leaves, first_reads, second_came = (threading.Event() for _ in range(4))
    monkeypatch.setattr(compiling, "_lock", WatchedLock(second_came))
    ticks = itertools.count()

    def clock() -> float:
        if threading.current_thread() is threads[0] and first_leaves.is_set():
            first_reads.set()
            assert second_came.wait(60.0)
        return float(next(ticks))

    def first() -> None:
        with compiling.one():
            assert second_inside.wait(60.0)
            first_leaves.set()

    def second() -> None:
        with compiling.one():
            second_inside.set()
            assert first_reads.wait(60.0)
        second_came.set()

    threads = [threading.Thread(target=one, daemon=True) for one in (first, second)]
    monkeypatch.setattr(numba_cache, "time", SimpleNamespace(monotonic=clock))
    for thread in threads:
        thread.start()
    finish(*threads)
    assert ["once: up to a minute" in said for said in caplog.messages] == [True, False]
    assert "compiled in" in caplog.messages[1]


def test_kernels_compile_in_two_threads_at_once(source: Path):
    """One holds numba's lock and waits for a function that the other compiles, which wants numba's lock."""
    plain = numba.njit(lambda x: module.double(x) + 1.0)
    with numba_cache.kernel_cache(source):
        module = executed(source)
    both = threading.Barrier(2)
    results: list[float] = []

    def use(function: Callable[[float], float]) -> None:
        both.wait(60.0)
        results.append(function(21.0))

    threads = [threading.Thread(target=use, args=(one,), daemon=True) for one in (plain, module.double)]
    for thread in threads:
        thread.start()
    finish(*threads)
    assert sorted(results) == [42.0, 43.0]


COLLECTOR = "import gc{imports}; print(gc.isenabled(), gc.get_threshold(), gc.get_freeze_count())"


def test_importing_leaves_pythons_collector_alone():
    """What it is told to collect, and when, is the user's."""
    said = [
        subprocess.run(
            [sys.executable, "-c", COLLECTOR.format(imports=imports)], capture_output=True, text=True, check=True
        ).stdout
        for imports in ("", ", surgsim_env")
    ]
    assert said[1] == said[0]
