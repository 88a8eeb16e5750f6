"""A mistake in an arm of one's own is named."""

import os

import numpy as np
import pytest

from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments.arm.arm import load_arm
from surgsim_env.instruments.arm.model import FILE_SIZE_MOST
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import list_arms, make_scene, scenes_folder
from surgsim_env.scene.model import Port

INSTRUMENTS = scenes_folder() / "instruments"

URDF = """<robot name="stick">
  <link name="base">
    <collision name="foot"><geometry><cylinder radius="0.03" length="0.1"/></geometry></collision></link>
  <link name="swing">
    <inertial><mass value="0.5"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry>VISUAL</geometry></visual>
  </link>
  <link name="stick">
    <inertial><origin xyz="0 0 -0.1"/><mass value="0.2"/>
      <inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision name="ball"><origin xyz="0 0 -0.2"/><geometry><sphere radius="0.006"/></geometry></collision>
  </link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="swing"/><axis xyz="1 0 0"/>
    <limit lower="-0.8" upper="0.8" effort="10" velocity="2"/></joint>
  <joint name="slide" type="prismatic"><parent link="swing"/><child link="stick"/><axis xyz="0 0 -1"/>
    <limit lower="0" upper="0.2" effort="20" velocity="0.3"/></joint>
</robot>
"""
URDF_TABLE = """
model = "stick.urdf"
kind = "palpator"
joints = ["turn", "slide"]
contact = ["ball"]
[tip]
body = "stick"
offset = [0.0, 0.0, -0.2]
direction = [0.0, 0.0, -1.0]
ball = "ball"
[trocar]
shaft_body = "stick"
shaft_axis = [0.0, 0.0, -1.0]
fixed = true
[control]
mode = "servo"
speed_limit = [1.0, 0.2]
stiffness = [200.0, 2000.0]
damping = [10.0, 60.0]
effort = [10.0, 20.0]
[home]
turn = 0.1
slide = 0.05
"""


def written(folder, table, model, name="mine", model_name=None):
    (folder / f"{name}.toml").write_text(table)
    if model is not None:
        (folder / (model_name or "psm_palpator.xml")).write_text(model)
    return folder / f"{name}.toml"


def texts(name="psm_palpator"):
    return (INSTRUMENTS / f"{name}.toml").read_text(), (INSTRUMENTS / f"{name}.xml").read_text()


def swap(text, old, new):
    assert old in text, old
    return text.replace(old, new)


def test_the_shipped_arms_are_listed_and_load():
    assert list_arms() == ["psm_grasper", "psm_palpator", "psm_retractor", "six_axis"]
    for name in list_arms():
        assert load_arm(name).description.name == name


# What is changed in psm_palpator.toml, and what the message names.
TABLES = [
    ('kind = "palpator"', 'kind = "palpater"', "'palpater'"),
    ('kind = "palpator"', 'kind = "grasper"', "jaw"),
    ('kind = "palpator"\n', "", '"kind"'),
    ("speed_limit = [", "speed_limits = [", "'speed_limits'"),
    ("speed_limit = [2.0, 2.0, ", "speed_limit = [2.0, ", "speed_limit has 5"),
    ("speed_limit = [2.0", "speed_limit = [0.0", "'yaw' is 0"),
    ('mode = "position"', 'mode = "servo"', "stiffness"),
    ('joints = ["yaw",', 'joints = ["yaww",', "'yaww'"),
    ('contact = ["tip_ball"', 'contact = ["tipball"', "'tipball'"),
    ('contact = ["tip_ball"', 'contact = ["tip_ball", "rail"', "'rail'"),
    ('site = "tip"', 'site = "tipp"', "'tipp'"),
    ('site = "tip"\n', "", "tip.site"),
    ('shaft_body = "roll"', 'shaft_body = "rolled"', "'rolled'"),
    ("fixed = true", "fixed = true\npoint = [0.02, 0.0, 0.0]", "20 mm"),
    ("tolerance = 1e-9", "tolerance = nan", "tolerance is nan"),
    ("insertion = 0.0865", "insertion = 0.3", "'insertion' is 0.3"),
    ("wrist_yaw = 0.0", "wrist_jaw = 0.0", "'wrist_yaw'"),
    ('model = "psm_palpator.xml"', 'model = "nothing.xml"', r"nothing\.xml"),
]


@pytest.mark.parametrize(("old", "new", "named"), TABLES)
def test_a_mistake_in_the_table_is_named(tmp_path, old, new, named):
    table, model = texts()
    assert_refused(written(tmp_path, swap(table, old, new), model), named)


