"""Organs on a CUDA device: simulated by numba against the organ alone, and compiled for a device that is not there."""

import importlib.util
import json
import os
import subprocess
import sys

import numpy as np
import pytest

from msdm_core.kernels.structure_kernels import FAULT_INVERTED_TET, ContactLaw
from tests.core import oracle
from tests.core.lanes.test_lanes import tool

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("numba_cuda") is None, reason='needs the extra "cuda": pip install "surgsim[cuda]"'
)


def test_simulated_presses_are_those_of_the_organ_alone():
    """Three organs in blocks, one of them with a fault, and one organ by the whole grid; a tet squeezed to 0.4."""
    environment = {**os.environ, "NUMBA_ENABLE_CUDASIM": "1"}
    run = subprocess.run(
        [sys.executable, "-m", "tests.core.cuda.simulated"], capture_output=True, text=True, env=environment
    )
    assert run.returncode == 0, run.stderr
    presses = json.loads(run.stdout.splitlines()[-1])
    # Forces are added node by node here, tet by tet there; float32 rounds a wrench of many points.
    for name, tolerance in (("float64", 1e-12), ("float32", 1e-4), ("alone", 1e-12)):
        worst = presses[name]
        assert worst["wrench"] < tolerance and worst["velocity"] < tolerance, (name, worst)
        assert worst["engaged"] == 0 and worst["squeezed"] < 0.6
    assert presses["float64"]["fault"] == presses["float32"]["fault"] == FAULT_INVERTED_TET


@pytest.mark.parametrize("name", ["advance_lanes", pytest.param("advance_organ", marks=pytest.mark.slow)])
def test_kernels_compile_for_a_device(name: str, monkeypatch: pytest.MonkeyPatch):
    """PTX for compute capability 9.0; a float32 kernel multiplies and adds no float64 numbers."""
    pytest.importorskip("cuda.bindings.nvvm", reason="needs CUDA's compiler NVVM")
    from numba import cuda, typeof, types

    from msdm_core.cuda import organ_steps
    from msdm_core.cuda.device_functions import DeviceFunctions
    from msdm_core.cuda.organs import DeviceArrays

    class Device:
        compute_capability = (9, 0)

    # Device functions ask for the device even where the kernel is compiled for another one.
    monkeypatch.setattr(sys.modules["numba.cuda.dispatcher"], "get_current_device", Device)
    organ = oracle.block((0.03, 0.02, 0.02), (3, 2, 2), anchored_below=0.0)
    real = np.float32
    arrays = DeviceArrays.of(organ, 1, tool(0), real, blocks=1, threads=8, room=1)
    law = ContactLaw(*(real(1.0) for _ in ContactLaw._fields))
    given = (*arrays, law, organ_steps.StepNumbers(real(1e-4), real(1.0), 3, 1))
    signature = types.void(*(typeof(value) for value in given))
    ptx, _ = cuda.compile_ptx(DeviceFunctions(real).typed(getattr(organ_steps, name)), signature, cc=(9, 0))
    assert ".target sm_90" in ptx
    wide = [line for line in ptx.splitlines() if line.split()[:1] and line.split()[0] in WIDE]
    assert not wide


WIDE = {"add.f64", "add.rn.f64", "sub.f64", "sub.rn.f64", "mul.f64", "mul.rn.f64", "fma.rn.f64", "div.rn.f64"}
