"""The compiled control step against the plain Python loop, to the bit; and what happens where it cannot be had."""

import copy
import re
from functools import cache

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import surgsim_env  # noqa: F401
from msdm_core.kernels.structure_kernels import FAULT_NONE
from surgsim_env.coupling.exchange import haptic_steps, step_outcome
from surgsim_env.coupling.haptic_kernels import (
    FAULT_FORCE_CAP,
    FAULT_WRENCH_NOT_FINITE,
    StepPlan,
    end_step,
)
from surgsim_env.instruments.tool_bodies import ToolBodies
from surgsim_env.instruments.tool_kernels import factorise, tool_mobility
from tests.coupling.test_exchange import LAW, driven_probe, free_ball, free_organ, lopsided_body
from tests.coupling.test_passivity import damped_arm


def made(scene, compiled, instrument=None):
    env = gym.make("SurgSim/Palpate-v0", scene=scene, instrument=instrument).unwrapped
    env.simulation.compiled = compiled
    return env


@cache
def pair(scene, instrument=None):
    """The same environment with the compiled step and with the plain loop."""
    return made(scene, True, instrument), made(scene, False, instrument)


def assert_same(compiled, plain, action):
    """One control step of both; everything that can be seen or saved is the same to the bit."""
    result, other = compiled.step(action), plain.step(action)
    assert result[0].tobytes() == other[0].tobytes()
    assert result[1:] == other[1:]
    ours, theirs = compiled.simulation, plain.simulation
    assert ours.contact_wrench.tobytes() == theirs.contact_wrench.tobytes()
    assert (ours.time, ours.fault) == (theirs.time, theirs.fault)
    for name in ("qpos", "qvel", "qacc", "ctrl", "xfrc_applied", "sensordata", "xipos"):
        mine, reference = getattr(ours.instrument.data, name), getattr(theirs.instrument.data, name)
        assert mine.tobytes() == reference.tobytes(), name
    for name, array in theirs.get_state().items():
        assert ours.get_state()[name].tobytes() == array.tobytes(), name
    assert compiled.save_state() == plain.save_state()
    return result


def press(both, seed, count):
    """Control steps from the surface on: in along its normal, then a random walk that presses and never declares."""
    scene, face = both[1].scene, both[1].simulation.anatomy.face
    rng = np.random.default_rng(seed)
    point, normal = face.random_point(rng, scene.palpation.face_margin)
    for env in both:
        env.simulation.restart(point + normal * scene.instrument.tip_radius)
    for step in range(count):
        velocity = -0.7 * normal if step < 5 else rng.uniform(-0.5, 0.5, 3) - 0.1 * normal
        yield assert_same(*both, np.append(velocity, 0.0).astype(np.float32))[-1]["force_peak"]


