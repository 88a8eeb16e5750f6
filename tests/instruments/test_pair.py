"""Two arms in one model: each moves as it would alone, they meet each other and the organ, all loops do the same."""

from dataclasses import replace

import numpy as np
import pytest

from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments.arm.pair import Pair
from surgsim_env.scene.anatomy import load_anatomy
from tests.instruments.pair_scene import LEFT, RIGHT, pair_anatomy

pytestmark = pytest.mark.filterwarnings("ignore:scene 'slab for two'")
STILL = np.zeros((2, 3))
START = np.stack([LEFT, RIGHT])
IN_THE_AIR = START + np.array([0.0, 0.03, 0.02])


def simulation(places=START, *, compiled: bool = True) -> Simulation:
    made = Simulation(pair_anatomy())
    made.compiled = compiled
    made.restart(places)
    return made


def run(sim: Simulation, steps: int, velocity=STILL, turning=None) -> None:
    for _ in range(steps):
        sim.instrument.command_velocity(np.asarray(velocity), turning)
        sim.control_step(50)
        assert sim.end_control_step(), sim.fault


def test_each_arm_stands_as_it_would_alone():
    """The joint model's tips against those of the arms compiled by themselves, at the same joint values."""
    pair = simulation(IN_THE_AIR).instrument
    assert isinstance(pair, Pair)
    for side, place in zip(("left", "right"), IN_THE_AIR, strict=True):
        arm = pair.arms[side]
        np.testing.assert_allclose(arm.tip_position, place, atol=1e-6)
        alone = arm.arm.tip_pose(arm.joint_positions)
        np.testing.assert_allclose(arm.tip_position, alone.position, atol=1e-12)
        np.testing.assert_allclose(arm.tip_rotation, alone.rotation, atol=1e-12)
        direction = arm.tip_rotation @ arm.arm.description.tip.direction
        np.testing.assert_allclose(direction, [0.0, -1.0, 0.0], atol=1e-6)
        assert arm.trocar_residual < 1e-9
    assert pair.jaw.opening == pair.arms["left"].jaw.opening > 0.018
    assert pair.arms["right"].jaw is None
    # The gear of the jaw and its serrated pads stay so beside another arm.
    assert pair.model.ntendon == 1
    assert pair.jaw is pair.arms["left"].jaw
    assert (pair.jaw.friction == 5.0).all() and (pair.shapes.shape_friction == 5.0).sum() == 2


def test_each_tip_follows_its_own_line():
    sim = simulation(IN_THE_AIR)
    velocity = np.array([[0.01, 0.0, 0.02], [0.0, -0.015, -0.01]])
    run(sim, 10, velocity)
    run(sim, 4)
    for side, place, speed in zip(("left", "right"), IN_THE_AIR, velocity, strict=True):
        np.testing.assert_allclose(sim.instrument.arms[side].tip_position, place + 0.5 * speed, atol=3e-5)
        assert np.linalg.norm(sim.instrument.arms[side].tip_velocity) < 1e-3
    assert not sim.instrument.workspace_limited
    sim.instrument.arms["left"].command_jaw(-1.0)
    run(sim, 12)
    assert sim.instrument.jaw.opening == pytest.approx(0.0055, abs=2e-4)
    with pytest.raises(ValueError, match=r"psm_palpator.* has no jaw: it carries a palpator"):
        sim.instrument.arms["right"].command_jaw(0.0)


@pytest.mark.parametrize("speed", [0.02, 0.1])
def test_arms_collide_and_do_not_pass_through_each_other(speed: float):
    """The right tip is sent 30 mm to the left, across the left wrist 12 mm away: there it stays, never deep in it."""
    sim = simulation(IN_THE_AIR)
    pair = sim.instrument
    pair.arms["left"].command_jaw(-1.0)
    run(sim, 11)
    assert pair.distance > 0.005 and pair.collision_force == 0.0
    deepest, largest = 0.0, 0.0
    for _ in range(round(0.03 / speed / 0.05)):
        pair.command_velocity(np.array([[0.0, 0.0, 0.0], [-speed, 0.0, 0.0]]))
        for _ in range(50):
            sim.control_step(1)
            sim.instrument.refresh()
            deepest, largest = min(deepest, pair.distance), max(largest, pair.collision_force)
    run(sim, 40)
    way = IN_THE_AIR[1, 0] - pair.arms["right"].tip_position[0]
    print(f"\n{speed} m/s: {deepest * 1e3:.2f} mm deep, {largest:.1f} N; came {way * 1e3:.1f} mm")
    assert pair.distance <= 0.0 and largest > 1.0
    assert deepest > -1e-3
    assert 0.010 < way < 0.020
    assert np.abs(pair.data.qvel).max() < 0.05, "they came to rest"


def grasped(*, compiled: bool = True) -> Simulation:
    """The left arm holds the edge and the right one presses it from the side, the arms in contact."""
    sim = simulation(compiled=compiled)
    sim.instrument.arms["left"].command_jaw(-1.0)
    run(sim, 12)
    run(sim, 12, [[0.0, 0.0, 0.01], [-0.012, -0.02, 0.0]])
    return sim


def test_both_arms_feel_the_organ_each_for_itself():
    sim = grasped()
    pair, wrench = sim.instrument, sim.contact_wrench
    left, right = (pair.contact_force(side, wrench) for side in ("left", "right"))
    np.testing.assert_allclose(left + right, sim.contact_force, atol=1e-15)
    assert sorted([*pair.tools_of("left"), *pair.tools_of("right")]) == list(range(pair.tool_count))
    assert sim.grasp.holds and sim.grasp.grip_force > 0.1
    fingers = wrench[pair.jaw.tools, :3].sum(axis=0)
    np.testing.assert_allclose(sim.grasp.pull_force, np.linalg.norm(fingers), rtol=1e-12)
    # The right ball was driven 6 mm into the edge, towards -y: tissue pushes it back.
    assert right[1] > 0.02


def test_both_loops_do_the_same():
    compiled, plain = grasped(), grasped(compiled=False)
    for name, array in plain.get_state().items():
        assert compiled.get_state()[name].tobytes() == array.tobytes(), name
    assert compiled.grasp == plain.grasp and compiled.pull_peak == plain.pull_peak > 0.0
    assert compiled.instrument.distance == plain.instrument.distance


def test_a_pair_needs_two_ports():
    scene = pair_anatomy().scene
    with pytest.raises(ValueError, match=r"scene 'slab for two' has 1 \[\[ports\]\]; 'psm_pair' needs two"):
        Simulation(load_anatomy(replace(scene, ports=scene.ports[:1])))
    far = replace(scene.ports[1], point=(0.5, 0.5, 0.5))
    with pytest.raises(ValueError, match=r"arm 'psm_palpator' at its port \(500.0, .* cannot put its tip at"):
        Simulation(load_anatomy(replace(scene, ports=(scene.ports[0], far))))
