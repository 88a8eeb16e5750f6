"""Arms made from model files alone: `find_arm` and `surgsim arm check`, on files with the faults of public ones."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import trimesh

import surgsim_env  # noqa: F401  (registers the environments)
from surgsim_apps.arms.find_arm import find_arm, joint_inertia
from surgsim_apps.cli.main import main
from surgsim_env.instruments.arm.arm import load_arm
from surgsim_env.instruments.arm.model import hold_joints, read_model
from surgsim_env.instruments.arm.urdf import mesh_files
from surgsim_env.scene.arm_description import AddedShape, LinkInertia, read_description
from surgsim_env.scene.load import scenes_folder
from surgsim_env.scene.save import as_toml

SIX_AXIS = scenes_folder() / "instruments" / "six_axis.xml"
# An arm with a remote centre at (0, 0, 0.3): yaw about x, pitch about y, insertion along -z, roll, and a bent wrist.
# Its faults: moments of inertia of zero or none at all, meshes by a package whose folder is elsewhere, two meshes of
# one name in two folders, no sphere or capsule, no actuator, a joint without limits, joints that follow others.
ZERO = '<inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/>'
URDF = f"""<robot name="scope">
  <link name="base"><inertial><mass value="2"/>{ZERO}</inertial>
    <visual><geometry><mesh filename="package://scope/meshes/visual/base.stl"/></geometry></visual>
    <collision><geometry><mesh filename="package://scope/meshes/collision/base.stl"/></geometry></collision></link>
  <link name="yawed"><inertial><origin xyz="0 0 0.1"/><mass value="1.2"/>{ZERO}</inertial>
    <visual><geometry><mesh filename="package://scope/meshes/visual/block.stl"/></geometry></visual></link>
  <joint name="yaw" type="revolute"><origin xyz="0 0 0.3"/><parent link="base"/><child link="yawed"/><axis xyz="1 0 0"/>
    <limit lower="-1.2" upper="1.2" effort="40" velocity="1.5"/></joint>
  <link name="pitched"><inertial><mass value="0.5"/>{ZERO}</inertial></link>
  <joint name="pitch" type="revolute"><parent link="yawed"/><child link="pitched"/><axis xyz="0 1 0"/>
    <limit lower="-0.8" upper="0.8" effort="40" velocity="1.5"/></joint>
  <link name="weight"><inertial><mass value="0.5"/>{ZERO}</inertial></link>
  <joint name="counter" type="revolute"><origin xyz="0 0.1 0"/><parent link="yawed"/><child link="weight"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/>
    <mimic joint="pitch" multiplier="-1"/></joint>
  <link name="carriage"/>
  <joint name="insertion" type="prismatic"><origin xyz="0 0 0.25"/><parent link="pitched"/><child link="carriage"/>
    <axis xyz="0 0 -1"/><limit lower="0" upper="0.2" effort="20" velocity="0.3"/></joint>
  <link name="rolled"/>
  <joint name="roll" type="continuous"><origin xyz="0 0 -0.22"/><parent link="carriage"/><child link="rolled"/>
    <axis xyz="0 0 -1"/></joint>
  <link name="wrist"><inertial><mass value="0.01"/>
    <inertia ixx="1e-9" iyy="1e-6" izz="1e-6" ixy="1e-6" ixz="0" iyz="0"/></inertial></link>
  <joint name="bend" type="revolute"><parent link="rolled"/><child link="wrist"/><axis xyz="0 1 0"/>
    <limit lower="-1.3" upper="1.3" effort="1" velocity="3"/></joint>
  <link name="finger_1"/><link name="finger_2"/><link name="tool_tip"/>
  <joint name="open_1" type="revolute"><parent link="wrist"/><child link="finger_1"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="open_2" type="revolute"><parent link="wrist"/><child link="finger_2"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/><mimic joint="open_1" multiplier="-1"/></joint>
  <joint name="fix" type="fixed"><origin xyz="0 0 -0.015"/><parent link="wrist"/><child link="tool_tip"/></joint>
</robot>"""
CENTRE = np.array([0.0, 0.0, 0.3])
BLOCK = np.array([0.1, 0.2, 0.3])


@pytest.fixture
def scope(tmp_path: Path) -> Path:
    """The URDF in scope/urdf with its meshes in scope/meshes, as in a ROS package."""
    for kind in ("visual", "collision"):
        (tmp_path / "scope" / "meshes" / kind).mkdir(parents=True)
        trimesh.creation.box((0.3, 0.2, 0.1)).export(tmp_path / "scope" / "meshes" / kind / "base.stl")
    trimesh.creation.box(BLOCK).export(tmp_path / "scope" / "meshes" / "visual" / "block.stl")
    (tmp_path / "scope" / "urdf").mkdir()
    path = tmp_path / "scope" / "urdf" / "scope.urdf"
    path.write_text(URDF)
    return path


@pytest.fixture(scope="module")
def bare_six_axis(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The six-axis arm without its tool: nothing straight, no site, no ball."""
    tree = ElementTree.parse(SIX_AXIS)
    hand = next(body for body in tree.iter("body") if body.get("name") == "wrist_3")
    for part in [*hand.findall("site"), *hand.findall("geom")]:
        if part.tag == "site" or part.get("name") is not None or part.get("size") == "0.018":
            hand.remove(part)
    for sensors in tree.getroot().findall("sensor"):
        tree.getroot().remove(sensors)
    path = tmp_path_factory.mktemp("bare") / "bare.xml"
    tree.write(path)
    return path


