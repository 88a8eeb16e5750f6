"""Model files that ask for too much are refused in one line, before MuJoCo reads them or by a child process."""

import contextlib
import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import pytest

from surgsim_env.instruments.arm import model_limits
from surgsim_env.instruments.arm.arm import load_arm
from surgsim_env.instruments.arm.model_limits import check_model, read_xml
from surgsim_env.scene.load import list_arms, scenes_folder
from tests.instruments.test_refusals import URDF, URDF_TABLE

INSTRUMENTS = scenes_folder() / "instruments"
BODY = '<body><geom size="0.1"/></body>'


def mjcf(assets="", world=BODY, more=""):
    return f"<mujoco>{more}<asset>{assets}</asset><worldbody>{world}</worldbody></mujoco>"


def nested(count):
    return "<frame>" * count + "</frame>" * count


def checked(path):
    """Check a model file as reading an arm does."""
    return check_model(path, read_xml(path), "")


@pytest.fixture
def no_child(monkeypatch):
    """A child process is an error."""

    def start(*_arguments, **_options):
        raise AssertionError("a child process was started")

    monkeypatch.setattr(model_limits.subprocess, "run", start)


TOO_MUCH = {
    "texture": (
        mjcf('<texture name="wood" type="2d" builtin="checker" width="40000" height="40000"/>'),
        r"<texture name='wood'> of 40000 x 40000 pixels: 4800000000 bytes of textures; at most 256000000 are accepted",
    ),
    "cube": (mjcf('<texture builtin="flat" width="4000"/>'), r"of 4000 x 24000 pixels: 288000000 bytes of textures"),
    "textures together": (
        mjcf("".join(f'<texture name="{n}" type="2d" builtin="flat" width="4000" height="4000"/>' for n in range(6))),
        r"<texture name='5'> of 4000 x 4000 pixels: 288000000 bytes",
    ),
    "texture by default": (
        mjcf('<texture builtin="flat" type="2d"/>', more='<default><texture width="90000" height="90000"/></default>'),
        r"of 90000 x 90000 pixels",
    ),
    "height field": (
        mjcf('<hfield name="ground" nrow="100000" ncol="100000" size="1 1 1 1"/>'),
        r"<hfield name='ground'> of 100000 x 100000 points: 1e\+10 points of height fields; at most 16000000",
    ),
    "replicas": (
        mjcf(world=f'<replicate count="100000000">{BODY}</replicate>'),
        r"with <replicate count=100000000>: 200000\d\d\d elements, replicas counted; at most 10000 are accepted",
    ),
    "replicas of replicas": (
        mjcf(world=f'<replicate count="100"><replicate count="200">{BODY}</replicate></replicate>'),
        r"with <replicate count=200>: \d+ elements, replicas counted",
    ),
    "bodies": (
        mjcf(world=f'<replicate count="2500">{BODY}</replicate>'),
        r"2500 bodies, replicas counted; at most",
    ),
    "joints": (mjcf(world=f'<body>{"<joint/>" * 501}<geom size="1"/></body>'), r"501 joints, replicas counted"),
    "links": (f"<robot>{'<link/>' * 2001}</robot>", r"2001 bodies"),
    "soft body": (
        mjcf(world='<flexcomp name="sheet" count="1000 1000 1" dim="2"/>'),
        r"1000000 points of soft bodies; at most 20000 are accepted: take fewer points",
    ),
    "memory": (mjcf(more='<size memory="1T"/>'), r"<size memory='1T'>: 1\.099511628e\+12 bytes; .*: leave it out"),
    "keyframes": (mjcf(more='<size nkey="1000000"/>'), r"<size nkey='1000000'>: 1000000 keyframes; at most 1000"),
    "user numbers": (
        mjcf(more=f'<body user="{"0 " * 200}"/>'),
        r"<body user='0 0 .*\.\.\.'>: 200 numbers; at most 100",
    ),
    "numeric": (mjcf(more='<custom><numeric name="n" size="100000000"/></custom>'), r"<numeric name='n' size='1000"),
    "nesting": (nested(401), r"401 levels of XML elements; at most 400"),
    "entities": (
        '<!DOCTYPE m [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><mujoco model="&b;"/>',
        r"declares the entity 'a'; entities are not expanded: write what it stands for",
    ),
    "no number": (
        mjcf(world='<body name="nan"><geom name="tip" size="0.1 nan"/></body>'),
        r"<geom name='tip' size='0\.1 nan'> is not a number; write one",
    ),
    "too large": (
        mjcf(world='<body pos="0 -1e308 0"><geom name="1e308" size="inf"/></body>'),
        r"<body pos='0 -1e308 0'> is too large a number; at most 1e\+100",
    ),
    "encoding": (
        '<?xml version="1.0" encoding="big5"?><mujoco/>',
        r"encoding that cannot be read .*: save it as UTF",
    ),
}


