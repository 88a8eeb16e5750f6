"""The least mass of a tool: the bound against closed forms and against tools that are thrown off."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from msdm_core.errors import OrganDivergedError, OrganError
from msdm_core.kernels.structure_kernels import OrganState
from msdm_core.organ.compile import rest_state
from msdm_core.organ.stepping import advance_organ
from surgsim_apps.validation.dynamics import ELASTIC, UPRIGHT, free_ball
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments.tool_bodies import ToolBodies, check_tool_masses, tool_masses
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene
from tests.core import oracle
from tests.coupling.test_passivity import resting, static_force

DT = 1e-3
WIDE = 1.0  # [m^2] an organ without end


def test_a_balls_bound_is_that_of_its_cross_section():
    """k = k_p pi r^2, c = c_p pi r^2: m >= (k dt + c) dt / 2; stiffer friction counts where there is any."""
    area = np.pi * 0.01**2
    law = ELASTIC._replace(damping=500.0)
    (tool,) = tool_masses(free_ball(0.005, 0.01, 0.01), law, WIDE)
    assert tool.name == "ball"
    assert tool.mass == pytest.approx(0.005, rel=1e-12)
    assert tool.stiffness == pytest.approx(2e7 * area)
    assert tool.least_mass == pytest.approx(0.5 * DT * (2e7 * area * DT + 500.0 * area))
    assert tool.least_damping == 0.0
    sticky = law._replace(tangential_stiffness=5e7)
    assert tool_masses(free_ball(0.005, 0.01, 0.01), sticky, WIDE)[0].stiffness == pytest.approx(2e7 * area)
    sticky = sticky._replace(friction=0.1)
    assert tool_masses(free_ball(0.005, 0.01, 0.01), sticky, WIDE)[0].stiffness == pytest.approx(5e7 * area)
    # No more than the whole organ can touch it.
    assert tool_masses(free_ball(0.005, 0.01, 0.01), law, 1e-4)[0].stiffness == pytest.approx(2e7 * 1e-4)


TOOLS = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast" jacobian="dense"/>
  <default><geom contype="0" conaffinity="0" group="3"/></default>
  <worldbody>
    <body name="rod"><freejoint/>
      <inertial pos="0 0 0" mass="0.02" diaginertia="8e-6 8e-6 1e-6"/>
      <geom type="capsule" fromto="0 0 -0.03 0 0 0.05" size="0.003"/></body>
    <body name="slider"><joint type="slide" axis="0 0 1" damping="3" armature="0.004"/>
      <inertial pos="0 0 0" mass="0.001" diaginertia="1e-7 1e-7 1e-7"/>
      <geom type="sphere" size="0.005"/></body>
  </worldbody>
</mujoco>
"""


def test_mass_is_felt_at_the_lightest_end():
    """A rod at its far end: 1 / (1 / m + l^2 / I). A slide: mass and armature, braked by dt / 2 of its damping."""
    rod, slider = tool_masses(ToolBodies(mujoco.MjModel.from_xml_string(TOOLS)), ELASTIC, WIDE)
    assert rod.mass == pytest.approx(1.0 / (1.0 / 0.02 + 0.05**2 / 8e-6), rel=1e-9)
    assert rod.stiffness == pytest.approx(2e7 * (np.pi * 0.003**2 + 2.0 * 0.003 * 0.08))
    assert slider.mass == pytest.approx(0.005, rel=1e-9)
    assert slider.damped_mass == pytest.approx(0.005 + 0.5 * DT * 3.0, rel=1e-9)
    assert rod.least_damping == pytest.approx(rod.stiffness * DT - 2.0 * rod.mass / DT)