# ---- an arm with a remote centre, from a URDF with faults --------------------------------------------------------


def test_a_faulty_urdf_becomes_an_arm_with_its_remote_centre(scope):
    arm_model = find_arm(scope)
    arm = load_arm(arm_model.description)
    assert arm_model.description.joints == ("yaw", "pitch", "insertion", "roll", "bend")
    assert arm_model.description.trocar.fixed
    np.testing.assert_allclose(arm_model.description.trocar.point, CENTRE, atol=1e-9)
    # The tip is 10 cm past the centre along the shaft, the wrist straight.
    np.testing.assert_allclose(arm.tip_pose(arm.home).position, [0.0, 0.0, -0.1], atol=1e-8)
    np.testing.assert_allclose(arm.tip_direction(arm.home), [0.0, 0.0, -1.0], atol=1e-8)
    assert arm_model.reach == 1.0


def test_its_tip_follows_the_closed_form(scope):
    # Yaw about x, pitch about y, insertion q3: the wrist is q3 - 0.25 + 0.22 past the centre, the tip 15 mm beyond.
    arm = load_arm(find_arm(scope).description)
    yaw, pitch, insertion = 0.3, -0.4, 0.12
    depth = insertion - 0.25 + 0.22 + 0.015
    straight = np.array([-math.sin(pitch), 0.0, -math.cos(pitch)]) * depth
    expected = [straight[0], -math.sin(yaw) * straight[2], math.cos(yaw) * straight[2]]
    np.testing.assert_allclose(arm.tip_pose([yaw, pitch, insertion, 0.7, 0.0]).position, expected, atol=1e-9)


def test_meshes_of_a_package_are_found_and_drawn(scope):
    arm_model = find_arm(scope)
    model = load_arm(arm_model.description).model
    assert not arm_model.description.dropped_meshes
    assert model.nmesh == 3
    # MuJoCo turns a mesh into its principal axes.
    sizes = np.array([np.sort(np.ptp(vertices(model, mesh), axis=0)) for mesh in range(3)])
    np.testing.assert_allclose(sizes, [[0.1, 0.2, 0.3]] * 3, atol=1e-6)


def vertices(model: mujoco.MjModel, mesh: int) -> np.ndarray:
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    return model.mesh_vert[first : first + count]


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("package://scope/meshes/link.stl", "scope/meshes/link.stl"),
        ("package://scope/meshes/link.stl", "link.stl"),
        ("/home/them/ws/meshes/link.stl", "scope/meshes/link.stl"),
        ("link.stl", "scope/urdf/parts/link.stl"),
    ],
)
def test_a_mesh_is_found_where_folders_differ(tmp_path, name, place):
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / place).write_text("solid")
    (tmp_path / "scope/urdf").mkdir(parents=True, exist_ok=True)
    block = '<mujoco><compiler meshdir="parts"/></mujoco>'
    root = ElementTree.fromstring(f'<robot name="scope">{block}<mesh filename="{name}"/></robot>')
    mesh = mesh_files(root, tmp_path / "scope/urdf/arm.urdf")[name]
    assert mesh is not None
    assert mesh.samefile(tmp_path / place)


def test_missing_meshes_are_named_and_left_out(scope):
    (scope.parents[1] / "meshes" / "visual" / "block.stl").unlink()
    arm_model = find_arm(scope)
    assert arm_model.description.dropped_meshes == ("package://scope/meshes/visual/block.stl",)
    assert any("visual/block.stl" in sentence for sentence in arm_model.chosen)
    assert load_arm(arm_model.description).model.nmesh == 2


def test_missing_inertias_are_those_of_a_block_around_the_shapes(scope):
    arm_model = find_arm(scope)
    inertias = {inertia.link: inertia for inertia in arm_model.description.inertias}
    # m (b^2 + c^2) / 12 about the axis a.
    square = BLOCK**2
    np.testing.assert_allclose(inertias["yawed"].moments, 1.2 / 12.0 * (square.sum() - square), rtol=1e-6)
    assert inertias["yawed"].centre == (0.0, 0.0, 0.1)
    # The wrist's matrix is not positive definite; links without any inertia are moved by joints.
    assert {"wrist", "carriage", "rolled", "pitched"} <= inertias.keys()
    assert any("yawed" in sentence for sentence in arm_model.chosen)
    model = load_arm(arm_model.description).model
    np.testing.assert_allclose(np.sort(model.body("yawed").inertia), np.sort(inertias["yawed"].moments), rtol=1e-6)


