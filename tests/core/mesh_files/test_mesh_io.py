"""Mesh files: a round trip, units, and foreign files."""

import warnings

import meshio
import numpy as np
import pytest

from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.mesh_files.mesh_file import metres_per_unit
from msdm_core.mesh_files.mesh_io import read_mesh, write_mesh
from tests.core.mesh_files.made_files import POINTS, TETS, written

# As gmsh 4.15 writes it: sparse node tags, a named surface, one block per entity.
GMSH41 = """$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
3
2 3 "skin"
3 5 "lesion one"
3 9 "liver"
$EndPhysicalNames
$Entities
0 0 1 2
1 0 0 0 100 100 0 1 3 0
1 0 0 0 100 100 100 1 9 1 1
2 0 0 0 100 100 100 1 5 0
$EndEntities
$Nodes
2 5 10 22
3 1 0 2
10
22
0 0 0
100 0 0
3 2 0 3
11
12
13
0 100 0
0 0 100
100 100 100
$EndNodes
$Elements
3 3 1 3
2 1 2 1
1 10 22 11
3 1 4 1
2 10 22 11 12
3 2 4 1
3 22 11 12 13
$EndElements
"""


def test_what_is_written_is_read_back(tmp_path, random_mesh):
    mesh = random_mesh(5)
    write_mesh(tmp_path / "a.vtu", mesh)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = read_mesh(tmp_path / "a.vtu")
        read_mesh(tmp_path / "a.vtu", length_unit="m")
    np.testing.assert_array_equal(again.tets, mesh.tets)
    np.testing.assert_array_equal(again.region, mesh.region)
    np.testing.assert_array_equal(again.points, mesh.points)
    assert again.region_names == mesh.region_names


def test_region_names_with_any_letters_are_read_back(tmp_path):
    names = ((1, 'a "b"'), (2, "back\\slash <&>"))
    write_mesh(tmp_path / "a.vtu", TetMesh(POINTS / 1000, TETS, [1, 2], names))
    assert read_mesh(tmp_path / "a.vtu").region_names == names


def test_other_programs_see_points_and_tags(tmp_path, random_mesh):
    mesh = random_mesh(6)
    write_mesh(tmp_path / "a.vtu", mesh)
    seen = meshio.read(tmp_path / "a.vtu")
    np.testing.assert_array_equal(seen.points, mesh.points)
    assert np.concatenate(seen.cell_data["region"]).ravel().tolist() == mesh.region.tolist()


def test_other_suffixes_are_not_written(tmp_path):
    with pytest.raises(ValueError, match=r"\.vtu"):
        write_mesh(tmp_path / "a.msh", TetMesh(POINTS, TETS))


def test_the_callers_unit_wins_over_the_files_with_a_warning(tmp_path, random_mesh):
    write_mesh(tmp_path / "a.vtu", random_mesh(1))
    with pytest.warns(UserWarning, match="states 1 m per unit, but length_unit says 0.1; length_unit is used"):
        mesh = read_mesh(tmp_path / "a.vtu", length_unit=0.1)
    np.testing.assert_allclose(mesh.points, random_mesh(1).points / 10)


def test_a_genuine_gmsh_41_file(tmp_path):
    (tmp_path / "a.msh").write_text(GMSH41)
    mesh = read_mesh(tmp_path / "a.msh", length_unit="mm")
    assert mesh.region.tolist() == [9, 5] and mesh.region_names == ((5, "lesion one"), (9, "liver"))
    np.testing.assert_array_equal(mesh.points, POINTS * 0.001)
    assert np.sort(mesh.tets, axis=1).tolist() == TETS.tolist()


@pytest.mark.parametrize(
    ("name", "file_format", "key"),
    [
        ("a.vtu", "vtu", "region"),
        ("a.vtk", "vtk42", "region"),
        ("a.vtk", "vtk", "region"),
        ("a.msh", "gmsh22", "gmsh:physical"),
        ("a.mesh", "medit", "medit:ref"),
    ],
)
def test_blocks_of_tets_and_triangles_are_put_together(tmp_path, name, file_format, key):
    cells = [("tetra", TETS[:1]), ("triangle", [[0, 1, 2]]), ("tetra", TETS[1:])]
    tags = {key: [np.array([4]), np.array([7]), np.array([6])]}
    if file_format == "gmsh22":
        tags["gmsh:geometrical"] = tags[key]
    path = written(tmp_path / name, cells=cells, cell_data=tags, file_format=file_format)
    mesh = read_mesh(path, length_unit="mm")
    assert mesh.region.tolist() == [4, 6] and mesh.tet_count == 2 and mesh.points.flags.c_contiguous
    assert mesh.points.dtype == np.float64 and mesh.points.dtype.isnative
    np.testing.assert_array_equal(mesh.points, POINTS * 0.001)


