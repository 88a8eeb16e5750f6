"""Robot model files with the faults of public ones: what is read, left out by name, put right or refused."""

import struct
import sys
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh

from surgsim_apps.arms.find_arm import find_arm
from surgsim_apps.arms.survey import ModelSurvey
from surgsim_apps.cli.main import main
from surgsim_env.instruments.arm.arm import load_arm
from surgsim_env.instruments.arm.model import read_model
from surgsim_env.instruments.arm.urdf import mesh_files
from surgsim_env.scene.save import as_toml

BOX = np.array([0.3, 0.2, 0.1])
ROUND = '<mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
LIMIT = '<limit lower="-1.5" upper="1.5" effort="40" velocity="2"/>'
SHAFT = '<visual><origin xyz="0 0 -0.2"/><geometry><cylinder radius="0.004" length="0.4"/></geometry></visual>'
CHAIN = (  # link, origin and axis of the joint before it
    ("turn", "0 0 0.3", "0 0 1"),
    ("upper", "0 0 0", "0 1 0"),
    ("fore", "0.4 0 0", "0 1 0"),
    ("wrist_1", "0.3 0 0", "1 0 0"),
    ("wrist_2", "0 0 0", "0 1 0"),
    ("shaft", "0 0 0", "0 0 1"),
)


def visual(geometry):
    return f"<visual><geometry>{geometry}</geometry></visual>"


def six_hinges(*, block="", mesh="../stl/link.stl", base=ROUND, shapes=(), limits=(), last=ROUND, more=""):
    """URDF of a base with a mesh, six hinges j1 to j6, a shaft and a frame `tool_tip` at its end."""
    shapes, limits = {"shaft": SHAFT, **dict(shapes)}, dict(limits)
    drawn = visual(f'<mesh filename="{mesh}"/>')
    parts = [f'<link name="base"><inertial>{base}</inertial>{drawn}</link>']
    for number, ((name, origin, axis), parent) in enumerate(
        zip(CHAIN, ["base", *(link for link, *_ in CHAIN)], strict=False), 1
    ):
        inertial = f"<inertial>{last if name == 'shaft' else ROUND}</inertial>"
        parts.append(f'<link name="{name}">{inertial}{shapes.get(name, "")}</link>')
        parts.append(
            f'<joint name="j{number}" type="revolute"><origin xyz="{origin}"/><parent link="{parent}"/>'
            f'<child link="{name}"/><axis xyz="{axis}"/>{limits.get(f"j{number}", LIMIT)}</joint>'
        )
    tip = (
        '<joint name="fix" type="fixed"><origin xyz="0 0 -0.4"/><parent link="shaft"/><child link="tool_tip"/></joint>'
    )
    return f'<robot name="arm">{block}{"".join(parts)}<link name="tool_tip"/>{tip}{more}</robot>'


def written(folder: Path, *, box=BOX, **changes) -> Path:
    """The URDF in urdf/ with its mesh in stl/."""
    for name in ("urdf", "stl"):
        (folder / name).mkdir(exist_ok=True)
    trimesh.creation.box(box).export(folder / "stl" / "link.stl")
    path = folder / "urdf" / "arm.urdf"
    path.write_text(six_hinges(**changes))
    return path


@cache
def plain_toml(folder: Path) -> str:
    return as_toml(find_arm(written(folder)).description)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return tmp_path_factory.mktemp("plain")


# ---- a file's own compiler element -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("attributes", "mesh"),
    [
        ('discardvisual="false" meshdir="../stl"', "link.stl"),
        ('balanceinertia="true" fusestatic="true"', "../stl/link.stl"),
        ('assetdir="../" strippath="false"/><option gravity="0 0 -9.81"', "stl/link.stl"),
    ],
)
def test_a_compiler_element_changes_nothing_that_it_does_not_state(plain, tmp_path, attributes, mesh):
    path = written(tmp_path, block=f"<mujoco><compiler {attributes}/></mujoco>", mesh=mesh)
    assert as_toml(find_arm(path).description) == plain_toml(plain)


@pytest.mark.parametrize("block", ["", '<mujoco><compiler discardvisual="false"/></mujoco>'])
def test_inertias_that_break_the_triangle_inequality_are_balanced(tmp_path, block):
    path = written(tmp_path, block=block, last=ROUND.replace('izz="0.01"', 'izz="0.05"'))
    # MuJoCo gives each axis the mean, so that the trace is kept.
    np.testing.assert_allclose(ModelSurvey(path).model.body("shaft").inertia.sum(), 0.07, rtol=1e-9)


