"""TetMesh: geometry and incidences against slow loops, and every refusal."""

from collections import Counter
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from msdm_core.errors import MeshError
from msdm_core.mesh.tet_mesh import TetMesh

TET = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
TWO = np.vstack([TET, [[1.0, 1, 1]]])
TWO_TETS = [[0, 1, 2, 3], [1, 2, 3, 4]]
seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=10, deadline=None)


@few
@given(seed=seeds)
def test_volumes_are_those_of_each_tet(random_mesh, seed):
    mesh = random_mesh(seed)
    expected = [abs(np.linalg.det(mesh.points[tet[1:]] - mesh.points[tet[0]])) / 6 for tet in mesh.tets]
    np.testing.assert_allclose(mesh.volumes, expected, rtol=1e-9)


@few
@given(seed=seeds)
def test_edges_are_every_pair_once_in_order(random_mesh, seed):
    mesh = random_mesh(seed)
    expected = sorted({pair for tet in mesh.tets.tolist() for pair in combinations(sorted(tet), 2)})
    assert mesh.edges.tolist() == [list(pair) for pair in expected]
    for tet, edges in zip(mesh.tets.tolist(), mesh.tet_edges, strict=True):
        pairs = [[min(a, b), max(a, b)] for a, b in combinations(tet, 2)]
        assert mesh.edges[edges].tolist() == pairs


@few
@given(seed=seeds)
def test_boundary_is_closed_outward_and_encloses_the_volume(random_mesh, seed):
    mesh = random_mesh(seed)
    faces = Counter(frozenset(face) for tet in mesh.tets.tolist() for face in combinations(tet, 3))
    outer = {face for face, count in faces.items() if count == 1}
    triangles = mesh.boundary_triangles.tolist()
    assert len(triangles) == len(outer) and {frozenset(triangle) for triangle in triangles} == outer
    directed = Counter((t[i], t[(i + 1) % 3]) for t in triangles for i in range(3))
    assert all(directed[b, a] == count for (a, b), count in directed.items())
    a, b, c = (mesh.points[mesh.boundary_triangles[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    inside = mesh.points[mesh.tets[mesh.boundary_tets]].mean(axis=1)
    assert (np.einsum("ij,ij->i", normals, a - inside) > 0).all()
    assert all(set(t) <= set(mesh.tets[owner].tolist()) for t, owner in zip(triangles, mesh.boundary_tets, strict=True))
    assert np.einsum("ij,ij->", a, normals) / 6 == pytest.approx(mesh.volumes.sum(), rel=1e-9)
    assert mesh.boundary_nodes.tolist() == sorted(set().union(*outer))


@few
@given(seed=seeds)
def test_tets_given_inside_out_are_reoriented(random_mesh, seed):
    mesh = random_mesh(seed)
    wrong = np.random.default_rng(seed).random(mesh.tet_count) < 0.3
    tets = mesh.tets.copy()
    tets[wrong] = tets[wrong][:, [1, 0, 2, 3]]
    again = TetMesh(mesh.points, tets)
    assert (again.volumes > 0).all()
    assert (np.sort(again.tets, axis=1) == np.sort(mesh.tets, axis=1)).all()
    assert mesh.volumes.sum() == pytest.approx(again.volumes.sum(), rel=1e-12)


@pytest.mark.parametrize("points", [TWO.astype(">f8"), np.asfortranarray(TWO), np.repeat(TWO, 2, axis=0)[::2]])
@pytest.mark.parametrize("dtype", [">i4", "<i8", ">i8", np.uint64, np.int16])
def test_foreign_arrays_become_native_contiguous_and_read_only(points, dtype):
    tets = np.asfortranarray(np.array(TWO_TETS, dtype=dtype))
    mesh = TetMesh(points, tets, region=np.array([1, 2], dtype=">i2"))
    for array, kind in ((mesh.points, np.float64), (mesh.tets, np.int32), (mesh.region, np.int32)):
        assert array.dtype == kind and array.dtype.isnative and array.flags.c_contiguous
    assert (mesh.points == TWO).all() and mesh.region.tolist() == [1, 2]
    assert mesh.volumes == pytest.approx([1 / 6, 1 / 3])


def test_arrays_are_copies_that_cannot_be_written():
    points, tets = TWO.copy(), np.array(TWO_TETS, dtype=np.int32)
    mesh = TetMesh(points, tets)
    points[0], tets[0] = 9, 4
    assert (mesh.points == TWO).all() and sorted(mesh.tets[0]) == [0, 1, 2, 3]
    names = "points tets region volumes edges tet_edges boundary_triangles boundary_tets boundary_nodes".split()
    for array in [getattr(mesh, name) for name in names]:
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


def test_regions_are_found_by_name():
    mesh = TetMesh(TWO, TWO_TETS, [3, 5], {3: "liver", 5: "lesion"})
    assert mesh.region_names == ((3, "liver"), (5, "lesion")) and mesh.region_tag("lesion") == 5
    assert TetMesh(TWO, TWO_TETS).region.tolist() == [0, 0]
    with pytest.raises(MeshError, match="'tumour' is not in the mesh; its named regions: liver, lesion"):
        mesh.region_tag("tumour")


FAR = np.vstack([TET, TET + 5])
REFUSED = {
    "infinite": (np.vstack([TET, [[0, np.inf, 0]]]), [[0, 1, 2, 3]], "node 4 .*inf"),
    "duplicates": (np.vstack([TET, TET[2:3]]), TWO_TETS, "nodes 2 and 4"),
    "no tets": (TET, np.empty((0, 4), int), "no tets"),
    "outside": (TET, [[0, 1, 2, 4]], r"tet 0 .*\[0, 1, 2, 4\]"),
    "repeated": (TET, [[0, 1, 2, 3], [0, 1, 1, 3]], "tet 1"),
    "unused": (TWO, [[0, 1, 2, 3]], "node 4"),
    "degenerate": (np.vstack([TET, [[0.5, 0.5, 0]]]), [[0, 1, 2, 3], [0, 1, 2, 4]], "tet 1"),
    "disconnected": (FAR, [[0, 1, 2, 3], [4, 5, 6, 7]], "2 disconnected parts"),
    "crowded face": (np.vstack([TWO, [[2.0, 2, 2]]]), [*TWO_TETS, [1, 2, 3, 5]], r"face \[1, 2, 3\] of tet 0"),
}


def test_region_tags_are_one_per_tet():
    with pytest.raises(MeshError, match=r"\(1,\)"):
        TetMesh(TWO, TWO_TETS, [1])


def test_flatness_is_judged_by_shape_not_by_size():
    for size in (1e-9, 1.0, 1e9):
        assert TetMesh(TET * size, [[0, 1, 2, 3]]).tet_count == 1
        assert TetMesh(TET * [size, size, 1e-4 * size], [[0, 1, 2, 3]]).tet_count == 1
    with pytest.raises(MeshError, match=r"volume / longest edge\^3 = 5.9e-07, the rule is above 1e-06"):
        TetMesh(TET * [1, 1, 1e-5], [[0, 1, 2, 3]])


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_organ_is_refused_with_the_element(case):
    points, tets, named = REFUSED[case]
    with pytest.raises(MeshError, match=named):
        TetMesh(points, tets)
