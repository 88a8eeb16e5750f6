"""A strip held between two pads: it hangs, stretches, slips and comes free as Coulomb's law and Hooke's say."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from msdm_core.damping import Damping
from msdm_core.kernels import FAULT_NONE, ContactLaw, ContactShapes, OrganModel, OrganState
from msdm_core.mesh import TetMesh
from msdm_core.meshing import box_mesh
from msdm_core.organ import OrganSpec, compile_organ, rest_state
from msdm_core.regions import Material
from msdm_core.shapes import round_shapes
from msdm_core.stability import stable_dt
from msdm_core.stepping import advance_organ, describe_fault

WIDTH, LENGTH, CELL = 0.010, 0.060, 0.0025
MODULUS, POISSON = 20e3, 0.45
# Between the pads, and from where to where the strain is measured: a width away from pads and weight.
HELD, WEIGHT_HEIGHT = 0.010, 0.005
GAUGE = (0.015, 0.040)
PAD_RADIUS = 0.0015
LAW = ContactLaw(stiffness=3e7, damping=100.0, friction=0.2, tangential_stiffness=1.5e7)
# Pads are twice as rough as the law.
MU = 0.4


def make_strip() -> OrganModel:
    """A strip 10 x 10 x 60 mm whose lowest 5 mm carry 4 g more; gravity comes with the substeps."""
    box = box_mesh((WIDTH, WIDTH, LENGTH), (4, 4, 24))
    low = box.points[box.tets].mean(axis=1)[:, 2] < WEIGHT_HEIGHT
    mesh = TetMesh(box.points, box.tets, np.where(low, 1, 0), {0: "strip", 1: "weight"})
    weight = Material(MODULUS, 1060.0 + 0.004 / (WIDTH * WIDTH * WEIGHT_HEIGHT), POISSON)
    materials = {"strip": Material(MODULUS, 1060.0, POISSON), "weight": weight}
    return compile_organ(OrganSpec(mesh=mesh, materials=materials, damping=Damping(alpha=40.0)))


@dataclass
class Hanging:
    """The strip between two pads that close along x."""

    model: OrganModel
    state: OrganState
    pads: ContactShapes
    dt: float

    def run(
        self, duration: float, *, gravity: float = 0.0, tilt: float = 0.0, closing: float = 0.0, turning: float = 0.0
    ) -> NDArray:
        """Go on for so long [s] and give the last wrenches.

        Gravity [m/s^2] pulls along -z, tilted about x by an angle [rad]; each pad closes at a speed [m/s], both turn
        about x [rad/s].
        """
        pull = -gravity * np.array([0.0, -np.sin(tilt), np.cos(tilt)])
        pull.setflags(write=False)
        model, wrench = self.model._replace(gravity=pull), np.zeros((2, 6))
        self.pads.tool_twist[:] = 0.0
        self.pads.tool_twist[:, 0] = closing, -closing
        self.pads.tool_twist[:, 3] = turning
        if turning:
            arm = self.pads.tool_centre - self.pads.tool_centre.mean(axis=0)
            self.pads.tool_twist[:, :3] += np.cross([turning, 0.0, 0.0], arm)
        for _ in range(round(duration / (5 * self.dt))):
            fault = advance_organ(model, self.state, self.pads, LAW, self.dt, 5, wrench)
            assert fault == FAULT_NONE, describe_fault(model, self.state, fault)
        return wrench

    def grip(self, wrench: NDArray) -> float:
        """Mean of the normal forces on both pads [N]."""
        return float(0.5 * (wrench[1, 0] - wrench[0, 0]))

    def height(self, level: float) -> float:
        """Where the nodes that rest at a level are now, on average [m]."""
        nodes = np.abs(self.model.node_rest_position[:, 2] - level) < 1e-6
        return float(self.state.node_position[nodes, 2].mean())


@pytest.fixture
def hanging() -> Hanging:
    """The strip gripped with 0.33 N on each pad, in no gravity yet, come to rest."""
    model = make_strip()
    dt = 0.9 * stable_dt(model, LAW)
    middle, half = LENGTH - 0.5 * HELD, 0.5 * HELD
    reach = np.array([-0.001 + PAD_RADIUS, WIDTH + 0.001 - PAD_RADIUS])
    ends = [[[x, y, middle] for y in reach] for x in (-PAD_RADIUS, WIDTH + PAD_RADIUS)]
    pads = round_shapes(
        ends, [PAD_RADIUS] * 2, span=[[0.0, 0.0, half - PAD_RADIUS]] * 2, friction=MU / LAW.friction, tool=[0, 1]
    )
    hanging = Hanging(model, rest_state(model, shape_count=2), pads, dt)
    hanging.run(0.2, closing=0.004)
    assert hanging.grip(hanging.run(0.3)) == pytest.approx(0.3, abs=0.1)
    return hanging


def test_jaw_carries_the_load_and_the_strip_stretches_by_it(hanging: Hanging):
    """Reaction = weight below and between the pads, to 2 %; strain = F / (E A), to 10 %, below 3 %; pads balance."""
    low, high = GAUGE
    mass, rest = hanging.model.node_mass, hanging.model.node_rest_position[:, 2]
    resting = hanging.height(high) - hanging.height(low)
    for gravity in (3.0, 8.5):
        wrench = hanging.run(0.6, gravity=gravity)
        load = gravity * mass.sum()
        assert -wrench[:, 2].sum() == pytest.approx(load, rel=0.02)
        assert wrench[0, 0] == pytest.approx(-wrench[1, 0], rel=1e-3)
        carried = [gravity * mass[rest < level].sum() for level in np.linspace(low, high, 101)]
        strain = (hanging.height(high) - hanging.height(low)) / resting - 1.0
        assert strain < 0.03
        assert strain == pytest.approx(float(np.mean(carried)) / (MODULUS * WIDTH**2), rel=0.10)


def test_strip_slips_at_two_mu_n(hanging: Hanging):
    """The load grows by 2 % at a time; the last that holds is 2 mu N, N as it is then, to 10 %."""
    gravity, mass = 12.0, hanging.model.node_mass.sum()
    held = hanging.run(0.6, gravity=gravity)
    hung = hanging.height(LENGTH)
    for _ in range(40):
        gravity *= 1.02
        wrench = hanging.run(0.1, gravity=gravity)
        # Sticking springs give by 2 mm at most; a strip that slips falls and falls.
        if hanging.height(LENGTH) < hung - 0.002:
            break
        held = wrench
    else:
        pytest.fail(f"it never slipped, up to {gravity * mass:.3f} N")
    assert gravity / 1.02 * mass == pytest.approx(2.0 * MU * hanging.grip(held), rel=0.10)


def test_open_jaw_leaves_nothing(hanging: Hanging):
    """No force, no memory of contact or stretch; afterwards the strip floats without strain."""
    hanging.run(0.3, gravity=5.0)
    wrench = hanging.run(0.2, closing=-0.01)
    assert not wrench.any()
    assert not hanging.state.contact_engaged.any() and not hanging.state.contact_stretch.any()
    hanging.run(0.8)
    low, high = GAUGE
    assert hanging.height(high) - hanging.height(low) == pytest.approx(high - low, rel=1e-4)


def test_hold_turns_with_the_jaw(hanging: Hanging):
    """Jaw and gravity turn together by a right angle: seen from the jaw nothing changes, friction's memory included.

    The springs of friction are stretched by 30 um; were they to keep their direction in the world, the strip would have
    crept by as much times sqrt(2).
    """
    model, state, pads = hanging.model, hanging.state, hanging.pads
    held = np.flatnonzero(model.node_rest_position[:, 2] > LENGTH - HELD)
    hanging.run(1.5, gravity=9.0)
    before, middle = state.node_position[held].mean(axis=0), pads.tool_centre.mean(axis=0)
    reaction = hanging.run(0.1, gravity=9.0)[:, :3].sum(axis=0)
    for step in range(30):
        hanging.run(0.1, gravity=9.0, tilt=np.pi / 60.0 * (step + 0.5), turning=np.pi / 6.0)
    after = hanging.run(1.5, gravity=9.0, tilt=np.pi / 2.0)
    # z has become -y.
    x, y, z = state.node_position[held].mean(axis=0) - pads.tool_centre.mean(axis=0)
    np.testing.assert_allclose([x, z, -y], before - middle, atol=8e-6)
    np.testing.assert_allclose(after[:, 1].sum(), -reaction[2], rtol=0.01)
