"""A patient's scene: materials by names, and an organ without room for hidden lesions."""

import math
from dataclasses import replace

import pytest
import trimesh

from surgsim_apps.cli.main import main
from surgsim_apps.palpate.sites import plan_sites
from surgsim_apps.patient import patient_scene
from surgsim_apps.patient.materials import is_lesion, organ_material, region_material
from surgsim_env.envs.ids import PalpateEnv
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import load_scene


@pytest.mark.parametrize(
    ("region", "organ", "lesion", "modulus", "source"),
    [
        ("lesion 2", "liver", True, 8 * 2140.0, "doi 10.1177/8756479317733713"),
        ("Tumour", "liver", True, 8 * 2140.0, "doi 10.1177/8756479317733713"),
        ("hepatic adenoma", "liver", True, 1.9 * 2140.0, "PMID 26299323"),
        ("FNH 1", "liver", True, 7.9 * 2140.0, "PMID 26299323"),
        ("tumor", "left kidney", True, 4 * 8000.0, "PMID 26880174"),
        ("stomach", "liver", False, 5000.0, "no source was looked up"),
        ("kidney", "liver", False, 8000.0, "PMC10403462"),
        ("portal vein", "left kidney", False, 8000.0, "nothing is known of 'portal vein' here"),
        ("lesion", "pancreas", True, 8 * 2140.0, "doi 10.1177/8756479317733713"),
    ],
)
def test_materials_go_by_names(region, organ, lesion, modulus, source):
    healthy = organ_material(organ)
    tissue = region_material(region, organ, healthy.material, {})
    assert is_lesion(region) == lesion
    assert tissue.material.youngs_modulus == pytest.approx(modulus)
    assert source in tissue.source
    assert (tissue.material.density, tissue.material.poisson_ratio) == (1060.0, 0.45)
    # Of a liver and of what is unknown, with their lesions.
    assert (tissue.material.relaxation is not None) == (lesion and organ != "left kidney")


def test_contact_is_as_stiff_as_a_press_feels_the_tissue():
    """200 E / a with E (1 + sum g_i exp(-t / tau_i)) at the 0.15 s that a press loads the tissue."""
    arms = zip((0.8, 0.8, 0.5), (0.15, 1.86, 51.3), strict=True)
    modulus = 2140.0 * (1.0 + sum(g * math.exp(-0.15 / tau) for g, tau in arms))
    liver, kidney = (organ_material(name).material for name in ("liver", "kidney"))
    assert patient_scene._contact_stiffness(liver, 0.0046) == pytest.approx(200.0 * modulus / 0.0046, rel=5e-3)
    assert patient_scene._contact_stiffness(kidney, 0.0092) == pytest.approx(200.0 * 8000.0 / 0.0092, rel=5e-3)


@pytest.mark.slow
def test_a_thin_organ_is_pressed_all_over_and_may_have_no_room_for_hidden_lesions(tmp_path, capsys, monkeypatch):
    """A plate of 16 mm, pressed 3.8 mm deep: less than five depths, more than three; lesions of 29 mm and more."""
    monkeypatch.setattr(patient_scene, "LAYOUT", replace(patient_scene.LAYOUT, lesion_shrinks=(1.5,)))
    trimesh.creation.box((50.0, 40.0, 16.0)).export(tmp_path / "liver.stl")
    out = tmp_path / "a.vtu"
    given = ["organ", str(tmp_path / "liver.stl"), "--length-unit", "mm", "--cell-size", "0.004"]
    assert main([*given, "--out", str(out)]) == 0
    warnings = capsys.readouterr().err
    assert "the organ is thin: sites with 3 instead of 5 press depths of organ are pressed" in warnings
    assert "there is no [lesion] table" in warnings
    scene = load_scene(out.with_suffix(".toml"))
    assert scene.lesion is None
    assert scene.palpation.press_depth == pytest.approx(0.0038)
    assert scene.palpation.thickness_smallest == pytest.approx(3 * 0.0038)
    assert len(plan_sites(load_anatomy(scene))[0]) >= 1
    with pytest.raises(ValueError, match=r"has no \[lesion\] table"):
        PalpateEnv(scene=str(out.with_suffix(".toml")))
