"""The force exchange: momentum balance per haptic step, what reaches MuJoCo, faults, saved states, the wrist."""

import re
from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from msdm_core.errors import OrganError
from msdm_core.kernels.structure_kernels import FAULT_NONE, ContactLaw, OrganModel, OrganState
from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from surgsim_env.coupling import haptic_kernels
from surgsim_env.coupling.exchange import haptic_steps
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments.make import Probe
from surgsim_env.instruments.tool_bodies import ToolBodies
from surgsim_env.scene.anatomy import Anatomy, load_anatomy
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import Scene
from tests.core import oracle
from tests.core.measures import angular_momentum, momentum

DT, SUBSTEPS = 1e-3, 5
LAW = ContactLaw(stiffness=2e7, damping=300.0, friction=0.3, tangential_stiffness=1e7)

FREE_TOOL = """
<mujoco>
  <option timestep="0.001" integrator="Euler" jacobian="dense" gravity="0 0 0"><flag autoreset="disable"/></option>
  <default><geom contype="0" conaffinity="0" group="3"/></default>
  <worldbody>
    <body name="tool">
      <freejoint/>
      <inertial pos="{centre}" mass="0.02" diaginertia="2e-6 3e-6 4e-6"/>
      <geom type="sphere" size="0.006"/>
      {shaft}
    </body>
  </worldbody>
</mujoco>
"""
BALL = FREE_TOOL.format(centre="0 0 0", shaft="")
# Its centre of mass is none of its shapes' centres.
LOPSIDED = FREE_TOOL.format(
    centre="0.004 -0.003 0.01", shaft='<geom type="capsule" fromto="0 0 0 0.02 0.004 0.012" size="0.003"/>'
)


class FreeBody(ToolBodies):
    """A body that nothing drives."""

    def __init__(self, xml: str, position: tuple[float, float, float], velocity: NDArray) -> None:
        super().__init__(mujoco.MjModel.from_xml_string(xml))
        self.data.qpos[:3] = position
        self.data.qvel[:] = velocity


@cache
def scene() -> Scene:
    return make_scene("phantom")


def free_organ() -> tuple[OrganModel, OrganState]:
    """An unheld block that flies and spins a little, alpha = 0: only the tool changes its momentum."""
    model = oracle.block((0.03, 0.03, 0.015), (6, 6, 3))
    state = rest_state(model, shape_count=2)
    state.node_velocity[:] = np.array([0.01, 0.02, 0.0]) + np.cross([0.5, -0.3, 0.8], state.node_position)
    return model, state


def free_ball() -> ToolBodies:
    return FreeBody(BALL, (0.014, 0.016, 0.0215), np.array([0.03, -0.02, -0.15, 3.0, -2.0, 5.0]))


def lopsided_body() -> ToolBodies:
    return FreeBody(LOPSIDED, (0.014, 0.016, 0.0215), np.array([0.03, -0.02, -0.15, 3.0, -2.0, 5.0]))


def driven_probe() -> Probe:
    probe = Probe(scene(), np.full(3, -0.1), np.full(3, 0.1))
    probe.place(np.array([0.014, 0.016, 0.0235]))
    probe.command_velocity(np.array([0.02, 0.01, -0.05]))
    return probe


TOOLS = {"free ball": free_ball, "lopsided free body": lopsided_body, "probe": driven_probe}
POINT = np.array([0.3, -0.2, 0.1])  # angular momentum is taken about this one [m]


