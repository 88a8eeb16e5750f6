"""Arms with joints that follow others: a parallelogram that keeps its shaft in a point, from URDF and MJCF files."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import surgsim_env  # noqa: F401  (registers the environments)
from surgsim_apps.arms.find_arm import find_arm, joint_inertia
from surgsim_apps.arms.joint_search import Wanted, search_joints
from surgsim_apps.arms.kinematics import BatchKinematics
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments.arm.arm import Arm, load_arm
from surgsim_env.instruments.arm.inverse_kinematics import reach_pose
from surgsim_env.instruments.arm.pair import Pair
from surgsim_env.instruments.joint_couplings import joint_couplings
from surgsim_env.instruments.tool_bodies import ToolBodies
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.model import Port
from surgsim_env.scene.save import as_toml
from tests.instruments.joints import random_joints
from tests.instruments.pair_scene import LEFT, RIGHT, pair_anatomy

CENTRE = np.array([0.0, 0.0, 0.3])
INERTIAL = '<inertial><mass value="0.5"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
MINUS, PLUS = '<mimic joint="pitch" multiplier="-1"/>', '<mimic joint="pitch" multiplier="1"/>'


def joint(name, parent, child, place, axis, limits, mimic="", kind="revolute", speed=1.0):
    low, high = limits
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{place}"/><parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="{axis}"/><limit lower="{low}" upper="{high}" effort="40" velocity="{speed}"/>{mimic}</joint>'
    )


def parallelogram(
    mimic_2=MINUS, mimic_3=PLUS, mimic_1="", limits_2=(-1, 1), limits_3=(-1, 1), more="", depth=0.1, speed=1.0
):
    """A rod turns about y at (-0.3, 0, 0.3), a bar at its end turns back, a holder at the bar's end turns as the rod.

    The point 0.25 m below the holder stays at CENTRE, on the axis of the yaw, for multipliers -1 and 1.
    """
    names = ("base", "yawed", "rod", "bar", "holder", "carriage")
    return (
        '<robot name="para">'
        + "".join(f'<link name="{name}">{INERTIAL}</link>' for name in names)
        + f'<link name="shaft">{INERTIAL}<visual><origin xyz="0 0 -0.2"/><geometry><cylinder radius="0.004" '
        'length="0.4"/></geometry></visual></link><link name="tool_tip"/>'
        + joint("yaw", "base", "yawed", "0 0 0.3", "1 0 0", (-1, 1))
        + joint("pitch", "yawed", "rod", "-0.3 0 0", "0 1 0", (-0.8, 0.8), mimic_1)
        + joint("pitch_2", "rod", "bar", "0 0 0.25", "0 1 0", limits_2, mimic_2)
        + joint("pitch_3", "bar", "holder", "0.3 0 0", "0 1 0", limits_3, mimic_3, speed=speed)
        + joint("insertion", "holder", "carriage", f"0 0 {depth}", "0 0 -1", (0, 0.2), kind="prismatic")
        + joint("roll", "carriage", "shaft", "0 0 0", "0 0 -1", (-3, 3))
        + '<joint name="fix" type="fixed"><origin xyz="0 0 -0.4"/><parent link="shaft"/><child link="tool_tip"/>'
        + "</joint>"
        + more
        + "</robot>"
    )


DUMMY = f'<link name="motor">{INERTIAL}</link>' + joint("lead", "base", "motor", "0 0.3 0", "0 0 1", (-0.4, 0.5))
# Texts of the same mechanism, with the names of the driven joint and its couplings (follower: slope, offset).
MIMIC = '<mimic joint="{}" multiplier="{}" offset="{}"/>'.format
VARIANTS: dict[str, tuple[dict[str, Any], str, dict[str, tuple[float, float]]]] = {
    "both": ({}, "pitch", {"pitch_2": (-1, 0), "pitch_3": (1, 0)}),
    "of a follower": ({"mimic_3": MIMIC("pitch_2", -1, 0)}, "pitch", {"pitch_2": (-1, 0), "pitch_3": (1, 0)}),
    "leader last": (
        {"mimic_1": MIMIC("pitch_3", 1, 0), "mimic_2": MIMIC("pitch_3", -1, 0), "mimic_3": ""},
        "pitch_3",
        {"pitch": (1, 0), "pitch_2": (-1, 0)},
    ),
    "leader beside": (
        {"mimic_1": MIMIC("lead", 2, 0.1), "mimic_2": MIMIC("lead", -2, -0.1), "mimic_3": MIMIC("lead", 2, 0.1)}
        | {"more": DUMMY},
        "pitch",
        {"lead": (0.5, -0.05), "pitch_2": (-1, 0), "pitch_3": (1, 0)},
    ),
    "other numbers": (
        {"mimic_2": MIMIC("pitch", -0.5, 0.2), "mimic_3": MIMIC("pitch", 0.25, 0.3)},
        "pitch",
        {"pitch_2": (-0.5, 0.2), "pitch_3": (0.25, 0.3)},
    ),
}


def made(folder: Path, text: str, name: str = "para.urdf"):
    (folder / name).write_text(text)
    return find_arm(folder / name)


@pytest.fixture(scope="module", params=VARIANTS)
def variant(request, tmp_path_factory) -> tuple[Arm, str, str, dict[str, tuple[float, float]]]:
    """An arm in its model's own frame, its text, the joint that leads and the couplings."""
    options, leader, couplings = VARIANTS[request.param]
    text = parallelogram(**options)
    description = made(tmp_path_factory.mktemp("para"), text).description
    trocar = description.trocar
    return (
        load_arm(replace(description, trocar=replace(trocar, into=(0, 0, -1))), Port(trocar.point)),
        text,
        leader,
        couplings,
    )


