"""The page's organ with a scan's own surface: what is sent to a browser, and the paint on it. No browser is needed."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from surgsim_apps.live.stage import NOTHING, SCALE, FeltMap, OrganView, paint_colours
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


def test_a_field_covers_the_whole_organ_in_the_colours_of_its_values(anatomy, view):
    organ, sent = view
    height = anatomy.mesh.points[:, 2]
    organ.show_paint("stress")
    organ.paint_field((height - height.min()) / np.ptp(height))
    organ.follow(anatomy.mesh.points)
    painted = [mesh for name, mesh in sent.meshes.items() if name.startswith("/felt")]
    assert sum(len(mesh.faces) for mesh in painted) == len(sent.meshes["/organ"].faces)
    middles = [(mesh.color, mesh.vertices[mesh.faces][:, :, 2].mean(axis=1)) for mesh in painted]
    colours = paint_colours("stress")
    for (low_colour, low), (high_colour, high) in itertools.pairwise(sorted(middles, key=lambda row: row[1].mean())):
        assert low.max() < high.min() + 1e-6 and colours.index(low_colour) < colours.index(high_colour)
    organ.show_paint(NOTHING)
    assert not any(mesh.visible for mesh in painted)
