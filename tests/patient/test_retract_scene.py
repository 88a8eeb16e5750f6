"""Retraction scene of a patient's organ: its edge, its files and its environments."""

import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import trimesh

import surgsim_env  # noqa: F401
from msdm_core.mesh_files.mesh_io import read_mesh
from msdm_core.mesh_files.surface_io import read_surface
from msdm_core.meshing.lattice_meshing import mesh_surface
from surgsim_apps.cli.main import main
from surgsim_apps.patient.rims import SEARCH, OrganVoxels, Rim, _thickness, find_rim
from surgsim_env.scene.load import load_scene, make_retract_scene
from surgsim_env.scripting.oracle import edge_section, oracle_script
from surgsim_env.scripting.run import run_script
from tests.patient.scans import LABELS, WEDGE_EDGE, WEDGE_SLOPE, wedge

CELL = 0.007
UP = np.array([0.0, 0.0, 1.0])
RETRACTIONS = ("SurgSim/Retract-v0", "SurgSim/BimanualRetract-v0")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """The folder of a wedge's organ with a lesion; to be read only."""
    path = tmp_path_factory.mktemp("wedge")
    file = wedge(tmp_path_factory.mktemp("scan") / "wedge.nii.gz", spacing=2.0)
    given = ["organ", str(file), *LABELS, "--cell-size", str(CELL), "--no-healthy-map"]
    assert main([*given, "--out", str(path / "patient.vtu")]) == 0
    return path


@pytest.fixture(scope="module")
def scene(folder):
    return make_retract_scene(folder / "patient.toml")


@pytest.fixture(scope="module")
def env(folder):
    env = gym.make("SurgSim/Retract-v0", scene=str(folder / "patient.toml"))
    yield env
    env.close()


@pytest.mark.slow
def test_the_patient_s_scene_names_its_scene_of_retraction(folder, scene):
    assert load_scene(folder / "patient.toml").retract_scene == "patient_retract.toml"
    assert scene.name == "patient_retract"
    assert {path.name for path in folder.iterdir()} == {
        *("patient.vtu", "patient.toml", "patient_surface.ply", "report.html"),
        *("patient_retract.vtu", "patient_retract.toml", "patient_retract_surface.ply"),
    }
    assert "is lifted along" in (folder / "report.html").read_text(encoding="utf-8")


def test_it_is_the_same_organ_turned_by_what_the_file_says(folder, scene):
    text = (folder / "patient_retract.toml").read_text(encoding="utf-8")
    line = next(line for line in text.splitlines() if line.startswith("#   o = "))
    numbers = line.removeprefix("#   o = (").removesuffix(", one row each.").replace("), R = (", ", ").rstrip(")")
    values = np.array([float(number) for number in numbers.replace(";", ",").split(",")])
    origin, rotation = values[:3], values[3:].reshape(3, 3)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-5)
    plain, turned = read_mesh(folder / "patient.vtu"), read_mesh(folder / scene.mesh.tets.file)
    # Nodes are numbered anew: compare what does not depend on it, to the digits of the file's comment.
    there = (plain.points - origin) @ rotation.T
    np.testing.assert_allclose(np.sort(there, axis=0), np.sort(turned.points, axis=0), atol=1e-6)
    own, moved = (read_surface(folder / f"{name}_surface.ply", length_unit="m")[0] for name in ("patient", scene.name))
    np.testing.assert_allclose((own - origin) @ rotation.T, moved, atol=1e-6)
    for tag, name in plain.region_names:
        volume = plain.volumes[plain.region == tag].sum()
        assert turned.volumes[turned.region == turned.region_tag(name)].sum() == pytest.approx(volume, rel=1e-9)


def test_tissue_is_the_patient_s_and_lesions_are_part_of_it(folder, scene):
    patient = load_scene(folder / "patient.toml")
    assert (scene.material, scene.capsule) == (patient.material, patient.capsule)
    assert scene.stiffness_rule == patient.stiffness_rule == "lloyd"
    assert [(region.name, region.material, region.lesion) for region in scene.regions] == [
        (region.name, region.material, False) for region in patient.regions
    ]
    low, high = scene.retract.youngs_modulus
    assert low < patient.material.youngs_modulus < high
    assert scene.retract.scale == (1.0, 1.0)


