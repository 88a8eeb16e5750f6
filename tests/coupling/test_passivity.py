"""The exchange gives no energy: tools yield as MuJoCo will, contact's energy is counted right, sticking decays."""

import mujoco
import numpy as np
import pytest

from msdm_core.kernels.structure_kernels import ContactLaw, OrganModel
from msdm_core.material.regions import Damping
from msdm_core.organ.compile import rest_state
from msdm_core.organ.measure import contact_energy
from msdm_core.organ.stepping import advance_organ
from surgsim_apps.validation.dynamics import BLOCK, ELASTIC, FREE, Coupled, bounces, free_ball, small_block
from surgsim_env.instruments.make import Probe
from surgsim_env.instruments.tool_bodies import ToolBodies
from surgsim_env.scene.load import make_scene
from tests.core import oracle

DT = 1e-3

# Its centre of mass is none of its shapes' centres.
LOPSIDED = """
<mujoco>
  <option timestep="0.001" integrator="Euler" jacobian="dense" gravity="0 0 -9.81"/>
  <default><geom contype="0" conaffinity="0" group="3"/></default>
  <worldbody>
    <body name="tool">
      <freejoint/>
      <inertial pos="0.004 -0.003 0.01" mass="0.02" diaginertia="2e-6 3e-6 4e-6"/>
      <geom type="sphere" size="0.006"/>
    </body>
  </worldbody>
</mujoco>
"""


def lopsided_body() -> ToolBodies:
    return ToolBodies(mujoco.MjModel.from_xml_string(LOPSIDED))


def probe_at_its_servo() -> ToolBodies:
    """Slides damped with 2 N s/m and driven by servos of 60 N s/m, which MuJoCo takes implicitly."""
    probe = Probe(make_scene("phantom"), np.full(3, -0.1), np.full(3, 0.1))
    probe.place(np.zeros(3))
    probe.data.qvel[:] = 0.03, -0.02, 0.05
    return probe


def damped_arm() -> ToolBodies:
    """Two hinges, a motor on one, gravity: inertia and Jacobian depend on the pose."""
    text = """
    <mujoco>
      <option timestep="0.001" integrator="implicitfast" jacobian="dense" gravity="0 0 -9.81"/>
      <default><geom contype="0" conaffinity="0" size="0.004" group="3"/></default>
      <worldbody><body><joint name="a" axis="0 1 0" damping="0.01" armature="1e-4"/>
        <inertial pos="0.05 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>
        <body pos="0.1 0 0"><joint name="b" axis="0 1 0" damping="0.02"/>
          <inertial pos="0.04 0 0.01" mass="0.05" diaginertia="2e-5 3e-5 4e-5"/><geom pos="0.08 0 0"/></body>
      </body></worldbody>
      <actuator><motor joint="a"/></actuator>
    </mujoco>"""
    arm = ToolBodies(mujoco.MjModel.from_xml_string(text))
    arm.data.qpos[:] = 0.4, -0.9
    arm.data.ctrl[0] = 0.05
    return arm