def test_driven_joints_are_those_that_follow_none(variant):
    arm, _, leader, couplings = variant
    assert arm.joints == ("yaw", *(("pitch", "insertion") if leader == "pitch" else (leader, "insertion")), "roll")
    named = {arm.model.joint(joint).name: numbers for joint, *numbers in zip(*arm.followers, strict=True)}
    assert named.keys() == couplings.keys()
    for name, (driver, slope, offset) in named.items():
        assert arm.joints[driver] == leader
        assert (slope, offset) == pytest.approx(couplings[name], abs=1e-15)


def test_tip_is_that_of_the_whole_model_with_its_couplings_satisfied(variant):
    arm, text, leader, couplings = variant
    model = mujoco.MjSpec.from_string(text).compile()
    data = mujoco.MjData(model)
    for values in (arm.home, *random_joints(arm, 20)):
        place = dict(zip(arm.joints, values, strict=True))
        place |= {name: offset + slope * place[leader] for name, (slope, offset) in couplings.items()}
        for name, value in place.items():
            data.joint(name).qpos[0] = value
        mujoco.mj_forward(model, data)
        equality = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        assert np.abs(data.efc_pos[equality]).max() < 1e-12
        np.testing.assert_allclose(
            arm.tip_pose(values).position,
            data.body("shaft").xpos - 0.4 * data.body("shaft").xmat.reshape(3, 3)[:, 2],
            atol=1e-9,
        )
    whole = mujoco.MjData(arm.model)
    arm.write(whole, arm.home)
    mujoco.mj_forward(arm.model, whole)
    assert np.abs(whole.efc_pos[whole.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]).max() < 1e-9