@pytest.mark.parametrize(
    ("attributes", "name", "place"),
    [
        ('meshdir="b"', "a/link.stl", "b/link.stl"),
        ('meshdir="b" strippath="false"', "a/link.stl", "b/a/link.stl"),
        ('assetdir="b"', "link.stl", "b/link.stl"),
        ('assetdir="a" meshdir="b"', "link.stl", "b/link.stl"),
        ("", "a/link.stl", "a/link.stl"),
    ],
)
def test_a_stated_mesh_folder_comes_first(tmp_path, attributes, name, place):
    for folder in ("", "a", "b", "b/a"):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / "link.stl").touch()
    root = ElementTree.fromstring(six_hinges(block=f"<mujoco><compiler {attributes}/></mujoco>", mesh=name))
    assert mesh_files(root, tmp_path / "arm.urdf") == {name: tmp_path / place}


# ---- shapes that cannot be read ----------------------------------------------------------------------------------


def flat_stl():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) * 0.1
    triangles = [struct.pack("<12fH", 0, 0, 1, *corners[start : start + 3].ravel(), 0) for start in (0, 3)]
    return bytes(80) + struct.pack("<I", 2) + b"".join(triangles)


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 194\n"


@pytest.mark.parametrize(
    ("geometry", "content"),
    [
        ('<mesh filename="../stl/second.stl"/>', flat_stl()),
        ('<mesh filename="../stl/second.stl"/>', b""),
        ('<mesh filename="../stl/second.obj"/>', POINTER),
        ('<mesh filename="../stl/second.dae"/>', b"no mesh"),
        ('<mesh filename="../stl/second.stl"/>', None),
        ('<mesh filename="../stl/link.stl" scale="0 0 0"/>', None),
        ('<box size="0 0 0"/>', None),
        ('<box size="nan 0.1 0.1"/>', None),
        ('<sphere radius="-0.1"/>', None),
        ('<cylinder radius="0.1"/>', None),
        ("<cone/>", None),
        ("", None),
    ],
)
def test_a_shape_that_cannot_be_read_is_left_out_and_named(tmp_path, geometry, content):
    expected = ModelSurvey(written(tmp_path)).model
    name = "stl/second." + geometry.partition("second.")[2][:3]
    path = written(tmp_path, shapes={"fore": visual(geometry)})
    if content is not None:
        (tmp_path / name).write_bytes(content)
    survey = ModelSurvey(path)
    (places,) = survey.left_out.values()
    assert places[0].startswith("fore")
    assert ("second" in places[0]) == ("second" in geometry)
    assert survey.model.ngeom == expected.ngeom
    np.testing.assert_array_equal(survey.model.body_mass, expected.body_mass)


def test_the_rest_of_an_arm_is_that_without_its_bad_shape(plain, tmp_path):
    path = written(tmp_path, shapes={"fore": visual('<mesh filename="../stl/second.stl"/>')})
    (tmp_path / "stl" / "second.stl").write_bytes(flat_stl())
    description = find_arm(path).description
    assert description.dropped_meshes == ("../stl/second.stl",)
    lines = [line for line in as_toml(description).splitlines() if not line.startswith("dropped_meshes")]
    assert lines == plain_toml(plain).splitlines()
    assert load_arm(description).model.nmesh == 1


@pytest.mark.parametrize("kind", ["urdf", "mjcf"])
@pytest.mark.parametrize("suffix", [".stl", ".ply", ".off"])
def test_meshes_in_formats_unknown_to_mujoco_are_read(tmp_path, kind, suffix):
    sizes = np.array([0.05, 0.06, 0.07])
    box = trimesh.creation.box(sizes)
    (tmp_path / "stl").mkdir()
    box.export(tmp_path / "stl" / f"box{suffix}", **({"file_type": "stl_ascii"} if suffix == ".stl" else {}))
    if kind == "urdf":
        path = written(tmp_path, mesh=f"../stl/box{suffix}")
        assert not ModelSurvey(path).left_out
    else:
        path = tmp_path / "arm.xml"
        path.write_text(
            f'<mujoco><compiler meshdir="stl"/><asset><mesh file="box{suffix}"/></asset><worldbody><body>'
            '<joint/><geom type="mesh" mesh="box"/></body></worldbody></mujoco>'
        )
    model = read_model(path).compile()
    np.testing.assert_allclose(np.sort(np.ptp(model.mesh_vert, axis=0)), sizes, rtol=1e-6)


