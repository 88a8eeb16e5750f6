"""Clearances of capsules against closed forms and brute force."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surgsim_apps.arms.clearance import (
    ClusteredSurface,
    outside_ball,
    point_segment_distance,
    segment_distance,
    segment_triangle_distance,
    wall_clearance,
)
from surgsim_apps.arms.ports import EndoscopePort, PortPlace, Ports, Wall

COORDINATE = st.floats(-1.0, 1.0, allow_subnormal=False).map(lambda value: round(value, 6))
POINT = st.tuples(COORDINATE, COORDINATE, COORDINATE)


@pytest.mark.parametrize(
    ("first", "second", "distance"),
    [
        ([[0, 0, 0], [1, 0, 0]], [[0.5, -1, 2], [0.5, 1, 2]], 2.0),  # crossed, one above the other
        ([[0, 0, 0], [1, 0, 0]], [[0, 3, 0], [1, 3, 0]], 3.0),  # parallel
        ([[0, 0, 0], [1, 0, 0]], [[4, 0, 0], [2, 0, 0]], 1.0),  # in line, end to end
        ([[0, 0, 0], [1, 0, 0]], [[2, 1, 0], [3, 5, 0]], np.sqrt(2.0)),  # end to end, skew
        ([[0, 0, 0], [1, 0, 0]], [[0.5, 2, 0], [0.5, 1, 0]], 1.0),  # end over the middle
        ([[0, 0, 0], [1, 0, 0]], [[0.5, -1, 0], [0.5, 1, 0]], 0.0),  # they meet
        ([[0, 0, 0], [0, 0, 0]], [[3, 4, 0], [3, 4, 0]], 5.0),  # points
        ([[0, 0, 0], [0, 0, 0]], [[-1, 2, 0], [1, 2, 0]], 2.0),  # a point and a segment
        ([[0, 0, 0], [1, 0, 0]], [[-1, 0, 0], [2, 0, 0]], 0.0),  # one along the other
    ],
)
def test_segments_closed_forms(first, second, distance):
    assert segment_distance(first, second) == pytest.approx(distance, abs=1e-14)
    assert segment_distance(second, first) == pytest.approx(distance, abs=1e-14)


@settings(max_examples=150, deadline=None)
@given(POINT, POINT, POINT, POINT)
def test_segments_against_brute_force(a, b, c, d):
    """The least of all pairs of points on a grid is the distance, to half the grid's step: |d f| <= |u| ds + |v| dt."""
    first, second = np.array([a, b]), np.array([c, d])
    steps = 120
    s = np.linspace(0.0, 1.0, steps + 1)[:, None]
    on_first, on_second = first[0] + s * (first[1] - first[0]), second[0] + s * (second[1] - second[0])
    brute = np.linalg.norm(on_first[:, None] - on_second, axis=2).min()
    slack = 0.5 / steps * (np.linalg.norm(first[1] - first[0]) + np.linalg.norm(second[1] - second[0]))
    exact = float(segment_distance(first, second))
    assert brute - slack - 1e-9 <= exact <= brute + 1e-9


TRIANGLE = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0]])


@pytest.mark.parametrize(
    ("segment", "distance"),
    [
        ([[0.5, 0.5, 1], [0.5, 0.5, 3]], 1.0),  # above the inside
        ([[0.5, 0.5, -2], [0.6, 0.4, -1]], 1.0),  # below it
        ([[0.5, 0.5, -1], [0.5, 0.5, 1]], 0.0),  # through it
        ([[3, -1, -1], [3, -1, 1]], np.sqrt(2.0)),  # past a corner
        ([[-1, -1, 2], [3, -1, 2]], np.sqrt(5.0)),  # along an edge
        ([[2, 2, -1], [2, 2, 1]], np.sqrt(2.0)),  # past the long edge
        ([[-1, 0.5, 0.25], [3, 0.5, 0.25]], 0.25),  # flat above
    ],
)
def test_segment_and_triangle_closed_forms(segment, distance):
    for corners in (TRIANGLE, TRIANGLE[::-1]):
        measured = segment_triangle_distance(np.array([segment], dtype=float), corners[None])
        assert measured[0] == pytest.approx(distance, abs=1e-14)


@settings(max_examples=60, deadline=None)
@given(POINT, POINT, POINT, POINT, POINT)
def test_segment_and_triangle_against_brute_force(a, b, c, d, e):
    corners = np.array([c, d, e])
    if np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0])) < 1e-3:
        return  # a surface's triangles have an area
    segment, steps = np.array([a, b]), 40
    grid = np.linspace(0.0, 1.0, steps + 1)
    i, j = (part.ravel() for part in np.meshgrid(grid, grid, indexing="ij"))
    inside = i + j <= 1.0 + 1e-12
    on_face = corners[0] + i[inside, None] * (corners[1] - corners[0]) + j[inside, None] * (corners[2] - corners[0])
    brute = point_segment_distance(on_face, segment).min()
    slack = np.abs(np.diff(corners[[0, 1, 2, 0]], axis=0)).max() * np.sqrt(3.0) * 2.0 / steps
    exact = float(segment_triangle_distance(segment[None], corners[None])[0])
    assert brute - slack <= exact <= brute + 1e-9


def bumpy_sphere():
    """A surface of 1280 triangles, radius 0.05 to 0.06 m."""
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=3)
    points = np.asarray(sphere.vertices)
    return points * (0.05 + 0.01 * np.cos(5.0 * points[:, :1])), np.asarray(sphere.faces, dtype=np.int32)