@pytest.mark.parametrize("name", TOOLS)
def test_organs_change_of_momentum_is_minus_the_wrench(name: str):
    """Per haptic step dp = -F dt and dL = -(tau + (c - P) x F) dt, c the centre of mass at its start, to 1e-12."""
    model, state = free_organ()
    tool = TOOLS[name]()
    wrench = np.zeros((1, 6))
    impulse = twist_impulse = 0.0
    for _ in range(150):
        linear, angular = momentum(model, state), angular_momentum(model, state, POINT)
        assert not haptic_steps(model, state, tool, LAW, DT / SUBSTEPS, SUBSTEPS, wrench).fault
        centre = tool.data.xipos[tool.model.nbody - 1].copy()  # mj_step2 leaves the poses of the step's start
        force, torque = wrench[0, :3], wrench[0, 3:]
        turn = torque + np.cross(centre - POINT, force)
        # To rounding: momenta are sums over 175 nodes, of the impulse's size and of what the organ carries.
        scale = DT * np.abs(force).max() + np.abs(linear).max()
        np.testing.assert_allclose(momentum(model, state) - linear, -DT * force, rtol=0, atol=1e-12 * scale)
        np.testing.assert_allclose(
            angular_momentum(model, state, POINT) - angular, -DT * turn, rtol=0, atol=1e-12 * scale
        )
        impulse += DT * np.linalg.norm(force)
        twist_impulse += DT * np.linalg.norm(torque)
    # They did push on each other.
    assert impulse > 1e-4
    assert twist_impulse > 1e-7


def test_organ_and_free_ball_keep_their_momentum():
    """m_tool v + sum m_i v_i is constant to rounding: the ball gets F dt, the organ -F dt."""
    model, state = free_organ()
    tool = free_ball()
    wrench = np.zeros((1, 6))
    before = momentum(model, state) + 0.02 * tool.data.qvel[:3]
    for _ in range(150):
        assert not haptic_steps(model, state, tool, LAW, DT / SUBSTEPS, SUBSTEPS, wrench).fault
    moved = np.abs(momentum(model, state) - momentum(*free_organ())).max()
    assert moved > 1e-4
    after = momentum(model, state) + 0.02 * tool.data.qvel[:3]
    np.testing.assert_allclose(after, before, rtol=0, atol=1e-12 * np.abs(before).max())


def test_the_reading_is_of_the_current_step(monkeypatch: pytest.MonkeyPatch):
    """Poses and twist that the organ sees are those of the coordinates before the step, not of the step before."""
    model, state = free_organ()
    probe = driven_probe()
    seen = []

    def spy(_model, _state, shapes, _law, _response, _dt, _decay, _count, _reference, wrench) -> int:
        seen.append((shapes.shape_ends[0, 0].copy(), shapes.tool_centre[0].copy(), shapes.tool_twist[0].copy()))
        wrench[:] = 0.0
        return FAULT_NONE

    monkeypatch.setattr(haptic_kernels, "advance_substeps", spy)
    wrench = np.zeros((1, 6))
    for _ in range(20):
        place, speed = probe.data.qpos[:3].copy(), probe.data.qvel[:3].copy()
        assert not haptic_steps(model, state, probe, LAW, DT / SUBSTEPS, SUBSTEPS, wrench).fault
        ball, centre, twist = seen[-1]
        np.testing.assert_allclose(ball, place, rtol=0, atol=1e-15)
        np.testing.assert_allclose(centre, place + np.array([0.0, 0.0, 0.02]), rtol=0, atol=1e-15)
        np.testing.assert_allclose(twist, [*speed, 0.0, 0.0, 0.0], rtol=0, atol=1e-15)
    assert np.abs(seen[-1][2]).max() > 0.02


def test_the_wrench_acts_in_the_same_step(monkeypatch: pytest.MonkeyPatch):
    """Free body: dv = F dt / m within the very step, and it is overwritten, not summed, in the next."""
    model, state = free_organ()
    tool = FreeBody(BALL, (0.0, 0.0, 0.5), np.zeros(6))

    def push(_model, _state, _shapes, _law, _response, _dt, _decay, _count, _reference, wrench) -> int:
        wrench[:] = [0.02, 0.0, -0.04, 0.0, 0.0, 0.0]
        return FAULT_NONE

    monkeypatch.setattr(haptic_kernels, "advance_substeps", push)
    wrench = np.zeros((1, 6))
    for count in (1, 2, 3):
        assert not haptic_steps(model, state, tool, LAW, DT / SUBSTEPS, SUBSTEPS, wrench).fault
        np.testing.assert_allclose(tool.data.qvel[:3], count * np.array([1e-3, 0.0, -2e-3]), rtol=1e-12, atol=1e-15)


