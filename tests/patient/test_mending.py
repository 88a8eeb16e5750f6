"""Organs from surfaces and faulty labels: mended when asked."""

import numpy as np
import pytest
import trimesh

from msdm_core.mesh_files.mesh_io import read_mesh
from surgsim_apps.cli.main import main
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import load_scene
from tests.patient.surfaces import ball


@pytest.mark.slow
def test_surfaces_one_file_a_region(tmp_path, capsys):
    organ, lesion = ball(tmp_path / "kidney.stl"), ball(tmp_path / "tumour.ply", 9.0, (8.0, 0.0, 5.0))
    other = ball(tmp_path / "stone.obj", 7.0, (-12.0, 0.0, 0.0))
    out = tmp_path / "out"
    out.mkdir()
    given = ["organ", str(organ), str(lesion), str(other), "--modulus", "stone=90000"]
    assert main([*given, "--length-unit", "mm", "--cell-size", "0.006", "--out", str(out / "k.vtu")]) == 0
    mesh = read_mesh(out / "k.vtu")
    assert dict(mesh.region_names) == {1: "kidney", 2: "tumour", 3: "stone"}
    for tag, radius in ((2, 0.009), (3, 0.007)):
        assert mesh.volumes[mesh.region == tag].sum() == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.06)
    scene = load_scene(out / "k.toml")
    assert scene.material.youngs_modulus == 8000
    assert [(region.name, region.lesion, region.material.youngs_modulus) for region in scene.regions] == [
        ("tumour", True, 32000.0),
        ("stone", False, 90000.0),
    ]
    # What is no lesion is in every organ.
    anatomy = load_anatomy(scene)
    assert [lesion.region for lesion in anatomy.specification().lesions] == ["stone"]
    assert "nothing is known" not in capsys.readouterr().out


@pytest.mark.slow
def test_a_broken_surface_is_mended_only_when_asked(tmp_path, refusal, capsys):
    broken = ball(tmp_path / "liver.stl", drop=6)
    given = ["organ", broken, "--length-unit", "mm", "--cell-size", "0.008"]
    assert "the surface is open" in refusal(*given)
    out = tmp_path / "liver.vtu"
    assert main([*map(str, given), "--mend", "--out", str(out)]) == 0
    assert "mended: liver was rebuilt from voxels of 1.33 mm" in capsys.readouterr().err
    # Lines that leave through the hole are outvoted; voxels of a sixth of a cell hold the ball within 2 %.
    whole = trimesh.creation.icosphere(3, 0.03).volume
    assert read_mesh(out).volumes.sum() == pytest.approx(whole, rel=0.02)


@pytest.mark.slow
def test_surfaces_that_cross_are_joined_when_mended(tmp_path, refusal):
    first, second = (trimesh.creation.icosphere(3, 30.0).apply_translation([x, 0.0, 0.0]) for x in (0.0, 25.0))
    both = trimesh.util.concatenate([first, second])
    # One triangle joins the two into one body, so that they are not two.
    both.faces[0, 0] = len(first.vertices)
    both.export(tmp_path / "liver.stl")
    given = ["organ", str(tmp_path / "liver.stl"), "--length-unit", "mm", "--cell-size", "0.008"]
    refusal(*given)
    assert main([*given, "--mend", "--out", str(tmp_path / "a.vtu")]) == 0
    # Two balls of radius R less their lens of height 2 h: the lens is 2 pi h^2 (3 R - h) / 3 with h = R - d / 2.
    h = 0.03 - 0.0125
    union = 2 * 4 / 3 * np.pi * 0.03**3 - 2 * np.pi * h**2 * (0.09 - h) / 3
    assert read_mesh(tmp_path / "a.vtu").volumes.sum() == pytest.approx(union, rel=0.03)
