"""`surgsim organ` from a scan: the four files it writes, and what loads and steps them."""

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401
from msdm_core.mesh.quality import mesh_quality
from msdm_core.mesh_files.mesh_io import read_mesh
from surgsim_apps.cli.main import main
from surgsim_apps.patient.materials import organ_material, region_material
from surgsim_apps.patient.patient_scene import _check_moduli
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import load_scene
from tests.patient.scans import LABELS, LESIONS, MIDDLE, ORGAN_VOLUME, scan


@pytest.fixture(scope="module")
def anatomy(written):
    return load_anatomy(load_scene(written / "patient.toml"))


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


def test_a_modulus_is_for_a_region_s_name_or_the_name_before_its_number():
    names = ["lesion 1", "lesion 2", "portal vein"]
    organ = organ_material("liver").material
    for given in ("lesion", "lesion 2", "portal vein"):
        _check_moduli({given: 1.0}, names)
        assert any(region_material(name, "liver", organ, {given: 1.0}).material.youngs_modulus == 1.0 for name in names)
    for given in ("portal", "lesion 3", "vein"):
        with pytest.raises(ValueError, match="no such region; there are lesion 1, lesion 2, portal vein"):
            _check_moduli({given: 1.0}, names)


def test_the_scene_has_what_was_segmented(anatomy):
    scene = anatomy.scene
    assert [(region.name, region.lesion) for region in scene.regions] == [("lesion 1", True), ("lesion 2", True)]
    assert scene.regions[0].material.youngs_modulus == pytest.approx(8 * scene.material.youngs_modulus)
    lesions = anatomy.demonstration_lesions()
    assert [lesion.region for lesion in lesions] == ["lesion 1", "lesion 2"]
    healthy, ill = anatomy.organ(), anatomy.organ(lesions)
    assert ill.spring_stiffness.sum() > 1.05 * healthy.spring_stiffness.sum()
    # The chosen substeps hold for both.
    step = scene.timing.haptic_step / scene.timing.substep_count
    assert step < min(healthy.stable_step, ill.stable_step)
    assert anatomy.palpable_cell < np.sqrt(scene.instrument.tip_radius * scene.palpation.press_depth)


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


@pytest.mark.slow
def test_tetwild_makes_conforming_regions_and_leaves_nothing_behind(tmp_path, monkeypatch):
    pytest.importorskip("pytetwild", reason="needs the `tetwild` extra")
    monkeypatch.chdir(tmp_path)
    file = scan(tmp_path / "ct.nii.gz", spacing=(2.0, 2.0, 2.0))
    out = tmp_path / "out"
    out.mkdir()
    given = ["organ", str(file), *LABELS, "--cell-size", "0.01", "--mesher", "tetwild", "--no-healthy-map"]
    assert main([*given, "--out", str(out / "a.vtu")]) == 0
    written = {"a.vtu", "a.toml", "a_surface.ply", "report.html"}
    assert {path.name for path in tmp_path.rglob("*")} == {"ct.nii.gz", "out", *written}
    mesh = read_mesh(out / "a.vtu")
    assert mesh.volumes.sum() == pytest.approx(ORGAN_VOLUME, rel=0.02)
    # Tets follow the lesion's surface to its smoothing, in cells as wide as it is; whole ones would reach mm further.
    centre, radius = LESIONS[0]
    corners = mesh.points[np.unique(mesh.tets[mesh.region == 2])]
    reach = np.linalg.norm(corners - 1e-3 * (MIDDLE + centre), axis=1).max()
    assert reach == pytest.approx(1e-3 * radius, rel=0.08)
