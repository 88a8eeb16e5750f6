"""Pictures against geometry: where things are, how far, what they are called, and that they move."""

import copy

import mujoco
import numpy as np
import pytest

from msdm_core.mesh.geodesic import NearestTriangle
from surgsim_env.rendering import stage
from surgsim_env.rendering.embedding import organ_surface
from surgsim_env.rendering.looks import TRAIN, draw_look, look_generator
from surgsim_env.rendering.options import CAMERAS, RenderOptions
from surgsim_env.rendering.renderer import OrganRenderer
from surgsim_env.rendering.scene_model import ABDOMEN
from surgsim_env.rendering.stage import FRONT_GROUPS, LABELS, SCENERY_GROUP

pytestmark = pytest.mark.usefixtures("opengl")
ORGAN, INSTRUMENT, LESION = (LABELS[name] for name in ("organ", "instrument", "lesion"))


@pytest.fixture
def draw():
    """A function that makes renderers, all of which are closed after the test."""
    made = []

    def make(press, **options):
        made.append(OrganRenderer(press.simulation, RenderOptions(**options), lesions=[press.lesion]))
        return made[-1]

    yield make
    for renderer in made:
        renderer.close()


def reach(places, width, height, border=1):
    """Whole pixels of places [pixels] that lie in the picture, and which places those are."""
    pixels = np.floor(places).astype(int)
    inside = ((pixels >= border) & (pixels < np.array([width, height]) - border)).all(axis=1)
    return pixels[inside], inside


@pytest.mark.parametrize("camera", CAMERAS)
def test_organ_is_where_its_nodes_project_to_and_nowhere_else(press, draw, camera):
    """Every node's pixel shows the organ or an instrument before it; every organ pixel lies by a projected triangle."""
    renderer = draw(press, camera=camera)
    labels = renderer.segmentation()
    assert labels.shape == (480, 640) and labels.dtype == np.uint8
    mesh = press.simulation.anatomy.mesh
    nodes = press.simulation.organ_state.node_position[mesh.boundary_nodes]
    pixels, _ = renderer.cameras[camera].project(nodes, 640, 480)
    seen, _ = reach(pixels, 640, 480)
    # A node on the outline may show as its neighbour pixel does.
    around = [labels[seen[:, 1] + dy, seen[:, 0] + dx] for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
    assert np.isin(around, (ORGAN, INSTRUMENT)).any(axis=0).all()
    rows, columns = np.nonzero(labels == ORGAN)
    corners = mesh.boundary_triangles
    flat = renderer.cameras[camera].project(press.simulation.organ_state.node_position, 640, 480)[0]
    flat = np.column_stack([flat, np.zeros(len(flat))])[corners]
    for index in np.linspace(0, len(rows) - 1, 40).astype(int):
        point = np.array([columns[index] + 0.5, rows[index] + 0.5, 0.0])
        triangle, weights = NearestTriangle(flat)(point)
        assert np.linalg.norm(weights @ flat[triangle] - point) < 5.0


def test_labels_count_up_to_the_picture_and_to_the_shapes(phantom, draw):
    """Without a lesion shown there are three labels; the ball's pixels are those of its circle."""
    renderer = draw(phantom, camera="above")
    labels = renderer.segmentation()
    counts = {name: int((labels == number).sum()) for name, number in LABELS.items()}
    assert sum(counts.values()) == labels.size and counts["lesion"] == 0
    assert counts["background"] > 1000 and counts["organ"] > 1000
    # From above the shaft hides in the ball's circle or stands off it; the ball's centre is instrument, its rim too.
    camera, tip = renderer.cameras["above"], phantom.simulation.instrument.tip_position
    radius = phantom.simulation.anatomy.scene.instrument.tip_radius
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(24)])
    pixels, _ = camera.project(tip + np.concatenate([0.93 * radius * circle, 1.15 * radius * circle]), 640, 480)
    inner, outer = np.split(np.floor(pixels).astype(int), 2)
    assert (labels[inner[:, 1], inner[:, 0]] == INSTRUMENT).all()
    assert (labels[outer[:, 1], outer[:, 0]] == INSTRUMENT).mean() < 0.6


@pytest.mark.parametrize("left_there", [mujoco.mjtObj.mjOBJ_GEOM, mujoco.mjtObj.mjOBJ_BODY])
def test_lesions_are_labelled_whatever_the_memory_of_their_geoms_held(phantom, draw, left_there):
    """MuJoCo hands out geoms that nobody has written, and mjv_initGeom writes only a part of them."""
    renderer = draw(phantom, camera="side", show_lesion=True)
    renderer.rgb()
    drawn = renderer._stage.canvas.drawn
    for geom in drawn.geoms[drawn.ngeom - 1 :]:
        geom.objtype, geom.objid, geom.category = left_there, 1000, mujoco.mjtCatBit.mjCAT_STATIC
    assert (renderer.segmentation() == LESION).sum() > 100