def test_jacobians_are_the_slopes_along_the_coupled_motion(variant):
    arm, *_ = variant
    kinematics, step = BatchKinematics(arm), 1e-6
    for values in random_joints(arm, 5, margin=0.01):
        aside = step * np.eye(arm.joint_count)
        tips = [[arm.tip_pose(values + sign * row).position for row in aside] for sign in (1.0, -1.0)]
        slopes = (np.array(tips[0]) - tips[1]).T / (2.0 * step)
        np.testing.assert_allclose(arm.tip_jacobian(values)[:3], slopes, atol=1e-8)
        chain = kinematics.at(values[None])
        np.testing.assert_allclose(chain.tip[0], arm.tip_pose(values).position, atol=1e-13)
        np.testing.assert_allclose(chain.shape_ends[0], arm.shape_ends(values), atol=1e-13)
        np.testing.assert_allclose(
            np.concatenate(kinematics.tip_jacobian(chain), axis=1)[0], arm.tip_jacobian(values), atol=1e-13
        )
        near = [[arm.shaft_line(values + sign * row)[0] for row in aside] for sign in (1.0, -1.0)]
        along = arm.shaft_line(values)[1]
        across = np.eye(3) - np.outer(along, along)
        moved = kinematics.shaft_jacobian(chain)[0]
        if arm.trocar_residual(values) < 1e-9:
            np.testing.assert_allclose(
                across @ moved, across @ (np.array(near[0]) - near[1]).T / (2.0 * step), atol=1e-7
            )


def test_tools_yield_as_the_coupled_mechanism_does(variant):
    """J Z (Z^T (M + dt D) Z)^-1 Z^T J^T, with the speeds Z of all joints for unit speeds of the driven ones."""
    arm, *_ = variant
    model, tools = arm.model, ToolBodies(arm.model)
    arm.write(tools.data, arm.home)
    mujoco.mj_forward(model, tools.data)
    tools.read_response()
    speeds = np.zeros((model.nv, arm.joint_count))
    speeds[arm.dof, np.arange(arm.joint_count)] = 1.0
    for follower, driver, slope, _ in zip(*arm.followers, strict=True):
        speeds[model.jnt_dofadr[follower], driver] = slope
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, tools.data, inertia)
    np.testing.assert_allclose(joint_inertia(arm, arm.home), np.diag(speeds.T @ inertia @ speeds), rtol=1e-12)
    damping = np.diag(np.append(arm.description.control.damping, np.zeros(model.nv - arm.joint_count)))
    order = [*arm.dof, *(model.jnt_dofadr[follower] for follower in arm.followers.joints)]
    inertia[np.ix_(order, order)] += model.opt.timestep * damping
    coupled = np.linalg.inv(speeds.T @ inertia @ speeds)
    for tool in range(tools.tool_count):
        own = tools.jacobian(tool) @ speeds
        expected = own @ coupled @ own.T
        # The couplings' stiffness in the response is finite: 1e6 times the joints' inertia.
        np.testing.assert_allclose(
            tools.response.tool_mobility[tool, tool], expected, atol=1e-5 * np.abs(expected).max()
        )


def test_the_parallelogram_keeps_its_shaft_in_a_point(tmp_path):
    arm_model = made(tmp_path, parallelogram())
    assert arm_model.description.trocar.fixed
    np.testing.assert_allclose(arm_model.description.trocar.point, CENTRE, atol=1e-9)
    assert arm_model.reach == 1.0
    arm = load_arm(arm_model.description)
    tips = arm.trocar + np.array([[0.03, 0.02, -0.1], [-0.02, 0.0, -0.08]])
    assert all(reach_pose(arm, tip).reached for tip in tips)
    found = search_joints(BatchKinematics(arm), Wanted(tips), np.tile(arm.home, (2, 1)))
    assert (found.position_error < 1e-7).all()


def test_home_of_an_insertion_that_ends_deep_is_where_its_tip_reaches(tmp_path):
    # The tip is 0.4 - 0.25 m past the centre at least, and 0.2 m more at most.
    arm_model = made(tmp_path, parallelogram(depth=0.0))
    arm = load_arm(arm_model.description)
    assert 0.15 < np.linalg.norm(arm.tip_pose(arm.home).position - arm.trocar) < 0.35
    assert arm_model.reach == 1.0


