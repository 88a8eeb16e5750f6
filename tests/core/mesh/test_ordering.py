"""The kernels' order of tets and springs: neighbours stand apart, each tet has a spring of its own."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from msdm_core.mesh.ordering import EDGE_FIRST, GAP, in_sweep_order, spring_order, swept
from msdm_core.mesh.tet_mesh import TetMesh, tet_volumes
from msdm_core.meshing.lattice_meshing import box_mesh
from msdm_core.organ.compile import OrganSpec, compile_organ
from tests.core import oracle

BLOCK = box_mesh((0.06, 0.06, 0.03), (12, 12, 6))


def scattered(seed: int, count: int) -> TetMesh:
    """Delaunay tets of random points, the flat ones on the hull left out."""
    points = np.random.default_rng(seed).uniform(0.0, 0.05, (count, 3))
    tets = Delaunay(points).simplices
    corners = points[tets]
    longest = np.linalg.norm(corners[:, :, None] - corners[:, None, :], axis=3).max(axis=(1, 2))
    tets = tets[np.abs(tet_volumes(points, tets)) > 1e-4 * longest**3]
    used, renumbered = np.unique(tets, return_inverse=True)
    return TetMesh(points[used], renumbered.reshape(-1, 4))


def gaps(items: np.ndarray) -> np.ndarray:
    """Distance of each item from the last use of any of its nodes, in places."""
    last: dict[int, int] = {}
    distances = []
    for place, nodes in enumerate(items.tolist()):
        distances.append(place - max(last.get(node, -1000) for node in nodes))
        last.update(dict.fromkeys(nodes, place))
    return np.array(distances)


def reach(items: np.ndarray, node_count: int) -> float:
    """Mean number of places between the first and the last item of a node."""
    first, last = np.full(node_count, len(items)), np.zeros(node_count)
    for corner in items.T:
        np.minimum.at(first, corner, np.arange(len(items)))
        np.maximum.at(last, corner, np.arange(len(items)))
    return float((last - first).mean())


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(6, 60))
def test_each_tet_has_a_spring_of_its_own_along_its_first_edge(seed: int, count: int):
    mesh = scattered(seed, count)
    order = spring_order(mesh)
    np.testing.assert_array_equal(np.sort(order.springs), np.arange(len(mesh.edges)))
    first = np.sort(order.tet_nodes[:, :2], axis=1)
    np.testing.assert_array_equal(first, mesh.edges[order.springs[: mesh.tet_count]])
    np.testing.assert_array_equal(np.sort(order.tet_nodes, axis=1), np.sort(mesh.tets, axis=1))
    np.testing.assert_allclose(tet_volumes(mesh.points, order.tet_nodes), mesh.volumes, rtol=1e-9)


def test_corners_are_turned_by_even_permutations():
    for corners in EDGE_FIRST:
        assert np.linalg.det(np.eye(4)[corners]) == pytest.approx(1.0)


def test_the_sweep_keeps_neighbours_apart_and_memory_near():
    """On the phantom's block, against the order of a lattice row by row and against none at all."""
    shuffled = np.random.default_rng(0).permutation(BLOCK.tet_count)
    order = swept(BLOCK.points, BLOCK.tets[shuffled])
    np.testing.assert_array_equal(np.sort(order), np.arange(BLOCK.tet_count))
    tets = BLOCK.tets[shuffled][order]
    assert (gaps(tets) >= GAP - 2).mean() > 0.99
    centres = BLOCK.points[BLOCK.tets].mean(axis=1).round(7)
    assert (gaps(BLOCK.tets[np.lexsort(centres.T)]) >= GAP - 2).mean() < 0.1
    assert reach(tets, BLOCK.node_count) < 0.1 * BLOCK.tet_count
    assert reach(BLOCK.tets[shuffled], BLOCK.node_count) > 0.8 * BLOCK.tet_count


def test_meshes_come_in_sweep_order_and_others_can_be_brought_into_it():
    assert (gaps(BLOCK.tets) >= GAP - 2).mean() > 0.99
    order = np.random.default_rng(1).permutation(BLOCK.tet_count)
    tags = np.arange(BLOCK.tet_count, dtype=np.int32)
    mixed = TetMesh(BLOCK.points, BLOCK.tets[order], tags[order], {3: "third"})
    mesh = in_sweep_order(mixed)
    assert (gaps(mesh.tets) >= GAP - 2).mean() > 0.99
    np.testing.assert_array_equal(mesh.tets, BLOCK.tets[mesh.region])  # each tet kept its tag
    assert mesh.region_names == mixed.region_names


def test_an_organs_numbers_by_tet_are_the_meshs():
    organ = compile_organ(OrganSpec(BLOCK, oracle.TISSUE))
    np.testing.assert_array_equal(np.sort(organ.tet_nodes, axis=1), np.sort(BLOCK.tets, axis=1))
    np.testing.assert_array_equal(organ.spring_nodes[: BLOCK.tet_count], np.sort(organ.tet_nodes[:, :2], axis=1))
    span = organ.node_rest_position[organ.spring_nodes]
    np.testing.assert_allclose(organ.spring_rest_length, np.linalg.norm(span[:, 1] - span[:, 0], axis=1), rtol=1e-14)
    np.testing.assert_array_equal(organ.tet_inverse_volume, 1.0 / organ.tet_rest_volume)
    np.testing.assert_array_equal(organ.node_inverse_volume, 1.0 / organ.node_rest_volume)
