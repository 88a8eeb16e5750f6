"""Options of `@njit(**...)` for kernels.

Division by zero gives infinity and nan, as in numpy, and no function has a wrapper for C. Without `_nrt`, numba's
runtime, there are no allocations and no reference counts: a kernel that makes an array does not compile, and all
compile in 0.8 of the time. A wrapper for Python takes as long to compile as a small function: functions for compiled
callers alone have none; numba still makes machine code of them, and links them into their callers. A call of one of
them from Python ends the process (a jump to address 0); call its `py_func`.
"""

from typing import Any

_ALL: dict[str, Any] = {"error_model": "numpy", "no_cfunc_wrapper": True, "_nrt": False}
# Called from Python, cached on disk, run without the interpreter's lock.
KERNEL: dict[str, Any] = {**_ALL, "cache": True, "nogil": True}
# For `register_jitable`: a part of a kernel for Python too.
JITABLE: Any = _ALL
# A kernel called by kernels alone.
INNER: dict[str, Any] = {**KERNEL, "no_cpython_wrapper": True}
# Inlined into each caller.
INLINED: dict[str, Any] = {**_ALL, "forceinline": True, "no_cpython_wrapper": True}
# Inlined, and called from Python too.
INLINED_KERNEL: dict[str, Any] = {**_ALL, "forceinline": True}
# Inlined, with a view of an array as result, which numba takes for a new array.
INLINED_VIEW: dict[str, Any] = {**INLINED, "_nrt": True}
# A kernel outside of the substep with arrays of its own.
ALLOCATING_KERNEL: dict[str, Any] = {**KERNEL, "_nrt": True}