@pytest.mark.parametrize(("multiplier", "fixed"), [("1.01", True), ("1.5", False)])
def test_a_mechanism_that_nearly_keeps_its_shaft_states_by_how_much(tmp_path, multiplier, fixed):
    description = made(tmp_path, parallelogram(mimic_3=MIMIC("pitch", multiplier, 0))).description
    assert description.trocar.fixed == fixed
    if fixed:
        arm = load_arm(description)
        missed = max(arm.trocar_residual(values) for values in random_joints(arm, 300))
        assert 1e-4 < missed <= description.trocar.tolerance <= 2.0 * missed


@pytest.mark.parametrize(
    ("options", "limits"),
    [
        ({"limits_2": (-0.3, 0.5)}, (-0.5, 0.3)),
        ({"limits_3": (-0.3, 0.5)}, (-0.3, 0.5)),
        ({"limits_3": (-0.3, 0.5), "mimic_3": MIMIC("pitch", 2, 0.1)}, (-0.2, 0.2)),
        ({"limits_3": (-0.3, 0.5), "mimic_3": MIMIC("pitch_2", -1, 0.1)}, (-0.4, 0.4)),
        ({"limits_2": (-9, 9), "limits_3": (-9, 9)}, (-0.8, 0.8)),
        ({"mimic_1": MIMIC("lead", -1, 0.2), "more": DUMMY, "mimic_2": MINUS}, (-0.3, 0.6)),
    ],
)
def test_limits_of_followers_are_their_leaders(tmp_path, options, limits):
    description = made(tmp_path, parallelogram(**options)).description
    for arm in (load_arm(description), load_arm(replace(description, limits={}))):
        place = arm.joints.index("pitch")
        assert (arm.lower[place], arm.upper[place]) == pytest.approx(limits, abs=1e-9)


@pytest.mark.parametrize(
    ("options", "held"),
    [
        ({"limits_3": (0.1, 0.1)}, {"pitch": 0.1, "pitch_2": -0.1, "pitch_3": 0.1}),
        ({"limits_3": (0.1, 0.1), "mimic_3": MIMIC("pitch", 2, 0.3)}, {"pitch": -0.1, "pitch_2": 0.1, "pitch_3": 0.1}),
        ({"mimic_2": MIMIC("pitch", 0, 0.2), "mimic_3": MIMIC("pitch", 0, -0.2)}, {"pitch_2": 0.2, "pitch_3": -0.2}),
    ],
)
def test_a_follower_that_cannot_move_is_held_with_its_leader(tmp_path, options, held):
    description = made(tmp_path, parallelogram(**options)).description
    assert description.held == pytest.approx(held, abs=1e-9)
    assert description.joints == ("yaw", *["pitch"] * ("pitch" not in held), "insertion", "roll")


def test_a_joint_before_a_remote_centre_is_held(tmp_path):
    text = parallelogram().replace('link="base"/><child link="yawed"', 'link="turned"/><child link="yawed"')
    wrist = "".join(f'<link name="wrist_{n}">{INERTIAL}</link>' for n in (1, 2))
    wrist += joint("bend", "shaft", "wrist_1", "0 0 -0.4", "1 0 0", (-1, 1))
    wrist += joint("sway", "wrist_1", "wrist_2", "0 0 -0.01", "0 1 0", (-1, 1))
    base = f'<link name="turned">{INERTIAL}</link>' + joint("set_up", "base", "turned", "0 0.2 0", "1 0 0", (-2, 2))
    description = made(tmp_path, text.replace("</robot>", wrist + base + "</robot>")).description
    assert description.joints == ("yaw", "pitch", "insertion", "roll", "bend", "sway")
    assert description.held == {"set_up": 0.0}
    assert description.trocar.fixed
    np.testing.assert_allclose(description.trocar.point, CENTRE + np.array([0.0, 0.2, 0.0]), atol=1e-9)