@pytest.mark.parametrize("camera", CAMERAS)
def test_depth_of_visible_nodes_is_their_distance(press, draw, camera):
    """At a node's pixel the depth is the node's to 1 mm, unless something nearer hides it (and never is it farther)."""
    renderer = draw(press, camera=camera)
    depth, view = renderer.depth(), renderer.cameras[camera]
    assert depth.shape == (480, 640) and depth.dtype == np.float32
    anatomy = press.simulation.anatomy
    vertices, normals = organ_surface(anatomy).follow(press.simulation.organ_state.node_position)
    # Facing the camera within 60 degrees, so that a pixel's width does not matter.
    towards = view.position - vertices
    facing = (normals * towards).sum(axis=1) > 0.5 * np.linalg.norm(towards, axis=1)
    pixels, distance = view.project(vertices[facing], 640, 480)
    seen, inside = reach(pixels, 640, 480)
    measured, expected = depth[seen[:, 1], seen[:, 0]], distance[inside]
    # On the outline the pixel beside it may be the one.
    nearest = np.min([depth[seen[:, 1] + dy, seen[:, 0] + dx] for dx in (-1, 0, 1) for dy in (-1, 0, 1)], axis=0)
    assert (nearest < expected + 1e-3).all()
    labels = renderer.segmentation()[seen[:, 1], seen[:, 0]]
    visible = (labels == ORGAN) & (measured > expected - 5e-3)
    assert visible.mean() > 0.7
    np.testing.assert_allclose(measured[visible], expected[visible], atol=1e-3)


def test_pressed_organ_looks_and_measures_differently(press, draw):
    """The surface in the picture goes down with the tissue under the tip, by as much as the nodes do."""
    renderer = draw(press, camera="endoscope", show_force=False)
    before, depth_before = renderer.rgb(), renderer.depth()
    assert before.shape == (480, 640, 3) and before.dtype == np.uint8
    press.press(1.4 * press.simulation.anatomy.scene.palpation.press_depth)
    after, depth_after = renderer.rgb(), renderer.depth()
    assert (before != after).any(axis=2).mean() > 0.002
    nodes, rest = press.simulation.organ_state.node_position, press.simulation.anatomy.mesh.points
    face = np.unique(press.simulation.anatomy.face.triangles)
    moved = face[np.argsort(-np.linalg.norm((nodes - rest)[face], axis=1))][:12]
    pixels, distance = renderer.cameras["endoscope"].project(nodes[moved], 640, 480)
    column, row = np.floor(pixels).astype(int).T
    visible = (renderer.segmentation()[row, column] == ORGAN) & (np.abs(depth_after[row, column] - distance) < 2e-3)
    assert visible.any()
    change = depth_after[row, column] - depth_before[row, column]
    assert np.abs(change[visible]).max() > 0.3 * np.linalg.norm((nodes - rest)[moved], axis=1).max() * 0.5


def test_same_state_same_bytes(press, draw):
    """Also with another renderer, after other pictures, and by a copy."""
    press.press(0.003)
    for options in ({}, {"show_lesion": True}, {"cut_away": True}):
        renderer = draw(press, **options)
        frame = renderer.rgb()
        renderer.rgb("above")
        renderer.depth()
        assert renderer.rgb().tobytes() == frame.tobytes()
        assert draw(press, **options).rgb().tobytes() == frame.tobytes()
        twin = copy.deepcopy(renderer)
        assert twin.rgb().tobytes() == frame.tobytes()
        twin.close()


@pytest.mark.parametrize("options", [{"show_lesion": True}, {"cut_away": True}])
def test_lesion_is_seen_where_it_is_and_only_when_asked(press, draw, options):
    plain, shown = draw(press, show_force=False), draw(press, show_force=False, **options)
    assert (plain.segmentation() == LESION).sum() == 0
    labels = shown.segmentation()
    rows, columns = np.nonzero(labels == LESION)
    view = plain.cameras["overview"]
    (centre,), (depth,) = view.project(np.array([press.lesion.centre]), 640, 480)
    radius = press.lesion.radius * 0.5 * 480 / np.tan(np.radians(0.5 * view.fov)) / depth
    # A ball's outline (seen whole) or its section, seen aslant and partly behind the instrument.
    full = np.pi * radius**2
    assert 0.5 * full < len(rows) < 1.15 * full
    assert np.hypot(rows - centre[1], columns - centre[0]).max() < 1.2 * radius
    # Yellowish there, tissue elsewhere: the lesion's green is well above the tissue's.
    green = [int(frame.rgb()[rows, columns, 1].mean()) for frame in (plain, shown)]
    assert green[1] > green[0] + 40


def test_cut_away_takes_the_near_side(press, draw):
    """Behind the cut the picture is farther away: nearest organ pixel of the whole and of the cut organ."""
    whole, cut = draw(press), draw(press, cut_away=True)
    labels = [renderer.segmentation() for renderer in (whole, cut)]
    nearest = [renderer.depth()[label == ORGAN].min() for renderer, label in zip((whole, cut), labels)]
    assert nearest[1] > nearest[0] + 0.005


