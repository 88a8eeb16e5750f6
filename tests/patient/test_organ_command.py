"""`surgsim organ` and `surgsim palpate` from labels and surfaces: what is written, loads, is refused and is mended."""

import html
import json
import os
import re
import shlex
import tomllib

import gymnasium as gym
import numpy as np
import pytest
import trimesh

import surgsim_env  # noqa: F401
from msdm_core.mesh_io import read_mesh
from msdm_core.quality import mesh_quality
from surgsim_env.anatomy import load_anatomy
from surgsim_env.cli import main
from surgsim_env.patient.command import _replace
from surgsim_env.patient.materials import organ_material, region_material
from surgsim_env.patient.patient_scene import _check_moduli
from surgsim_env.patient.scene_text import _entry
from surgsim_env.scenes import load_scene
from tests.patient.scans import LESIONS, MIDDLE, ORGAN_VOLUME, affine_of, labels_on, scan, write_nifti

LABELS = ["--labels", "liver=1,lesion=2"]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The folder of an organ made from a scan with two lesions."""
    folder = tmp_path_factory.mktemp("organ")
    file = scan(tmp_path_factory.mktemp("scan") / "ct.nii.gz", spacing=(1.5, 1.5, 2.5))
    assert main(["organ", str(file), *LABELS, "--cell-size", "0.006", "--out", str(folder / "patient.vtu")]) == 0
    return folder


@pytest.fixture(scope="module")
def anatomy(written):
    return load_anatomy(load_scene(written / "patient.toml"))


def refused(capsys, *arguments):
    """The one line on standard error."""
    assert main([str(one) for one in arguments]) == 2
    said = [line for line in capsys.readouterr().err.splitlines() if "surgsim: warning" not in line]
    assert len(said) == 1
    assert "Traceback" not in said[0]
    return said[0]


def ball(path, radius=30.0, place=(0.0, 0.0, 0.0), drop=0):
    """A ball's surface [mm], some of its triangles missing."""
    mesh = trimesh.creation.icosphere(3, radius)
    trimesh.Trimesh(mesh.vertices + np.array(place), mesh.faces[drop:], process=False).export(path)
    return path


def test_three_files_and_no_more(written):
    assert {path.name for path in written.iterdir()} == {"patient.vtu", "patient.toml", "report.html"}


def test_the_mesh_has_the_scan_s_volume_place_and_regions(written):
    mesh = read_mesh(written / "patient.vtu")
    assert dict(mesh.region_names) == {1: "liver", 2: "lesion 1", 3: "lesion 2"}
    # The voxels' volume is within 1 % of the ellipsoid's, the mesh's within 0.5 % of theirs.
    assert mesh.volumes.sum() == pytest.approx(ORGAN_VOLUME, rel=0.015)
    assert mesh_quality(mesh).dihedral_smallest_deg > 10
    for tag, (centre, radius) in enumerate(LESIONS, start=2):
        chosen = mesh.region == tag
        volume = mesh.volumes[chosen].sum()
        assert volume == pytest.approx(4 / 3 * np.pi * (radius * 1e-3) ** 3, rel=0.06)
        middle = mesh.volumes[chosen] @ mesh.points[mesh.tets[chosen]].mean(axis=1) / volume
        np.testing.assert_allclose(1e3 * middle, MIDDLE + centre, atol=1.0)


def test_the_scene_file_states_its_axes_and_sources(written):
    text = (written / "patient.toml").read_text(encoding="utf-8")
    assert "x to the patient's left, y to the back, z to the head (LPS" in text
    assert text.count("doi 10.1177/8756479317733713") >= 3


@pytest.mark.parametrize(
    "name", ["scan\U0001f600.nii.gz", 'a"b\\c\td\x7f\x1b.nii.gz', "half\ud83d.nii.gz", "byte\udc80.nii.gz"]
)
def test_strings_of_a_scene_are_toml_whatever_a_file_is_called(name):
    (value,) = tomllib.loads(_entry("description", name)).values()
    assert value == re.sub("[\ud800-\udfff]", "\ufffd", name)


