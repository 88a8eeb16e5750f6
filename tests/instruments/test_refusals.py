"""Every mistake in an arm of one's own gets one clear line."""

import contextlib
import os

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments.arm.arm import load_arm
from surgsim_env.instruments.arm.model import FILE_SIZE_MOST
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.arm_description import read_description
from surgsim_env.scene.load import list_arms, make_scene, scenes_folder, with_instrument
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


# What is changed in psm_palpator.toml, and what is said.
TABLES = [
    ('kind = "palpator"', 'kind = "palpater"', r"kind is 'palpater'; it must be one of palpator, grasper"),
    ('kind = "palpator"', 'kind = "grasper"', r"a grasper needs a jaw"),
    ('kind = "palpator"\n', "", r'missing value for field "kind"'),
    ("speed_limit = [", "speed_limits = [", r"entry 'speed_limits' is unknown there; did you mean 'speed_limit'"),
    ("speed_limit = [2.0, 2.0, ", "speed_limit = [2.0, ", r"speed_limit has 5 numbers for 6 joints"),
    ("speed_limit = [2.0", "speed_limit = [0.0", r"speed_limit of joint 'yaw' is 0; it must be finite and above 0"),
    ('mode = "position"', 'mode = "servo"', r"control.stiffness must be given with control.mode = 'servo'"),
    ('mode = "position"', 'mode = "position"\neffort = [1.0]', r"control.effort must be left out"),
    ('joints = ["yaw",', 'joints = ["yaw", "yaw",', r"name 'yaw' twice"),
    ('contact = ["tip_ball"', 'contact = ["tipball"', r"contact geom 'tipball' is not .*did you mean 'tip_ball'"),
    ('site = "tip"', 'body = "wrist"', r"tip body 'wrist' is not in the model; did you mean 'wrist_"),
    ('site = "tip"\n', "", r"exactly one of tip.site and tip.body"),
    ('site = "tip"', 'site = "tip"\nsite = "tip"', r"not valid TOML"),
    ("fixed = true", "fixed = true\npoint = [0.02, 0.0, 0.0]", r"passes the trocar at 20 mm, more than .* 1e-06 mm"),
    ("fixed = true", "fixed = true\nshaft_axis = [0.0, 0.0, -1.0]", r"tip has not passed the trocar"),
    ("tolerance = 1e-9", "tolerance = nan", r"trocar.tolerance is nan m"),
    ("insertion = 0.0865", "insertion = 0.3", r"home of joint 'insertion' is 0.3, outside its limits 0 to 0.24"),
    ("wrist_yaw = 0.0", "wrist_jaw = 0.0", r"home gives no value for joint 'wrist_yaw'"),
    ('model = "psm_palpator.xml"', 'model = "nothing.xml"', r"model file .*nothing.xml cannot be read: No such file"),
]


@pytest.mark.parametrize(("old", "new", "message"), TABLES)
def test_a_mistake_in_the_table_is_named(tmp_path, old, new, message):
    table, model = texts()
    assert_refused(written(tmp_path, swap(table, old, new), model), message)


def assert_refused(path, message):
    with pytest.raises(ValueError, match=message) as caught:
        load_arm(path)
    text = str(caught.value)
    assert text.startswith(("arm 'mine'", "arm file")) and "\n" not in text and len(text) < 700


FLAT = '<asset><mesh name="flat" vertex="0 0 0 1 0 0 0 1 0 1 1 0"/></asset>'
CART = '<worldbody><body name="cart"><freejoint name="loose"/><geom size="0.1"/></body>'
# What is changed in psm_palpator.xml, and what is said.
MODELS = [
    ('<site name="tip"', '<site name="wrist"', r"two parts <site> are named 'wrist'; names must differ"),
    ('range="0 0.24"', 'range="0.24 0.01"', r"the limits of joint 'insertion' cross: lower 0.24, upper 0.01"),
    ('range="0 0.24"', "", r"joint 'insertion' has no limits; give it a range"),
    ('<position name="hold_roll"', '<motor name="hold_roll"', r"unrecognized attribute: 'kp'"),
    (
        'name="hold_roll" joint="roll"',
        'name="hold_roll" joint="roll" gear="2"',
        r"'roll' has no position actuator of gear 1",
    ),
    (
        'name="hold_roll" joint="roll"',
        'name="hold_roll" joint="roll" ctrlrange="-1 1"',
        r"joint 'roll' takes -1 to 1, less than the joint's limits -4\.53786 to 4\.53786: widen its ctrlrange",
    ),
    ('name="neck" type="capsule"', 'name="neck" type="cylinder"', r"contact geom 'neck' is a cylinder; only spheres"),
    ('0.02 0" size="0.003"', '0.02 0" size="1e99"', r"size of geom 'neck' is .*the rule is at most 100 m"),
    ("</mujoco>", "", r"not valid XML"),
    ("<worldbody>", f'{FLAT}<worldbody><geom type="mesh" mesh="flat"/>', r"mesh 'flat' has coplanar vertices"),
    ("<worldbody>", CART, r"hangs on the free joint 'loose'"),
]


@pytest.mark.parametrize(("old", "new", "message"), MODELS)
def test_a_mistake_in_the_model_is_named(tmp_path, old, new, message):
    table, model = texts()
    assert_refused(written(tmp_path, table, swap(model, old, new)), message)


