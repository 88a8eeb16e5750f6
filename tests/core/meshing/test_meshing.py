"""Blocks and stuffed surfaces: counts, exact faces, shapes, fit, conformity and refusals."""

import warnings

import numpy as np
import pytest
import trimesh

from msdm_core.errors import MeshError
from msdm_core.mesh.quality import dihedral_angles, mesh_quality, radius_ratios
from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.meshing import stuffing
from msdm_core.meshing.lattice_meshing import box_mesh, mesh_surface

SOLIDS = {
    "sphere": trimesh.creation.icosphere(4, 0.05),
    "torus": trimesh.creation.torus(0.05, 0.02, 64, 48),
    "box": trimesh.creation.box((0.1, 0.08, 0.06)),
}


def surface(name):
    return np.array(SOLIDS[name].vertices), np.array(SOLIDS[name].faces)


def boundary_edge_counts(mesh):
    sides = np.sort(mesh.boundary_triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return np.unique(sides, axis=0, return_counts=True)[1]


@pytest.mark.parametrize(
    ("size", "cells", "nodes", "tets"),
    [
        ((0.02, 0.05, 0.10), (2, 5, 10), 308, 1220),
        ((0.10, 0.10, 0.30), (5, 5, 15), 976, 4550),
        ((0.12, 0.12, 0.06), (12, 12, 6), 2191, 10656),
    ],
)
def test_block_has_the_known_counts_volume_and_faces(size, cells, nodes, tets):
    """A square of the top gives one more node and four tets of half the size, where others give two tets."""
    mesh, plain = box_mesh(size, cells), box_mesh(size, cells, top_nodes=False)
    squares = cells[0] * cells[1]
    assert (mesh.node_count, mesh.tet_count) == (nodes, tets)
    assert (plain.node_count, plain.tet_count) == (nodes - squares, tets - 2 * squares)
    assert mesh.volumes.sum() == pytest.approx(np.prod(size), rel=1e-12)
    whole = np.prod(size) / np.prod(cells) / 12
    np.testing.assert_allclose(plain.volumes, whole, rtol=1e-10)
    np.testing.assert_allclose(np.sort(mesh.volumes)[: 4 * squares], whole / 2, rtol=1e-10)
    np.testing.assert_allclose(np.sort(mesh.volumes)[4 * squares :], whole, rtol=1e-10)
    outer = mesh.points[mesh.boundary_nodes]
    assert ((outer == 0) | (outer == np.array(size))).any(axis=1).all()
    a, b, c = (mesh.points[mesh.boundary_triangles[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    sx, sy, sz = size
    assert area == pytest.approx(2 * (sx * sy + sy * sz + sz * sx), rel=1e-12)
    assert (boundary_edge_counts(mesh) == 2).all()


def test_inner_tets_of_a_block_are_bcc_tets():
    mesh = box_mesh((0.04, 0.04, 0.04), (4, 4, 4))
    is_centre = (np.rint(mesh.points / 0.005).astype(int) % 2 == 1).all(axis=1)
    centres = is_centre[mesh.tets].sum(axis=1)
    angles = np.sort(dihedral_angles(mesh)[centres == 2], axis=1)
    np.testing.assert_allclose(angles, np.tile([60, 60, 60, 60, 90, 90], (len(angles), 1)), atol=1e-6)
    lengths = np.linalg.norm(np.diff(mesh.points[mesh.edges], axis=1)[:, 0], axis=1) / 0.01
    # Half a diagonal and half a cell at the nodes in the middle of the top face's squares.
    assert np.isclose(lengths[:, None], [1, np.sqrt(0.75), np.sqrt(2), np.sqrt(0.5), 0.5]).any(axis=1).all()


def test_diagonals_of_outer_faces_alternate():
    mesh = box_mesh((0.04, 0.04, 0.02), (4, 4, 2))
    vectors = np.diff(mesh.points[mesh.edges], axis=1)[:, 0] / 0.01
    flat = np.isclose((vectors**2).sum(axis=1), 2)
    for axis in range(3):
        across = [k for k in range(3) if k != axis]
        in_plane = flat & np.isclose(vectors[:, axis], 0)
        turn = np.sign(vectors[in_plane][:, across].prod(axis=1))
        # The top's squares have nodes in their middle instead.
        assert len(turn) == {0: 16, 1: 16, 2: 16}[axis]
        assert turn.sum() == 0
        cells = np.floor(mesh.points[mesh.edges[in_plane]].mean(axis=1)[:, across] / 0.01).sum(axis=1)
        assert len(set(zip(cells % 2, turn, strict=True))) == 2


def test_stretched_cells_are_warned_of_and_cubes_are_not():
    with pytest.warns(UserWarning, match="stretched 1.1 to 1"):
        box_mesh((0.02, 0.02, 0.022), (2, 2, 2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        box_mesh((0.02, 0.02, 0.0201), (2, 2, 2))


@pytest.mark.parametrize(
    ("size", "cells", "named"),
    [
        ((0.1, 0.0, 0.1), (1, 1, 1), "size is .*0.0"),
        ((0.1, 0.1, 0.1), (1, 1.5, 1), "1.5"),
        ((0.1, 0.1, 0.1), (1000, 1000, 1000), "cells"),
    ],
)
def test_impossible_blocks_are_refused(size, cells, named):
    with pytest.raises(ValueError, match=named):
        box_mesh(size, cells)


@pytest.mark.parametrize("name", SOLIDS)
def test_stuffed_solid_is_watertight_on_the_surface_and_well_shaped(name):
    vertices, faces = surface(name)
    mesh = mesh_surface(vertices, faces, cell_size=0.01)
    assert mesh.volumes.min() > 0
    assert (boundary_edge_counts(mesh) == 2).all()
    quality = mesh_quality(mesh, (vertices, faces))
    assert quality.dihedral_smallest_deg >= 10
    assert quality.dihedral_largest_deg <= 165
    assert abs(quality.volume_error) < 0.02
    solid = trimesh.Trimesh(vertices, faces)
    _, distance, _ = solid.nearest.on_surface(mesh.points[mesh.boundary_nodes])
    # Every boundary node is a point where a lattice line crosses the surface.
    assert distance.max() < 1e-9


@pytest.mark.parametrize("name", ["sphere", "torus"])
def test_volume_error_is_of_second_order(name):
    vertices, faces = surface(name)
    errors = [
        mesh_quality(mesh_surface(vertices, faces, cell_size=h), (vertices, faces)).volume_error for h in (0.012, 0.006)
    ]
    assert 3 < errors[0] / errors[1] < 6


def test_box_on_lattice_planes_is_filled_exactly():
    vertices, faces = surface("box")
    mesh = mesh_surface(vertices, faces, cell_size=0.01)
    assert mesh.volumes.sum() == pytest.approx(0.1 * 0.08 * 0.06, rel=1e-4)


def test_stuffing_does_not_depend_on_the_order_of_the_triangles():
    vertices, faces = surface("torus")
    soup = vertices[faces[::-1]].reshape(-1, 3)
    first = mesh_surface(vertices, faces, cell_size=0.01)
    second = mesh_surface(soup, np.arange(len(soup)).reshape(-1, 3), cell_size=0.01)
    np.testing.assert_array_equal(first.tets, second.tets)
    np.testing.assert_allclose(first.points, second.points, rtol=0, atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_bumpy_bodies_stay_conforming_and_well_shaped(seed):
    random = np.random.default_rng(seed)
    solid = trimesh.creation.icosphere(4, 0.05)
    bumps = np.sin(solid.vertices @ random.normal(size=(3, 4)) * 80) @ random.normal(size=4) * 0.04
    vertices = solid.vertices * (1 + bumps[:, None])
    mesh = mesh_surface(vertices, solid.faces, cell_size=0.008)
    assert (boundary_edge_counts(mesh) == 2).all()
    quality = mesh_quality(mesh, (vertices, solid.faces))
    # The bound of the lattice with these alphas, whatever the surface.
    assert quality.dihedral_smallest_deg > 9.31
    assert abs(quality.volume_error) < 0.03


def random_cuts(lattice, random):
    """Random sides of the inner nodes, and on each edge between sides a cut at or around the limits of warping."""
    sign = np.full(lattice.shape, -1, dtype=np.int8)
    inner = sign[5:-5, 5:-5, 5:-5]
    inner[:] = np.where(random.random(inner.shape) < random.uniform(0.2, 0.8), 1, -1)
    sign = sign.ravel()
    steps = np.concatenate([stuffing.AXES, stuffing.DIAGONALS])
    node = [stuffing._changing_edges(step, sign, lattice) for step in steps]
    other = np.concatenate([nodes + step @ lattice.strides for nodes, step in zip(node, steps, strict=True)])
    is_long = np.repeat(steps.max(axis=1) == 2, [len(nodes) for nodes in node])
    node = np.concatenate(node)
    alpha = np.where(is_long, 0.24999, 0.41189)
    close = random.random(len(node)) < random.uniform(0, 0.35)
    anywhere = np.where(close, alpha * random.random(len(node)), alpha + (1 - 2 * alpha) * random.random(len(node)))
    fraction = np.where(random.random(len(node)) < 0.7, alpha + np.where(close, -1e-6, 1e-6), anywhere)
    fraction = np.where(random.random(len(node)) < 0.5, fraction, 1 - fraction)
    order = np.lexsort([other, node])
    return sign, stuffing.Cuts(node[order], other[order], fraction[order], is_long[order])


@pytest.mark.parametrize("seed", range(4))
def test_angles_are_bounded_for_every_pattern_of_sides_and_cuts(seed):
    lattice = stuffing.Lattice(np.zeros(3), 1.0, (53, 53, 53))
    sign, cuts = random_cuts(lattice, np.random.default_rng(seed))
    limit = np.where(cuts.is_long, 0.24999, 0.41189)
    points, tets = stuffing.fill_background(stuffing._background_tets(lattice, sign), cuts, limit, sign, lattice)
    faces = np.sort(tets[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
    keys = (faces[:, 0] * len(points) + faces[:, 1]) * len(points) + faces[:, 2]
    assert np.unique(keys, return_counts=True)[1].max() == 2
    corners = points[tets]
    normals = np.stack(
        [
            np.cross(*(corners[:, k] - corners[:, j] for k in (a, b)))
            for j, a, b in ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))
        ],
        axis=1,
    )
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    i, j = np.triu_indices(4, k=1)
    angles = np.degrees(np.arccos(-np.einsum("nkx,nkx->nk", normals[:, i], normals[:, j])))
    assert angles.min() > 9.317 and angles.max() < 161.65


def test_dumbbell_with_a_thin_neck_keeps_one_ball_and_says_so():
    length = np.linspace(-0.08, 0.08, 81)
    balls = np.maximum(0.03**2 - (np.abs(length) - 0.05) ** 2, 0)
    profile = np.column_stack([np.maximum(np.sqrt(balls), 0.0008), length])
    profile = np.concatenate([[[0, -0.081]], profile, [[0, 0.081]]])
    solid = trimesh.creation.revolve(profile, sections=24)
    with pytest.warns(UserWarning, match=r"1 part\(s\) of \d+ tets .* were dropped"):
        mesh = mesh_surface(solid.vertices, solid.faces, cell_size=0.01)
    assert mesh.volumes.sum() == pytest.approx(4 / 3 * np.pi * 0.03**3, rel=0.1)


def test_too_coarse_names_a_size_that_works():
    vertices, faces = surface("box")
    with pytest.raises(MeshError, match=r"0\.04 .* 0\.015 m"):
        mesh_surface(vertices, faces, cell_size=0.04)
    assert mesh_surface(vertices, faces, cell_size=0.015).tet_count > 0


def test_quality_of_a_regular_and_a_corner_tet():
    regular = TetMesh([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], [[0, 1, 2, 3]])
    np.testing.assert_allclose(dihedral_angles(regular), np.degrees(np.arccos(1 / 3)))
    np.testing.assert_allclose(radius_ratios(regular), 1.0)
    corner = TetMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]])
    # Inradius 1 / (3 + sqrt 3), circumradius sqrt(3) / 2.
    np.testing.assert_allclose(radius_ratios(corner), 3 / (3 + np.sqrt(3)) / (np.sqrt(3) / 2))
    assert mesh_quality(corner).volume_error is None