@pytest.mark.parametrize("name", TOO_MUCH)
def test_what_is_too_much_is_refused_unread(name, tmp_path, no_child):
    text, message = TOO_MUCH[name]
    (tmp_path / "arm.xml").write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        checked(tmp_path / "arm.xml")
    assert str(caught.value).startswith(f"model file {tmp_path / 'arm.xml'}") and "\n" not in str(caught.value)


def test_an_arm_is_refused_by_the_limits(tmp_path):
    """The check is part of reading an arm."""
    table = (INSTRUMENTS / "psm_palpator.toml").read_text()
    model = (INSTRUMENTS / "psm_palpator.xml").read_text()
    assert "<worldbody>" in model
    big = '<asset><texture builtin="flat" type="2d" width="40000" height="40000"/></asset><worldbody>'
    (tmp_path / "mine.toml").write_text(table)
    (tmp_path / "psm_palpator.xml").write_text(model.replace("<worldbody>", big))
    with pytest.raises(ValueError, match=r"arm 'mine': model file .*psm_palpator\.xml: <texture> of 40000 x 40000 pix"):
        load_arm(tmp_path / "mine.toml")


@pytest.mark.parametrize("name", list_arms())
def test_shipped_arms_need_no_child(name, no_child):
    checked(INSTRUMENTS / f"{name}.xml")


def png(path, width, height):
    """A PNG file's signature and header; the data that it states are left out."""
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    path.write_bytes(model_limits.PNG + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header)))


def test_pictures_are_measured_by_their_headers(tmp_path, no_child):
    (tmp_path / "pictures").mkdir()
    png(tmp_path / "pictures" / "wood.png", 30000, 20000)
    (tmp_path / "arm.xml").write_text(
        mjcf('<texture name="wood" file="wood.png"/>', more='<compiler texturedir="pictures"/>')
    )
    with pytest.raises(ValueError, match=r"<texture name='wood'> with wood\.png of 30000 x 20000 pixels: 1800000000 b"):
        checked(tmp_path / "arm.xml")


def test_large_files_of_assets_are_refused_unread(tmp_path, no_child):
    with (tmp_path / "link.stl").open("wb") as stream:
        stream.truncate(300_000_000)
    urdf = '<robot><link><visual><geometry><mesh filename="package://arm/link.stl"/></geometry></visual></link></robot>'
    (tmp_path / "arm.urdf").write_text(urdf)
    with pytest.raises(ValueError, match=r"300000000 bytes in files of assets; at most 200000000 are accepted"):
        checked(tmp_path / "arm.urdf")
    (tmp_path / "link.stl").unlink()
    os.mkfifo(tmp_path / "link.stl")
    with pytest.raises(ValueError, match=r"asset .*link\.stl is no regular file"):
        checked(tmp_path / "arm.urdf")
    (tmp_path / "link.stl").unlink()
    (tmp_path / "link.stl").symlink_to(tmp_path / "arm.urdf")
    model_limits_passed(tmp_path / "arm.urdf")


def model_limits_passed(path: Path):
    """What the count itself says, without a child."""
    count = model_limits._Count(path)
    count.add(read_xml(path), 1)
    count.check()
    return count


def test_included_files_count(tmp_path, no_child):
    (tmp_path / "arm.xml").write_text(mjcf(world='<include file="parts/more.xml"/>'))
    (tmp_path / "parts").mkdir()
    geoms = '<geom size="1"/>' * 6000
    (tmp_path / "parts" / "more.xml").write_text(f'<mujoco>{geoms}<include file="parts/last.xml"/></mujoco>')
    (tmp_path / "parts" / "last.xml").write_text(f"<mujoco>{geoms}</mujoco>")
    with pytest.raises(ValueError, match=r"1200\d elements, replicas counted"):
        checked(tmp_path / "arm.xml")
    # MuJoCo includes a file once; a circle ends.
    (tmp_path / "parts" / "last.xml").write_text('<mujoco><include file="arm.xml"/></mujoco>')
    count = model_limits_passed(tmp_path / "arm.xml")
    assert 6000 < count.totals["elements"] < 6020


