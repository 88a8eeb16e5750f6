"""Functions of the kernels as device functions of one floating-point type, made from the same source.

A number in the text of a kernel is float64, and makes an expression of float32 numbers float64 too. Here each function
is built anew from its code, with such numbers, and the constants of its module, in the type that is asked for.
"""

import math
from types import FunctionType
from typing import Any

import numpy as np
from numba import config, cuda, from_dtype, types

from msdm_core.kernels import vector_kernels

# In the text of a kernel: the type that it is made for, as numpy and as numba name it.
REAL, REAL_TYPE = np.float64, types.float64


def _keep_lower(new, old, of_new, of_old):
    return of_old if new >= old else of_new


def _below_zero(value):
    return min(value, 0.0)


def _any_below(value, limit):
    return value < limit


# Whether numba simulates devices, NUMBA_ENABLE_CUDASIM.
SIMULATED = bool(config.ENABLE_CUDASIM)  # pyright: ignore[reportAttributeAccessIssue]

# Functions of vector registers for one number.
SCALAR: dict[Any, Any] = {
    vector_kernels.root: math.sqrt,
    vector_kernels.keep_lower: _keep_lower,
    vector_kernels.below_zero: _below_zero,
    vector_kernels.any_below: _any_below,
}


def _known(**options: Any) -> dict[str, Any]:
    """Options of `cuda.jit`; the simulator knows none of these."""
    return {} if SIMULATED else options


class DeviceFunctions:
    """Device functions of one floating-point type; each is made once."""

    def __init__(self, dtype: Any, **names: Any) -> None:
        """Make functions of np.float32 or np.float64, in which some names of modules have other values."""
        self._dtype = np.dtype(dtype).type
        self._names = names
        self._made: dict[Any, Any] = {}

    def __call__(self, function: Any) -> Any:
        """The device function of a kernel's function: a plain one, or one that is compiled for the processor."""
        if function not in self._made:
            self._made[function] = cuda.jit(device=True, **_known(forceinline=True))(self.typed(function))
        return self._made[function]

    def kernel(self, function: Any, registers: int | None = None) -> Any:
        """The kernel of a plain function, whose threads have at most so many registers."""
        return cuda.jit(**_known(max_registers=registers))(self.typed(function))

    def typed(self, function: Any) -> FunctionType:
        """A plain function whose constants are of the type, and whose callees are device functions."""
        source = getattr(function, "py_func", function)
        code = source.__code__
        known = {**source.__globals__, **self._names}
        names = {name: self._value(known[name]) for name in code.co_names if name in source.__globals__}
        constants = tuple(self._constant(value) for value in code.co_consts)
        return FunctionType(code.replace(co_consts=constants), {**source.__globals__, **names}, source.__name__)

    def _value(self, value: Any) -> Any:
        """The stand-in for what a name of a module means."""
        if value is REAL:
            return self._dtype
        if value is REAL_TYPE:
            return from_dtype(np.dtype(self._dtype))
        if isinstance(value, FunctionType) or hasattr(value, "py_func"):
            return self(value)
        if isinstance(value, np.ndarray) and value.dtype == np.float64:
            return value.astype(self._dtype)
        if callable(value) and value in SCALAR:
            stand_in = SCALAR[value]
            return self(stand_in) if isinstance(stand_in, FunctionType) else stand_in
        return self._constant(value)

    def _constant(self, value: Any) -> Any:
        if type(value) is tuple:
            return tuple(self._constant(part) for part in value)
        return self._dtype(value) if isinstance(value, float) else value