def assert_refused(path, named):
    with pytest.raises(ValueError, match=named) as refusal:
        load_arm(path)
    assert str(refusal.value).startswith(("arm 'mine'", "arm file"))


# What is changed in psm_palpator.xml, and what the message names.
MODELS = [
    ('<site name="tip"', '<site name="wrist"', "'wrist'"),
    ('range="0 0.24"', 'range="0.24 0.01"', "'insertion'"),
    ('range="0 0.24"', "", "'insertion'"),
    ('<position name="hold_roll" joint="roll" kp="6"/>', "", "'roll'"),
    ('name="hold_roll" joint="roll"', 'name="hold_roll" joint="roll" gear="2"', "'roll'"),
    ('name="neck" type="capsule"', 'name="neck" type="cylinder"', "'neck'"),
    ("</mujoco>", "", "XML"),
]


@pytest.mark.parametrize(("old", "new", "named"), MODELS)
def test_a_mistake_in_the_model_is_named(tmp_path, old, new, named):
    table, model = texts()
    assert_refused(written(tmp_path, table, swap(model, old, new)), named)


def test_a_floating_base_is_refused(tmp_path):
    table, model = texts()
    cart = '<worldbody><body name="cart"><freejoint name="loose"/><geom size="0.1"/></body>'
    assert_refused(written(tmp_path, table, swap(model, "<worldbody>", cart)), "'loose'")


def test_a_home_that_misses_the_trocar_is_refused(tmp_path):
    """0.01 rad of the shoulder move the shaft, 0.45 m to 0.7 m away, by some millimetres."""
    table, model = texts("six_axis")
    table = swap(table, "shoulder_pan = 0.0", "shoulder_pan = 0.01")
    path = written(tmp_path, table, model, model_name="six_axis.xml")
    assert_refused(path, r"[3-6]\.\d+ mm")


def test_a_remote_centre_that_is_none_is_refused(tmp_path):
    table, model = texts("six_axis")
    path = written(tmp_path, swap(table, "fixed = false", "fixed = true"), model, model_name="six_axis.xml")
    assert_refused(path, "fixed")


def test_unknown_arms_and_files_are_named(tmp_path):
    with pytest.raises(ValueError, match="'psm_palpator'"):
        load_arm("psm_palpato")
    with pytest.raises(ValueError, match=r"none\.toml"):
        load_arm(tmp_path / "none.toml")


def test_an_arm_beside_its_scene_file_is_found(tmp_path):
    table, model = texts()
    written(tmp_path, table, model)
    scene = (scenes_folder() / "organs" / "phantom.toml").read_text()
    (tmp_path / "scene.toml").write_text(swap(scene, 'model = "probe.xml"', 'model = "mine.toml"'))
    instrument = Simulation(load_anatomy(make_scene(tmp_path / "scene.toml"))).instrument
    assert instrument.arm.description.folder == tmp_path  # type: ignore[attr-defined]


def test_ports_are_checked():
    with pytest.raises(ValueError, match="nan"):
        Port((0.0, np.nan, 0.0))
    with pytest.raises(ValueError, match="into"):
        Port(into=(0.0, 0.0, 0.0))


def test_a_urdf_is_read_with_its_tip_from_the_table(tmp_path):
    urdf = swap(URDF, "VISUAL", '<sphere radius="0.02"/>')
    arm = load_arm(written(tmp_path, URDF_TABLE, urdf, model_name="stick.urdf"), Port((0.1, 0.2, 0.3)))
    # Turned about x by q the stick hangs along (0, sin q, -cos q); the tip is 0.2 m and the slide beyond.
    tip = arm.tip_pose([0.3, 0.07]).position
    assert tip == pytest.approx(
        np.array([0.1, 0.2, 0.3]) + 0.27 * np.array([0.0, np.sin(0.3), -np.cos(0.3)]), abs=1e-12
    )
    assert arm.trocar_residual([0.3, 0.07]) < 1e-12
    assert arm.shape_names == ["ball"]
    assert (arm.model.geom_contype == 0).all() and (arm.model.body_gravcomp[1:] == 1.0).all()
    assert tuple(arm.upper) == (0.8, 0.2)


def test_missing_meshes_are_named(tmp_path):
    urdf = swap(URDF, "VISUAL", '<mesh filename="package://stick/meshes/swing.stl"/>')
    path = written(tmp_path, URDF_TABLE, urdf, model_name="stick.urdf")
    assert_refused(path, r"swing\.stl")


def test_a_model_file_that_is_too_large_is_refused_unread(tmp_path):
    path = written(tmp_path, *texts())
    os.truncate(tmp_path / "psm_palpator.xml", FILE_SIZE_MOST + 1)
    assert_refused(path, "200000001")
