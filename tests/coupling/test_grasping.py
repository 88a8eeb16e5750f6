"""Jaws that close on a slab: how hard, how far, what is told of it, and that all three loops do the same."""

from types import SimpleNamespace

import numpy as np
import pytest

from surgsim_env.coupling.lane_group import LaneGroup
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments.instrument import read_grasp
from tests.coupling.slab import HOLD, slab

JAWS = ["grasper.xml", "psm_retractor"]
# Force of each pad [N]: the range of its joint, over the lever of the pad's middle.
PAD_FORCE = {"grasper.xml": 0.5, "psm_retractor": 0.4}


def simulation(model: str, *, compiled: bool = True) -> Simulation:
    made = Simulation(slab(model))
    made.compiled = compiled
    made.restart(HOLD)
    return made


def run(sim: Simulation, steps: int, velocity=(0.0, 0.0, 0.0), turning=None) -> None:
    """Control steps at a steady velocity."""
    for _ in range(steps):
        sim.instrument.command_velocity(np.array(velocity), turning)
        sim.control_step(50)
        assert not sim.fault, sim.fault
        assert sim.end_control_step(), sim.fault


@pytest.mark.parametrize("model", JAWS)
def test_the_jaw_starts_open_and_level(model: str):
    """Around the slab's edge: nothing touches; the pads look at each other along z."""
    sim = simulation(model)
    jaw = sim.instrument.jaw
    assert jaw.opening > 0.018
    np.testing.assert_allclose(sim.instrument.tip_position, HOLD, atol=1e-9)
    mean = jaw.normals[0] - jaw.normals[1]
    np.testing.assert_allclose(np.abs(mean / np.linalg.norm(mean)), [0.0, 0.0, 1.0], atol=1e-6)
    run(sim, 1)
    assert not sim.contact_wrench.any()
    grasp = sim.grasp
    assert grasp.opening == jaw.opening and not grasp.holds
    assert grasp.grip_force == grasp.pull_force == grasp.friction_left == 0.0


@pytest.mark.parametrize("model", JAWS)
def test_a_closed_jaw_grips_with_its_joints_force(model: str):
    """At rest each pad's force is what its joint may push with; opened again, nothing of it is left."""
    sim = simulation(model)
    sim.instrument.command_jaw(-1.0)
    run(sim, 40)
    grasp = sim.grasp
    print(f"\n{model}: {grasp}")
    assert grasp.holds
    assert grasp.grip_force == pytest.approx(PAD_FORCE[model], rel=0.05)
    assert 0.002 < grasp.opening < 0.012
    # Nobody pulls, but the squeezed slab grows away from its wall and drags the pads along, as far as they stick.
    assert grasp.pull_force < 0.4 * PAD_FORCE[model]
    assert grasp.friction_left > 1.2 * sim.contact.friction * 4.0 * PAD_FORCE[model]
    sim.instrument.command_jaw(1.0)
    run(sim, 20)
    assert sim.grasp.opening > 0.018
    assert not sim.contact_wrench.any() and not sim.grasp.holds
    assert np.abs(sim.organ_state.node_position - sim.organ_model.node_rest_position).max() < 1e-4


@pytest.mark.parametrize("model", JAWS)
def test_a_restart_forgets_where_the_jaw_was_told_to_go(model: str):
    """Opened again and stopped on its way: restarted it is as the first time, and stays open."""
    sim = simulation(model)
    first = sim.instrument.get_state()
    for target in (-1.0, -0.3):
        sim.instrument.command_jaw(target)
        run(sim, 10)
    sim.restart(HOLD)
    assert sim.instrument.get_state().tobytes() == first.tobytes()
    sim.control_step(1)
    assert sim.instrument.jaw.target == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("model", JAWS)
def test_no_joint_of_the_jaw_pushes_beyond_its_range(model: str):
    sim = simulation(model)
    sim.instrument.command_jaw(-1.0)
    model_, data = sim.instrument.model, sim.instrument.data
    fingers = [j for j in range(model_.njnt) if model_.joint(j).name.startswith("finger")]
    limit = model_.jnt_actfrcrange[fingers, 1]
    for _ in range(30):
        run(sim, 1)
        assert (np.abs(data.qfrc_actuator[model_.jnt_dofadr[fingers]]) <= limit + 1e-12).all()
    assert np.abs(data.qfrc_actuator[model_.jnt_dofadr[fingers]]) == pytest.approx(limit)


def test_turning_the_wrist_leaves_the_tip_where_it_is():
    """The hinge lies 22 mm behind: between control steps the tip leaves its place by 22 mm (1 - cos(0.025))."""
    sim = simulation("grasper.xml")
    sim.restart(HOLD + np.array([0.0, 0.04, 0.02]))
    start, pitch = sim.instrument.tip_position, sim.instrument.pitch
    run(sim, 20, turning=np.array([1.0]))
    assert sim.instrument.pitch - pitch == pytest.approx(1.0, abs=2e-3)
    np.testing.assert_allclose(sim.instrument.tip_position, start, atol=2e-5)
    run(sim, 10, velocity=(0.01, 0.0, 0.0), turning=np.array([-1.0]))
    np.testing.assert_allclose(sim.instrument.tip_position, start + np.array([0.005, 0.0, 0.0]), atol=1e-4)
    assert not sim.instrument.workspace_limited
    run(sim, 80, turning=np.array([1.0]))
    assert sim.instrument.workspace_limited
    assert sim.instrument.pitch == pytest.approx(1.9, abs=2e-3)
    with pytest.raises(ValueError, match=r"turning has shape \(3,\); instrument 'grasper' takes \(1,\)"):
        sim.instrument.command_velocity(np.zeros(3), np.zeros(3))


