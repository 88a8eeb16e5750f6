"""Graded lattices: balance, conformity, shapes, fit, node counts and what the seams cost."""

import numpy as np
import pytest
import trimesh
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import KDTree

from msdm_core.material.stiffness import spring_network
from msdm_core.mesh.geodesic import NearestTriangle
from msdm_core.mesh.quality import dihedral_angles, mesh_quality
from msdm_core.mesh.surface import check_surface, triangles_facing
from msdm_core.mesh.tet_mesh import TET_FACES, TetMesh
from msdm_core.meshing import grading
from msdm_core.meshing.grading import balanced_levels, octree_tets
from msdm_core.meshing.lattice_meshing import box_mesh, mesh_surface
from msdm_core.meshing.stuffing import SurfaceBody, lattice_around, stuff


def bumpy_body(seed):
    random = np.random.default_rng(seed)
    solid = trimesh.creation.icosphere(4, 0.08)
    bumps = np.sin(solid.vertices @ random.normal(size=(3, 4)) * 40) @ random.normal(size=4) * 0.04
    return np.array(solid.vertices * (1 + bumps[:, None])), np.array(solid.faces)


def corner_sets(points, tets):
    """Each tet as the places of its corners, in an order that no numbering changes."""
    corners = points[tets]
    order = np.lexsort(np.moveaxis(corners, 2, 0)[::-1], axis=1)
    rows = np.take_along_axis(corners, order[..., None], axis=1).reshape(-1, 12)
    return rows[np.lexsort(rows.T)]


def assert_sound(mesh):
    """Positive tets, every inner face between exactly two tets on its two sides, a watertight boundary."""
    assert mesh.volumes.min() > 0
    faces = mesh.tets[:, TET_FACES].reshape(-1, 3)
    _, which, count = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
    assert count.max() == 2
    # An outward face seen from its two sides turns both ways: the parity of the sorting differs.
    steps = np.sign(faces[:, [1, 2, 2]] - faces[:, [0, 1, 0]]).prod(axis=1)
    turned = np.bincount(which.ravel(), steps)
    assert (turned[count == 2] == 0).all()
    sides = mesh.boundary_triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    keys, back = sides @ [mesh.node_count, 1], sides @ [1, mesh.node_count]
    np.testing.assert_array_equal(np.sort(keys), np.sort(back))


def random_levels(seed, coarsest):
    random = np.random.default_rng(seed)
    return np.where(random.random((16, 8, 24)) < 10.0**-coarsest / 3, 0, coarsest)


