"""The page's organ with a scan's own surface: what is sent to a browser, and the paint on it. No browser is needed."""

from types import SimpleNamespace

import numpy as np
import pytest

from surgsim_apps.live.stage import LEVELS, NOTHING, PAINT_ABOVE, SCALE, FeltMap, OrganView
from surgsim_env.rendering.embedding import EmbeddedSurface, organ_surface
from surgsim_env.rendering.painted_fields import field_colours
from surgsim_env.scene.anatomy import load_anatomy


class Sent:
    """Meshes given to a viser scene, by name, the last one of each."""

    def __init__(self) -> None:
        self.meshes = {}

    def add_mesh_simple(self, name, vertices, faces, **look):
        self.meshes[name] = SimpleNamespace(vertices=vertices, faces=faces, visible=True, **look)
        return self.meshes[name]


def area(mesh) -> float:
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    return 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()


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


def test_a_pointer_meets_the_nearest_front_of_it(anatomy, view):
    organ, _ = view
    low, high = anatomy.mesh.points.min(axis=0), anatomy.mesh.points.max(axis=0)
    middle, above = 0.5 * (low + high), np.array([0.003, 0.002, 0.2])
    place, outward = organ.hit(middle + above, middle)
    assert place[2] == pytest.approx(high[2], abs=1e-6) and outward @ [0.0, 0.0, 1.0] > 0.99
    # On the line of sight, and regardless of the distance of the pointer's plane.
    assert np.linalg.norm(np.cross(place - middle, above / np.linalg.norm(above))) < 1e-9
    np.testing.assert_allclose(organ.hit(middle + above, middle + 0.5 * above)[0], place, atol=1e-9)
    assert organ.hit(middle + above, middle + above + [0.0, 0.0, 1.0]) is None
    assert organ.hit(middle + above, high + np.array([0.05, 0.0, 0.0])) is None


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
    # The map ends between the outermost node that was felt and its neighbours.
    away = np.linalg.norm(painted - top, axis=1).max()
    nodes = np.linalg.norm(anatomy.mesh.points[felt.nodes[felt.felt]] - top, axis=1).max()
    assert nodes - 0.001 < away < nodes + anatomy.palpable_cell


def test_a_field_covers_the_whole_organ_in_the_colours_of_its_values(anatomy, view):
    organ, sent = view
    height = anatomy.mesh.points[:, 2]
    organ.show_paint("stress")
    organ.paint_field((height - height.min()) / np.ptp(height))
    organ.follow(anatomy.mesh.points)
    painted = [mesh for name, mesh in sent.meshes.items() if name.startswith("/felt")]
    # Slightly above the organ.
    assert 1.0 <= sum(area(mesh) for mesh in painted) / area(sent.meshes["/organ"]) < 1.05
    # Each band lies between two isolines of the height.
    step, low = SCALE * np.ptp(height) / LEVELS, SCALE * height.min()
    colours = [tuple(row) for row in field_colours(LEVELS).tolist()]
    for mesh in painted:
        level = colours.index(mesh.color)
        inside = mesh.vertices[:, 2] - low - step * level
        above = 1.01 * SCALE * PAINT_ABOVE
        assert inside.min() > -above and inside.max() < step + above
    organ.show_paint(NOTHING)
    assert not any(mesh.visible for mesh in painted)