@pytest.mark.parametrize(
    "inertial", ['<mass value="1"/>', "", ROUND.replace(' iyz="0"', ""), '<mass value="nan"/>', '<mass value="-1"/>']
)
def test_an_incomplete_inertia_of_a_link_that_does_not_move_is_replaced(tmp_path, inertial):
    survey = ModelSurvey(written(tmp_path, base=inertial))
    (inertia,) = survey.inertias
    # Without a mass that of a solid of water around the mesh.
    mass = 1.0 if 'value="1"' in inertial else 1000.0 * BOX.prod()
    assert (inertia.link, inertia.mass) == ("base", pytest.approx(mass, rel=1e-6))
    square = BOX**2
    np.testing.assert_allclose(inertia.moments, mass / 12.0 * (square.sum() - square), rtol=1e-6)


# ---- sizes and numbers -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"box": 300 * BOX}, "base is 90 m"),
        ({"box": 0.001 * BOX}, r"base .*0\.0003 m"),
        ({"shapes": {"fore": visual('<cylinder radius="4" length="400"/>')}}, "fore is 400 m"),
        ({"base": ROUND.replace("0.01", "${m*0.1}", 1)}, r"base: .*ixx.*\$\{m\*0\.1\}.*xacro"),
        ({"base": '<mass value=""/>'}, "base: mass value"),
        ({"mesh": "$(find arm)/link.stl"}, "base: mesh filename .*xacro"),
        ({"limits": {"j3": LIMIT.replace("-1.5", "-pi/2")}}, "j3: limit lower"),
        ({"limits": {"j3": LIMIT.replace("-1.5", "nan")}}, "j3: limit lower"),
        ({"limits": {"j3": LIMIT.replace('"2"', '"fast"')}}, "j3: limit velocity"),
        ({"limits": {"j3": '<mimic joint="j2" multiplier="x"/>'}}, "j3: mimic multiplier"),
        ({"last": '<origin xyz="0, 0, 0.1"/>' + ROUND}, "shaft: origin xyz"),
        ({"more": '<material name="red"><color rgba="${r} 0 0 1"/></material>'}, "red: color rgba.*xacro"),
        ({"last": '<origin xyz="0 0"/>' + ROUND}, "shaft: origin xyz"),
        ({"last": '<origin xyz="0 0 inf"/>' + ROUND}, "shaft: origin xyz"),
        ({"more": '<x:if xmlns:x="http://www.ros.org/wiki/xacro" value="1"/>'}, "xacro"),
    ],
)
def test_a_wrong_unit_or_text_in_place_of_a_number_is_named(tmp_path, changes, named):
    path = written(tmp_path, **changes)
    with pytest.raises(ValueError, match=named) as refusal:
        ModelSurvey(path)
    assert str(path) in str(refusal.value)


# ---- limits ------------------------------------------------------------------------------------------------------

LOCKED = '<limit lower="0.3" upper="0.3" effort="40" velocity="2"/>'
CROSSED = '<limit lower="1.5" upper="-1.5" effort="40" velocity="2"/>'
FOLLOWER = (
    '<link name="cover"/><joint name="follower" type="revolute"><parent link="fore"/><child link="cover"/>'
    f'<axis xyz="0 1 0"/>{LIMIT}<mimic joint="j4" multiplier="-2" offset="0.1"/></joint>'
)


def test_a_joint_with_equal_limits_is_held_there_with_what_follows_it(tmp_path, capfd, recwarn):
    path = written(tmp_path, limits={"j4": LOCKED}, more=FOLLOWER)
    description = find_arm(path).description
    assert description.joints == ("j1", "j2", "j3", "j5", "j6")
    assert description.held == pytest.approx({"j4": 0.3, "follower": 0.1 - 2.0 * 0.3})
    assert load_arm(description).joint_count == 5
    # With the driven joints at 0 the shaft's z axis is turned by 0.3 about x.
    axis = ModelSurvey(path).data.body("shaft").xmat.reshape(3, 3)[:, 2]
    np.testing.assert_allclose(axis, [0.0, -np.sin(0.3), np.cos(0.3)], atol=1e-12)
    assert not recwarn.list
    assert capfd.readouterr().err == ""


def test_crossed_limits_are_put_in_order(plain, tmp_path, capfd):
    names = [f"j{number}" for number in range(1, 7)]
    found = find_arm(written(tmp_path, limits=dict.fromkeys(names, CROSSED)))
    assert found.description.limits == dict.fromkeys(names, (-1.5, 1.5))
    toml = as_toml(found.description)
    assert toml[: toml.index("[limits]")].rstrip() == plain_toml(plain)[: toml.index("[limits]")].rstrip()
    assert any("-1.5 to 1.5" in sentence for sentence in found.chosen)
    assert load_arm(found.description).upper == pytest.approx([1.5] * 6)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    "limit",
    [
        '<limit lower="0" upper="0" effort="0" velocity="0"/>',
        '<limit lower="-inf" upper="inf"/>',
        "<limit/>",
        '<limit lower="0" upper="-1"/>',
    ],
)
def test_limits_of_zero_or_infinity_are_none(tmp_path, limit):
    survey = ModelSurvey(written(tmp_path, limits={"j4": limit}))
    assert not survey.locked
    assert not survey.model.joint("j4").limited[0]
    assert survey.model.njnt == 6


