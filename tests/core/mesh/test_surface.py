"""Closed surfaces: refusals, repairs, and where lines cross."""

import numpy as np
import pytest
import trimesh

from msdm_core.errors import MeshError
from msdm_core.mesh.surface import check_surface, line_hits, merge_vertices, surface_volume


def box(size=(0.1, 0.08, 0.06)):
    solid = trimesh.creation.box(size)
    return np.array(solid.vertices), np.array(solid.faces)


def joined(*bodies):
    offsets = np.cumsum([0] + [len(vertices) for vertices, _ in bodies])
    return (
        np.concatenate([vertices for vertices, _ in bodies]),
        np.concatenate([faces + offset for (_, faces), offset in zip(bodies, offsets, strict=False)]),
    )


def figure_of_eight():
    """One closed body, a square tube bent into a figure of eight that runs through itself where it meets."""
    angle = np.linspace(0, 2 * np.pi, 40)
    path = np.column_stack([np.cos(angle), np.sin(angle) * np.cos(angle), np.zeros_like(angle)]) * 0.1
    square = np.array([[0, 1, 1], [0, -1, 1], [0, -1, -1], [0, 1, -1]]) * 0.01
    tangent = np.gradient(path, axis=0)
    side = np.cross([0, 0, 1.0], tangent)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    rings = path[:, None] + square[:, 1][:, None] * side[:, None] + square[:, 2][:, None] * np.array([0, 0, 1.0])
    rings = rings[:-1]  # the figure of eight closes: its last ring is its first
    n, faces = len(rings), []
    for ring in range(n):
        for k in range(4):
            a, b = 4 * ring + k, 4 * ring + (k + 1) % 4
            c, d = 4 * ((ring + 1) % n) + k, 4 * ((ring + 1) % n) + (k + 1) % 4
            faces += [[a, c, b], [b, c, d]]
    return rings.reshape(-1, 3), np.array(faces)


def test_volume_of_a_box_far_from_the_origin():
    vertices, faces = box()
    assert surface_volume(vertices + 5.0, faces) == pytest.approx(4.8e-4, rel=1e-12)


def test_merge_joins_equal_vertices_and_drops_unused_ones():
    vertices, faces = box()
    soup = np.concatenate([vertices[faces].reshape(-1, 3), [[9.0, 9.0, 9.0]]])
    points, corners = merge_vertices(soup, np.arange(36).reshape(-1, 3))
    assert len(points) == 8
    np.testing.assert_array_equal(points[corners], vertices[faces])


def test_merge_knows_that_minus_zero_is_zero():
    points, _ = merge_vertices([[0.0, 0, 0], [-0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 2, 3], [1, 2, 3]])
    assert len(points) == 3


def test_good_surface_passes_unchanged_in_shape():
    vertices, faces = box()
    points, corners = check_surface(vertices, faces)
    np.testing.assert_array_equal(points[corners], vertices[faces])


def test_inside_out_surface_is_flipped():
    vertices, faces = box()
    assert surface_volume(*check_surface(vertices, faces[:, ::-1])) == pytest.approx(4.8e-4, rel=1e-12)


def test_triangles_turned_the_wrong_way_are_reoriented():
    solid = trimesh.creation.icosphere(2, 0.05)
    faces = np.array(solid.faces)
    faces[::3] = faces[::3, ::-1]
    assert surface_volume(*check_surface(solid.vertices, faces)) == pytest.approx(solid.volume, rel=1e-12)


def test_one_sided_surface_is_refused():
    # A Klein bottle of 8 x 8 quads: its grid closes with a flip in one direction.
    n, faces = 8, []

    def number(i, j):
        return i * n + j % n if i < n else (n - 1 - j) % n

    for i in range(n):
        for j in range(n):
            a, b, c, d = number(i, j), number(i + 1, j), number(i + 1, j + 1), number(i, j + 1)
            faces += [[a, b, c], [a, c, d]]
    points = np.random.default_rng(0).random((n * n, 3))
    with pytest.raises(MeshError, match="one side only"):
        check_surface(points, faces)