def test_a_scan_of_any_name_becomes_a_scene(tmp_path):
    file = scan(tmp_path / "scan\U0001f600.nii.gz", spacing=(3.0, 3.0, 3.0))
    out = tmp_path / "out\U0001f600.vtu"
    assert main(["organ", str(file), *LABELS, "--cell-size", "0.009", "--out", str(out)]) == 0
    assert "of scan\U0001f600.nii.gz" in load_scene(out.with_suffix(".toml")).description


def test_a_modulus_is_for_a_region_s_name_or_the_name_before_its_number():
    names = ["lesion 1", "lesion 2", "portal vein"]
    organ = organ_material("liver").material
    for given in ("lesion", "lesion 2", "portal vein"):
        _check_moduli({given: 1.0}, names)
        assert any(region_material(one, "liver", organ, {given: 1.0}).material.youngs_modulus == 1.0 for one in names)
    for given in ("portal", "lesion 3", "vein"):
        with pytest.raises(ValueError, match="no such region; there are lesion 1, lesion 2, portal vein"):
            _check_moduli({given: 1.0}, names)


def test_the_scene_has_what_was_segmented(anatomy):
    scene = anatomy.scene
    assert [(one.name, one.lesion) for one in scene.regions] == [("lesion 1", True), ("lesion 2", True)]
    assert scene.regions[0].material.youngs_modulus == pytest.approx(8 * scene.material.youngs_modulus)
    lesions = anatomy.demonstration_lesions()
    assert [one.region for one in lesions] == ["lesion 1", "lesion 2"]
    healthy, ill = anatomy.organ(), anatomy.organ(lesions)
    assert ill.spring_stiffness.sum() > 1.05 * healthy.spring_stiffness.sum()
    # The chosen substeps hold for both.
    step = scene.timing.haptic_step / scene.timing.substep_count
    assert step < min(healthy.stable_step, ill.stable_step)
    assert anatomy.palpable_cell < np.sqrt(scene.instrument.tip_radius * scene.palpation.press_depth)


