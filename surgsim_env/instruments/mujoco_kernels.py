"""MuJoCo's functions under one name for Python and for compiled code.

Python calls MuJoCo's own bindings, with an MjModel and an MjData. Compiled code calls the C function of the same name,
with the addresses of mjModel and mjData. The linker must know that function first: call `coupling.mujoco_library`
before running a compiled function with one of these.
"""

from typing import Any

import mujoco
import numpy as np
from numba import types
from numba.extending import overload

from msdm_core.kernels.option_kernels import JITABLE

# The objtype of a body in `mj_objectVelocity`.
OBJECT_BODY = int(mujoco.mjtObj.mjOBJ_BODY)

mj_step1 = mujoco.mj_step1
mj_step2 = mujoco.mj_step2
mj_fwdActuation = mujoco.mj_fwdActuation
mj_fwdAcceleration = mujoco.mj_fwdAcceleration
mj_fullM = mujoco.mj_fullM
mj_jacBodyCom = mujoco.mj_jacBodyCom
mj_objectVelocity = mujoco.mj_objectVelocity

_address, _index = types.uintp, types.int32


def _c_function(name: str, *arguments: types.Type) -> Any:
    """MuJoCo's C function of a name, without a result."""
    return types.ExternalFunction(name, types.void(*arguments))


_step1 = _c_function("mj_step1", _address, _address)
_step2 = _c_function("mj_step2", _address, _address)
_actuation = _c_function("mj_fwdActuation", _address, _address)
_acceleration = _c_function("mj_fwdAcceleration", _address, _address)
_inertia = _c_function("mj_fullM", _address, _address, _address)
_jacobian = _c_function("mj_jacBodyCom", _address, _address, _address, _address, _index)
_velocity = _c_function("mj_objectVelocity", _address, _address, _index, _index, _address, _index)
MUJOCO_FUNCTIONS = tuple(
    function.symbol for function in (_step1, _step2, _actuation, _acceleration, _inertia, _jacobian, _velocity)
)


@overload(mj_step1, jit_options=JITABLE)
def _(model, data):
    return lambda model, data: _step1(model, data)


@overload(mj_step2, jit_options=JITABLE)
def _(model, data):
    return lambda model, data: _step2(model, data)


@overload(mj_fwdActuation, jit_options=JITABLE)
def _(model, data):
    return lambda model, data: _actuation(model, data)


@overload(mj_fwdAcceleration, jit_options=JITABLE)
def _(model, data):
    return lambda model, data: _acceleration(model, data)


@overload(mj_fullM, jit_options=JITABLE)
def _(model, data, inertia):
    return lambda model, data, inertia: _inertia(model, data, inertia.ctypes.data)


@overload(mj_jacBodyCom, jit_options=JITABLE)
def _(model, data, linear, angular, body):
    return lambda model, data, linear, angular, body: _jacobian(
        model, data, linear.ctypes.data, angular.ctypes.data, np.int32(body)
    )


@overload(mj_objectVelocity, jit_options=JITABLE)
def _(model, data, kind, index, velocity, local):
    return lambda model, data, kind, index, velocity, local: _velocity(
        model, data, np.int32(kind), np.int32(index), velocity.ctypes.data, np.int32(local)
    )