@pytest.mark.parametrize(("unit", "metres"), [("m", 1), ("cm", 0.01), ("mm", 0.001), (0.0254, 0.0254), (1, 1)])
def test_units_scale_the_points(tmp_path, unit, metres):
    assert metres_per_unit(unit) == metres
    points = POINTS / 100 / metres * 0.2
    mesh = read_mesh(written(tmp_path / "a.vtu", points=points), length_unit=unit)
    assert np.ptp(mesh.points, axis=0) == pytest.approx([0.2] * 3)


# Volume 1 is in the groups 1 and 5, volume 2 in `groups`.
VOLUMES = """$MeshFormat
4.1 0 8
$EndMeshFormat
$Entities
0 0 0 2
1 0 0 0 1 1 1 2 1 5 0
2 0 0 0 1 1 1 {groups} 0
$EndEntities
$Nodes
1 5 1 5
3 1 0 5
1 2 3 4 5
0 0 0 30 0 0 0 30 0 0 0 30 30 30 30
$EndNodes
$Elements
2 2 1 2
3 1 4 1
1 1 2 3 4
3 2 4 1
2 2 3 4 5
$EndElements
"""


@pytest.mark.parametrize(("groups", "tags"), [("1 2", [1, 2]), ("0", [1, 0])])
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_volumes_of_gmsh_in_two_groups_or_in_none(tmp_path, groups, tags, newline):
    (tmp_path / "a.msh").write_text(VOLUMES.format(groups=groups), newline=newline)
    with pytest.warns(UserWarning, match=r"\b1, 5\b"):
        mesh = read_mesh(tmp_path / "a.msh", length_unit="mm")
    assert mesh.region.tolist() == tags and mesh.volumes.sum() == pytest.approx(13.5e-6)


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".mesh"])
def test_unused_nodes_are_left_out(tmp_path, suffix):
    points = np.vstack([[7.0, 7, 7], POINTS, POINTS[:1]])
    with pytest.warns(UserWarning, match="2 nodes"):
        mesh = read_mesh(written(tmp_path / f"a{suffix}", points, [("tetra", TETS + 1)]), length_unit="mm")
    np.testing.assert_array_equal(mesh.points, POINTS * 0.001)
    np.testing.assert_array_equal(np.sort(mesh.tets, axis=1), TETS)


@pytest.mark.parametrize("numbers", [[3, 4], [3.0, 4.0], [[3], [4]]])
def test_cell_data_of_any_name(tmp_path, numbers):
    arrays = {"labels": [np.array(numbers)], "quality": [np.array([0.5, 0.7])], "part": [np.array([1, 1])]}
    path = written(tmp_path / "a.vtu", cell_data=arrays)
    with pytest.warns(UserWarning, match=r"labels \(3, 4\)"):
        assert read_mesh(path, length_unit="mm").region.tolist() == [3, 4]
    assert read_mesh(path, length_unit="mm", cell_data="part").region.tolist() == [1, 1]


@pytest.mark.parametrize(
    ("suffix", "arrays", "named"),
    [
        (".vtu", {"tissue": [7, 7]}, r"\btissue\b"),
        (".vtu", {"tissue": [np.nan, 1.0]}, r"\btissue\b"),
        (".msh", {"gmsh:physical": [0, 0], "gmsh:geometrical": [1, 2]}, r"gmsh:geometrical \(1, 2\)"),
    ],
)
def test_cell_data_that_are_no_regions_are_named(tmp_path, suffix, arrays, named):
    cell_data = {name: [np.array(values)] for name, values in arrays.items()}
    path = written(tmp_path / f"a{suffix}", cell_data=cell_data, file_format="gmsh22" if suffix == ".msh" else None)
    with pytest.warns(UserWarning, match=named):
        assert read_mesh(path, length_unit="mm").region.tolist() == [0, 0]


def test_point_data_are_named(tmp_path):
    path = written(tmp_path / "a.vtu", point_data={"labels": np.array([0, 1, 1, 2, 0])})
    with pytest.warns(UserWarning, match=r"labels \(0, 1, 2\)"):
        assert read_mesh(path, length_unit="mm").region.tolist() == [0, 0]