def test_a_tool_too_light_is_refused_and_the_ways_out_work():
    """At 0.99 and 1.01 of the least mass; a light one passes with the damping that is reported."""
    area = np.pi * 0.01**2
    least = 0.5 * 2e7 * area * DT**2
    with pytest.raises(OrganError, match=rf"'ball'.* {least * 1e3:.3g} g"):
        check_tool_masses("x", free_ball(0.99 * least, 0.01, 0.01, joint=UPRIGHT), ELASTIC, WIDE)
    check_tool_masses("x", free_ball(1.01 * least, 0.01, 0.01, joint=UPRIGHT), ELASTIC, WIDE)
    light = free_ball(0.3 * least, 0.01, 0.01, joint=UPRIGHT)
    (tool,) = tool_masses(light, ELASTIC, WIDE)
    light.model.dof_damping[:] = 1.001 * tool.least_damping
    check_tool_masses("x", light, ELASTIC, WIDE)
    light.model.dof_damping[:] = 0.99 * tool.least_damping
    with pytest.raises(OrganError, match="'ball'"):
        check_tool_masses("x", light, ELASTIC, WIDE)


@pytest.mark.parametrize("name", ["phantom", "liver"])
def test_shipped_scenes_pass_with_room(name: str):
    simulation = Simulation(load_anatomy(make_scene(name)))
    area = float(simulation.organ_model.surface_rest_area.sum())
    (tool,) = tool_masses(simulation.instrument, simulation.contact, area)
    assert tool.mass == pytest.approx(0.18, rel=1e-9)  # the z slide and the tip
    # The liver's: k_p 1.5e8 on a ball of 12 mm and a shaft, 0.195e6 N/m, need 98 g. The bound is safe by 1.5 (below).
    assert tool.mass > 1.8 * tool.least_mass


def test_a_scene_whose_contact_is_too_stiff_for_its_tool_is_refused():
    """Before anything moves, whatever the number of substeps."""
    scene = make_scene("phantom")
    stiff = replace(
        scene, contact=replace(scene.contact, stiffness=4e8), timing=replace(scene.timing, substep_count=50)
    )
    with pytest.raises(OrganError, match=r"'phantom'.* 180 g"):
        Simulation(replace(load_anatomy(scene), scene=stiff))


# ---- tools that are thrown off ---------------------------------------------------------------------------------------


DEPTH = 0.0025  # [m] of an 8 mm ball: the guard of its centre (beyond 0.4 r) is not met


def thrown(mass: float, *, substeps: int = 4, damping: float = 0.0) -> bool:
    """True if a ball at rest DEPTH deep in a fixed block, knocked at 2 mm/s, diverges or ends faster than 50."""
    coupled = resting(mass, DEPTH, ELASTIC, joint=UPRIGHT, substeps=substeps)
    coupled.ball.model.dof_damping[:] = damping
    coupled.ball.data.qvel[0] = 2e-3
    heights = []
    try:
        for _ in range(300):
            coupled.step()
            heights.append(coupled.ball.data.qpos[0])
    except OrganDivergedError:
        return True
    return float(np.abs(np.diff(heights)[-50:]).max()) > 25.0 * 2e-3 * DT


def felt_stiffness() -> float:
    coupled = resting(0.1, DEPTH, ELASTIC, joint=UPRIGHT)
    return (static_force(coupled, 1e-6) - static_force(coupled)) / 1e-6


def test_the_bound_counts_more_than_is_felt():
    """A flat surface holds a ball with k_p (pi r^2 / 2) (1 - (1 - depth / r)^4); the bound takes k_p pi r^2.

    To 5 %: on the rim of the contact, 5 mm wide, quadrature points come in one after the other.
    """
    felt = felt_stiffness()
    assert felt == pytest.approx(0.5 * 2e7 * np.pi * 0.008**2 * (1.0 - (1.0 - DEPTH / 0.008) ** 4), rel=0.05)
    (tool,) = tool_masses(free_ball(0.1, 0.008, 0.0), ELASTIC, WIDE)
    assert 2.0 * felt < tool.stiffness < 3.0 * felt


