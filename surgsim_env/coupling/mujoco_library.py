"""Makes MuJoCo's C functions known to the linker of compiled code when it is imported, and chooses the loop.

Compiled code that calls a function unknown to the linker ends the process, also when it comes from the cache. Callers
therefore check `missing` first.
"""

import os
import warnings
from functools import cache
from pathlib import Path

import mujoco
from llvmlite import binding

from msdm_core.numba_cache import NUMBA_CONFIG
from surgsim_env.coupling import mujoco_library
from surgsim_env.instruments.mujoco_kernels import MUJOCO_FUNCTIONS

LIBRARY_NAMES = ("libmujoco*.so*", "libmujoco*.dylib", "mujoco.dll")


def load_library(folder: Path) -> str:
    """Load the library in MuJoCo's package folder into the linker; returns why it cannot be used, or ""."""
    libraries = sorted(path for name in LIBRARY_NAMES for path in folder.glob(name))
    if not libraries:
        return f"no library of MuJoCo in {folder} ({', '.join(LIBRARY_NAMES)})"
    try:
        binding.load_library_permanently(str(libraries[0]))
    except RuntimeError as error:
        return f"{libraries[0]} cannot be loaded: {error}"
    return check_functions(MUJOCO_FUNCTIONS)


def check_functions(names: tuple[str, ...]) -> str:
    """Returns why functions cannot be called through the linker, or ""."""
    unknown = [name for name in names if binding.address_of_symbol(name) is None]
    if unknown:
        return f"MuJoCo {mujoco.mj_versionString()} has no function {', '.join(unknown)}"
    return ""


_missing = load_library(Path(mujoco.__file__).parent)


def missing() -> str:
    """Returns why compiled code cannot step MuJoCo, or ""."""
    return _missing


# "python": haptic steps run in Python, as they do without this variable if MuJoCo's functions cannot be linked, or with
# NUMBA_DISABLE_JIT, numba's own switch.
LOOP_VARIABLE = "SURGSIM_LOOP"


def runs_compiled() -> bool:
    """True unless LOOP_VARIABLE or a missing library makes new simulations run in Python.

    Raises:
        ValueError: the variable is neither "compiled" nor "python".
    """
    loop = os.environ.get(LOOP_VARIABLE, "python" if NUMBA_CONFIG.DISABLE_JIT else "compiled")
    if loop not in ("compiled", "python"):
        raise ValueError(f'{LOOP_VARIABLE} is {loop!r}; it is "compiled" or "python"')
    return loop == "compiled" and not _warn_of_missing_library(mujoco_library.missing())


@cache
def _warn_of_missing_library(missing: str) -> bool:
    """Warn once of control steps in Python, with the reason; False if nothing is missing."""
    if missing:
        warnings.warn(f"control steps run in the plain Python loop, more slowly: {missing}", RuntimeWarning, 2)
    return bool(missing)
