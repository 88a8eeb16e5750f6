"""An organ at rest under gravity: dynamic relaxation onto its anchors and supports, remembered for the last organs."""

import hashlib
import math
from collections import OrderedDict

import numpy as np

from msdm_core.errors import OrganDivergedError
from msdm_core.kernels.structure_kernels import FAULT_NONE, OrganModel, OrganState
from msdm_core.kernels.substep_kernels import evaluate_forces
from msdm_core.kernels.support_kernels import add_support_forces
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.organ.stability import own_step
from msdm_core.organ.stepping import NO_CONTACT, NO_SHAPES, advance_organ, describe_fault

# How many settled organs are remembered, the most recently used.
REMEMBERED = 32
# Forces balance when their magnitudes sum to less than this share of the weight of the organ.
FORCE_TOLERANCE = 1e-6
ROUNDS, ROUND_STEPS = 4000, 10

_settled: OrderedDict[bytes, tuple[FloatArray, FloatArray]] = OrderedDict()


def settle(model: OrganModel, state: OrganState) -> None:
    """Bring a state from the undeformed position to rest under gravity, in place; the same organ settles only once.

    Raises:
        OrganDivergedError: gravity turns the organ inside out or it does not settle.
    """
    key = _content(model)
    settled = _settled.pop(key, None)
    if settled is None:
        _relax(model, state)
        settled = state.node_position.copy(), state.support_stretch.copy()
    # Moved to the end: the least recently used organ is forgotten first.
    _settled[key] = settled
    if len(_settled) > REMEMBERED:
        _settled.popitem(last=False)
    state.node_position[:], state.support_stretch[:] = settled
    state.node_velocity[:] = 0.0
    state.node_force[:] = 0.0
    # The smallest volume ratio on the way to equilibrium does not count.
    state.volume_ratio_smallest[:] = 1.0


def _content(model: OrganModel) -> bytes:
    """A digest of all numbers of an organ."""
    digest = hashlib.blake2b(digest_size=16)
    for value in model:
        array = np.ascontiguousarray(value)
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(array.data)
    return digest.digest()


def _relax(model: OrganModel, state: OrganState) -> None:
    """Dynamic relaxation: advance the organ, the mode that gravity excites damped critically, until forces balance.

    alpha = 2 w, w^2 = -(u . f) / (u . M u) (Rayleigh's quotient of the displacement u, f the forces without gravity).
    """
    relaxed = model._replace(alpha=0.0, beta=0.0)
    free = model.node_inverse_mass > 0.0
    mass = model.node_mass[:, None]
    weight = float(np.linalg.norm(model.gravity) * model.node_mass.sum())
    wrench = np.zeros((0, 6))
    dt = 0.8 * own_step(relaxed)
    for _ in range(ROUNDS):
        fault = advance_organ(relaxed, state, NO_SHAPES, NO_CONTACT, dt, ROUND_STEPS, wrench)
        if fault != FAULT_NONE:
            raise OrganDivergedError("under gravity, " + describe_fault(relaxed, state, fault))
        evaluate_forces(relaxed, state)
        add_support_forces(
            relaxed, state.node_position, state.node_velocity, state.node_force, state.support_stretch, 0.0
        )
        if np.linalg.norm(state.node_force[free], axis=1).sum() <= FORCE_TOLERANCE * weight:
            return
        displacement = state.node_position - model.node_rest_position
        held = float((displacement * (mass * model.gravity - state.node_force)).sum())
        relaxed = relaxed._replace(alpha=2.0 * math.sqrt(max(held, 0.0) / float((mass * displacement**2).sum())))
    raise OrganDivergedError(
        f"the organ did not settle under gravity in {ROUNDS * ROUND_STEPS} steps: is it anchored, or does it "
        "rest on something? Give `anchors` or `supports`, or no gravity"
    )