EPISODES = [
    ("phantom", "probe", 3, 30),
    pytest.param("phantom", "probe", 11, 20, marks=pytest.mark.slow),
    pytest.param("liver", "probe", 5, 20, marks=pytest.mark.slow),
    ("phantom", "psm_palpator", 3, 30),
    pytest.param("liver", "psm_palpator", 5, 20, marks=pytest.mark.slow),
    pytest.param("phantom", "six_axis", 3, 20, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("scene", "instrument", "seed", "count"), EPISODES)
def test_whole_episodes_are_the_same(scene, instrument, seed, count):
    compiled, plain = pair(scene, instrument)
    assert compiled.simulation.compiled and not plain.simulation.compiled
    assert compiled.reset(seed=seed)[0].tobytes() == plain.reset(seed=seed)[0].tobytes()
    assert max(press((compiled, plain), seed, count)) > 0.1, "the walk must press to prove anything"
    assert np.abs(plain.simulation.organ_state.contact_stretch).max() > 0.0


def on_phantom(seed=3, gap=0.0005):
    """Both at rest over the phantom's lesion."""
    both = pair("phantom")
    for env in both:
        env.reset(seed=seed)
        x, y = env.task.lesion.centre[:2]
        env.simulation.restart(np.array([x, y, 0.038 + gap]))
    return both


DOWN = np.array([0.0, 0.0, -1.0, 0.0], dtype=np.float32)


def test_the_hard_limit_stops_both_in_the_same_haptic_step():
    compiled, plain = on_phantom()
    for _ in range(40):
        _, _, terminated, _, info = assert_same(compiled, plain, DOWN)
        if terminated:
            break
    assert info["hard_limit"] and 0.8 < info["force_peak"] < 0.81
    steps = round(compiled.simulation.time / 0.001)
    assert steps % 50 != 0, "in the middle of a control step"


def spoil(env):
    env.simulation.organ_state.node_velocity[700, 1] = np.nan


def stiffen(env):
    env.simulation.contact = env.simulation.contact._replace(stiffness=1e12)


def fling(env):
    env.simulation.instrument.data.qvel[0] = 1e12


def lose_control(env):
    env.simulation.instrument.data.ctrl[0] = np.nan


FAULTS = [
    (spoil, "no longer finite"),
    (stiffen, "turned inside out"),
    (fling, "turned inside out|MuJoCo warning"),
    (lose_control, "MuJoCo warning"),
]


@pytest.mark.parametrize(("harm", "message"), FAULTS, ids=[harm.__name__ for harm, _ in FAULTS])
def test_faults_are_the_same(harm, message, tmp_path, monkeypatch, caplog):
    """The same words, and the last good step's wrench; afterwards both are clean."""
    monkeypatch.chdir(tmp_path)
    both = on_phantom(gap=-0.001)
    law = both[0].simulation.contact
    for _ in range(2):
        assert_same(*both, np.zeros(4, dtype=np.float32))
    assert both[0].simulation.contact_wrench.any()
    try:
        for env in both:
            harm(env)
        record = assert_same(*both, 0.3 * DOWN)
    finally:
        for env in both:
            env.simulation.contact = law
    assert record[2] and re.search(message, record[-1]["sim_fault"]), record[-1]["sim_fault"]
    # MuJoCo's own words are logged, without its file in the working folder.
    assert "MuJoCo" not in record[-1]["sim_fault"] or "mujoco" in [line.name for line in caplog.records]
    assert not list(tmp_path.iterdir())
    for env in both:
        env.reset(seed=4)
    assert not assert_same(*both, DOWN)[2]


def test_a_fault_in_mid_step_is_the_same():
    """A ram at 0.3 m/s turns a tet inside out after some 65 haptic steps: those count, with their largest force."""
    compiled, plain = (env.simulation for env in on_phantom())
    for simulation in (compiled, plain):
        simulation.instrument.command_velocity(np.array([0.0, 0.0, -0.3]))
    peaks = [simulation.control_step(600) for simulation in (compiled, plain)]
    assert peaks[0] == peaks[1] > 2.0
    assert "turned inside out" in compiled.fault and 0.05 < compiled.time < 0.1
    for name, array in plain.get_state().items():
        assert compiled.get_state()[name].tobytes() == array.tobytes(), name


TWO_ARMS = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast" jacobian="dense"><flag autoreset="disable"/></option>
  <default><geom contype="0" conaffinity="0" group="3"/></default>
  <worldbody>
    <body pos="0.008 0.015 0.06"><joint axis="0 1 0" damping="0.002"/>
      <inertial pos="0 0 0" mass="0.01" diaginertia="1e-6 1e-6 1e-6"/>
      <body pos="0.005 0 -0.02"><joint axis="1 0 0" damping="0.001" armature="1e-6"/>
        <inertial pos="0 0 -0.01" mass="0.03" diaginertia="4e-6 3e-6 2e-6"/>
        <geom type="capsule" fromto="0 0 -0.02 0.002 0 0" size="0.004"/></body></body>
    <body pos="0.022 0.015 0.0195"><freejoint/><inertial pos="0.001 0 0" mass="0.02" diaginertia="1e-6 2e-6 3e-6"/>
      <geom type="sphere" size="0.005"/><geom type="sphere" size="0.003" pos="0.003 0.002 0"/></body>
  </worldbody>
</mujoco>
"""


def two_arms() -> ToolBodies:
    return ToolBodies(mujoco.MjModel.from_xml_string(TWO_ARMS))


TOOLS = [free_ball, lopsided_body, driven_probe, damped_arm, two_arms]


@pytest.mark.parametrize("tool", TOOLS, ids=[tool.__name__ for tool in TOOLS])
def test_any_tools_move_the_same(tool):
    """Free, jointed, driven, one or two, on a block that flies: as step by step in Python, to the bit."""
    tools, others = tool(), tool()
    model, state = free_organ()
    state = state._replace(
        contact_engaged=np.zeros((4, state.contact_engaged.shape[1]), dtype=np.uint8),
        contact_stretch=np.zeros((4, *state.contact_stretch.shape[1:])),
        contact_candidates=np.zeros((4, state.contact_candidates.shape[1]), dtype=np.int32),
        contact_rows=np.zeros((4 * state.contact_engaged.shape[1], state.contact_rows.shape[1])),
        contact_places=np.zeros((4 * state.contact_engaged.shape[1], state.contact_places.shape[1]), dtype=np.int32),
    )
    reference = type(state)(*(array.copy() for array in state))
    wrench, wanted = np.zeros((tools.tool_count, 6)), np.zeros((tools.tool_count, 6))
    peak = 0.0
    for _ in range(60):
        assert not haptic_steps(model, reference, others, LAW, 2e-4, 5, wanted, compiled=False).fault
        peak = max(peak, float(np.linalg.norm(wanted[:, :3].sum(axis=0))))
    taken = haptic_steps(model, state, tools, LAW, 2e-4, 5, wrench, 60, compiled=True)
    assert (taken.step_count, taken.fault) == (60, "")
    assert taken.force_peak == pytest.approx(peak, rel=1e-14)
    assert wrench.tobytes() == wanted.tobytes()
    assert tools.data.qpos.tobytes() == others.data.qpos.tobytes()
    for name, array in reference._asdict().items():
        assert getattr(state, name).tobytes() == array.tobytes(), name
    for name, array in (others.shapes._asdict() | others.response._asdict()).items():
        assert getattr(tools.shapes, name, getattr(tools.response, name, None)).tobytes() == array.tobytes(), name
    if tool is not damped_arm:
        assert peak > 0.01


@pytest.mark.parametrize(
    ("value", "fault"),
    [
        (np.nan, FAULT_WRENCH_NOT_FINITE),
        (np.inf, FAULT_WRENCH_NOT_FINITE),
        (120.0, FAULT_FORCE_CAP),
        (99.0, FAULT_NONE),
    ],
)
def test_a_bad_wrench_never_reaches_mujoco(value, fault):
    """Nor the wrench that is kept; a good one reaches both."""
    probe = driven_probe()
    mujoco.mj_step1(probe.model, probe.data)
    outcome, place = step_outcome(1, 1), probe.data.qpos.copy()
    outcome.mean[0, 0, 1], outcome.wrench[:] = value, 0.25
    end_step(probe.views(), FAULT_NONE, StepPlan(1e-3, 1.0, 1, 1, np.inf, np.inf), outcome, 0)
    assert outcome.fault[0] == fault
    reached = fault == FAULT_NONE
    assert probe.data.xfrc_applied.any() == reached
    assert (probe.data.qpos != place).any() == reached
    np.testing.assert_array_equal(
        outcome.wrench[0, 0], [0.0, value, 0.0, 0.0, 0.0, 0.0] if reached else np.full(6, 0.25)
    )


def test_the_solve_is_that_of_linear_algebra():
    """J A^-1 J^T and J A^-1 q against LAPACK, for one to nine joints."""
    rng = np.random.default_rng(2)
    for count in range(1, 10):
        root = rng.normal(size=(count, count))
        matrix = root @ root.T + 0.1 * np.eye(count)
        jacobian, force = rng.normal(size=(6, count)), rng.normal(size=count)
        other = rng.normal(size=(6, count))
        factors, yielded = matrix.copy(), np.zeros((count, 6))
        mobilities, rates = np.zeros((2, 2, 6, 6)), np.zeros((2, 6))
        factorise(factors)
        tool_mobility(factors, np.stack([other, jacobian]), 1, force, yielded, mobilities, rates)
        wanted, mobility, rate = np.linalg.solve(matrix, jacobian.T), mobilities[1, 1], rates[1]
        accuracy = 1e-13 * np.linalg.cond(matrix)
        np.testing.assert_allclose(yielded, wanted, rtol=0, atol=accuracy * np.abs(wanted).max())
        np.testing.assert_allclose(mobility, jacobian @ wanted, rtol=0, atol=accuracy * np.abs(mobility).max())
        np.testing.assert_allclose(mobilities[0, 1], other @ wanted, rtol=0, atol=accuracy * np.abs(mobility).max())
        np.testing.assert_allclose(rate, force @ wanted, rtol=0, atol=accuracy * np.abs(mobility).max())
        assert not mobilities[:, 0].any() and not rates[0].any()


def test_a_copy_goes_on_by_itself():
    """Views are made for each call: a deep copy steps its own MuJoCo data, not that of the original."""
    original = on_phantom()[0].simulation
    original.instrument.command_velocity(np.array([0.0, 0.0, -0.02]))
    original.control_step(60)
    twin = copy.deepcopy(original, {id(original.anatomy): original.anatomy})
    stood = original.get_state()
    assert twin.control_step(60) > 0.0
    moved = twin.get_state()
    assert all(array.tobytes() == stood[name].tobytes() for name, array in original.get_state().items())
    original.control_step(60)
    assert all(array.tobytes() == moved[name].tobytes() for name, array in original.get_state().items())
