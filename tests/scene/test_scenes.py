"""Scene files: read, refused, and true to what they state."""

import math
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import surgsim_env
from msdm_core.errors import OrganError
from msdm_core.material.fitting import spring_fit
from msdm_core.mesh.ordering import spring_order
from msdm_core.organ.stability import stable_dt
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.palpation.site_press import scan
from surgsim_env.scene.anatomy import ADDED_MASS_SHARE, load_anatomy, with_added_mass
from surgsim_env.scene.load import make_scene, scene_from_table, scenes_folder
from surgsim_env.scene.model import substeps_needed


def changed(**entries):
    """The phantom's table with dotted entries replaced."""
    table = tomllib.loads((scenes_folder() / "organs" / "phantom.toml").read_text())
    for path, value in entries.items():
        *folders, last = path.split("__")
        place = table
        for folder in folders:
            place = place[folder]
        place[last] = value
    return scene_from_table(table, name="changed", folder=Path("."))


WITH_LESIONS = [name for name in surgsim_env.list_scenes() if make_scene(name).lesion is not None]


@pytest.mark.parametrize("name", surgsim_env.list_scenes())
def test_every_scene_loads_with_its_palpable_face_and_sites(name):
    scene = make_scene(name)
    anatomy = load_anatomy(scene)
    assert len(anatomy.anchors) + len(anatomy.foundation_nodes) > 10
    points, normals = anatomy.face.raster(scene.palpation.site_spacing)
    assert len(points) > 20
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)
    assert (normals @ np.asarray(scene.instrument.approach) < 0.0).all()


@pytest.mark.parametrize("name", WITH_LESIONS)
def test_substeps_of_a_scene_bear_its_worst_randomisation(name):
    scene = make_scene(name)
    anatomy = load_anatomy(scene)
    rng = np.random.default_rng(0)
    worst = math.inf
    # The largest, shallowest and stiffest lesions that the file allows.
    draw = scene.lesion
    extreme = replace(
        draw,
        radius=(draw.radius[1], draw.radius[1]),
        cover=(draw.cover[0], draw.cover[0]),
        modulus_ratio=(draw.modulus_ratio[1], draw.modulus_ratio[1]),
    )
    hardest = replace(anatomy, scene=replace(scene, lesion=extreme))
    for _ in range(12):
        lesion = hardest.random_lesion(rng)
        assert (
            anatomy._free_surface.distances(np.array(lesion.centre)[None])[0]
            >= draw.radius[1] + draw.cover[0] - 1.01e-4
        )
        worst = min(worst, stable_dt(anatomy.organ([lesion]), scene.contact.law))
    assert substeps_needed(scene.timing.haptic_step, worst) <= scene.timing.substep_count


def test_too_few_substeps_are_refused_with_the_number_needed():
    with pytest.raises(OrganError, match=r"1 substeps of 1 ms are too long .*timing\.substep_count = 3"):
        Simulation(load_anatomy(changed(timing__substep_count=1)))
    anatomy = load_anatomy(make_scene("phantom"))
    simulation = Simulation(anatomy)
    hard = anatomy.lesion_at([0.03, 0.03, 0.015], 0.01, 40.0, "stone")
    with pytest.raises(OrganError, match="or use softer lesions"):
        simulation.reset(anatomy.organ([hard]), np.array([0.03, 0.03, 0.05]))


@pytest.mark.parametrize(
    ("entries", "named"),
    [
        ({"material__poisson_ratio": 0.5}, "poisson_ratio is 0.5"),
        ({"material__density": math.nan}, "density is nan"),
        ({"material__density": "heavy"}, "heavy"),
        ({"material__youngs_moduls": 3.0}, "'youngs_moduls'"),
        ({"limits__hard_force": 0.1}, "hard_force"),
        ({"lesion__radius": [0.01, 0.006]}, "radius = "),
        ({"mesh__block": None}, "block"),
        ({"mesh__block__cells": [12.5, 12, 6]}, "12.5"),
        ({"contact__stiffness": 0.0}, "contact.stiffness is 0"),
        ({"sensor__noise": -0.005}, "sensor.noise is -0.005"),
        ({"timing__substep_count": 0}, "timing.substep_count is 0"),
        ({"instrument__tip_radius": 0.0}, "instrument.tip_radius is 0"),
        ({"instrument__approach": [0.0, 0.0, 0.0]}, "instrument.approach"),
        ({"palpation__press_depth": -0.001}, "palpation.press_depth is -0.001"),
        ({"anchors": [{"name": "nothing"}]}, "'nothing'"),
    ],
)
def test_bad_entries_are_named(entries, named):
    with pytest.raises(ValueError, match=named):
        changed(**entries)


def test_a_scene_chooses_the_stiffness_rule():
    """Of one scene's organ with formula (6) and with fitted springs, the springs differ by the mesh's factors."""
    lloyd, fitted = load_anatomy(changed()), load_anatomy(changed(stiffness_rule="fitted"))
    factor = spring_fit(fitted.mesh).edge_factor
    assert not spring_fit(fitted.mesh).report.fallback
    lesion = lloyd.demonstration_lesions()
    springs = lloyd.organ(lesion).spring_stiffness
    factor = factor[spring_order(fitted.mesh).springs]
    np.testing.assert_array_equal(fitted.organ(lesion).spring_stiffness, factor * springs)
    with pytest.raises(ValueError, match=r"scene 'changed': stiffness rule 'fited' is unknown"):
        changed(stiffness_rule="fited")