def test_the_report_is_one_page_that_asks_for_nothing(written):
    page = (written / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 2
    assert not re.findall(r"(?:src|href)=\"(?!data:|#)", page)
    assert "<script" not in page
    for word in ("dihedral angles", "stable step", "smoothing", "error", "kg", "lesion 2", "surgsim organ", "capsule"):
        assert word in page, word


@pytest.mark.parametrize("level", [None, "standard"])
def test_palpation_s_environment_takes_it(written, level):
    env = gym.make("SurgSim/Palpate-v0", scene=str(written / "patient.toml"), level=level)
    observation, _ = env.reset(seed=1)
    for _ in range(3):
        observation, _, terminated, _, info = env.step(env.action_space.sample() * 0.1)
        assert info["sim_fault"] == ""
        assert not terminated
    assert env.observation_space.contains(observation)
    env.close()


@pytest.mark.slow
def test_palpation_by_sites_takes_it(written, tmp_path, monkeypatch):
    monkeypatch.setenv("SURGSIM_CACHE", str(tmp_path))
    env = gym.make("SurgSim/PalpateSites-v0", scene=str(written / "patient.toml"), level="standard", budget=2)
    env.reset(seed=1)
    for _ in range(2):
        *_, info = env.step(np.zeros(2, dtype=np.float32))
        assert info["sim_fault"] == ""
    env.close()


def test_palpate_goes_from_a_scan_to_a_map_in_one_command(tmp_path, capsys):
    file = scan(tmp_path / "ct.nii.gz", spacing=(2.0, 2.0, 2.0))
    out = tmp_path / "out"
    # Around the larger lesion, 9 mm.
    centre = ",".join(f"{one:.4f}" for one in 1e-3 * (MIDDLE + LESIONS[0][0] + [0.0, -9.0, 5.0]))
    arguments = ["palpate", "--segmentation", str(file), *LABELS, "--cell-size", "0.007", "--around", f"{centre},0.017"]
    assert main([*arguments, "--out", str(out), "--workers", "1"]) == 0
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert [one["name"] for one in summary["truth"]] == ["lesion 1", "lesion 2"]
    assert summary["truth"][0]["radius_m"] == pytest.approx(0.009, rel=0.1)
    np.testing.assert_allclose(summary["truth"][0]["centre_m"], 1e-3 * (MIDDLE + LESIONS[0][0]), atol=1.5e-3)
    assert summary["volume_ratio_smallest"] > 0.0
    expected = {"ct.vtu", "ct.toml", "report.html", "palpation.csv", "summary.json", "stiffness_map.png"}
    assert {path.name for path in out.iterdir()} == expected
    # Healthy sites would be felt as 1.
    assert summary["maps"]["pre-operative model"]["lesions"][0]["contrast"] > 1.1
    assert "written" in capsys.readouterr().out


def test_what_is_dropped_filled_or_cut_off_is_said(tmp_path, capsys):
    affine, shape = affine_of(margin=0.0)
    labels = labels_on(affine, shape)
    labels[0:2, 0, 0] = 1
    labels[20:23, 15:18, 14:17] = 0
    labels[30, 10, 20] = 2
    labels = labels[:, : shape[1] // 2 + 6]
    file = write_nifti(tmp_path / "a.nii.gz", labels, affine)
    assert main(["organ", str(file), *LABELS, "--cell-size", "0.008"]) == 0
    said = capsys.readouterr().err
    assert "1 part(s) apart from the largest were left out: 2 voxels" in said
    assert "1 cavity(ies) inside the labels, 0.216 ml, were left as they are (--mend fills them)" in said
    assert "lesion: 1 part(s), 0.008 ml together, are smaller than what cells of 8 mm can show" in said
    assert "touches the image's border towards the front" in said
    assert main(["organ", str(file), *LABELS, "--cell-size", "0.008", "--mend"]) == 0
    assert "mended: 1 cavity(ies) inside the labels, 0.216 ml, were filled with liver" in capsys.readouterr().err


def test_surfaces_one_file_a_region(tmp_path, capsys):
    organ, lesion = ball(tmp_path / "kidney.stl"), ball(tmp_path / "tumour.ply", 9.0, (8.0, 0.0, 5.0))
    other = ball(tmp_path / "x.obj", 7.0, (-12.0, 0.0, 0.0))
    out = tmp_path / "out"
    out.mkdir()
    given = ["organ", str(organ), str(lesion), "--region", f"stone={other}", "--modulus", "stone=90000"]
    assert main([*given, "--length-unit", "mm", "--cell-size", "0.006", "--out", str(out / "k.vtu")]) == 0
    mesh = read_mesh(out / "k.vtu")
    assert dict(mesh.region_names) == {1: "kidney", 2: "tumour", 3: "stone"}
    for tag, radius in ((2, 0.009), (3, 0.007)):
        assert mesh.volumes[mesh.region == tag].sum() == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.06)
    scene = load_scene(out / "k.toml")
    assert scene.material.youngs_modulus == 8000
    assert [(one.name, one.lesion, one.material.youngs_modulus) for one in scene.regions] == [
        ("tumour", True, 32000.0),
        ("stone", False, 90000.0),
    ]
    # What is no lesion is in every organ.
    anatomy = load_anatomy(scene)
    assert [one.region for one in anatomy.specification().lesions] == ["stone"]
    assert "nothing is known" not in capsys.readouterr().out


def test_a_broken_surface_is_mended_only_when_asked(tmp_path, capsys):
    broken = ball(tmp_path / "liver.stl", drop=6)
    given = ["organ", broken, "--length-unit", "mm", "--cell-size", "0.008"]
    assert "the surface is open" in refused(capsys, *given)
    out = tmp_path / "liver.vtu"
    assert main([*map(str, given), "--mend", "--out", str(out)]) == 0
    assert "mended: liver was rebuilt from voxels of 1.33 mm" in capsys.readouterr().err
    # Lines that leave through the hole are outvoted; voxels of a sixth of a cell hold the ball within 2 %.
    whole = trimesh.creation.icosphere(3, 0.03).volume
    assert read_mesh(out).volumes.sum() == pytest.approx(whole, rel=0.02)


def test_surfaces_that_cross_are_joined_when_mended(tmp_path, capsys):
    first, second = (trimesh.creation.icosphere(3, 30.0).apply_translation([x, 0.0, 0.0]) for x in (0.0, 25.0))
    both = trimesh.util.concatenate([first, second])
    # One triangle joins the two into one body, so that they are not two.
    both.faces[0, 0] = len(first.vertices)
    both.export(tmp_path / "liver.stl")
    given = ["organ", str(tmp_path / "liver.stl"), "--length-unit", "mm", "--cell-size", "0.008"]
    refused(capsys, *given)
    assert main([*given, "--mend", "--out", str(tmp_path / "a.vtu")]) == 0
    # Two balls of radius R less their lens of height 2 h: the lens is 2 pi h^2 (3 R - h) / 3 with h = R - d / 2.
    h = 0.03 - 0.0125
    union = 2 * 4 / 3 * np.pi * 0.03**3 - 2 * np.pi * h**2 * (0.09 - h) / 3
    assert read_mesh(tmp_path / "a.vtu").volumes.sum() == pytest.approx(union, rel=0.03)


def test_the_largest_surface_is_kept(tmp_path, capsys):
    both = trimesh.util.concatenate(
        [trimesh.creation.icosphere(3, 30.0), trimesh.creation.icosphere(2, 5.0).apply_translation([60.0, 0.0, 0.0])]
    )
    both.export(tmp_path / "liver.stl")
    assert main(["organ", str(tmp_path / "liver.stl"), "--length-unit", "mm", "--cell-size", "0.01"]) == 0
    assert "1 surface(s) apart from the largest were left out (0.506 ml)" in capsys.readouterr().err


def test_nothing_of_others_is_overwritten_and_nothing_half_written(tmp_path, capsys):
    file = scan(tmp_path / "ct.nii.gz", spacing=(3.0, 3.0, 3.0))
    out = tmp_path / "out"
    out.mkdir()
    given = ["organ", file, *LABELS, "--cell-size", "0.009", "--out", out / "a.vtu"]
    (out / "a.toml").write_text("mine", encoding="utf-8")
    assert "is there, and not of an earlier run" in refused(capsys, *given)
    (out / "a.toml").unlink()
    others = "<!DOCTYPE html>\n<p>What I think of surgsim organ</p>"
    (out / "report.html").write_text(others, encoding="utf-8")
    assert "report.html is there" in refused(capsys, *given)
    (out / "report.html").unlink()
    assert "approach is (0.0, 0.0, 0.0)" in refused(capsys, *given, "--approach", "0,0,0")
    assert not list(out.iterdir())
    for _ in range(2):
        assert main([str(one) for one in given]) == 0
    assert {path.name for path in out.iterdir()} == {"a.vtu", "a.toml", "report.html"}


@pytest.mark.parametrize("there", [[], ["a.vtu", "a.toml", "report.html"], ["a.toml"]])
@pytest.mark.parametrize("failing", [1, 2, 3])
def test_three_files_are_replaced_or_none(there, failing, tmp_path, monkeypatch):
    part, out = tmp_path / "part", tmp_path / "out"
    part.mkdir()
    out.mkdir()
    names = ["a.vtu", "a.toml", "report.html"]
    for name in names:
        (part / name).write_text("new", encoding="utf-8")
    for name in there:
        (out / name).write_text(f"old {name}", encoding="utf-8")
    real, calls = os.replace, []

    def replace(source, target):
        calls.append(target)
        if len(calls) == failing:
            raise PermissionError(13, "in use", str(target))
        real(source, target)

    monkeypatch.setattr("surgsim_env.patient.command.os.replace", replace)
    with pytest.raises(PermissionError):
        _replace([out / name for name in names], part)
    assert {path.name: path.read_text(encoding="utf-8") for path in out.iterdir()} == {
        name: f"old {name}" for name in there
    }


def test_the_report_shows_the_command_that_was_given(tmp_path, monkeypatch):
    given = ["--anchors=-0.06,0.025,0.08,0.03", "--tip-radius", "0.008", "--press-depth", "0.004", "--spacing", "0.012"]
    file = scan(tmp_path / "ct.nii.gz", spacing=(3.0, 3.0, 3.0))
    arguments = ["palpate", "--segmentation", str(file), *LABELS, "--cell-size", "0.009", *given]
    arguments += ["--around=-0.06,0.0,0.13,0.01", "--out", str(tmp_path / "out"), "--workers", "1"]
    pressed = []
    monkeypatch.setattr("surgsim_env.palpation.job.run_palpation", lambda *_, **__: pressed.append(1) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        main(arguments)
    assert pressed
    page = html.unescape((tmp_path / "out" / "report.html").read_text(encoding="utf-8"))
    (command,) = re.findall(r"<code>(surgsim .*)</code>", page)
    words = shlex.split(command)
    assert words[:2] == ["surgsim", "palpate"]
    for word in arguments:
        assert word in words, word
    # It is read as what was given.
    again = []
    monkeypatch.setattr("surgsim_env.palpation.palpate_command.palpate", lambda request, _: again.append(request))
    assert main(words[1:]) == 0
    assert again[0].command == command
    assert again[0].anchors == ("-0.06,0.025,0.08,0.03",)
    assert again[0].spacing == 0.012


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (["--seed", "-1"], "--seed is -1"),
        (["--around", "0,0,0,-1"], "the radius is -1 m"),
        (["--around", "0,0,0"], "the form is x,y,z,radius"),
        (["--lesion", "0,0,0,0.01,0"], "the modulus ratio is 0"),
    ],
)
def test_palpation_s_options_are_looked_at_before_an_organ_is_made(option, words, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("surgsim_env.patient.command.palpable_patient", lambda *_: pytest.fail("an organ was made"))
    file = scan(tmp_path / "ct.nii.gz", spacing=(6.0, 6.0, 6.0))
    given = ["palpate", "--segmentation", file, *LABELS, *option, "--out", tmp_path / "out"]
    assert words in refused(capsys, *given)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        (["--labels", "liver=1", "--region", "a=b.stl"], "--region goes with surfaces"),
        (["--labels", "liver=1", "--length-unit", "mm"], "--length-unit goes with surfaces"),
        ([], "which labels are the organ?"),
        (["--labels", "liver=1", "--mesher", "cgal"], "must be lattice or tetwild"),
        (["--labels", "liver=1", "--modulus", "lesion=5"], "there is no such region"),
        (["--labels", "liver=1", "--modulus", "lesion"], "the form is NAME=PASCAL"),
        (["--labels", "liver=1", "--cell-size", "0.05"], "too coarse"),
        (["--labels", "liver=1", "--cell-size", "-1"], "cell_size is -1"),
        (["--labels", "liver=1", "--youngs-modulus", "0"], "must be finite and above 0"),
    ],
)
def test_options_that_do_not_fit_a_scan(extra, words, tmp_path, capsys):
    file = scan(tmp_path / "ct.nii.gz", spacing=(4.0, 4.0, 4.0))
    assert words in refused(capsys, "organ", file, *extra)


