"""An organ on an elastic foundation: weight, period, stiffness of a node, step, energy, bad input."""

import math
from dataclasses import replace

import numpy as np
import pytest

from msdm_core.errors import OrganError
from msdm_core.kernels.structure_kernels import FAULT_NONE, OrganModel
from msdm_core.material.regions import Damping, Material
from msdm_core.meshing.lattice_meshing import box_mesh
from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from msdm_core.organ.foundation import Foundation
from msdm_core.organ.measure import kinetic_energy, potential_energy
from msdm_core.organ.stability import scale_mass, stable_dt
from msdm_core.organ.stepping import NO_CONTACT, NO_SHAPES, advance_organ
from tests.core.organ.test_step_limit import dense_modes

SIZE = (0.03, 0.02, 0.02)
MESH = box_mesh(SIZE, (3, 2, 2))
BOTTOM = np.flatnonzero(MESH.points[:, 2] < 1e-9)
AREA = SIZE[0] * SIZE[1]
SOFT = 2e3
SPEC = OrganSpec(MESH, Material(20e3, 1000.0, 0.3), damping=Damping(alpha=0.0))
FAT = Foundation("fat", BOTTOM, SOFT, 0.0)


def on(*foundations: Foundation, **changes) -> OrganModel:
    return compile_organ(replace(SPEC, foundations=foundations, **changes))


def test_a_node_has_the_stiffness_of_the_area_around_it():
    """Over the closed surface of a block the normal of each pair of faces takes k_n, the others k_t."""
    whole = on(Foundation("all around", MESH.boundary_nodes, 7e4, 2e4)).foundation_stiffness.sum(axis=0)
    x, y, z = SIZE
    faces = 2.0 * np.array([y * z, z * x, x * y])
    np.testing.assert_allclose(whole, np.diag(7e4 * faces + 2e4 * (faces.sum() - faces)), rtol=1e-12, atol=1e-12)


def test_it_bears_the_weight():
    """Statics of springs of k A: the mean sink of the bottom, weighted by stiffness, is m g / (k A)."""
    model = on(FAT, gravity=(0.0, 0.0, -2.0))
    sink = (model.foundation_position - rest_state(model).node_position[model.foundation_nodes])[:, 2]
    assert sink @ model.foundation_stiffness[:, 2, 2] == pytest.approx(2.0 * model.node_mass.sum(), rel=1e-5)


def test_a_stiff_block_sways_with_the_period_of_its_mass():
    """w = sqrt(k A / m) = 10 rad/s; the block's own first mode lies far above, at 1e3 rad/s: off by its square, 1e-4.

    A quarter of a period after it starts upwards its middle is highest, and there its speed changes sign.
    """
    model = on(FAT)
    omega = math.sqrt(SOFT * AREA / model.node_mass.sum())
    state = rest_state(model)
    state.node_velocity[:, 2] = 1e-3
    dt = 0.5 * stable_dt(model)
    steps = round(0.25 * 2.0 * math.pi / omega / dt)
    assert advance_organ(model, state, NO_SHAPES, NO_CONTACT, dt, steps, np.zeros((0, 6))) == FAULT_NONE
    middle = model.node_mass @ (state.node_position - model.node_rest_position) / model.node_mass.sum()
    assert middle[2] == pytest.approx(1e-3 / omega, rel=2e-3)
    # The steps are rounded by half of one, and speeds are half a step behind.
    assert abs(model.node_mass @ state.node_velocity[:, 2]) < 1.2 * omega * dt * 1e-3 * model.node_mass.sum()


def test_energy_is_kept():
    """Symplectic Euler keeps the energy within a share of w dt; without the foundation's part it would be lost."""
    model = on(Foundation("fat", BOTTOM, 5e5, 2e5))
    state = rest_state(model)
    state.node_velocity[:] = [2e-3, 0.0, -1e-3]
    begin = kinetic_energy(model, state)
    for _ in range(40):
        advance_organ(model, state, NO_SHAPES, NO_CONTACT, 0.05 * stable_dt(model), 11, np.zeros((0, 6)))
        assert kinetic_energy(model, state) + potential_energy(model, state) == pytest.approx(begin, rel=0.1)
    assert potential_energy(model, state) > 0.0


@pytest.mark.parametrize("stiffness", [1e5, 3e7])
def test_the_step_counts_it(stiffness: float):
    """2 / w_max of the dense eigenvalues, from below, to 1 %."""
    model = on(Foundation("fat", BOTTOM, stiffness, 0.3 * stiffness))
    true_step = 2.0 / math.sqrt(dense_modes(model)[0][-1])
    assert 0.99 * true_step <= stable_dt(model) <= true_step * (1.0 + 1e-12)


def test_mass_scaling_makes_a_step_on_a_stiff_foundation_stable():
    model = on(Foundation("ligament", BOTTOM[:1], 2e8, 1e8))
    step = 1.5 * stable_dt(model)
    scaled = scale_mass(model, step)
    assert scaled.added_mass > 0.0
    assert 2.0 / math.sqrt(dense_modes(scaled)[0][-1]) >= step


def test_fixed_nodes_are_not_held_twice():
    model = on(FAT, anchors=BOTTOM[:5])
    assert set(model.foundation_nodes) == set(BOTTOM[5:])


INNER = next(node for node in range(MESH.node_count) if node not in MESH.boundary_nodes)


@pytest.mark.parametrize(
    ("nodes", "stiffness", "shear", "named"),
    [
        (BOTTOM, math.nan, 1.0, "stiffness is nan"),
        (BOTTOM, 1.0, -1.0, "shear_stiffness is -1"),
        ([], 1.0, 1.0, "nodes"),
        ([INNER], 1.0, 1.0, f"node {INNER}"),
        ([MESH.node_count], 1.0, 1.0, f"node {MESH.node_count}"),
    ],
)
def test_bad_input_is_refused(nodes, stiffness: float, shear: float, named: str):
    with pytest.raises(OrganError, match=f"'fat'.*{named}"):
        on(Foundation("fat", nodes, stiffness, shear))
