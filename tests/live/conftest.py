"""One served page for all tests of a module, and a scene with a fine surface."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from surgsim_apps.live.exchange_records import Change, Phase
from surgsim_apps.live.organ_choice import NONE, OrganChoice
from surgsim_apps.patient.fine_surface import split_edges
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import FineSurface, Scene
from tests.live.served import Served, wait_until


@pytest.fixture(scope="module")
def fine_scene(tmp_path_factory) -> Scene:
    """The small phantom with a finer surface of its own block."""
    scene = make_scene("phantom_small")
    points = load_anatomy(scene).mesh.points
    low, high = points.min(axis=0), points.max(axis=0)
    box = trimesh.creation.box(high - low)
    vertices, faces = split_edges(np.array(box.vertices) + 0.5 * (low + high), np.array(box.faces), 0.0015)
    file = tmp_path_factory.mktemp("own") / "own.ply"
    trimesh.Trimesh(vertices, faces, process=False).export(file)
    return replace(scene, mesh=replace(scene.mesh, fine_surface=FineSurface(str(file), "m")))


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    made = Served(tmp_path_factory.mktemp("live") / "out")
    yield made
    made.close()


@pytest.fixture
def fresh(served):
    """The same session with another organ, at rest, tips parked."""
    before = int(served.session.frame()["organ"])
    served.session.park()
    served.session.ask(Change(OrganChoice(lesions=NONE)))

    def renewed() -> bool:
        frame = served.session.frame()
        return int(frame["organ"]) > before and frame["phase"] == Phase.RUNNING

    wait_until(renewed)