def test_an_arm_turns_the_jaw_with_its_whole_frame():
    """Half a radian about x, across the jaw: it lifts, its pads do not roll, its middle stays."""
    sim = simulation("psm_retractor")
    sim.restart(HOLD + np.array([0.0, 0.03, 0.02]))
    start, frame = sim.instrument.tip_position, sim.instrument.steered.tip_rotation
    run(sim, 10, turning=np.array([-1.0, 0.0, 0.0]))
    run(sim, 4)
    c, s = np.cos(0.5), np.sin(0.5)
    turned = np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]]) @ frame
    np.testing.assert_allclose(sim.instrument.steered.tip_rotation, turned, atol=2e-3)
    np.testing.assert_allclose(sim.instrument.tip_position, start, atol=5e-5)


def test_what_a_grasp_tells():
    """Pads that look at each other along z, hand-made wrenches: every number by its definition."""
    jaw = SimpleNamespace(
        tools=np.array([2, 0]),
        normals=np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]),
        opening=0.009,
        friction=np.array([3.0, 2.0]),
    )
    instrument = SimpleNamespace(jaw=jaw)
    wrench = np.zeros((3, 6))
    wrench[2] = [0.03, 0.04, 0.5, 9.0, 9.0, 9.0]  # the upper pad: pushed up by 0.5, dragged by 0.05
    wrench[0] = [0.0, 0.12, -0.3, 9.0, 9.0, 9.0]
    wrench[1] = 7.0  # a shaft, no business of the jaw's
    grasp = read_grasp(instrument.jaw, wrench, friction=0.2)
    assert (grasp.opening, grasp.holds) == (0.009, True)
    assert grasp.grip_force == pytest.approx(0.3)
    assert grasp.pull_force == pytest.approx(np.sqrt(0.03**2 + 0.16**2 + 0.2**2))
    assert grasp.friction_left == pytest.approx(0.2 * (3.0 * 0.5 + 2.0 * 0.3) - 0.05 - 0.12)
    wrench[0, 2] = 0.1  # sticks to the lower pad's back: it does not press
    grasp = read_grasp(instrument.jaw, wrench, friction=0.2)
    assert not grasp.holds and grasp.grip_force == 0.0
    assert read_grasp(None, wrench, friction=0.2) is None


def pulled(sim: Simulation, pull_limit: float) -> int:
    """Close, then pull away along y until the pull passes a limit; how many control steps that took."""
    sim.instrument.command_jaw(-1.0)
    run(sim, 20)
    for step in range(60):
        sim.instrument.command_velocity(np.array([0.0, 0.02, 0.01]))
        sim.control_step(50, np.inf, pull_limit)
        assert not sim.fault
        sim.instrument.refresh()
        if sim.pull_peak > pull_limit:
            return step
    raise AssertionError("the pull never passed its limit")


@pytest.mark.parametrize("model", JAWS)
def test_the_pull_limit_stops_both_loops_in_the_same_haptic_step(model: str):
    limit = 0.25
    compiled, plain = simulation(model), simulation(model, compiled=False)
    assert pulled(compiled, limit) == pulled(plain, limit)
    steps = round(compiled.time / compiled.haptic_dt)
    assert steps % 50 != 0, "in the middle of a control step"
    fingers = compiled.contact_wrench[compiled.instrument.jaw.tools, :3]
    assert compiled.pull_peak == plain.pull_peak == pytest.approx(np.linalg.norm(fingers.sum(axis=0)), rel=1e-14)
    assert limit < compiled.pull_peak < 1.05 * limit
    assert compiled.grasp == plain.grasp
    for name, array in plain.get_state().items():
        assert compiled.get_state()[name].tobytes() == array.tobytes(), name


def test_lanes_stop_at_the_pull_limit_too():
    """Two side by side, one of which pulls: each as it would alone, to the bit."""
    together = [simulation("grasper.xml") for _ in range(2)]
    apart = [simulation("grasper.xml") for _ in range(2)]
    for sim in (*together, *apart):
        sim.instrument.command_jaw(-1.0)
        run(sim, 20)
    group = LaneGroup(together)
    stopped = 0
    for _ in range(40):
        for pair in (together, apart):
            pair[0].instrument.command_velocity(np.array([0.0, 0.02, 0.01]))
            pair[1].instrument.command_velocity(np.zeros(3))
        group.control_step(together, 50, np.inf, 0.25)
        for lane, other in zip(together, apart, strict=True):
            assert lane.force_peak == other.control_step(50, np.inf, 0.25) == other.force_peak
            assert lane.pull_peak == other.pull_peak
            assert lane.time == other.time
            lane.instrument.refresh()
            other.instrument.refresh()
            for name, array in other.get_state().items():
                assert lane.get_state()[name].tobytes() == array.tobytes(), name
        stopped = together[0].pull_peak > 0.25
        if stopped:
            break
    assert stopped and together[1].time > together[0].time
