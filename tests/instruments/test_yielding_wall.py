"""A wall that yields: the load of a lever, presses that repeat to the bit, two arms, and refused values."""

from dataclasses import replace

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import surgsim_env  # noqa: F401  (registers the ids)
from surgsim_env.instruments import load_arm
from surgsim_env.instruments.arm.arm_instrument import default_port
from surgsim_env.instruments.arm.model import CANNULA, WALL_JOINTS
from surgsim_env.scene import Port, YieldingWall, as_toml, load_anatomy, make_scene, read_description

OUTER, INNER = 0.25, 0.10
MODEL = f"""<mujoco model="lever">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body name="yaw" pos="0 0 {OUTER}"><inertial pos="0 0 -0.1" mass="0.2" diaginertia="0.001 0.001 0.001"/>
      <joint name="yaw" axis="0 1 0" range="-1 1"/>
      <body name="shaft"><inertial pos="0 0 -0.1" mass="0.2" diaginertia="0.001 0.001 0.001"/>
        <joint name="pitch" axis="1 0 0" range="-1 1"/>
        <geom name="shaft" type="capsule" fromto="0 0 0 0 0 {-OUTER - INNER}" size="0.004"/>
        <site name="tip" pos="0 0 {-OUTER - INNER}"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
# The servos hardly hold the shaft: its outer end is a hinge without a moment.
TABLE = """
model = "lever.xml"
kind = "palpator"
joints = ["yaw", "pitch"]
contact = ["shaft"]
[tip]
site = "tip"
direction = [0.0, 0.0, -1.0]
[trocar]
shaft_body = "shaft"
shaft_axis = [0.0, 0.0, -1.0]
[control]
mode = "servo"
speed_limit = [1.0, 1.0]
stiffness = [1e-3, 1e-3]
damping = [1e-3, 1e-3]
effort = [3.0, 3.0]
[home]
yaw = 0.0
pitch = 0.0
"""


@pytest.fixture
def lever(tmp_path):
    """A shaft on a hinge 25 cm outside its trocar, the tip 10 cm inside."""
    (tmp_path / "lever.xml").write_text(MODEL)
    (tmp_path / "lever.toml").write_text(TABLE)
    return read_description(tmp_path / "lever.toml")


def at_rest(description, wall, force):
    """Stretch of the wall's springs [m] (3,) in the port's frame at rest, with a force [N] (3,) on the tip."""
    arm = load_arm(description, Port(wall=wall))
    model, data = arm.model, mujoco.MjData(arm.model)
    arm.write(data, arm.home)
    data.qpos[model.joint(CANNULA).qposadr[0]] = arm.trocar_place(arm.home)
    for _ in range(3000):
        data.qfrc_applied[:] = 0.0
        place = data.site_xpos[arm.tip_site] if data.time else np.array([0.0, 0.0, -INNER])
        body = int(model.site_bodyid[arm.tip_site])
        mujoco.mj_applyFT(model, data, np.array(force), np.zeros(3), place, body, data.qfrc_applied)
        mujoco.mj_step(model, data)
    assert np.abs(data.qvel).max() < 1e-4
    return np.array([data.qpos[model.joint(name).qposadr[0]] for name in WALL_JOINTS])


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-0.6, 0.8, 0.0)])
def test_a_stiff_wall_bears_the_load_of_a_lever(lever, direction):
    """Moments about the outer end: (outer + inner) / outer times the force on the tip, against it."""
    wall = YieldingWall(stiffness_across=20_000.0, friction=0.0)
    stretch = at_rest(lever, wall, 0.8 * np.array(direction))
    expected = 0.8 * (OUTER + INNER) / OUTER * np.array(direction)
    np.testing.assert_allclose(wall.stiffness_across * stretch[:2], expected[:2], atol=0.005)
    assert abs(stretch[2]) < 1e-6


def test_a_soft_wall_yields_by_its_stiffness(lever):
    soft, stiff = (
        at_rest(lever, YieldingWall(stiffness_across=stiffness, friction=0.0), (0.1, 0.0, 0.0))[0]
        for stiffness in (500.0, 2000.0)
    )
    assert soft == pytest.approx(4.0 * stiff, rel=0.01)


def test_friction_takes_the_wall_along_as_far_as_it_holds(lever, tmp_path):
    """A pull along the shaft of less than the friction stays in the wall's spring along the port's axis."""
    pitch = '<joint name="pitch" axis="1 0 0" range="-1 1"/>'
    model = MODEL.replace(pitch, f'{pitch}<joint name="free" type="slide" axis="0 0 1" damping="1"/>')
    (tmp_path / "lever.xml").write_text(model)
    wall = YieldingWall(friction=0.5)
    held = at_rest(lever, wall, (0.0, 0.0, 0.3))
    assert wall.stiffness_along * held[2] == pytest.approx(0.3, rel=0.02)


def test_a_struck_shaft_gives_the_wall_its_momentum_and_loses_energy_in_its_dampers_alone(lever):
    """Of arm and wall, about the outer hinge: the servos hold by 1e-3 N m/rad."""
    wall, step, struck = YieldingWall(friction=0.0), 2e-4, 100
    arm = load_arm(lever, Port(wall=wall), timestep=step)
    model, data = arm.model, mujoco.MjData(arm.model)
    model.opt.gravity[:] = 0.0
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    arm.write(data, arm.home)
    data.qpos[model.joint(CANNULA).qposadr[0]] = arm.trocar_place(arm.home)
    mujoco.mj_forward(model, data)
    hinge, joints = np.array([0.0, 0.0, OUTER]), [model.joint(name).id for name in WALL_JOINTS]
    stiffness = np.array([wall.stiffness_across, wall.stiffness_across, wall.stiffness_along])
    rotation, impulse, lost, largest, energies = arm.port.rotation, np.zeros(3), 0.0, 0.0, []
    for number in range(1500):
        data.qfrc_applied[:] = 0.0
        force = np.array([0.5, 0.3, 0.0]) if number < struck else np.zeros(3)
        tip, stretch = data.site_xpos[arm.tip_site].copy(), data.qpos[model.jnt_qposadr[joints]].copy()
        body = int(model.site_bodyid[arm.tip_site])
        mujoco.mj_applyFT(model, data, force, np.zeros(3), tip, body, data.qfrc_applied)
        mujoco.mj_step(model, data)
        for refresh in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel, mujoco.mj_subtreeVel):
            refresh(model, data)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        speed = data.qvel[model.jnt_dofadr[joints]]
        pull = -(stiffness * stretch + wall.damping * speed)
        impulse += step * (np.cross(rotation @ stretch - hinge, rotation @ pull) + np.cross(tip - hinge, force))
        lost += step * wall.damping * float(speed @ speed) if number >= struck else 0.0
        moving = model.body_subtreemass[0] * np.cross(data.subtree_com[0] - hinge, data.subtree_linvel[0])
        momentum = data.subtree_angmom[0] + moving
        largest = max(largest, np.abs(momentum).max())
        np.testing.assert_allclose(momentum, impulse, atol=0.01 * largest)
        energies.append(data.energy.sum())
    after = np.array(energies[struck - 1 :])
    assert (np.diff(after) < 0.0).all() and after[-1] < 1e-6 * after[0]
    assert lost == pytest.approx(after[0], rel=0.03)


def scene_file(folder, arm, wall):
    scene = make_scene("phantom_small")
    scene = replace(scene, instrument=replace(scene.instrument, model=arm))
    scene = replace(scene, port=replace(default_port(load_anatomy(scene).face), wall=wall))
    (folder / f"{arm}.toml").write_text(as_toml(scene))
    return str(folder / f"{arm}.toml")


ACTION = np.array([0.2, 0.0, -0.3, 0.0], dtype=np.float32)


def press(env, steps=25):
    env.reset(seed=0)
    return [env.step(ACTION) for _ in range(steps)]


@pytest.mark.parametrize("arm", ["psm_palpator", "six_axis"])
def test_a_press_through_a_wall_repeats_to_the_bit_and_tells_its_force(tmp_path, arm):
    env = gym.make("SurgSim/Palpate-v0", scene=scene_file(tmp_path, arm, YieldingWall()))
    first, second = press(env), press(env)
    for (seen, *_, info), (again, *_, info_again) in zip(first, second, strict=True):
        assert (seen == again).all() and info["trocar_force"] == info_again["trocar_force"]
    forces = [info["trocar_force"] for *_, info in first]
    assert not any(info["sim_fault"] for *_, info in first)
    assert 0.0 < max(forces) < 5.0
    assert "trocar_force" not in gym.make("SurgSim/Palpate-v0", scene="phantom_small", instrument=arm).reset(seed=0)[1]


def test_a_wall_goes_on_from_a_saved_state(tmp_path):
    env = gym.make("SurgSim/Palpate-v0", scene=scene_file(tmp_path, "psm_palpator", YieldingWall())).unwrapped
    press(env, 10)
    state = env.save_state()
    ahead = [env.step(ACTION) for _ in range(5)]
    env.load_state(state)
    for seen, *_, info in ahead:
        again, *_, info_again = env.step(ACTION)
        assert (seen == again).all() and info["trocar_force"] == info_again["trocar_force"]


def test_each_of_two_arms_has_its_wall(tmp_path):
    scene = make_scene("lobe")
    left, right = scene.ports
    scene = replace(scene, ports=(replace(left, wall=YieldingWall()), right))
    (tmp_path / "walled.toml").write_text(as_toml(scene))
    env = gym.make("SurgSim/BimanualRetract-v0", scene=str(tmp_path / "walled.toml"))
    _, info = env.reset(seed=0)
    pair = env.unwrapped.simulation.instrument
    assert pair.arms["left"].trocar_force is not None and pair.arms["right"].trocar_force is None
    assert 0.0 <= info["trocar_force"] < 1.0


def test_wrong_walls_are_refused(lever):
    with pytest.raises(ValueError, match=r"wall\.mass is 0"):
        YieldingWall(mass=0.0)
    with pytest.raises(ValueError, match=r"wall\.friction is -1"):
        YieldingWall(friction=-1.0)
    with pytest.raises(ValueError, match="at most mass"):
        load_arm(lever, Port(wall=YieldingWall(stiffness_across=1e6)))