def test_no_press_is_felt_stiffer_than_the_bound():
    """A ball pressed 8 mm into the phantom, nodes held at each 2 mm: stiffness along its stiffest direction."""
    scene = make_scene("phantom")
    model = load_anatomy(scene).organ()
    held = model._replace(node_inverse_mass=oracle.frozen(np.zeros_like(model.node_mass)))
    law, radius = scene.contact.law._replace(damping=0.0, friction=0.0), scene.instrument.tip_radius
    state = rest_state(model, shape_count=1)
    shapes = oracle.ball((0.0312, 0.0287, 0.03 + radius), radius, velocity=(0.0, 0.0, -0.02))
    felt = []
    for _ in range(4):
        assert advance_organ(model, state, shapes, law, 2.5e-4, 400, np.zeros((1, 6))) == 0
        slope = np.empty((3, 3))
        for axis in range(3):
            force = []
            for shift in (1e-7, -1e-7):
                moved = oracle.ball(shapes.tool_centre[0] + shift * np.eye(3)[axis], radius)
                still = OrganState(*(array.copy() for array in state))
                wrench = np.zeros((1, 6))
                advance_organ(held, still, moved, law, 1e-9, 1, wrench)
                force.append(wrench[0, :3])
            slope[:, axis] = (force[1] - force[0]) / 2e-7
        felt.append(float(np.linalg.eigvalsh(0.5 * (slope + slope.T))[-1]))
    bound = law.stiffness * np.pi * radius**2
    assert 0.2 * bound < max(felt) < 0.67 * bound


@pytest.mark.parametrize(("substeps", "limit", "bound"), [(1, 0.75, 0.75), (3, 0.148, 0.5), (8, 0.276, 0.5)])
def test_a_tool_below_the_bound_is_thrown_off_and_one_above_stays(substeps: int, limit: float, bound: float):
    """Limits of k dt^2, from the 2 x 2 amplification matrix of one haptic step with n substeps; the bound is 0.5."""
    least = felt_stiffness() * DT**2
    assert limit == pytest.approx(matrix_limit(substeps), abs=1.1e-3)
    assert thrown(0.85 * limit * least, substeps=substeps)
    assert not thrown(1.15 * limit * least, substeps=substeps)
    assert not thrown(max(bound, 1.15 * limit) * least, substeps=substeps)
    assert not thrown(2.0 * bound * least, substeps=substeps)


def test_one_substep_needs_more_mass():
    """The pressure after the whole step at the old twist: m >= (1.5 k dt + c) dt / 2."""
    law = ELASTIC._replace(damping=500.0)
    single, double = (tool_masses(free_ball(0.005, 0.01, 0.01), law, WIDE, count)[0] for count in (1, 2))
    assert single.least_mass - double.least_mass == pytest.approx(0.25 * double.stiffness * DT**2)


def test_damping_holds_a_tool_below_the_bound():
    """b = k dt - 2 m / dt instead of mass."""
    stiffness = felt_stiffness()
    mass = 0.05 * stiffness * DT**2
    assert thrown(mass)
    assert not thrown(mass, damping=stiffness * DT - 2.0 * mass / DT)


def matrix_limit(substeps: int) -> float:
    """Least m / (k dt^2) at which (x, v) -> (x + dt v', v') does not grow, v' after n substeps in the spring.

    Each substep pulls with the spring as it would be at its end at the old speed.
    """

    def radius(mass: float) -> float:
        columns = []
        for x, v in ((1.0, 0.0), (0.0, 1.0)):
            y, u = x, v
            for _ in range(substeps):
                u -= (y + u / substeps) / mass / substeps
                y += u / substeps
            columns.append((x + u, u))
        return float(np.abs(np.linalg.eigvals(np.array(columns).T)).max())

    masses = np.arange(0.1, 0.9, 1e-3)
    return float(masses[np.flatnonzero([radius(mass) > 1.0 + 1e-9 for mass in masses])[-1]])