def test_an_edge_s_thickness_is_the_wedge_s(folder):
    voxels = OrganVoxels(read_mesh(folder / "patient.vtu"), SEARCH.voxel)
    # In the middle of the edge: outward is down, up to the front.
    frame = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]]).T
    thickness = _thickness(voxels, np.array([0.0, -0.5e-3 * WEDGE_EDGE, 0.0]), frame)
    # To two voxels: cells of 7 mm round the edge off.
    assert thickness == pytest.approx(1e-3 * (WEDGE_EDGE + WEDGE_SLOPE * 1e3 * SEARCH.overlap), abs=2 * SEARCH.voxel)


@pytest.mark.slow
def test_the_edge_s_level_side_is_below(folder):
    rim = find_rim(read_mesh(folder / "patient.vtu"), np.array([0.0, -1.0, 0.0]))
    assert isinstance(rim, Rim)
    assert rim.thickness <= SEARCH.jaw_opening - SEARCH.jaw_play
    np.testing.assert_allclose(rim.frame.T @ rim.frame, np.eye(3), atol=1e-12)
    # The level side faces the back: up is to the front, -y of LPS, to 5 degrees.
    assert rim.frame[:, 2] @ [0.0, -1.0, 0.0] > np.cos(np.radians(5.0))


def test_targets_are_hidden_at_rest_and_only_the_flap_is_free(env, scene):
    anatomy = env.unwrapped.simulation.anatomy
    for seed in range(3):
        env.reset(seed=seed)
        assert env.unwrapped.task.visible_share <= 0.1
    free = np.setdiff1d(np.arange(anatomy.mesh.node_count), anatomy.anchors)
    assert len(free) > 100
    assert (anatomy.mesh.points[free, 1] > 0.0).all()
    # Nothing moves before it is touched: the scan's shape is the rest.
    np.testing.assert_array_equal(env.unwrapped.simulation.rest_position, anatomy.mesh.points)


@pytest.mark.parametrize("name", RETRACTIONS)
def test_environments_of_retraction_take_the_patient_s_scene(folder, name):
    env = gym.make(name, scene=str(folder / "patient.toml"))
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(5):
        observation, _, _, _, info = env.step(env.action_space.sample())
        assert info["sim_fault"] == ""
        assert env.observation_space.contains(observation)
    env.close()


@pytest.mark.slow
def test_the_oracle_lifts_the_wedge_s_edge(env):
    env.reset(seed=0)
    trace = run_script(env, oracle_script(env))
    assert trace.info["success"]
    assert trace.info["slips"] == 0
    assert trace.info["pull_force_peak"] < env.unwrapped.scene.limits.soft_force


def test_a_ball_s_thickness_is_measured():
    sphere = trimesh.creation.icosphere(3, 0.030)
    mesh = mesh_surface(sphere.vertices, sphere.faces, cell_size=0.006)
    reason = find_rim(mesh, UP)
    # A chord 12 mm below the top of a ball of 30 mm, 48 mm; more where the jaw's width adds to it.
    thickness = int(re.search(r"the thinnest is (\d+) mm thick", reason)[1])
    assert thickness == pytest.approx(2e3 * np.sqrt(0.03**2 - 0.018**2), abs=4)


def test_columns_follow_the_piece_that_the_edge_belongs_to():
    box = trimesh.creation.box((0.06, 0.06, 0.012))
    mesh = mesh_surface(box.vertices, box.faces, cell_size=0.004)
    voxels = OrganVoxels(mesh, 0.001)
    depth, height = np.array([0.005, 0.010]), np.arange(-0.02, 0.0201, 0.001)
    bottom, top = voxels.columns(np.array([0.0, 0.03, 0.0]), np.eye(3), np.array([0.0, 0.1]), depth, height)
    np.testing.assert_allclose(bottom[0], -0.006, atol=0.0011)
    np.testing.assert_allclose(top[0], 0.006, atol=0.0011)
    assert np.isnan(bottom[1]).all()


def test_the_section_of_a_box_is_its_border_and_its_sides():
    box = trimesh.creation.box((0.06, 0.06, 0.012))
    place, sides = edge_section(np.asarray(box.vertices), np.asarray(box.faces), 0.0101, 0.0)
    assert place[0] == pytest.approx(0.03, abs=0.0006)
    np.testing.assert_allclose(sides, [[-0.006, 0.006]] * len(place), atol=1e-12)
    with pytest.raises(ValueError, match=r"no tissue at x = 0\.2 m"):
        edge_section(np.asarray(box.vertices), np.asarray(box.faces), 0.2, 0.0)