def two_fingers() -> ToolBodies:
    """Two fingers on slides at the end of a light wrist that hangs on a slide and a hinge."""
    finger = """<body name="{0}" pos="0 0 -0.03"><joint type="slide" axis="0 {1} 0" damping="0.5"/>
      <geom name="pad_{0}" type="box" size="0.005 0.002 0.006" mass="0.008" group="3"/></body>"""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{DT}" integrator="implicitfast" gravity="0 0 0"/><worldbody>
        <body name="wrist"><joint type="slide" axis="0 1 0" damping="1"/><joint type="hinge" axis="0 0 1"/>
        <geom type="sphere" size="0.004" mass="0.03"/>{finger.format("left", 1)}{finger.format("right", -1)}</body>
        </worldbody></mujoco>"""
    )
    return ToolBodies(model)


@pytest.mark.parametrize("tool", [lopsided_body, probe_at_its_servo, damped_arm, two_fingers])
def test_tools_yield_as_mujoco_will(tool):
    """Change of the twist in mj_step2 under a wrench: dt (a + B w), to rounding; what was applied before is gone."""
    body = tool()
    body.data.xfrc_applied[body.views().bodies] = 3.0
    mujoco.mj_step1(body.model, body.data)
    body.read_shapes()
    before = body.shapes.tool_twist.copy()
    body.read_response()
    wrench = np.array([[0.3, -0.2, 0.5, 1e-3, 2e-3, -1e-3], [0.1, 0.4, 0.2, 2e-3, -1e-3, 1e-3]])[: body.tool_count]
    body.data.xfrc_applied[body.views().bodies] = wrench
    jacobians = np.array([body.jacobian(index) for index in range(body.tool_count)])
    mujoco.mj_step2(body.model, body.data)
    after = jacobians @ body.data.qvel
    response = body.response
    change = DT * (response.tool_acceleration + np.einsum("ijrc,jc->ir", response.tool_mobility, wrench))
    assert np.abs(change).max() > 1e-4
    np.testing.assert_allclose(before + change, after, rtol=0, atol=1e-10 * np.abs(after).max())


def test_the_response_follows_the_pose():
    """Nothing is kept from the step before."""
    arm = damped_arm()
    mujoco.mj_forward(arm.model, arm.data)
    arm.read_response()
    first = arm.response.tool_mobility.copy()
    arm.data.qpos[1] = 0.7
    mujoco.mj_forward(arm.model, arm.data)
    arm.read_response()
    assert np.abs(arm.response.tool_mobility - first).max() > 0.1 * np.abs(first).max()


def test_the_organ_sees_the_twist_that_mujoco_ends_with():
    """A free ball in the block: the shapes' twist after the substeps is the ball's velocity after mj_step2."""
    ball = free_ball(0.02, 0.01, -0.0005)
    coupled = Coupled(small_block(Damping(0.0)), ball)
    for _ in range(5):
        before = ball.data.qvel.copy()
        coupled.step()
        assert np.abs(ball.data.qvel - before).max() > 1e-4
        np.testing.assert_allclose(ball.shapes.tool_twist[0, :3], ball.data.qvel[:3], rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize("engaged", [0, 1])
def test_contact_energy_is_the_oracles(engaged: int):
    """A ball and a capsule in a deformed block, held points counted where the surface has turned past the shape.

    No axis is so near that the guard pushes: its energy is the oracle's alone.
    """
    model = oracle.block()
    state = oracle.deformed_state(model, 5, shape_count=2)
    state.contact_engaged[:] = engaged
    shapes = oracle.single_tool(
        [[[0.012, 0.01, 0.024]] * 2, [[0.0, 0.004, 0.023], [0.03, 0.012, 0.025]]], [0.006, 0.004]
    )
    expected = oracle.contact_energy(model, state.node_position, shapes, 2e7, state.contact_engaged)
    assert expected > 1e-4
    assert contact_energy(model, state, shapes, ELASTIC) == pytest.approx(expected, rel=1e-12)


def test_energy_falls_by_what_the_height_gives():
    """A ball in free fall, read before it touches: m g z turns into m v^2 / 2, to m g v dt / 2 of symplectic Euler."""
    mass, drop = 0.005, 0.01
    coupled = Coupled(small_block(Damping(0.0)), free_ball(mass, 0.01, drop))
    coupled.ball.data.qvel[0] = 0.01
    start = coupled.energy()
    assert start == pytest.approx(mass * (9.81 * drop + 0.5 * 0.01**2), rel=1e-12)
    for _ in range(40):
        coupled.step()
    speed = 9.81 * 0.04
    assert coupled.energy() - start == pytest.approx(-0.5 * mass * 9.81 * speed * DT, rel=1e-9)


def test_energy_counts_the_contact():
    """At rest, 0.5 mm in: -m g d and contact's energy, to first order in d / r.

    g = d - rho^2 / (2 r) out to rho^2 = 2 r d: E = (k_p / 2) int g^2 2 pi rho drho = pi k_p r d^3 / 3.
    """
    mass, radius, depth = 0.005, 0.01, 5e-4
    coupled = Coupled(small_block(Damping(0.0)), free_ball(mass, radius, -depth))
    stored = coupled.energy() + mass * 9.81 * depth
    assert stored == pytest.approx(
        np.pi * 2e7 * radius * depth**3 / 3.0, rel=0.15
    )  # points 1.2 mm apart, 3 mm of patch


def test_a_ball_on_tissue_that_vibrates_gains_nothing():
    """Two seconds of the quick validation row: with the twist held through the step it has 8 times its energy then."""
    largest, rise, _ = bounces(((0.005, 0.0005),), duration=2.0)
    assert largest.verdict == "met" and largest.measured == pytest.approx(1.0, abs=1e-3)
    assert rise.verdict == "met"


# ---- a block whose nodes do not move: one spring ---------------------------------------------------------------------


def rigid_block() -> OrganModel:
    model = small_block(Damping(0.0))
    return model._replace(node_inverse_mass=oracle.frozen(np.zeros_like(model.node_mass)), stable_step=1.0)


def resting(mass: float, depth: float, contact: ContactLaw, *, joint: str = FREE, substeps: int = 4) -> Coupled:
    """A ball of 8 mm that stands in the block, gravity being what holds it there."""
    ball = free_ball(mass, 0.008, -depth, joint=joint)
    coupled = Coupled(rigid_block(), ball, contact)
    coupled._count = substeps
    ball.model.opt.gravity[2] = -static_force(coupled) / mass
    return coupled


def static_force(coupled: Coupled, lower: float = 0.0) -> float:
    """Force that pushes the ball up where it stands, or so much lower [N]."""
    ball, wrench = coupled.ball, np.zeros((1, 6))
    mujoco.mj_forward(ball.model, ball.data)
    ball.read_shapes()
    ball.shapes.shape_ends[:, :, 2] -= lower
    ball.shapes.tool_twist[:] = 0.0
    advance_organ(
        coupled.model, rest_state(coupled.model, shape_count=1), ball.shapes, coupled.contact, 1e-9, 1, wrench
    )
    return float(wrench[0, 2])


def test_sticking_friction_damps_a_free_tool():
    """A sticking ball kicked sideways swings in its friction's spring, and ever less.

    Friction that missed where MuJoCo puts the tool, dt^2 F / (2 m) ahead, would drive the swing instead. In the very
    middle: elsewhere the pressure, summed over quadrature points, pulls a ball towards a place between them.
    """
    coupled = resting(0.02, 1e-3, ELASTIC._replace(friction=50.0))
    data = coupled.ball.data
    data.qpos[:2] = 0.5 * np.array(BLOCK[:2])
    data.qvel[0] = 1e-3
    coupled.ball.model.body_inertia[1] *= 1e6  # it swings and does not roll
    speeds = []
    for _ in range(800):
        coupled.step()
        speeds.append(abs(data.qvel[0]))
    assert coupled.state.contact_stretch.any()
    early, late = max(speeds[:100]), max(speeds[-100:])
    assert early < 1.01e-3
    assert late < 0.6 * early