# ---- faults -------------------------------------------------------------------------------------------------------


def untouched(probe: Probe) -> bool:
    return not probe.data.xfrc_applied.any() and bool(np.isfinite(probe.data.qpos).all())


def test_a_force_that_is_not_finite_never_reaches_mujoco():
    """A contact law gone bad: the step ends before MuJoCo hears of it."""
    model, state = free_organ()
    probe = driven_probe()
    probe.place(np.array([0.014, 0.016, 0.0215]))
    bad = LAW._replace(stiffness=float("nan"))
    taken = haptic_steps(model, state, probe, bad, DT / SUBSTEPS, SUBSTEPS, np.zeros((1, 6)))
    assert taken.ended and "no longer finite" in taken.fault
    assert untouched(probe)


# ---- the simulation -----------------------------------------------------------------------------------------------

ABOVE = np.array([0.03, 0.03, 0.0385])  # the tip's centre, 0.5 mm clear of the phantom's top [m]


@cache
def anatomy() -> Anatomy:
    return load_anatomy(scene())


def simulation() -> Simulation:
    simulated = Simulation(anatomy())
    simulated.reset(anatomy().organ(), ABOVE)
    return simulated


def run(simulated: Simulation, velocity: tuple[float, float, float], count: int) -> NDArray:
    """The wrench of each haptic step at a commanded velocity, shape (count, 6)."""
    simulated.instrument.command_velocity(np.array(velocity))
    wrenches = []
    for _ in range(count):
        assert simulated.haptic_step(), simulated.fault
        wrenches.append(simulated.contact_wrench[0])
    return np.array(wrenches)


def test_too_few_substeps_are_refused_with_the_count_that_does():
    """The message's count is the least that passes."""
    worst = anatomy().lesion_below(ABOVE, 0.010, 0.003, 10.0, "worst")
    organ = anatomy().organ([worst])

    def with_substeps(count: int) -> Simulation:
        timing = replace(scene().timing, substep_count=count)
        return Simulation(replace(anatomy(), scene=replace(scene(), timing=timing)))

    with pytest.raises(OrganError, match=r"2 substeps of 0\.5 ms are too long .*substep_count = \d+") as refused:
        with_substeps(2).reset(organ, ABOVE)
    needed = int(re.findall(r"substep_count = (\d+)", str(refused.value))[0])
    assert 2 < needed <= scene().timing.substep_count + 1
    with pytest.raises(OrganError, match=f"substep_count = {needed}"):
        with_substeps(needed - 1).reset(organ, ABOVE)
    with_substeps(needed).reset(organ, ABOVE)


@pytest.mark.parametrize(
    ("name", "value"), [("qpos", np.nan), ("qvel", 1e12), ("ctrl", np.nan)], ids=["position", "velocity", "control"]
)
def test_mujocos_warnings_surface(name: str, value: float):
    simulated = simulation()
    run(simulated, (0.0, 0.0, -0.01), 3)
    assert simulated.end_control_step()
    getattr(simulated.instrument.data, name)[0] = value
    still_runs = simulated.haptic_step()
    assert not simulated.end_control_step()
    assert simulated.fault.startswith("MuJoCo warning") and not simulated.fault.isspace()
    if still_runs:
        assert np.isfinite(simulated.organ_state.node_position).all()
    simulated.reset(anatomy().organ(), ABOVE)
    run(simulated, (0.0, 0.0, -0.01), 3)
    assert simulated.end_control_step()


def test_a_tet_that_the_last_substep_inverts_is_named_at_the_end_of_the_control_step():
    """No further substep looks at it: an episode may end here, by a torn grasp for one."""
    simulated = simulation()
    run(simulated, (0.0, 0.0, -0.01), 3)
    assert simulated.end_control_step()
    model, position = simulated.organ_model, simulated.organ_state.node_position
    tet = model.tet_nodes[100]
    free = next(node for node in tet if model.node_inverse_mass[node] > 0.0)
    position[free] = 2.5 * position[[node for node in tet if node != free]].mean(axis=0) - 1.5 * position[free]
    assert not simulated.end_control_step()
    assert "turned inside out: volume ratio -" in simulated.fault
    simulated.restart(ABOVE)
    run(simulated, (0.0, 0.0, -0.01), 3)
    assert simulated.end_control_step()