def test_options_that_do_not_fit_surfaces_or_tets(written, tmp_path, capsys):
    surface = ball(tmp_path / "liver.stl")
    unit = ["--length-unit", "mm"]
    assert "--labels goes with a label image" in refused(capsys, "organ", surface, *unit, "--labels", "a=1")
    assert "is no NAME=FILE" in refused(capsys, "organ", surface, *unit, "--region", "lesion")
    outside = ball(tmp_path / "lesion.stl", 5.0, (40.0, 0.0, 0.0))
    assert "only 0% of it lies inside" in refused(capsys, "organ", surface, outside, *unit, "--cell-size", "0.01")
    twice = ["--region", f"lesion={outside}", "--region", f"lesion={outside}"]
    assert "is given twice" in refused(capsys, "organ", surface, *twice, *unit)
    assert "--mend goes with" in refused(capsys, "organ", written / "patient.vtu", "--mend")
    for size in ("0.01", "0"):
        assert "--cell-size goes with" in refused(capsys, "organ", written / "patient.vtu", "--cell-size", size)
    assert "is no surface" in refused(capsys, "organ", surface, written / "patient.vtu", *unit)
    assert "goes with --segmentation" in refused(capsys, "palpate", "--scene", "phantom", *LABELS)
    assert "give a file" in refused(capsys, "organ")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["openhelp_kidney_left", "openhelp_stomach"])