@pytest.mark.parametrize(("seed", "coarsest"), [(0, 1), (1, 2), (2, 2)])
def test_leaves_are_cubes_that_obey_the_permission_and_weak_balance(seed, coarsest):
    permitted = random_levels(seed, coarsest)
    level = balanced_levels(permitted)
    assert (level <= permitted).all() and len(np.unique(level)) == coarsest + 1
    for place in np.ndindex(level.shape):
        width = 2 ** level[place]
        leaf = tuple(slice(i // width * width, i // width * width + width) for i in place)
        assert (level[leaf] == level[place]).all()
    # Cells that share a face or an edge: steps along one or two axes.
    steps = [step for step in np.ndindex(3, 3, 3) if 1 <= sum(np.array(step) != 1) <= 2]
    for step in np.array(steps) - 1:
        ahead = tuple(slice(max(s, 0), n + min(s, 0)) for s, n in zip(step, level.shape, strict=True))
        behind = tuple(slice(max(-s, 0), n + min(-s, 0)) for s, n in zip(step, level.shape, strict=True))
        assert np.abs(level[ahead] - level[behind]).max() <= 1


def grid_mesh(level):
    used, tets = np.unique(octree_tets(level), return_inverse=True)
    points = np.stack(np.unravel_index(used, [2 * n + 1 for n in level.shape]), axis=1).astype(float)
    return TetMesh(points, TetMesh(points, tets.reshape(-1, 4)).tets)


@pytest.mark.parametrize(("seed", "coarsest"), [(0, 1), (1, 2), (2, 2)])
def test_an_octree_is_filled_without_hanging_nodes(seed, coarsest):
    level = balanced_levels(random_levels(seed, coarsest))
    mesh = grid_mesh(level)
    assert_sound(mesh)
    assert mesh.volumes.sum() == pytest.approx(8 * level.size, rel=1e-12)
    outer = mesh.points[mesh.boundary_nodes]
    assert ((outer == 0) | (outer == 2 * np.array(level.shape))).any(axis=1).all()
    # The paper's quarters and half pyramids keep 45 degrees.
    assert dihedral_angles(mesh).min() > 44.99 and dihedral_angles(mesh).max() < 120.01


def test_cells_of_one_size_give_the_uniform_mesh_to_the_bit():
    vertices, faces = bumpy_body(0)
    uniform = mesh_surface(vertices, faces, cell_size=0.01)
    same = mesh_surface(vertices, faces, cell_size=0.01, coarse_cell_size=0.01)
    assert uniform.points.tobytes() == same.points.tobytes() and uniform.tets.tobytes() == same.tets.tobytes()
    # The octree's own way through the same lattice: the same corners of the same tets, to the bit.
    points, corners = check_surface(vertices, faces)
    body = SurfaceBody(points, corners)
    graded = grading.stuff_graded(body, points[corners], 0.01, 0.0, 0)
    plain = stuff(body, lattice_around(points, 0.01))
    np.testing.assert_array_equal(corner_sets(*graded), corner_sets(*plain))


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "coarsening"), [(0, 2), (1, 2), (2, 4), (3, 4)])
def test_a_graded_body_is_sound_on_the_surface_and_well_shaped(seed, coarsening):
    vertices, faces = bumpy_body(seed)
    fine = triangles_facing(vertices, faces, (0, 0, -1), 50.0)
    mesh = mesh_surface(vertices, faces, cell_size=0.008, coarse_cell_size=0.008 * coarsening, fine_triangles=fine)
    assert_sound(mesh)
    quality = mesh_quality(mesh, (vertices, faces))
    assert quality.dihedral_smallest_deg >= 9
    assert abs(quality.volume_error) < 0.05
    assert mesh.node_count < 0.5 * mesh_surface(vertices, faces, cell_size=0.008).node_count
    corners, nodes = vertices[faces], mesh.points[mesh.boundary_nodes]
    # A node that lies on the surface lies on a triangle whose middle is near.
    for place, near in zip(nodes, KDTree(corners.mean(axis=1)).query(nodes, k=50)[1], strict=True):
        triangle, weights = NearestTriangle(corners[near])(place)
        assert np.linalg.norm(weights @ corners[near[triangle]] - place) < 1e-12


@pytest.mark.slow
def test_cells_are_split_around_poor_angles(monkeypatch):
    """Nodes that move as far at the seams as among BCC tets leave bad angles there: the lattice is refined."""
    monkeypatch.setattr(grading, "ALPHA_TRANSITION", 0.45)
    vertices, faces = bumpy_body(5)
    fine = triangles_facing(vertices, faces, (0, 0, -1), 50.0)
    poor = []
    find_poor = grading._poor_tets
    monkeypatch.setattr(grading, "_poor_tets", lambda *mesh: poor.append(find_poor(*mesh)) or poor[-1])
    mesh = mesh_surface(vertices, faces, cell_size=0.008, coarse_cell_size=0.032, fine_triangles=fine)
    assert poor[0].any() and not poor[-1].any()
    assert_sound(mesh)
    assert dihedral_angles(mesh).min() >= 9


def test_a_folded_tet_counts_as_poor():
    """Two regular tets on one face; the apex of the second pushed through the face, far enough to be regular again."""
    points = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1], [5 / 3, -5 / 3, 5 / 3]])
    tets = np.array([[0, 1, 2, 3], [0, 1, 3, 4]])
    assert not grading._poor_tets(points, tets).any()
    points[4] = points[2] + 0.3
    assert grading._poor_tets(points, tets).any()


