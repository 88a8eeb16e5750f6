"""The page's organ with a scan's own surface: what is sent to a browser, and the paint on it. No browser is needed."""

from types import SimpleNamespace

import numpy as np
import pytest

from surgsim_apps.live.stage import SCALE, FeltMap, OrganView
from surgsim_env.rendering.embedding import EmbeddedSurface, organ_surface
from surgsim_env.scene.anatomy import load_anatomy


class Sent:
    """Meshes given to a viser scene, by name, the last one of each."""

    def __init__(self) -> None:
        self.meshes = {}

    def add_mesh_simple(self, name, vertices, faces, **look):
        self.meshes[name] = SimpleNamespace(vertices=vertices, faces=faces, visible=True, **look)
        return self.meshes[name]


@pytest.fixture(scope="module")
def anatomy(fine_scene):
    return load_anatomy(fine_scene)


@pytest.fixture
def view(anatomy):
    sent = Sent()
    return OrganView(sent, anatomy), sent


def test_its_vertices_are_sent_and_follow_the_nodes(anatomy, view):
    organ, sent = view
    surface = organ_surface(anatomy)
    assert isinstance(surface, EmbeddedSurface)
    np.testing.assert_array_equal(sent.meshes["/organ"].faces, surface.faces)
    pushed = anatomy.mesh.points * [1.0, 1.0, 0.9]
    organ.follow(pushed)
    np.testing.assert_allclose(sent.meshes["/organ"].vertices, SCALE * surface.follow(pushed)[0], rtol=0, atol=1e-6)


def test_touches_paint_it_where_they_were_felt_and_nowhere_else(anatomy, view):
    organ, sent = view
    felt, scene = FeltMap(anatomy), anatomy.scene
    top = anatomy.mesh.points[anatomy.face.triangles].mean(axis=(0, 1))
    depth = scene.palpation.press_depth
    tip = top + (depth - scene.instrument.tip_radius) * anatomy.face.approach
    organ.paint(felt)
    organ.follow(anatomy.mesh.points)
    assert not any(name.startswith("/felt") for name in sent.meshes)
    for _ in range(20):
        felt.feel(tip, depth, 0.3)
    assert felt.felt.any() and not felt.felt.all()
    organ.paint(felt)
    organ.follow(anatomy.mesh.points)
    painted = np.concatenate([mesh.vertices for name, mesh in sent.meshes.items() if name.startswith("/felt")]) / SCALE
    assert len(painted)
    # A vertex is painted only where all corners of its triangle were felt.
    nodes = anatomy.mesh.points[felt.nodes[felt.felt]]
    reach = np.linalg.norm(nodes - top, axis=1).max()
    assert np.linalg.norm(painted - top, axis=1).max() < reach + 0.001