def test_whatever_a_fault_leaves_can_be_drawn(phantom, draw):
    """Nodes that are no numbers any more: a video of the episode goes on to its end."""
    phantom.press(0.003)
    phantom.simulation.organ_state.node_position[:] = np.nan
    for options in ({}, {"show_lesion": True}, {"cut_away": True}):
        assert draw(phantom, **options).rgb().shape == (480, 640, 3)


def test_renderers_share_their_meshes_and_give_them_back(make_press, draw):
    held = len(stage._stages)
    presses = [make_press("phantom") for _ in range(4)]
    presses[1].press(0.004)
    renderers = [draw(press) for press in presses]
    frames = [renderer.rgb() for renderer in renderers]
    assert len(stage._stages) == held + 1
    assert frames[0].tobytes() == frames[2].tobytes() != frames[1].tobytes()
    for renderer in renderers[:3]:
        renderer.close()
    assert len(stage._stages) == held + 1
    assert renderers[3].rgb().tobytes() == frames[3].tobytes()
    renderers.clear()
    del frames
    draw(presses[0]).close()


@pytest.mark.parametrize("cut_away", [False, True])
def test_a_field_is_painted_where_it_is(press, draw, cut_away):
    """The organ is purple far from the tip, green below it; the picture without the option stays as it was."""
    press.press(0.006)
    plain = draw(press, cut_away=cut_away).rgb()
    renderer = draw(press, paint="stress", show_force=False, cut_away=cut_away)
    frame, labels = renderer.rgb().astype(int), renderer.segmentation()
    # Viridis begins with purple, and has more green than red from a fifth of its scale on.
    rows, columns = np.nonzero((labels == ORGAN) & (frame[..., 1] > frame[..., 0]))
    assert 0 < len(rows) < 0.2 * (labels == ORGAN).sum()
    (place,), _ = renderer.cameras["overview"].project(press.simulation.contact_centre[None], 640, 480)
    # Within a radius of the ball, 50 to 60 pixels, around and below the contact.
    assert np.linalg.norm(np.median([columns, rows], axis=1) - place) < 60.0
    np.testing.assert_array_equal(draw(press, cut_away=cut_away).rgb(), plain)


# ---- styles --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("camera", CAMERAS)
def test_the_abdomen_hides_nothing(press, draw, camera):
    """Drawn among the organ and the instrument it is in front of neither; it fills the rest of the picture."""
    renderer = draw(press, camera=camera)
    labels, scene = renderer.segmentation(), renderer._stage.scene
    with renderer._shown(renderer.cameras[camera]) as shown:
        shown.canvas.look(renderer.cameras[camera], groups=[*FRONT_GROUPS, SCENERY_GROUP])
        numbers, drawn = shown.canvas.numbers(), shown.canvas.drawn
        geoms = drawn.geoms[: drawn.ngeom]
    (abdomen,) = [geom.segid + 1 for geom in geoms if geom.segid >= 0 and geom.objid == scene.model.geom(ABDOMEN).id]
    np.testing.assert_array_equal(numbers == abdomen, labels == LABELS["background"])


@pytest.mark.parametrize("options", [{}, {"show_lesion": True}, {"cut_away": True}], ids=str)
def test_styles_differ_in_colour_alone(press, draw, options):
    """Depth and labels are of one geometry; the shadow on the plain style's drape lies 0.2 mm above it."""
    press.press(0.003)
    plain, shaded = (draw(press, style=style, show_force=False, **options) for style in ("plain", "endoscopic"))
    assert (plain.rgb() != shaded.rgb()).any(axis=2).mean() > 0.9
    np.testing.assert_array_equal(plain.segmentation(), shaded.segmentation())
    np.testing.assert_allclose(plain.depth("above"), shaded.depth("above"), atol=3e-4)


def test_looks_and_paint_are_drawn_in_the_plain_style(phantom, draw):
    """To the bit, whatever the style, so that policies see what they were trained on."""
    phantom.press(0.003)
    look = draw_look(TRAIN, look_generator(TRAIN, 2))
    for options in ({}, {"paint": "stress"}):
        plain, shaded = draw(phantom, style="plain", **options), draw(phantom, **options)
        own = shaded.rgb()
        plain.look = shaded.look = look
        np.testing.assert_array_equal(shaded.rgb(), plain.rgb())
        shaded.look = None
        np.testing.assert_array_equal(shaded.rgb(), own)


def test_light_falls_off(phantom, draw):
    """The wall of the abdomen, far behind the organ, is darker than the floor before it."""
    frame = draw(phantom, camera="side", show_force=False).rgb().astype(float)
    assert frame[:60, :100].mean() < 0.6 * frame[-80:, :100].mean()