def test_a_leader_is_as_fast_as_its_followers_allow(tmp_path):
    description = made(tmp_path, parallelogram(mimic_3=MIMIC("pitch", 2, 0), speed=0.5)).description
    assert description.control.speed_limit[1] == 0.25


def test_couplings_hold_in_a_press(tmp_path):
    arm_model = made(tmp_path, parallelogram())
    (tmp_path / "para.toml").write_text(as_toml(arm_model.description))
    env: Any = gym.make("SurgSim/Palpate-v0", scene="phantom_small", instrument=str(tmp_path / "para.toml"))
    env.reset(seed=0)
    simulation = env.unwrapped.simulation
    model, data = simulation.instrument.model, simulation.instrument.data
    force, apart, start = 0.0, 0.0, simulation.instrument.tip_position
    for _ in range(16):
        *_, info = env.step([0.0, 0.0, -0.5, 0.0])
        force = max(force, float(np.linalg.norm(simulation.contact_wrench[:, :3])))
        assert not info.get("sim_fault")
        assert info["trocar_error_mm"] < 1e-3
        values = data.qpos[model.jnt_qposadr]
        couplings = joint_couplings(model)
        assert len(couplings) == 2
        apart = max(apart, *(abs(values[f] - terms[0] - terms[1] * values[leader]) for f, leader, terms in couplings))
    assert force > 0.01
    # MuJoCo leaves a coupling 1e-4 of the acceleration of its joints, here below 1 rad/s^2, over two steps of 1 ms.
    assert apart < 1e-6
    # 10 mm/s for 16 steps of 50 ms; the servos lag by 0.1 mm.
    assert (start - simulation.instrument.tip_position)[2] == pytest.approx(8e-3, abs=2e-4)
    env.close()


@pytest.mark.filterwarnings("ignore:scene 'slab for two'")
def test_couplings_hold_in_a_pair(tmp_path):
    (tmp_path / "para.toml").write_text(as_toml(made(tmp_path, parallelogram()).description))
    anatomy = pair_anatomy()
    instrument = replace(anatomy.scene.instrument, model=f"psm_retractor+{tmp_path / 'para.toml'}")
    simulation = Simulation(load_anatomy(replace(anatomy.scene, instrument=instrument)))
    simulation.restart(np.stack([LEFT, RIGHT]) + np.array([0.0, 0.03, 0.02]))
    pair = simulation.instrument
    assert isinstance(pair, Pair)
    couplings, places = joint_couplings(pair.model), pair.model.jnt_qposadr
    assert len(couplings) == 2
    start = pair.arms["right"].tip_position
    for _ in range(5):
        pair.command_velocity(np.array([[0.0, 0.0, 0.0], [0.0, 0.01, 0.0]]))
        simulation.control_step(50)
        assert simulation.end_control_step(), simulation.fault
        for follower, leader, terms in couplings:
            led = terms[1] * pair.data.qpos[places[leader]]
            assert pair.data.qpos[places[follower]] == pytest.approx(led, abs=1e-6)
    # 10 mm/s for 0.25 s.
    np.testing.assert_allclose(pair.arms["right"].tip_position - start, [0, 2.5e-3, 0], atol=2e-4)


# ---- MJCF --------------------------------------------------------------------------------------------------------