def test_servos_have_the_stated_frequency_and_damping(scope):
    arm = load_arm(find_arm(scope).description)
    control, inertia = arm.description.control, joint_inertia(arm, arm.home)
    frequency = np.sqrt(np.array(control.stiffness) / inertia)
    np.testing.assert_allclose(frequency, 2.0 * math.pi * 30.0, rtol=1e-3)
    np.testing.assert_allclose(np.array(control.damping) / (2.0 * inertia * frequency), 1.0, rtol=1e-3)
    assert control.speed_limit[:3] == (1.5, 1.5, 0.3)
    assert control.effort[0] == 40.0


@pytest.mark.parametrize("leader", ["pitch", "counter"])
def test_what_is_coupled_to_a_driven_joint_is_held_where_it_is_at_home(scope, leader):
    # Of a pitch that cannot be 0 home has another value, and the counterweight the opposite one.
    text = URDF.replace('lower="-0.8"', 'lower="0.2"')
    if leader == "counter":
        text = text.replace('<mimic joint="pitch" multiplier="-1"/>', "")
        pitch = '<joint name="pitch" type="revolute">'
        text = text.replace(pitch, f'{pitch}<mimic joint="counter" multiplier="-1"/>')
    scope.write_text(text)
    description = find_arm(scope).description
    assert description.home["pitch"] >= 0.2
    assert description.held["counter"] == pytest.approx(-description.home["pitch"], abs=1e-9)
    assert set(description.held) == {"counter", "open_1", "open_2"}
    assert {load_arm(description).model.joint(index).name for index in range(5)} == set(description.joints)


@pytest.mark.parametrize(
    ("open_1", "mimic", "values"),
    [
        ("-1", '<mimic joint="open_1" offset="0.3"/>', (0.0, 0.3)),
        ("0.2", '<mimic joint="open_1" multiplier="-2" offset="0.1"/>', (0.2, -0.3)),
    ],
)
def test_held_joints_keep_their_couplings(scope, open_1, mimic, values):
    text = URDF.replace('<mimic joint="open_1" multiplier="-1"/>', mimic)
    first, second = text.split('<joint name="open_1"')
    second = second.replace('lower="-1"', f'lower="{open_1}"', 1)
    scope.write_text(f'{first}<joint name="open_1"{second}')
    held = find_arm(scope).description.held
    assert (held["open_1"], held["open_2"]) == pytest.approx(values, abs=1e-9)


def test_its_file_reads_back_equal(scope):
    description = find_arm(scope).description
    path = scope.parent / "scope.toml"
    path.write_text(as_toml(description))
    assert read_description(path) == description


def test_it_presses_like_the_probe(scope):
    path = scope.parent / "scope.toml"
    path.write_text(as_toml(find_arm(scope).description))
    peaks = []
    for instrument in ("probe", str(path)):
        env: Any = gym.make("SurgSim/Palpate-v0", scene="phantom", instrument=instrument)
        env.reset(seed=0)
        force, error = 0.0, 0.0
        for _ in range(14):
            *_, info = env.step([0.0, 0.0, -0.5, 0.0])
            force = max(force, float(np.linalg.norm(env.unwrapped.simulation.contact_wrench[:, :3])))
            error = max(error, info.get("trocar_error_mm", 0.0))
        peaks.append(force)
        env.close()
        assert error < 1e-3
    assert peaks[0] > 0.01
    # The servos give way by 5 N / 0.1 mm at each of five joints, the contact by far less than the tissue.
    assert peaks[1] == pytest.approx(peaks[0], rel=0.05)


# ---- arms without a remote centre, from MJCF ---------------------------------------------------------------------


def test_a_tool_of_the_model_is_used_as_it_is():
    description = find_arm(SIX_AXIS).description
    assert description.contact == ("tip_ball", "neck", "shaft")
    assert description.tip.ball == "tip_ball"
    assert description.trocar.shaft_body == "wrist_3"
    np.testing.assert_allclose(np.abs(description.trocar.shaft_axis), [0.0, 1.0, 0.0], atol=1e-9)
    assert "fore_link" in description.links


