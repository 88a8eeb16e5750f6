"""Visible share of a disc: shapes whose shadow is known in closed form, and pictures of the same."""

import math

import mujoco
import numpy as np
import pytest

from surgsim_env.tasks.visibility import Disc, hiding_geoms, visible

RADIUS = 0.008
DISC = Disc(np.zeros(3), np.array([0.0, 0.0, 1.0]), RADIUS)
# Far above the disc's middle, so that what hides close above it throws a shadow of nearly its own size.
EYE = np.array([0.0, 0.0, 0.1])
HEIGHT = 0.02
# A shape at HEIGHT throws a shadow so many times its size on the disc: similar triangles.
SHADOW = EYE[2] / (EYE[2] - HEIGHT)
NOTHING = np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32)
SIDE = 0.1


def instrument(geoms=""):
    """A MuJoCo model of geoms that hide, poses up to date."""
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geoms}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return model, data, hiding_geoms(model)


def rectangle(x0, x1, y0, y1, height=HEIGHT):
    """Two triangles, as nodes and corners."""
    nodes = np.array([[x0, y0, height], [x1, y0, height], [x1, y1, height], [x0, y1, height]])
    return nodes, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)


def joined(*parts):
    counts = np.cumsum([0, *(len(nodes) for nodes, _ in parts)])
    corners = [triangles + count for (_, triangles), count in zip(parts, counts)]
    return np.vstack([nodes for nodes, _ in parts]), np.vstack(corners).astype(np.int32)


def seen(surface=NOTHING, geoms="", eye=EYE, disc=DISC):
    return float(visible(np.asarray(eye), disc.points(), *surface, *instrument(geoms)).mean())


def segment(offset):
    """Share of a disc beyond a chord at `offset` radii from its middle."""
    return (math.acos(offset) - offset * math.sqrt(1.0 - offset**2)) / math.pi


def test_nothing_hides_nothing():
    assert seen() == 1.0


@pytest.mark.parametrize("offset", [-0.9, -0.5, -0.2, 0.0, 0.1, 0.4, 0.8])
@pytest.mark.parametrize("turn", [0.0, 0.4, 1.1, 2.0])
def test_a_half_plane_leaves_a_segment(offset, turn):
    nodes, corners = rectangle(-SIDE, offset * RADIUS / SHADOW, -SIDE, SIDE)
    cosine, sine = math.cos(turn), math.sin(turn)
    nodes = nodes @ np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    assert seen((nodes, corners)) == pytest.approx(segment(offset), abs=0.01)


def test_a_square_hole_shows_a_square():
    half = 0.5 * RADIUS / SHADOW
    frame = joined(
        rectangle(-SIDE, -half, -SIDE, SIDE), rectangle(half, SIDE, -SIDE, SIDE),
        rectangle(-half, half, -SIDE, -half), rectangle(-half, half, half, SIDE),
    )  # fmt: skip
    assert seen(frame) == pytest.approx(1.0 / math.pi, abs=0.01)


def test_a_cover_hides_all_and_one_beyond_the_disc_or_behind_the_eye_nothing():
    assert seen(rectangle(-SIDE, SIDE, -SIDE, SIDE)) == 0.0
    assert seen(rectangle(-SIDE, SIDE, -SIDE, SIDE, height=-0.001)) == 1.0
    assert seen(rectangle(-SIDE, SIDE, -SIDE, SIDE, height=0.101)) == 1.0


@pytest.mark.parametrize("kind", ["sphere", "ellipsoid"])
@pytest.mark.parametrize("radius", [0.002, 0.004])
def test_a_balls_shadow_is_a_disc(kind, radius):
    """The tangent cone from the eye has the half angle asin(r / d): on the disc's plane a circle about the middle."""
    distance = EYE[2] - HEIGHT
    shadow = EYE[2] * math.tan(math.asin(radius / distance))
    sizes = f"{radius}" if kind == "sphere" else f"{radius} {radius} {radius}"
    share = seen(geoms=f'<geom type="{kind}" size="{sizes}" pos="0 0 {HEIGHT}"/>')
    assert share == pytest.approx(1.0 - (shadow / RADIUS) ** 2, abs=0.01)


def test_a_balls_shadow_from_the_side_is_an_ellipse():
    """Seen at 45 degrees from afar, a ball that lies wholly before the disc hides pi r^2 sqrt(2) of it."""
    radius, far = 0.003, 10.0
    towards = np.array([1.0, 0.0, 1.0]) / math.sqrt(2.0)
    place = 0.02 * towards
    share = seen(geoms=f'<geom type="sphere" size="{radius}" pos="{place[0]} 0 {place[2]}"/>', eye=far * towards)
    assert share == pytest.approx(1.0 - math.sqrt(2.0) * (radius / RADIUS) ** 2, abs=0.01)


@pytest.mark.parametrize("kind", ["capsule", "cylinder"])
def test_a_long_capsule_across_hides_a_strip(kind):
    radius = 0.002
    half = EYE[2] * math.tan(math.asin(radius / (EYE[2] - HEIGHT))) / RADIUS
    share = seen(geoms=f'<geom type="{kind}" size="{radius} 0.05" pos="0 0 {HEIGHT}" euler="0 90 0"/>')
    assert share == pytest.approx(2.0 * segment(half), abs=0.01)


def test_a_capsule_has_round_ends_and_a_cylinder_flat_ones():
    """Upright in the line of sight both hide what their upper end's outline hides; the capsule's stands higher."""
    radius, half = 0.003, 0.004
    ball = EYE[2] * math.tan(math.asin(radius / (EYE[2] - HEIGHT - half)))
    flat = EYE[2] * radius / (EYE[2] - HEIGHT - half)
    for kind, shadow in (("capsule", ball), ("cylinder", flat)):
        share = seen(geoms=f'<geom type="{kind}" size="{radius} {half}" pos="0 0 {HEIGHT}"/>')
        assert share == pytest.approx(1.0 - (shadow / RADIUS) ** 2, abs=0.01)


def test_a_box_hides_what_its_upper_face_hides():
    half, thick = 0.003, 0.001
    shadow = EYE[2] / (EYE[2] - HEIGHT - thick)
    share = seen(geoms=f'<geom type="box" size="{half} {half} {thick}" pos="0 0 {HEIGHT}" euler="0 0 30"/>')
    assert share == pytest.approx(1.0 - (2.0 * half * shadow / RADIUS) ** 2 / math.pi, abs=0.01)


def test_what_is_not_shown_and_not_felt_hides_nothing():
    ball = '<geom type="sphere" size="0.02" pos="0 0 0.03" {}/>'
    assert seen(geoms=ball.format('rgba="1 1 1 0"')) == 1.0
    assert seen(geoms=ball.format('group="4"')) == 1.0
    assert seen(geoms=ball.format('group="3" rgba="1 1 1 0"')) == 0.0


def test_a_tilted_disc_is_seen_as_an_upright_one():
    normal = np.array([0.3, -0.5, 0.8]) / math.sqrt(0.98)
    disc = Disc(np.array([0.1, 0.2, 0.3]), normal, RADIUS)
    points = disc.points()
    np.testing.assert_allclose((points - disc.centre) @ normal, 0.0, atol=1e-15)
    np.testing.assert_allclose(points.mean(axis=0), disc.centre, atol=0.005 * RADIUS)
    # The mean square distance from the middle of an even disc is r^2 / 2.
    assert np.mean(np.sum((points - disc.centre) ** 2, axis=1)) == pytest.approx(0.5 * RADIUS**2, rel=1e-3)
    np.testing.assert_allclose(disc.rotation.T @ disc.rotation, np.eye(3), atol=1e-12)
