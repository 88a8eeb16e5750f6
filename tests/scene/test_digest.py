"""Digests: equal for the same content wherever it lies, another one for each change."""

import ast
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401
from surgsim_env.scene import digest
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.digest import code, content_digest, instrument_files, scene_digest, source_files
from surgsim_env.scene.load import make_scene, scenes_folder, with_instrument


def test_content_is_that_of_b2sum(tmp_path: Path):
    """Of the empty file by RFC 7693's BLAKE2b-512 reference; parts one after the other, arrays by their bytes."""
    (tmp_path / "empty").write_bytes(b"")
    assert content_digest(tmp_path / "empty", size=64).startswith("786a02f742015903c6c6fd852552d272")
    (tmp_path / "file").write_bytes(np.arange(3.0).tobytes())
    assert content_digest(np.arange(3.0)) == content_digest(tmp_path / "file") == content_digest(np.arange(6.0)[:3])
    assert content_digest(np.arange(6.0)[::2]) != content_digest(np.arange(3.0))
    assert content_digest("a", 1) != content_digest("a", 2)
    assert len(content_digest("a", size=4)) == 8


PLAIN = """\'\'\'Mathematics.\'\'\'
import math

TEXT = \'\'\'one

    # two\'\'\'
\'\'\'Of a constant.\'\'\'


def area(radius):
    \'\'\'Area.\'\'\'
    return math.pi * radius**2 + len("# no comment")


class Empty:
    \'\'\'Nothing.\'\'\'
"""
EXPLAINED = """\'\'\'Areas.\'\'\'

# Of the library.
import math

TEXT = \'\'\'one

    # two\'\'\'
\'\'\'What stands below a constant.\'\'\'

def area(radius):
    \'\'\'The area of a disc.

    Of this radius.
    \'\'\'  # noqa

    return math.pi * radius**2 + len("# no comment")  # pi r^2


class Empty:
    "Nothing at all."
    # Nothing.
"""


def test_of_python_files_the_code_counts(tmp_path: Path):
    def of(text: str) -> str:
        (tmp_path / "file.py").write_text(text, encoding="utf-8")
        return content_digest(tmp_path / "file.py")

    assert of(PLAIN) == of(EXPLAINED)
    for old, new in [("**2", "**3"), ("# no", "# a"), ("# two", "# three"), ("one\n\n", "one\n")]:
        assert PLAIN.count(old) == 1 and of(PLAIN.replace(old, new)) != of(PLAIN)
    assert of("if a:\n    b()\nc()\n") != of("if a:\n    b()\n    c()\n")


@pytest.mark.parametrize(
    "path", source_files("scene", "instruments", "coupling", "palpation", "tasks", "envs"), ids=str
)
def test_code_without_comments_is_the_same_program(path: Path):
    def program(text: str) -> str:
        tree = ast.parse(text)
        for node in ast.walk(tree):
            if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
                node.value.value = ""
        return ast.dump(tree)

    assert program(code(path)) == program(path.read_text(encoding="utf-8"))


def test_a_scene_is_known_by_its_content_and_not_by_its_folder():
    anatomy = load_anatomy(make_scene("phantom_small"))
    scene, mesh = anatomy.scene, anatomy.mesh
    plain = scene_digest(scene, mesh)
    assert scene_digest(replace(scene, folder=Path("/elsewhere")), mesh) == plain
    softer = replace(scene, material=replace(scene.material, youngs_modulus=4999.0))
    moved = replace(mesh, points=mesh.points + np.array([0.0, 0.0, 1e-9]))
    assert len({plain, scene_digest(softer, mesh), scene_digest(scene, moved)}) == 3
    arm = str(scenes_folder() / "instruments" / "psm_palpator.toml")
    copied = arm.replace("instruments", "elsewhere")
    one, other = (replace(scene, instrument=replace(scene.instrument, model=name)) for name in (arm, copied))
    assert scene_digest(one, mesh) == scene_digest(other, mesh) != plain


@pytest.mark.parametrize(
    ("instrument", "files"),
    [
        ("probe", ["probe.xml"]),
        ("psm_palpator", ["psm_palpator.toml", "psm_palpator.xml"]),
        (
            "psm_grasper+psm_retractor",
            ["psm_grasper.toml", "psm_grasper.xml", "psm_retractor.toml", "psm_retractor.xml"],
        ),
    ],
)
def test_files_of_instruments(instrument: str, files: list[str]):
    found = list(instrument_files(with_instrument(make_scene("lobe"), instrument)))
    assert [path.name for path in found] == files and all(path.is_file() for path in found)


def test_an_environment_tells_scene_and_source_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    plain, hard = (gym.make("SurgSim/Palpate-v0", level=level).unwrapped.digests() for level in (None, "hard"))
    assert plain["source"] == hard["source"] and plain["scene"] != hard["scene"]
    assert plain == gym.make("SurgSim/Palpate-v0").unwrapped.digests()
    env = gym.make("SurgSim/Palpate-v0").unwrapped
    for room in ("scene", "instruments", "coupling", "palpation", "tasks", "envs"):
        (tmp_path / room).mkdir()
        (tmp_path / room / "other.py").write_text(f"ROOM = {room!r}\n", encoding="utf-8")
    monkeypatch.setattr(digest, "PACKAGE", tmp_path)
    changed = env.digests()
    assert changed["scene"] == plain["scene"] and changed["source"] != plain["source"]
