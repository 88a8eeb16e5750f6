"""Selective mass scaling: the step that is asked for, mass on few nodes, what is added and what is refused."""

import numpy as np
import pytest

from msdm_core.errors import OrganDivergedError, OrganError
from msdm_core.kernels.structure_kernels import ContactLaw
from msdm_core.material.regions import Lesion, Material
from msdm_core.meshing.lattice_meshing import box_mesh
from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from msdm_core.organ.stability import scale_mass, stable_dt
from msdm_core.organ.stepping import advance
from tests.core import oracle

CONTACT = ContactLaw(stiffness=1e7, damping=0.0, friction=0.0, tangential_stiffness=0.0)
# Nodes in the middle of the top would ask for mass of their own.
BLOCK = box_mesh((0.06, 0.06, 0.03), (12, 12, 6), top_nodes=False)
TRAY = np.flatnonzero(BLOCK.points[:, 2] < 1e-6)
HARD = Lesion((0.03, 0.03, 0.02), 0.007, Material(50e3, 1060.0, 0.45))
ORGAN = compile_organ(OrganSpec(BLOCK, Material(5000.0, 1060.0, 0.45), lesions=(HARD,), anchors=TRAY))


@pytest.mark.parametrize("contact", [None, CONTACT])
def test_the_step_is_reached_with_little_mass_where_the_lesion_is(contact: ContactLaw | None):
    before = stable_dt(ORGAN, contact)
    step = 1.25 * before
    scaled = scale_mass(ORGAN, step, contact)
    assert step <= stable_dt(scaled, contact) < 1.02 * step
    added = scaled.node_mass - ORGAN.node_mass
    assert (added >= 0.0).all() and scaled.added_mass == pytest.approx(added.sum(), rel=1e-12)
    assert 0.0 < scaled.added_mass < 0.05 * ORGAN.node_mass.sum()
    heavier = added > 0.0
    assert heavier.sum() < 0.1 * BLOCK.node_count
    # Contact also asks for some along the block's edges, whose nodes are light.
    near = np.linalg.norm(BLOCK.points[heavier] - HARD.centre, axis=1) < HARD.radius + 0.005
    assert near.all() if contact is None else near.any()
    np.testing.assert_array_equal(scaled.node_inverse_mass[TRAY], 0.0)
    free = scaled.node_inverse_mass > 0.0
    np.testing.assert_array_equal(scaled.node_inverse_mass[free], 1.0 / scaled.node_mass[free])
    assert scaled.stable_step == pytest.approx(stable_dt(scaled), rel=1e-12)


def test_it_runs_at_that_step_and_not_without():
    """Free vibration at nine tenths of the new step: bounded with the mass, without bound as the organ was."""
    step = 0.9 * 1.4 * ORGAN.stable_step
    scaled = scale_mass(ORGAN, 1.4 * ORGAN.stable_step)
    ends = []
    for organ in (scaled, ORGAN._replace(stable_step=scaled.stable_step)):
        state = rest_state(organ)
        state.node_position[:, 2] += 1e-7 * np.sin(np.arange(BLOCK.node_count)) * (organ.node_inverse_mass > 0.0)
        try:
            advance(organ, state, dt=step, substep_count=400)
            ends.append(float(np.abs(state.node_position - organ.node_rest_position).max()))
        except OrganDivergedError:
            ends.append(np.inf)
    assert ends[0] < 1e-6 < 1e-3 < ends[1]


def test_a_step_that_is_stable_already_changes_nothing():
    assert scale_mass(ORGAN, 0.9 * ORGAN.stable_step) is ORGAN
    assert ORGAN.added_mass == 0.0


def test_what_is_refused():
    with pytest.raises(OrganError, match=r"\d\d+%"):
        scale_mass(ORGAN, 5.0 * ORGAN.stable_step)
    with pytest.raises(OrganError, match="weight"):
        scale_mass(ORGAN._replace(gravity=oracle.frozen([0.0, 0.0, -9.81])), 1.2 * ORGAN.stable_step)
