"""Parts of the stable step, by runs below and beyond it: springs, volume term, damping, contact, friction."""

import numpy as np
import pytest

from msdm_core.kernels.structure_kernels import FAULT_NONE, ContactLaw, ContactShapes, OrganModel, OrganState
from msdm_core.material.regions import Damping, Material
from msdm_core.organ.compile import rest_state
from msdm_core.organ.stability import contact_hold, stable_dt
from msdm_core.organ.stepping import NO_CONTACT, NO_SHAPES, advance_organ
from tests.core import oracle

KNOCK = 1e-11  # [m]
DEPTH = 1e-3  # [m]
SOFT = ContactLaw(stiffness=1e5, damping=0.0, friction=0.0, tangential_stiffness=1e5)


def organ(damping: Damping = oracle.UNDAMPED, *, modulus: float = 5000.0, poisson_ratio: float = 0.25) -> OrganModel:
    return oracle.block(damping=damping, material=Material(modulus, 1000.0, poisson_ratio), anchored_below=1e-4)


def plate() -> ContactShapes:
    """A ball so large that it is a plate, 1 mm into the block's whole top."""
    return oracle.ball((0.015, 0.01, 0.02 - DEPTH + 1.0), 1.0)


# Organ, contact law or none, and how far beyond the product's step it must be unstable. Contact is implicit and counts
# little of its stiffness, that of the node which is held most; the true limit lies further beyond.
PARTS = {
    "springs": (organ(), None, 1.1),
    "volume term": (organ(poisson_ratio=0.49), None, 1.1),
    "alpha": (organ(Damping(alpha=1e4)), None, 1.1),
    "beta": (organ(Damping(alpha=0.0, beta=1e-3)), None, 1.1),
    "contact stiffness": (organ(), SOFT._replace(stiffness=2e8), 3.0),
    "sticking friction": (organ(), SOFT._replace(stiffness=2e7, friction=50.0, tangential_stiffness=8e8), 3.0),
    "alpha with contact": (organ(Damping(alpha=3e4)), SOFT._replace(stiffness=3e7), 3.0),
    "beta with contact": (organ(Damping(alpha=0.0, beta=1e-2)), SOFT._replace(stiffness=2e8), 3.0),
}


def growth(model: OrganModel, contact: ContactLaw | None, dt: float) -> float:
    """Growth of a difference of 1e-11 m in every node between two runs, in up to 2000 steps.

    Under the plate both start settled: a node that is not knocked off it (1e-6 m deep) stays in contact.
    """
    shapes, law = (NO_SHAPES, NO_CONTACT) if contact is None else (plate(), contact)
    wrench = np.zeros((len(shapes.tool_centre), 6))
    state = rest_state(model, shape_count=1)
    if contact is not None:
        damped = model._replace(alpha=1500.0, beta=0.0)
        settle = 0.4 * stable_dt(damped, law)
        state.node_position[:, 2] *= 1.0 - DEPTH / 0.02
        assert advance_organ(damped, state, shapes, law, settle, round(0.1 / settle), wrench) == FAULT_NONE
        state.node_velocity[:] = 0.0
    twin = OrganState(*(array.copy() for array in state))
    free = model.node_inverse_mass > 0.0
    twin.node_position[free] += np.random.default_rng(0).uniform(-KNOCK, KNOCK, (int(free.sum()), 3))
    largest = 0.0
    for _ in range(200):
        faults = [advance_organ(model, run, shapes, law, dt, 10, wrench) for run in (state, twin)]
        apart = float(np.abs(state.node_position - twin.node_position).max())
        if any(faults) or not apart < 1e4 * KNOCK:
            return 1e4
        largest = max(largest, apart / KNOCK)
    return largest


@pytest.mark.parametrize("part", PARTS)
def test_stable_just_below_and_unstable_beyond(part: str):
    model, contact, beyond = PARTS[part]
    limit = stable_dt(model, contact)
    below = 0.95 * limit
    # A plate needs a hold that takes nothing of the limit: the rise of edges is not in the sweeps.
    while contact is not None and contact_hold(model, contact, below)[0] > 16.0:
        below *= 0.95
    assert growth(model, contact, below) < 30.0
    assert growth(model, contact, beyond * limit) > 1e3


@pytest.mark.parametrize("part", PARTS)
def test_each_part_shortens_the_step(part: str):
    """Without the part the step is too long by more than the 5 % that the run below the limit leaves."""
    model, contact, _ = PARTS[part]
    plain = organ()
    without = {
        "springs": (organ(modulus=500.0), None),
        "volume term": (organ(poisson_ratio=0.25), None),
        "alpha": (plain, None),
        "beta": (plain, None),
        "contact stiffness": (plain, SOFT),
        "sticking friction": (plain, SOFT._replace(stiffness=2e7)),
        "alpha with contact": (plain, SOFT._replace(stiffness=3e7)),
        "beta with contact": (plain, SOFT._replace(stiffness=2e8)),
    }[part]
    assert stable_dt(model, contact) < 0.95 * stable_dt(*without)


@pytest.mark.parametrize("law", [SOFT._replace(damping=2e4), SOFT._replace(stiffness=1e6, friction=50.0)])
def test_implicit_contact_asks_for_no_shorter_step(law: ContactLaw):
    """Damping up to a hold of 55 (here 39), and stiffness up to one of 16: stable at the step of the organ alone."""
    model = organ()
    assert stable_dt(model, law) == model.stable_step
    assert growth(model, law, 0.95 * model.stable_step) < 30.0


def test_a_fine_organ_has_the_step_of_its_cells():
    """52 000 nodes: the step of the cells of a tenth of it, to the share that the faces of a block change."""
    fine, coarse = (oracle.block((1e-3 * count,) * 3, (count,) * 3, anchored_below=0.0) for count in (37, 17))
    assert fine.stable_step == pytest.approx(coarse.stable_step, rel=0.02)