def test_real_organs_in_one_command(name, anatomy_folder, tmp_path):
    file = anatomy_folder / f"{name}.stl"
    assert main(["palpate", "--surface", str(file), "--length-unit", "mm", "--out", str(tmp_path)]) == 0
    check_run(tmp_path, name)


@pytest.mark.slow
def test_a_scan_in_one_command(tmp_path):
    file = scan(tmp_path / "ct.nii.gz", spacing=(1.0, 1.0, 3.0))
    assert main(["palpate", "--segmentation", str(file), *LABELS, "--out", str(tmp_path / "out")]) == 0
    check_run(tmp_path / "out", "ct")


def check_run(folder, name):
    """What issue 8 asks of a run: volume, angles, no inverted tet, some sites."""
    page = (folder / "report.html").read_text(encoding="utf-8")
    (error,) = re.findall(r"ml, ([+-][\d.]+)% of what the file has", page)
    assert abs(float(error)) < 2.0
    assert mesh_quality(read_mesh(folder / f"{name}.vtu")).dihedral_smallest_deg > 10
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert summary["volume_ratio_smallest"] > 0.0
    assert summary["sites"]["in_maps"] >= 10


@pytest.mark.slow
def test_tetwild_makes_conforming_regions_and_leaves_nothing_behind(tmp_path, monkeypatch):
    pytest.importorskip("pytetwild", reason="needs the `tetwild` extra")
    monkeypatch.chdir(tmp_path)
    file = scan(tmp_path / "ct.nii.gz", spacing=(2.0, 2.0, 2.0))
    out = tmp_path / "out"
    out.mkdir()
    given = ["organ", str(file), *LABELS, "--cell-size", "0.01", "--mesher", "tetwild", "--out", str(out / "a.vtu")]
    assert main(given) == 0
    assert {path.name for path in tmp_path.rglob("*")} == {"ct.nii.gz", "out", "a.vtu", "a.toml", "report.html"}
    mesh = read_mesh(out / "a.vtu")
    assert mesh.volumes.sum() == pytest.approx(ORGAN_VOLUME, rel=0.02)
    # Tets follow the lesion's surface to its smoothing, in cells as wide as it is; whole ones would reach mm further.
    centre, radius = LESIONS[0]
    corners = mesh.points[np.unique(mesh.tets[mesh.region == 2])]
    reach = np.linalg.norm(corners - 1e-3 * (MIDDLE + centre), axis=1).max()
    assert reach == pytest.approx(1e-3 * radius, rel=0.08)