def test_no_centre_of_a_lesion_lies_beyond_a_thin_wall():
    """5 mm past a wall of 6 mm there is a point 5 mm from the surface, too: outside."""
    wall = {"size": [0.06, 0.06, 0.006], "cells": [20, 20, 2]}
    side = {"name": "side", "box": {"lower": [-0.001] * 3, "upper": [0.0001, 0.061, 0.01]}}
    anatomy = load_anatomy(changed(mesh__block=wall, anchors=[side], palpation__thickness_smallest=0.005))
    points, normals = np.array([[0.03, 0.03, 0.006]]), np.array([[0.0, 0.0, 1.0]])
    assert np.isnan(anatomy.centres_below(points, normals, 0.005)).all()
    np.testing.assert_allclose(anatomy.centres_below(points, normals, 0.002), [[0.03, 0.03, 0.004]], atol=1e-4)


def test_mass_scaling_lets_a_scene_do_with_fewer_substeps():
    """A lesion that asks for four substeps runs with three; what was added is told at reset."""
    table = {"timing__mass_scaling": True, "lesion__modulus_ratio": [14.0, 14.0], "lesion__radius": [0.01, 0.01]}
    # Soft contact: the lesion alone asks for mass.
    table |= {"contact__stiffness": 1.9e7}
    simulation = Simulation(load_anatomy(changed(**table)))
    anatomy = simulation.anatomy
    organ = anatomy.organ([anatomy.random_lesion(np.random.default_rng(0))])
    simulation.reset(organ, simulation.instrument.upper)
    assert 0.0 < organ.added_mass < 0.03 * organ.node_mass.sum()
    plain = load_anatomy(changed(**{**table, "timing__mass_scaling": False}))
    with pytest.raises(OrganError, match=r"timing\.substep_count = 4, timing\.mass_scaling = true"):
        Simulation(plain).reset(plain.organ([plain.random_lesion(np.random.default_rng(0))]), np.zeros(3))


def test_added_mass_leaves_room_for_the_strain_of_a_press():
    """Nodes under the tip stand at the limit too: the substep is at most 0.75 of the stable step at rest."""
    table = {"lesion__modulus_ratio": [14.0, 14.0], "lesion__radius": [0.01, 0.01]}
    anatomy = load_anatomy(changed(timing__mass_scaling=True, **table))
    organ = anatomy.organ([anatomy.random_lesion(np.random.default_rng(0))])
    timing = anatomy.scene.timing
    assert organ.added_mass > 0.0
    assert timing.haptic_step / timing.substep_count <= 0.75 * stable_dt(organ, anatomy.scene.contact.law) * (
        1.0 + 1e-9
    )


def test_with_added_mass_fewer_substeps_measure_the_same():
    """8 substeps down to the 3 that 1 % of mass allows: the force of a press over the lesion within 1e-3."""
    table = {"lesion__modulus_ratio": [20.0, 20.0], "lesion__radius": [0.006, 0.006], "contact__stiffness": 1.9e7}
    anatomy = load_anatomy(changed(timing__substep_count=8, **table))
    lesion = anatomy.random_lesion(np.random.default_rng(1))

    def organ_of(case):
        return case.organ([lesion])

    fewer = with_added_mass(anatomy, lambda case: [organ_of(case)])
    assert fewer.scene.timing.substep_count == 3
    assert 0.0 < organ_of(fewer).added_mass <= ADDED_MASS_SHARE * organ_of(fewer).node_mass.sum()
    point, normal = anatomy.face.project(np.array(lesion.centre))
    forces = [scan(case, organ_of(case), point[None], normal[None])[0].force for case in (anatomy, fewer)]
    assert forces[1] == pytest.approx(forces[0], rel=1e-3)


def test_a_scene_file_of_ones_own_is_read(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text((scenes_folder() / "organs" / "phantom.toml").read_text().replace("[12, 12, 6]", "[6, 6, 3]"))
    scene = make_scene(str(path))
    assert scene.name == "mine"
    assert scene.mesh.block.cells == (6, 6, 3)
    assert load_anatomy(scene).mesh.tet_count < 2000
    path.write_text(path.read_text().replace("[6, 6, 3]", "[8, 8, 4]"))
    assert make_scene(str(path)).mesh.block.cells == (8, 8, 4), "an edited file is read again"
    with pytest.raises(ValueError, match=r"gone\.toml cannot be read"):
        make_scene(str(tmp_path / "gone.toml"))
    path.write_text("organ = [")
    with pytest.raises(ValueError, match="not valid TOML"):
        make_scene(str(path))


@pytest.mark.parametrize("name", WITH_LESIONS)
def test_every_draw_finds_room_and_keeps_its_ranges(name):
    anatomy = load_anatomy(make_scene(name))
    draw = anatomy.scene.lesion
    for seed in range(150):
        lesion = anatomy.random_lesion(np.random.default_rng(seed))
        cover = anatomy._free_surface.distances(np.array(lesion.centre)[None])[0] - lesion.radius
        assert draw.radius[0] <= lesion.radius <= draw.radius[1]
        assert draw.cover[0] - 1.01e-4 <= cover <= draw.cover[1] + 1.01e-4