MASS = '<geom size="0.01" mass="0.5"/>'
MJCF = f"""<mujoco><compiler angle="radian"/><worldbody>
  <body name="yawed" pos="0 0 0.3"><joint name="yaw" axis="1 0 0" range="-1 1"/>{MASS}
  <body name="rod" pos="-0.3 0 0"><joint name="pitch" axis="0 1 0" range="-0.8 0.8" ref="0.1"/>{MASS}
  <body name="bar" pos="0 0 0.25"><joint name="pitch_2" axis="0 1 0" range="-1 1" ref="0.3"/>{MASS}
  <body name="holder" pos="0.3 0 0"><joint name="pitch_3" axis="0 1 0" range="-1 1"/>{MASS}
  <body name="carriage" pos="0 0 0.1"><joint name="insertion" type="slide" axis="0 0 -1" range="0 0.2"/>{MASS}
  <body name="shaft"><joint name="roll" axis="0 0 -1" range="-3 3"/>
  <geom type="cylinder" fromto="0 0 0 0 0 -0.4" size="0.004"/>
  <site name="tip" pos="0 0 -0.4"/></body></body></body></body></body></body></worldbody>
  <equality><joint joint1="pitch_2" joint2="pitch" polycoef="0 -1 TERM 0 0"/>
  <joint joint1="pitch_3" joint2="pitch" polycoef="0 1 0 0 0"/></equality>
  <actuator>ACTUATORS</actuator><keyframe><key qpos="0 0.2 0.2 0.1 0.05 0" ctrl="CTRL"/></keyframe></mujoco>"""
JOINTS = ("yaw", "pitch", "pitch_2", "pitch_3", "insertion", "roll")


@pytest.mark.parametrize("driven", [JOINTS, ("pitch_2", "roll")])
def test_initial_values_count_and_followers_lose_their_actuators(tmp_path, driven):
    actuators = "".join(f'<position joint="{name}" kp="5000" kv="50"/>' for name in driven)
    text = MJCF.replace("TERM", "0").replace("ACTUATORS", actuators).replace("CTRL", " ".join("0" * len(driven)))
    description = made(tmp_path, text, "para.xml").description
    arm = load_arm(description)
    # At pitch = 0.1 the model is upright with pitch_2 = 0.3: pitch_2 = 0.3 - (pitch - 0.1), pitch_3 = pitch - 0.1.
    np.testing.assert_allclose(arm.followers.offset, [0.4, -0.1], atol=1e-15)
    np.testing.assert_allclose((arm.lower[1], arm.upper[1]), (-0.6, 0.8), atol=1e-12)
    assert description.trocar.fixed
    np.testing.assert_allclose(description.trocar.point, CENTRE, atol=1e-9)
    assert description.control.mode == ("position" if driven == JOINTS else "servo")
    targets = {arm.model.joint(joint).name for joint in arm.model.actuator_trnid[:, 0]}
    assert targets == set(arm.joints)


# ---- what is refused ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"mimic_2": MIMIC("pich", -1, 0)}, "'pich'"),
        ({"mimic_2": MIMIC("fix", -1, 0)}, "'fix'"),
        ({"mimic_2": MIMIC("pitch_3", -1, 0), "mimic_3": MIMIC("pitch_2", -1, 0)}, "'pitch_3'"),
        ({"mimic_1": MIMIC("pitch", 1, 0)}, "'pitch'.*no other joint"),
        ({"limits_2": (-0.1, -0.1), "limits_3": (0.2, 0.2)}, "'pitch_3'.*0\\.2"),
        ({"mimic_3": MIMIC("pitch", 1, 3)}, "'pitch_3'"),
    ],
)
def test_impossible_couplings_are_refused(tmp_path, options, named):
    with pytest.raises(ValueError, match=f"para.urdf.*{named}"):
        made(tmp_path, parallelogram(**options))


def test_a_polynomial_on_the_way_to_the_tip_is_refused(tmp_path):
    text = MJCF.replace("TERM", "0.2").replace("ACTUATORS", "").replace("CTRL", "")
    with pytest.raises(ValueError, match=r"'pitch_2'.*0\.2"):
        made(tmp_path, text, "para.xml")


def test_a_follower_is_not_driven(tmp_path):
    description = made(tmp_path, parallelogram()).description
    control = replace(description.control, **{
        name: (*getattr(description.control, name), 1.0)
        for name in ("speed_limit", "stiffness", "damping", "effort", "armature")
    })  # fmt: skip
    home = {**description.home, "pitch_2": 0.0}
    with pytest.raises(ValueError, match="'pitch_2'"):
        load_arm(replace(description, joints=(*description.joints, "pitch_2"), control=control, home=home))
