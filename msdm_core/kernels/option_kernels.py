"""How kernels are compiled: the options of `@njit(**...)`.

Division by zero gives infinity and nan, as in numpy, and no function is wrapped for C. No memory is taken and no
references are counted (`_nrt`, numba's runtime): a kernel that makes an array does not compile, and all compile in 0.8
of the time. A wrapper for Python takes as long to compile as a small function: those that compiled code alone calls
have none; numba makes machine code of them all the same, and links them into their callers. Calling one of them from
Python ends the process (a jump to address 0); call its `py_func`.
"""

from typing import Any

_ALL: dict[str, Any] = {"error_model": "numpy", "no_cfunc_wrapper": True, "_nrt": False}
# Called from Python, kept on disk, and runs without the interpreter's lock.
KERNEL: dict[str, Any] = {**_ALL, "cache": True, "nogil": True}
# For `register_jitable`: a part of a kernel that runs in Python too.
JITABLE: Any = _ALL
# A kernel that kernels call.
INNER: dict[str, Any] = {**KERNEL, "no_cpython_wrapper": True}
# Becomes part of each function that calls it.
INLINED: dict[str, Any] = {**_ALL, "forceinline": True, "no_cpython_wrapper": True}
# The same, and called from Python too.
INLINED_KERNEL: dict[str, Any] = {**_ALL, "forceinline": True}
# The same as INLINED of a function that returns a view of an array, which numba takes for a new array.
INLINED_VIEW: dict[str, Any] = {**INLINED, "_nrt": True}
# A kernel outside of the substep that makes arrays.
ALLOCATING_KERNEL: dict[str, Any] = {**KERNEL, "_nrt": True}