def test_a_fault_is_told_and_a_restart_is_clean():
    """An organ gone bad: haptic_step says no and why; after `restart` it runs as a fresh one does, to the bit."""
    simulated = simulation()
    run(simulated, (0.0, 0.0, -0.02), 60)
    simulated.organ_state.node_velocity[17, 0] = np.nan
    assert not simulated.haptic_step()
    assert "node 17 is no longer finite" in simulated.fault
    simulated.restart(ABOVE)
    assert simulated.time == 0.0 and simulated.fault == ""
    np.testing.assert_array_equal(run(simulated, (0.01, 0.0, -0.02), 100), run(simulation(), (0.01, 0.0, -0.02), 100))


def test_a_saved_state_resumes_to_the_bit():
    """Saved in mid-press with friction sticking; resumed in the same simulation, and in another after other work."""
    simulated = simulation()
    run(simulated, (0.01, 0.005, -0.03), 100)
    assert np.abs(simulated.organ_state.contact_stretch).max() > 0.0
    saved = {name: array.copy() for name, array in simulated.get_state().items()}
    ahead = run(simulated, (-0.01, 0.0, -0.01), 100)
    after = simulated.get_state()
    assert np.abs(ahead).max() > 0.05
    other = simulation()
    run(other, (0.0, 0.0, -0.05), 37)
    for resumed in (simulated, other):
        resumed.set_state(simulated.organ_model, saved)
        assert resumed.time == pytest.approx(0.1)
        np.testing.assert_array_equal(resumed.contact_wrench, saved["wrench"])
        np.testing.assert_array_equal(run(resumed, (-0.01, 0.0, -0.01), 100), ahead)
        for name, array in resumed.get_state().items():
            assert array.tobytes() == after[name].tobytes(), name


def test_the_wrist_feels_what_the_tissue_gives():
    """Static press: the force sensor between slide and tip carries the contact force, within 1 %."""
    simulated = simulation()
    run(simulated, (0.0, 0.0, -0.03), 150)
    run(simulated, (0.004, 0.0, 0.0), 100)
    wrench = run(simulated, (0.0, 0.0, 0.0), 1500)[-1]
    wrist = simulated.instrument.data.sensordata[:3]
    force = np.linalg.norm(wrench[:3])
    assert force > 0.15
    np.testing.assert_allclose(np.abs(wrist), np.abs(wrench[:3]), rtol=0, atol=0.01 * force)
    # The servo holds the tip with 5000 N/m: it is off its target by force / 5000.
    data = simulated.instrument.data
    np.testing.assert_allclose(data.qpos[:3] - data.ctrl[:3], wrench[:3] / 5000.0, rtol=0, atol=0.01 * force / 5000.0)


def test_restart_goes_back_to_the_settled_shape_under_gravity():
    anatomy = load_anatomy(scene())
    organ = compile_organ(OrganSpec(anatomy.mesh, scene().material, anchors=anatomy.anchors, gravity=(0.0, 0.0, -9.81)))
    simulation = Simulation(anatomy)
    simulation.reset(organ, np.array([0.03, 0.03, 0.06]))
    settled = simulation.organ_state.node_position.copy()
    assert (settled[:, 2] - organ.node_rest_position[:, 2]).min() < -1e-4
    simulation.organ_state.node_position[5] += 1e-4
    simulation.restart(np.array([0.03, 0.03, 0.06]))
    np.testing.assert_array_equal(simulation.organ_state.node_position, settled)
    for _ in range(20):
        assert simulation.haptic_step()
    # It stays: what is left of the settling moves it by less than a micrometre.
    assert np.abs(simulation.organ_state.node_position - settled).max() < 1e-6
