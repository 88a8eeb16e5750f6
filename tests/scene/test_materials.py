"""The library of materials: complete, and taken over by scenes."""

import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from msdm_core.material.regions import Material
from surgsim_env.scene.load import list_materials, make_material, scene_from_table, scenes_folder
from tests.core.measures import loss_tangent

PHANTOM = tomllib.loads((scenes_folder() / "organs" / "phantom.toml").read_text())
OWN = """
[material]
youngs_modulus = 7000.0
density = 1030.0
poisson_ratio = 0.3
"""


def scene_with(material, folder=Path("."), **entries):
    """The phantom with other entries of its material's table."""
    return scene_from_table({**PHANTOM, **entries, "material": material}, name="changed", folder=folder)


@pytest.mark.parametrize("name", list_materials())
def test_every_material_states_source_condition_and_interval(name):
    material = make_material(name)
    assert material.name == name and material.description
    for key in ("source", "condition", "interval"):
        text = getattr(material, key)
        assert text != "not stated" and text.strip() and "  " not in text, key


def test_pig_liver_stiffens_and_relaxes_as_its_file_says():
    elastic, relaxing = (make_material(name).material for name in ("pig_liver_ex_vivo", "pig_liver_ex_vivo_relaxing"))
    assert elastic.stiffening is not None and elastic.relaxation is None
    assert replace(relaxing, relaxation=None) == elastic
    arms = relaxing.relaxation
    assert arms is not None
    early, late = arms.remaining([0.2, 10.0])
    assert 1.0 - late / early == pytest.approx(0.42, abs=0.005)
    assert loss_tangent(arms, 1.0) == pytest.approx(0.18, abs=0.005)


def test_one_number_of_the_law_is_overridden_alone():
    stiffening = scene_with({"name": "pig_liver_ex_vivo", "stiffening": {"tangent_cap": 20}}).material.stiffening
    library = make_material("pig_liver_ex_vivo").material.stiffening
    assert stiffening is not None and library is not None
    assert stiffening == replace(library, tangent_cap=20.0)


def test_regions_take_materials_too():
    region = {"name": "tumour", "lesion": True, "material": {"name": "prostate_cancer_ex_vivo", "poisson_ratio": 0.4}}
    scene = scene_with({"name": "prostate_ex_vivo"}, regions=[region])
    assert scene.material.youngs_modulus == 17000.0
    assert (scene.regions[0].material.youngs_modulus, scene.regions[0].material.poisson_ratio) == (24100.0, 0.4)


def test_a_file_of_ones_own_is_found_beside_the_scene(tmp_path):
    (tmp_path / "mine.toml").write_text(OWN)
    assert scene_with({"name": "mine.toml"}, folder=tmp_path).material == Material(7000.0, 1030.0, 0.3)
    material = make_material(tmp_path / "mine.toml")
    assert material.name == "mine" and material.source == "not stated"


@pytest.mark.parametrize(
    ("material", "named"),
    [
        ({"name": "kidny_in_vivo"}, "'kidney_in_vivo'"),
        ({"name": "absent.toml"}, r"absent\.toml"),
        ({"name": "kidney_in_vivo", "densty": 1.0}, "'densty'"),
        ({"name": "kidney_in_vivo", "density": -1.0}, r"density is -1"),
        ("kidney_in_vivo", "material"),
    ],
)
def test_wrong_entries_are_refused(material, named):
    with pytest.raises(ValueError, match=named):
        scene_with(material)