@pytest.mark.parametrize(("coarsening", "share"), [pytest.param(2, 0.4, marks=pytest.mark.slow), (4, 0.33)])
def test_graded_block_is_exact_and_fine_on_top(coarsening, share):
    size, cells = (0.12, 0.08, 0.08), (24, 16, 16)
    uniform, mesh = box_mesh(size, cells), box_mesh(size, cells, coarsening=coarsening, fine_depth=0.015)
    assert_sound(mesh)
    assert mesh.volumes.sum() == pytest.approx(np.prod(size), rel=1e-12)
    outer = mesh.points[mesh.boundary_nodes]
    assert ((outer == 0) | (outer == np.array(size))).any(axis=1).all()
    # Nodes in the middle of the top's squares, the same in both, apart.
    squares = cells[0] * cells[1]
    assert mesh.node_count - squares < share * (uniform.node_count - squares)
    assert dihedral_angles(mesh).min() > 44.99
    top = [corner_sets(m.points, m.tets[(m.points[m.tets][:, :, 2] > 0.0649).all(axis=1)]) for m in (uniform, mesh)]
    np.testing.assert_allclose(top[0], top[1], rtol=0, atol=1e-15)
    assert box_mesh(size, cells, coarsening=1).points.tobytes() == uniform.points.tobytes()


# ---- what the seams cost -----------------------------------------------------------------------------------------


def spring_matrix(mesh):
    """Stiffness matrix of the springs of formula (6) with E = 1, blocks k n n^T, n along the spring."""
    edges, stiffness = spring_network(mesh, 1.0)
    along = mesh.points[edges[:, 1]] - mesh.points[edges[:, 0]]
    along /= np.linalg.norm(along, axis=1)[:, None]
    rows = np.repeat(np.arange(len(edges)), 6)
    columns = (3 * edges[:, :, None] + np.arange(3)).reshape(-1)
    stretch = coo_array(
        (np.stack([-along, along], axis=1).ravel(), (rows, columns)), shape=(len(edges), 3 * mesh.node_count)
    ).tocsr()
    return (stretch.T @ diags_array(stiffness) @ stretch).tocsr()


def uniaxial_modulus(mesh, axis):
    """Force per area and strain of a unit cube between sliding plates, low sides held by symmetry planes."""
    matrix, strain = spring_matrix(mesh), 1e-3
    moved = np.zeros((mesh.node_count, 3))
    held = mesh.points == 0
    high = mesh.points[:, axis] == 1
    held[high, axis], moved[high, axis] = True, strain
    free = np.flatnonzero(~held.ravel())
    place = moved.ravel()
    place[free] = spsolve(matrix[free][:, free].tocsc(), -(matrix @ place)[free])
    return (matrix @ place).reshape(-1, 3)[high, axis].sum() / strain


@pytest.mark.slow
def test_one_seam_costs_a_known_share_of_the_modulus():
    """A seam from cells h to 2 h acts like 0.5 h of slack across it and 0.3 h of added tissue along it.

    Formula (6) gives each edge the sum of its tets' shares; at a seam the tets are not BCC, and the network is no
    longer isotropic. Beside a cube with a third of 12 fine cells, the rest coarse: -4 % across, +3 % along. The uniform
    cubes themselves are within 3 %, for their faces: the top has nodes in the middle of its squares.
    """
    fine, coarse = box_mesh((1, 1, 1), (12, 12, 12)), box_mesh((1, 1, 1), (6, 6, 6))
    graded = box_mesh((1, 1, 1), (12, 12, 12), coarsening=2, fine_depth=1 / 3)
    moduli = np.array([[uniaxial_modulus(mesh, axis) for axis in (2, 0)] for mesh in (fine, coarse)])
    assert moduli == pytest.approx(1.0, abs=0.03)
    # Layers of both in series across, side by side along.
    without_across, without_along = 3 / (1 / moduli[0, 0] + 2 / moduli[1, 0]), (moduli[0, 1] + 2 * moduli[1, 1]) / 3
    across, along = uniaxial_modulus(graded, 2), uniaxial_modulus(graded, 0)
    assert 12 * (without_across / across - 1) == pytest.approx(0.50, abs=0.05)
    assert 12 * (along / without_along - 1) == pytest.approx(0.33, abs=0.05)