MESH = mjcf('<mesh name="m" builtin="supersphere" params="20 1 1"/>', world='<geom type="mesh" mesh="m"/>')


def test_a_child_s_verdict_holds_until_a_file_changes(tmp_path, monkeypatch):
    (tmp_path / "arm.xml").write_text(MESH)
    assert checked(tmp_path / "arm.xml") == ""
    with monkeypatch.context() as patched:
        patched.setattr(model_limits.subprocess, "run", None)
        assert checked(tmp_path / "arm.xml") == ""
    # Two million points, of which a convex hull is sought.
    (tmp_path / "arm.xml").write_text(MESH.replace('"20 1 1"', '"2000 1 1"'))
    monkeypatch.setattr(model_limits, "CHILD_SECONDS", 0.05)
    with pytest.raises(ValueError, match=r"arm\.xml was not compiled within 0\.05 s: take fewer or smaller meshes"):
        checked(tmp_path / "arm.xml")


@pytest.mark.skipif(sys.platform != "linux", reason="a child's memory is limited on Linux only")
def test_a_child_has_so_much_memory(tmp_path, monkeypatch):
    """490 free bodies take an arena of 0.4 GB, as it grows with the square of their number."""
    free = '<body><freejoint/><geom size="0.1"/></body>'
    (tmp_path / "arm.xml").write_text(mjcf(world=f'<replicate count="490">{free}</replicate>'))
    assert checked(tmp_path / "arm.xml") == ""
    model_limits._compile_apart.cache_clear()
    monkeypatch.setattr(model_limits, "CHILD_MEMORY", 1e8)
    with pytest.raises(ValueError, match=r"arm\.xml takes more than 0\.1 GB of memory to compile: take fewer"):
        checked(tmp_path / "arm.xml")


@pytest.mark.parametrize(
    ("status", "message"),
    [(-11, "ends MuJoCo by signal 11 as it is compiled"), (1, r"ended with 'no module mujoco': run it again")],
)
def test_a_child_that_ends_otherwise_is_one_line(status, message, tmp_path, monkeypatch):
    done = subprocess.CompletedProcess([], status, "", "no module\nmujoco\n")
    monkeypatch.setattr(model_limits.subprocess, "run", lambda *_arguments, **_options: done)
    (tmp_path / "arm.xml").write_text(MESH)
    with pytest.raises(ValueError, match=message) as caught:
        checked(tmp_path / "arm.xml")
    assert "\n" not in str(caught.value)


def test_what_a_child_finds_wrong_is_said(tmp_path, capfd):
    """Without a second try in this process, where what MuJoCo's libraries print would be seen."""
    table = (INSTRUMENTS / "psm_palpator.toml").read_text()
    flat = "0 0 0 1 0 0 0 1 0 1 1 0 0.5 0.5 0 0.2 0.1 0"
    model = (INSTRUMENTS / "psm_palpator.xml").read_text()
    mesh = f'<asset><mesh name="flat" vertex="{flat}"/></asset><worldbody><geom type="mesh" mesh="flat"/>'
    (tmp_path / "mine.toml").write_text(table)
    (tmp_path / "psm_palpator.xml").write_text(model.replace("<worldbody>", mesh))
    assert "mesh 'flat' has coplanar vertices" in checked(tmp_path / "psm_palpator.xml")
    with pytest.raises(ValueError, match=r"^arm 'mine': Error: mesh 'flat' has coplanar vertices") as caught:
        load_arm(tmp_path / "mine.toml")
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


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
    model = URDF.replace("VISUAL", '<sphere radius="0.01"/>')
    assert part in model
    (tmp_path / "stick.toml").write_text(URDF_TABLE)
    (tmp_path / "stick.urdf").write_text(model.replace(part, changed))
    with pytest.warns(UserWarning, match=message), contextlib.suppress(ValueError):
        load_arm(tmp_path / "stick.toml")
    assert capfd.readouterr() == ("", "")