def test_an_arm_without_a_tool_gets_a_palpator_on_its_last_axis(bare_six_axis):
    arm_model = find_arm(bare_six_axis)
    description = arm_model.description
    arm = load_arm(description)
    assert description.trocar.shaft_body == "wrist_3"
    # The flange is 75 mm along the last hinge's axis, the tool 400 mm long.
    np.testing.assert_allclose(description.tip.offset, [0.0, 0.475, 0.0], atol=1e-6)
    assert any("400 mm" in sentence for sentence in arm_model.chosen)
    assert arm.trocar_residual(arm.home) < 1e-5
    near, along = arm.shaft_line(arm.home)
    assert (arm.tip_pose(arm.home).position - near) @ along == pytest.approx(0.1, abs=1e-6)
    assert arm_model.reach > 0.5


def test_a_given_trocar_gets_a_home(bare_six_axis):
    arm_model = find_arm(bare_six_axis, trocar=(0.36, 0.13, 0.12), tool_length=0.3)
    assert arm_model.description.trocar.point == (0.36, 0.13, 0.12)
    arm = load_arm(arm_model.description)
    assert arm.trocar_residual(arm.home) < 1e-5


@pytest.mark.parametrize(
    ("options", "named"), [({"trocar": (5.0, 0.0, 0.0)}, r"\(5\.0, 0\.0, 0\.0\)"), ({"tip": "wrist_4"}, "'wrist_4'")]
)
def test_what_is_not_possible_is_refused(bare_six_axis, options, named):
    with pytest.raises(ValueError, match=named):
        find_arm(bare_six_axis, **options)


def test_servos_replace_the_models_actuators_and_its_limits_on_them(tmp_path):
    text = SIX_AXIS.read_text().replace("<default>", '<default><position ctrlrange="-1 1"/>', 1)
    text = text.replace("<sensor>", '<actuator><position name="own" joint="elbow" kp="9"/></actuator><sensor>')
    (tmp_path / "arm.xml").write_text(text)
    arm = load_arm(find_arm(tmp_path / "arm.xml").description)
    assert arm.description.control.mode == "servo"
    assert arm.model.nu == 2 * arm.joint_count
    assert not arm.model.actuator_ctrllimited.any()


# ---- parts of a description -------------------------------------------------------------------------------------

HINGED = """<mujoco><worldbody><body name="arm" pos="0.1 0.2 0.3" quat="0.5 0.5 -0.5 0.5">
  <joint name="moved" type="TYPE" axis="1 2 0.5" pos="0.05 -0.02 0.01"/><geom name="g" size="0.01" pos="0.3 0.1 0"/>
  </body></worldbody></mujoco>"""


@pytest.mark.parametrize("kind", ["hinge", "slide"])
def test_a_held_joint_stays_where_it_would_be(tmp_path, kind):
    (tmp_path / "arm.xml").write_text(HINGED.replace("TYPE", kind))
    spec = read_model(tmp_path / "arm.xml")
    free = spec.copy().compile()
    data = mujoco.MjData(free)
    data.qpos[0] = 0.7
    mujoco.mj_kinematics(free, data)
    hold_joints(spec, {"moved": 0.7})
    held = spec.compile()
    still = mujoco.MjData(held)
    mujoco.mj_kinematics(held, still)
    assert held.njnt == 0
    np.testing.assert_allclose(still.geom("g").xpos, data.geom("g").xpos, atol=1e-12)
    np.testing.assert_allclose(still.body("arm").xmat, data.body("arm").xmat, atol=1e-12)


def described(scope: Path, **changes):
    return replace(find_arm(scope).description, **changes)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"dropped_meshes": ("block.stl",)}, "'block.stl'"),
        ({"inertias": (LinkInertia("wirst", 1.0, (0, 0, 0), (1, 1, 1)),)}, "'wirst'"),
        ({"shapes": (AddedShape("tip_ball", "nose", (0, 0, 0), 0.01),)}, "'nose'"),
        ({"held": {"lost": 0.0}}, "'lost'"),
    ],
)
def test_what_is_not_in_the_model_is_refused(scope, changes, named):
    with pytest.raises(ValueError, match=named):
        load_arm(described(scope, **changes))


def test_a_held_joint_is_not_driven(scope):
    with pytest.raises(ValueError, match="'yaw'"):
        described(scope, held={"yaw": 0.0})


# ---- the command -------------------------------------------------------------------------------------------------


def test_the_command_writes_a_commented_file_and_a_picture(scope, capsys):
    assert main(["arm", "check", str(scope)]) == 0
    output = capsys.readouterr().out
    path = scope.parent / "scope.toml"
    arm = load_arm(path)
    assert arm.home == pytest.approx(load_arm(find_arm(scope).description).home, abs=1e-9)
    assert "remote centre" in output
    assert "warning: links without a valid inertia" in output
    begun = ("model", "[trocar", "tolerance", "stiff")
    entries = [line for line in path.read_text().splitlines() if line.startswith(begun)]
    assert len(entries) == 4
    assert all("#" in line for line in entries)
    assert (scope.parent / "scope.png").exists() or "no picture: " in output
