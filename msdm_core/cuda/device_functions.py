"""Device functions of one floating-point type from the source of the kernels.

A literal in a kernel is float64, and makes an expression of float32 numbers float64 too. Each function is therefore
built again from its code, with its literals and the constants of its module in the requested type.
"""

import math
from types import FunctionType
from typing import Any

import numpy as np
from numba import config, cuda, from_dtype, types

from msdm_core.kernels import vector_kernels

# Placeholders for the floating-point type in a kernel, for numpy and for numba.
REAL, REAL_TYPE = np.float64, types.float64


def _keep_lower(new, old, of_new, of_old):
    return of_old if new >= old else of_new


def _below_zero(value):
    return min(value, 0.0)


def _any_below(value, limit):
    return value < limit


# numba's simulator of devices, NUMBA_ENABLE_CUDASIM.
SIMULATED = bool(config.ENABLE_CUDASIM)  # pyright: ignore[reportAttributeAccessIssue]

# Scalar equivalents of functions of vector registers.
SCALAR: dict[Any, Any] = {
    vector_kernels.root: math.sqrt,
    vector_kernels.keep_lower: _keep_lower,
    vector_kernels.below_zero: _below_zero,
    vector_kernels.any_below: _any_below,
}


def _options(**options: Any) -> dict[str, Any]:
    """Options of `cuda.jit`; the simulator has none of these."""
    return {} if SIMULATED else options


class DeviceFunctions:
    """Device functions of one floating-point type, each compiled once."""

    def __init__(self, dtype: Any, **names: Any) -> None:
        """Functions of np.float32 or np.float64, with other values for some names of their modules."""
        self._dtype = np.dtype(dtype).type
        self._names = names
        self._functions: dict[Any, Any] = {}

    def __call__(self, function: Any) -> Any:
        """Device function of a plain function, or of a function compiled for the processor."""
        if function not in self._functions:
            self._functions[function] = cuda.jit(device=True, **_options(forceinline=True))(self.typed(function))
        return self._functions[function]

    def kernel(self, function: Any, registers: int | None = None) -> Any:
        """Kernel of a plain function, with a limit to the registers of a thread."""
        return cuda.jit(**_options(max_registers=registers))(self.typed(function))

    def typed(self, function: Any) -> FunctionType:
        """Plain function with constants of the type and device functions as callees."""
        source = getattr(function, "py_func", function)
        code = source.__code__
        scope = {**source.__globals__, **self._names}
        names = {name: self._value(scope[name]) for name in code.co_names if name in source.__globals__}
        constants = tuple(self._constant(value) for value in code.co_consts)
        return FunctionType(code.replace(co_consts=constants), {**source.__globals__, **names}, source.__name__)

    def _value(self, value: Any) -> Any:
        """Device's value for the value of a name in a module."""
        if value is REAL:
            return self._dtype
        if value is REAL_TYPE:
            return from_dtype(np.dtype(self._dtype))
        if isinstance(value, FunctionType) or hasattr(value, "py_func"):
            return self(value)
        if isinstance(value, np.ndarray) and value.dtype == np.float64:
            return value.astype(self._dtype)
        if callable(value) and value in SCALAR:
            scalar = SCALAR[value]
            return self(scalar) if isinstance(scalar, FunctionType) else scalar
        return self._constant(value)

    def _constant(self, value: Any) -> Any:
        if type(value) is tuple:
            return tuple(self._constant(part) for part in value)
        return self._dtype(value) if isinstance(value, float) else value