def test_files_that_are_too_large_are_refused_unread(tmp_path):
    path = written(tmp_path, *texts())
    (tmp_path / "link.stl").touch()
    os.truncate(tmp_path / "link.stl", FILE_SIZE_MOST + 1)
    mesh = '<asset><mesh name="link" file="link.stl"/></asset><worldbody>'
    written(tmp_path, texts()[0], swap(texts()[1], "<worldbody>", mesh))
    assert_refused(path, r"file .*link\.stl has 200000001 bytes; at most 200000000 are read")
    os.truncate(tmp_path / "psm_palpator.xml", FILE_SIZE_MOST + 1)
    assert_refused(path, r"file .*psm_palpator\.xml has 200000001 bytes")


def test_a_jaw_that_is_not_there_is_named(tmp_path):
    table, model = texts("psm_grasper")
    table = swap(table, '["finger_left", "finger_right"]', '["finger_left", "finger"]')
    path = written(tmp_path, table, model, model_name="psm_grasper.xml")
    assert_refused(path, r"jaw joint 'finger' is not in the model; did you mean 'finger_")


def test_a_home_that_misses_the_trocar_is_refused(tmp_path):
    """0.01 rad of the shoulder move the shaft, 0.45 m to 0.7 m away, by some millimetres."""
    table, model = texts("six_axis")
    table = swap(table, "shoulder_pan = 0.0", "shoulder_pan = 0.01")
    path = written(tmp_path, table, model, model_name="six_axis.xml")
    assert_refused(path, r"at home the shaft's axis passes the trocar at [3-6]\.\d+ mm, more than .* 0.01 mm")


def test_a_remote_centre_that_is_none_is_refused(tmp_path):
    table, model = texts("six_axis")
    path = written(tmp_path, swap(table, "fixed = false", "fixed = true"), model, model_name="six_axis.xml")
    assert_refused(path, r"trocar.fixed says .* leaves it by [\d.e+]+ mm .* use fixed = false")


def test_unknown_arms_and_files_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"arm 'psm_palpato' is unknown; .*did you mean 'psm_palpator'"):
        load_arm("psm_palpato")
    with pytest.raises(ValueError, match=r"arm file .*none\.toml cannot be read: No such file"):
        load_arm(tmp_path / "none.toml")
    with pytest.raises(ValueError, match=r"arm is 3; it must be"):
        read_description(3)  # type: ignore[arg-type]
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(ValueError, match="cannot be read"):
        load_arm(tmp_path / "folder.toml")


def test_an_unknown_instrument_of_a_scene_is_named(tmp_path):
    scene = make_scene("phantom")
    with pytest.raises(ValueError, match=r"instrument 'psm_palpater' is unknown; did you mean 'psm_palpator'"):
        with_instrument(scene, "psm_palpater")
    with pytest.raises(ValueError, match=r"arm file .*mine.toml cannot be read"):
        Simulation(load_anatomy(with_instrument(scene, str(tmp_path / "mine.toml"))))


def test_an_arm_beside_its_scene_file_is_found(tmp_path):
    table, model = texts()
    written(tmp_path, table, model)
    scene = (scenes_folder() / "organs" / "phantom.toml").read_text()
    (tmp_path / "scene.toml").write_text(swap(scene, 'model = "probe.xml"', 'model = "mine.toml"'))
    instrument = Simulation(load_anatomy(make_scene(tmp_path / "scene.toml"))).instrument
    assert instrument.arm.description.folder == tmp_path  # type: ignore[attr-defined]


def test_ports_are_checked():
    with pytest.raises(ValueError, match=r"every number must be finite"):
        Port((0.0, np.nan, 0.0))
    with pytest.raises(ValueError, match=r"`into` a direction"):
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
    assert_refused(path, r"mesh file .*swing\.stl is missing: put it there, or take the mesh out of stick\.urdf")


BALL = '<collision name="ball"><origin xyz="0 0 -0.2"/><geometry><sphere radius="0.006"/></geometry></collision>'


@pytest.mark.parametrize(
    ("part", "changed", "message"),
    [
        (BALL, 2 * BALL, "a second shape is named 'ball'; it has no name"),
        ('lower="0" upper="0.2"', 'lower="0.2" upper="0.2"', "MuJoCo: .* equal lower and upper limits"),
    ],
    ids=["a name twice", "equal limits"],
)
def test_what_mujoco_would_print_is_a_warning(part, changed, message, tmp_path, capfd):
    model = swap(swap(URDF, "VISUAL", '<sphere radius="0.01"/>'), part, changed)
    path = written(tmp_path, URDF_TABLE, model, model_name="stick.urdf")
    with pytest.warns(UserWarning, match=message), contextlib.suppress(ValueError):
        load_arm(path)
    assert capfd.readouterr() == ("", "")


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.text(max_size=60) | st.binary(max_size=60))
def test_garbage_gives_value_errors_alone(tmp_path, text):
    path = tmp_path / "mine.toml"
    path.write_bytes(text.encode("utf-8") if isinstance(text, str) else text)
    with pytest.raises(ValueError):
        load_arm(path)