@pytest.mark.parametrize(("limit", "limits"), [('upper="1.2"', (0.0, 1.2)), ('lower="-1.2"', (-1.2, 0.0))])
def test_a_limit_that_is_not_stated_is_0(tmp_path, limit, limits):
    survey = ModelSurvey(written(tmp_path, limits={"j4": f"<limit {limit}/>"}))
    assert survey.range_of(survey.model.joint("j4").id, np.inf) == limits


def test_limits_of_mjcf_joints_are_read_likewise(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(
        '<mujoco><worldbody><body><joint name="a" range="60 -60"/><geom size="0.1"/><body>'
        '<joint name="b" range="30 30"/><geom size="0.1"/></body></body></worldbody></mujoco>'
    )
    survey = ModelSurvey(path)
    assert survey.crossed.keys() == {"a"}
    assert survey.crossed["a"] == pytest.approx(np.radians([-60.0, 60.0]))
    assert survey.locked == pytest.approx({"b": np.radians(30.0)})


# ---- a mounted tool ----------------------------------------------------------------------------------------------

BLOCK = visual('<box size="0.08 0.08 0.2"/>')
HAND = (
    '<link name="flange"/><joint name="f" type="fixed"><parent link="shaft"/><child link="flange"/></joint>'
    '<link name="tool0"/><joint name="t" type="fixed"><parent link="flange"/><child link="tool0"/></joint>'
    f'<link name="finger"><inertial>{ROUND}</inertial>{BLOCK}</link>'
    '<joint name="grip" type="prismatic"><parent link="tool0"/><child link="finger"/><axis xyz="1 0 0"/>'
    '<limit lower="0" upper="0.05" effort="1" velocity="1"/></joint>'
)


def test_a_tool_may_touch_the_hand_and_the_links_at_its_flange(tmp_path):
    path = written(tmp_path, shapes={"shaft": "", "wrist_1": BLOCK, "wrist_2": BLOCK}, more=HAND)
    found = find_arm(path, tip="tool0")
    assert found.reach > 0.5
    assert found.description.held == {"grip": 0.0}


def test_two_arms_ask_for_the_tip_of_one(tmp_path):
    path = tmp_path / "arm.xml"
    arm = '<body name="{0}"><joint/><geom size="0.1"/></body>'
    path.write_text(f"<mujoco><worldbody>{arm.format('left')}{arm.format('right')}</worldbody></mujoco>")
    with pytest.raises(ValueError, match="left, right"):
        find_arm(path)


# ---- robot_descriptions ------------------------------------------------------------------------------------------

PULL = """import atexit, sys
if sys.argv[2] == "broken_description":
    atexit.register(print, "3it [00:00, 5.1it/s]", file=sys.stderr)
    raise RuntimeError("no network")
print("Cloning ...")
print({path!r})
"""


def test_a_model_of_robot_descriptions_is_named_by_it(tmp_path, monkeypatch, capsys):
    package = tmp_path / "site" / "robot_descriptions"
    package.mkdir(parents=True)
    (tmp_path / "cache").mkdir()
    (tmp_path / "work").mkdir()
    path = written(tmp_path / "cache")
    (package / "__init__.py").write_text("DESCRIPTIONS = {'hinges_description': 0, 'broken_description': 0}")
    (package / "__main__.py").write_text(PULL.format(path=str(path)))
    monkeypatch.chdir(tmp_path / "work")
    assert main(["arm", "check", "robot_descriptions:hinges_description"]) == 2
    assert "pip install robot_descriptions" in capsys.readouterr().err
    monkeypatch.syspath_prepend(package.parent)
    monkeypatch.setenv("PYTHONPATH", str(package.parent), prepend=":")
    assert main(["arm", "check", "robot_descriptions:hinge_description"]) == 2
    assert "'hinges_description'" in capsys.readouterr().err
    assert main(["arm", "check", "robot_descriptions:broken_description"]) == 2
    refusal = capsys.readouterr().err
    assert "no network" in refusal and "it/s" not in refusal
    assert main(["arm", "check", "robot_descriptions:hinges_description"]) == 0
    assert load_arm("hinges_description.toml").joints == tuple(f"j{number}" for number in range(1, 7))
    sys.modules.pop("robot_descriptions")
