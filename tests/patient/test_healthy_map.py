"""The map of the healthy organ that `surgsim organ` writes, and what environments make of it."""

import re

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401
from surgsim_apps.cli.main import main
from surgsim_env.palpation import chart
from surgsim_env.palpation.site_press import press_alone, press_phases
from surgsim_env.scene.load import load_scene
from tests.patient.surfaces import ball

pytestmark = pytest.mark.filterwarnings("ignore:.*cell / contact radius")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder of a ball's organ with its map; to be read only."""
    path = tmp_path_factory.mktemp("ball")
    surface = ball(tmp_path_factory.mktemp("surface") / "liver.stl")
    # Coarse cells for so small a tip: what counts here is whose map it is.
    given = ["organ", str(surface), "--length-unit", "mm", "--cell-size", "0.009", "--tip-radius", "0.005"]
    assert main([*given, "--out", str(path / "made" / "patient.vtu")]) == 0
    return path / "made"


@pytest.fixture
def presses(tmp_path, monkeypatch):
    """The scenes whose healthy organ is pressed; presses are not made, and the cache is empty."""
    made = []

    def pressed(anatomy, progress, dtype, between=1):
        made.append(anatomy.scene.name)
        side = chart.charted_face(anatomy).chart.side_count
        return np.full((side, side, 3), 50.0)

    monkeypatch.setenv("SURGSIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(chart, "_pressed", pressed)
    chart.healthy_map_of.cache_clear()
    yield made
    chart.healthy_map_of.cache_clear()


def test_an_environment_takes_the_map_beside_the_scene(folder, presses):
    env = gym.make("SurgSim/PalpateSites-v0", scene=str(folder / "patient.toml"))
    env.close()
    assert not presses


def test_the_map_has_the_stiffness_of_a_press_of_one_alone(folder):
    """In the middle of the chart, against a press of the same organ outside of any group."""
    scene = load_scene(folder / "patient.toml")
    anatomy = chart.load_anatomy(chart.with_instrument(scene, "probe"))
    site = chart.charted_face(anatomy).site(np.zeros(2))
    alone = chart.SitePress(chart.Simulation(anatomy), site.point, site.normal)
    result = press_alone(alone, press_phases(scene))
    alone_stiffness = result.force @ site.normal / result.depth
    # The map's organs advance in float32 (architecture.md: forces within 0.5 %), the single one in float64.
    assert chart.healthy_map(scene).stiffness(np.zeros(2)) == pytest.approx(alone_stiffness, rel=5e-3)


@pytest.mark.parametrize("what", ["tissue", "none"])
def test_a_map_that_is_not_of_this_organ_is_made_anew(what, folder, presses, tmp_path):
    for file in folder.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    scene, kept = tmp_path / "patient.toml", tmp_path / "patient_healthy.npz"
    if what == "tissue":
        text = scene.read_text(encoding="utf-8")
        scene.write_text(re.sub(r"youngs_modulus = 2140.0", "youngs_modulus = 2180.0", text, count=1), encoding="utf-8")
        assert scene.read_text(encoding="utf-8") != text
    else:
        kept.unlink()
    assert chart.healthy_map(load_scene(scene)).stiffness(np.zeros(2)) == 50.0
    assert presses == ["patient"]
