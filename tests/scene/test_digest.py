"""Digests: equal for the same content wherever it lies, another one for each change."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.digest import content_digest, scene_digest
from surgsim_env.scene.load import make_scene, scenes_folder


def test_content_is_that_of_b2sum():
    """Of nothing by RFC 7693's BLAKE2b-512 reference; arrays by their bytes."""
    assert content_digest(size=64).startswith("786a02f742015903c6c6fd852552d272")
    assert content_digest(np.arange(3.0)) == content_digest(np.arange(6.0)[:3])
    assert content_digest(np.arange(6.0)[::2]) != content_digest(np.arange(3.0))
    assert content_digest("a", 1) != content_digest("a", 2)
    assert len(content_digest("a", size=4)) == 8


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
    original, other = (replace(scene, instrument=replace(scene.instrument, model=name)) for name in (arm, copied))
    assert scene_digest(original, mesh) == scene_digest(other, mesh) != plain
