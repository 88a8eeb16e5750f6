"""Compiled code gives the same bits for every width of the processor's vector registers."""

import hashlib
import os
import platform
import subprocess
import sys

import numpy as np
import pytest

from msdm_core.lanes.lanes import advance_lanes, rest_lanes, stack_organs, stack_shapes
from msdm_core.material.regions import Damping, Material
from msdm_core.material.tissue_law import Relaxation, Stiffening
from msdm_core.meshing.lattice_meshing import box_mesh
from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from msdm_core.organ.stepping import NO_CONTACT, NO_SHAPES, advance_organ

# As LLVM names them: AVX2 without AVX-512, and the registers that every x86-64 has.
PROCESSORS = {"haswell": "+avx,+avx2,+bmi,+bmi2,+f16c,+fma,+popcnt", "x86-64": ""}
TISSUE = Material(
    *(5000.0, 1060.0, 0.45),
    stiffening=Stiffening(onset_strain=0.05, cap_strain=0.2, tangent_cap=20.0),
    relaxation=Relaxation(relative_moduli=(0.3, 0.3), times=(0.05, 0.5)),
)


def moved() -> str:
    """Positions and velocities of a block, alone and in lanes, after some substeps, as a digest of their bits.

    Its numbers of tets, springs and nodes leave remainders over groups of four.
    """
    mesh = box_mesh((0.02, 0.02, 0.02), (3, 3, 3))
    anchors = np.flatnonzero(mesh.points[:, 2] < 1e-9)
    organ = compile_organ(OrganSpec(mesh, TISSUE, anchors=anchors, damping=Damping(alpha=25.0)))
    digest = hashlib.blake2b(digest_size=16)
    alone = rest_state(organ)
    alone.node_position[:, 0] += 0.3 * alone.node_position[:, 2]
    assert advance_organ(organ, alone, NO_SHAPES, NO_CONTACT, 0.5 * organ.stable_step, 9, np.zeros((0, 6))) == 0
    digest.update(alone.node_position.tobytes() + alone.node_velocity.tobytes())
    for dtype, count in ((np.float64, 8), (np.float32, 16)):
        lanes, state = stack_organs([organ] * count, dtype=dtype), rest_lanes([organ] * count, dtype=dtype)
        state.node_position[:, 0] += np.linspace(0.1, 0.3, count, dtype=dtype) * state.node_position[:, 2]
        shapes, wrench = stack_shapes([NO_SHAPES] * count, count), np.zeros((count, 0, 6))
        assert not advance_lanes(lanes, state, shapes, NO_CONTACT, 0.5 * organ.stable_step, 9, wrench).any()
        digest.update(state.node_position.tobytes() + state.node_velocity.tobytes())
    return digest.hexdigest()


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="names processors of the x86-64 family")
@pytest.mark.parametrize("processor", PROCESSORS)
def test_bits_do_not_depend_on_the_registers(processor, tmp_path):
    setting = {"NUMBA_CPU_NAME": processor, "NUMBA_CPU_FEATURES": PROCESSORS[processor]}
    setting["NUMBA_CACHE_DIR"] = str(tmp_path)
    line = "from tests.core.lanes.test_registers import moved; print(moved())"
    told = subprocess.run([sys.executable, "-c", line], env=os.environ | setting, capture_output=True, text=True)
    assert told.returncode == 0, told.stderr
    assert told.stdout.strip() == moved()