def test_surface_clusters_lose_no_triangle():
    """With clusters or without: all triangles, one by one, give the same distance to rounding."""
    points, triangles = bumpy_sphere()
    surface = ClusteredSurface(points, triangles)
    rng = np.random.default_rng(1)
    segments = rng.uniform(-0.12, 0.12, (60, 2, 3))
    corners = points[triangles]
    brute = [segment_triangle_distance(np.broadcast_to(pair, (len(corners), 2, 3)), corners).min() for pair in segments]
    assert surface.distance(segments) == pytest.approx(brute, abs=1e-15)
    assert (np.array(brute) == 0.0).any() and (np.array(brute) > 0.02).any()
    assert surface.distance(segments, 0.01) == pytest.approx(np.minimum(brute, 0.01), abs=1e-15)


def test_capsule_over_a_sphere():
    """A rod at height h over a sphere of radius R: h - R, to the sagitta of the triangles."""
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    surface = ClusteredSurface(np.asarray(sphere.vertices), np.asarray(sphere.faces))
    measured = surface.distance(np.array([[[-0.1, 0.0, 0.07], [0.1, 0.0, 0.07]]]))[0]
    assert measured == pytest.approx(0.02, abs=0.05 * (0.04 / 2) ** 2 / 2 * 4)


def test_outside_ball_keeps_what_is_outside():
    """A chord of a ball of radius r at distance h from its middle is 2 sqrt(r^2 - h^2) long."""
    segments = np.array(
        [[[-3.0, 0.6, 0.0], [5.0, 0.6, 0.0]], [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]], [[0.1] * 3, [0.2] * 3]]
    )
    parts, left = outside_ball(segments, np.zeros((3, 3)), 1.0)
    assert left.tolist() == [[True, True], [False, True], [False, False]]
    assert parts[0, 0] == pytest.approx(np.array([[-3.0, 0.6, 0.0], [-0.8, 0.6, 0.0]]))
    assert parts[0, 1] == pytest.approx(np.array([[0.8, 0.6, 0.0], [5.0, 0.6, 0.0]]))
    assert parts[1, 1] == pytest.approx(np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]))


@pytest.mark.parametrize(("x", "whole"), [(0.5, False), (2.0, True)])
def test_outside_ball_of_a_sphere_shape(x, whole):
    parts, left = outside_ball(np.full((1, 2, 3), [x, 0.0, 0.0]), np.zeros((1, 3)), 1.0)
    assert left.any() == whole
    if whole:
        assert parts[0, left[0]][0].tolist() == [[x, 0.0, 0.0]] * 2


def test_outside_ball_missed_by_a_segment():
    parts, left = outside_ball(np.array([[[-1.0, 2.0, 0.0], [1.0, 2.0, 0.0]]]), np.zeros((1, 3)), 1.0)
    assert left.sum() == 1
    assert parts[0, left[0]][0].tolist() == [[-1.0, 2.0, 0.0], [1.0, 2.0, 0.0]]


def ports(wall):
    return Ports(
        left=PortPlace((-0.08, 0.0, 0.15), target=(0.0, 0.0, 0.0)),
        right=PortPlace((0.08, 0.0, 0.15), target=(0.0, 0.0, 0.0)),
        endoscope=EndoscopePort((0.0, 0.0, 0.15), (0.0, 0.0, 0.0)),
        wall=wall,
    )


def test_plate_clearance():
    """Above a plate 20 mm thick at z = 150 mm, below it, across it, and through its hole."""
    where = ports(Wall(plate=True))
    trocar = np.array([-0.08, 0.0, 0.15])
    segments = np.array(
        [
            [[0.0, 0.0, 0.20], [0.1, 0.0, 0.17]],
            [[0.0, 0.0, 0.0], [0.1, 0.0, 0.12]],
            [[0.0, 0.0, 0.0], [0.0, 0.0, 0.155]],
            [[-0.08, 0.0, 0.0], [-0.08, 0.0, 0.4]],
            [[-0.08, 0.0, 0.14], [-0.08, 0.0, 0.16]],
        ]
    )
    # The third would have to go down by 15 mm; the fourth leaves the hole at 30 mm, 20 mm from the plate's faces.
    assert wall_clearance(where, segments, trocar) == pytest.approx([0.010, 0.020, -0.015, 0.020, np.inf])


def test_dome_clearance():
    """A sphere of radius R through both trocars: heights are distances from its middle less R."""
    where = ports(Wall(radius=0.10))
    centre = np.array([0.0, 0.0, 0.15 - 0.06])  # sqrt(0.10^2 - 0.08^2)
    far = np.array([0.5, 0.5, 0.5])
    segments = centre + np.array(
        [
            [[-0.3, 0.0, 0.13], [0.3, 0.0, 0.13]],  # passes over the top: 130 - 100 - 10 mm
            [[0.0, 0.0, 0.0], [0.0, 0.05, 0.0]],  # inside: 100 - 50 - 10 mm
            [[0.0, 0.0, 0.0], [0.0, 0.0, 0.3]],  # through it
        ]
    )
    # The third: from 100 mm below to 200 mm above the middle surface; up by 110 mm or down by 210 mm frees it.
    assert wall_clearance(where, segments, far) == pytest.approx([0.02, 0.04, -0.11])