def test_small_triangle_through_a_large_one_is_found():
    # One vertex in the middle of the finely divided top is pulled through the two large triangles of the bottom.
    n = 16
    ramp = np.linspace(0.0, 0.1, n + 1)
    top = np.array([(x, y, 0.1) for x in ramp for y in ramp])
    floor = np.array([(0.0, 0.0, 0.0), (0.0, 0.1, 0.0), (0.1, 0.1, 0.0), (0.1, 0.0, 0.0)])
    vertices = np.concatenate([top, floor])
    at = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    faces = []
    for i in range(n):
        for j in range(n):
            a, b, c, d = at[i, j], at[i + 1, j], at[i + 1, j + 1], at[i, j + 1]
            faces += [(a, b, c), (a, c, d)]
    p, q, r, s = range((n + 1) ** 2, (n + 1) ** 2 + 4)
    faces += [(p, q, r), (p, r, s)]
    for edge, low, high in ((at[0], p, q), (at[:, n], q, r), (at[n, ::-1], r, s), (at[::-1, 0], s, p)):
        faces += [(low, edge[k], edge[k + 1]) for k in range(n)] + [(low, edge[n], high)]
    check_surface(vertices, faces)
    vertices[at[n // 2, n // 2], 2] = -0.001
    with pytest.raises(MeshError, match="cross"):
        check_surface(vertices, faces)


def test_regular_coplanar_tiles_do_not_count_as_crossing():
    solid = trimesh.creation.box((0.1, 0.1, 0.1)).subdivide().subdivide().subdivide()
    check_surface(solid.vertices, solid.faces)
    check_surface(solid.vertices @ trimesh.transformations.rotation_matrix(0.3, [1, 2, 3])[:3, :3], solid.faces)
    tube = trimesh.creation.revolve([[0, 0], *[[0.001, 0.002 * k] for k in range(20)], [0, 0.038]], sections=24)
    check_surface(tube.vertices, tube.faces)


def test_lines_cross_a_box_twice_where_its_planes_are():
    vertices, faces = box((4.4, 3.0, 7.0))
    u, v, at = line_hits(vertices[:, 0], vertices[:, 1], vertices[:, 2], faces, 0)
    crossings = sorted(zip(u.tolist(), v.tolist(), np.round(at, 12).tolist(), strict=True))
    assert crossings == [(i, j, z) for i in (-2, 0, 2) for j in (0,) for z in (-3.5, 3.5)]


def test_lines_through_edges_and_vertices_hit_each_side_once():
    # Every line here runs exactly through vertices and edges of the tiles.
    grid = np.stack(np.meshgrid(np.arange(9.0), np.arange(9.0), indexing="ij"), axis=-1).reshape(-1, 2)
    quads = [(9 * i + j, 9 * i + j + 9, 9 * i + j + 10, 9 * i + j + 1) for i in range(8) for j in range(8)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    u, v, _ = line_hits(grid[:, 0], grid[:, 1], np.zeros(81), faces, 0)
    inner = (u > 0) & (u < 8) & (v > 0) & (v < 8)
    _, count = np.unique(np.column_stack([u, v])[inner], axis=0, return_counts=True)
    assert len(count) == 9 and (count % 2 == 1).all()


def with_a_vertex_at_nan():
    vertices, faces = box()
    vertices[3, 1] = np.nan
    return vertices, faces


def with_a_vertex_too_many():
    vertices, faces = box()
    faces[5, 2] = 8
    return vertices, faces


def with_a_second_body():
    sphere = trimesh.creation.icosphere(1, 0.01)
    return joined(box(), (np.array(sphere.vertices) + 1.0, np.array(sphere.faces)))


def with_an_edge_of_four_triangles():
    first = box((1.0, 1.0, 1.0))
    return joined(first, (first[0] + [1.0, 1.0, 0.0], first[1]))


@pytest.mark.parametrize(
    ("surface", "named"),
    [
        (with_a_vertex_at_nan, "vertex 3 .*nan"),
        (with_a_vertex_too_many, "triangle 5 .*8"),
        (lambda: (np.empty((0, 3)), np.empty((0, 3), dtype=int)), "no triangles"),
        (lambda: (box()[0], np.concatenate([box()[1], [[0, 1, 1]]])), "triangle 12"),
        (lambda: (box()[0], box()[1][1:]), "open"),
        (with_an_edge_of_four_triangles, "manifold"),
        (with_a_second_body, "2 bodies"),
        (figure_of_eight, r"triangles \d+ and \d+"),
    ],
    ids=["not finite", "index", "empty", "degenerate", "open", "four at an edge", "two bodies", "crossing"],
)
def test_what_is_no_closed_surface_is_refused(surface, named):
    with pytest.raises(MeshError, match=named):
        check_surface(*surface())
