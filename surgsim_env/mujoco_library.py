"""MuJoCo's C functions, made known to the linker of compiled code; importing this module does it.

Compiled code that calls a function which the linker does not know ends the process, also when it comes from the cache:
`missing` is asked first.
"""

import ctypes
from pathlib import Path

import mujoco
from llvmlite import binding

from surgsim_env.haptic_kernels import MUJOCO_FUNCTIONS

LIBRARY_NAMES = ("libmujoco*.so*", "libmujoco*.dylib", "mujoco.dll")


def load_library(folder: Path) -> str:
    """Make the library in MuJoCo's package folder known to the linker; why it is not, or an empty string."""
    if not hasattr(mujoco.MjModel, "_address") or not hasattr(mujoco.MjData, "_address"):
        return f"MuJoCo {mujoco.mj_versionString()} does not tell the addresses of its model and data"
    found = sorted(path for name in LIBRARY_NAMES for path in folder.glob(name))
    if not found:
        return f"no library of MuJoCo in {folder} ({', '.join(LIBRARY_NAMES)})"
    try:
        binding.load_library_permanently(str(found[0]))
    except RuntimeError as error:
        return f"{found[0]} cannot be loaded: {error}"
    return check_functions(MUJOCO_FUNCTIONS)


def check_functions(names: tuple[str, ...]) -> str:
    """Why the linker's functions cannot be called, or an empty string."""
    unknown = [name for name in names if binding.address_of_symbol(name) is None]
    if unknown:
        return f"MuJoCo {mujoco.mj_versionString()} has no function {', '.join(unknown)}"
    # Another copy of MuJoCo in the process would read our data as what it is not.
    address = binding.address_of_symbol("mj_version")
    version = ctypes.CFUNCTYPE(ctypes.c_int)(address)() if address else None
    if version != mujoco.mj_version():
        return f"the process holds another MuJoCo too: version {version}, Python's is {mujoco.mj_version()}"
    return ""


_missing = load_library(Path(mujoco.__file__).parent)


def missing() -> str:
    """Why MuJoCo cannot be stepped in compiled code; an empty string where it can."""
    return _missing
