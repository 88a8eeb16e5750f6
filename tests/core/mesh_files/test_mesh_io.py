"""Mesh files: round trips in every format, units, and foreign files."""

import warnings

import meshio
import numpy as np
import pytest

from msdm_core.errors import MeshError
from msdm_core.mesh_files.mesh_file import metres_per_unit
from msdm_core.mesh_files.mesh_io import read_mesh, write_mesh
from tests.core.mesh_files.made_files import FORMATS, POINTS, TETS, every_format, written

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


# As VTK 9 saves one of our files again, as text.
VTK_TEXT = """# vtk DataFile Version 5.1
vtk output
ASCII
DATASET UNSTRUCTURED_GRID
FIELD FieldData 2
length_unit_m 1 1 double
0.001 
region/lesion%20one 1 1 vtktypeint64
8 
POINTS 5 double
0 0 0 100 0 0 0 100 0 
0 0 100 100 100 100 
CELLS 3 8
OFFSETS vtktypeint64
0 4 8 
CONNECTIVITY vtktypeint64
0 1 2 3 
1 2 3 4 
CELL_TYPES 2
10
10

CELL_DATA 2
SCALARS region int
LOOKUP_TABLE default
4 8 
"""  # noqa: W291


@every_format
@pytest.mark.parametrize("unit", ["m", "mm", 0.0123456789])
def test_what_is_written_is_read_back(tmp_path, random_mesh, name, file_format, unit):
    mesh = random_mesh(5)
    write_mesh(tmp_path / name, mesh, file_format=file_format, length_unit=unit)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = read_mesh(tmp_path / name)
        read_mesh(tmp_path / name, length_unit=unit)
    np.testing.assert_array_equal(again.tets, mesh.tets)
    np.testing.assert_array_equal(again.region, mesh.region)
    assert again.region_names == mesh.region_names
    if unit == "m":
        np.testing.assert_array_equal(again.points, mesh.points)
    np.testing.assert_allclose(again.points, mesh.points, rtol=1e-15, atol=0)


@every_format
def test_other_programs_see_file_units_and_tags(tmp_path, random_mesh, name, file_format):
    mesh = random_mesh(6)
    write_mesh(tmp_path / name, mesh, file_format=file_format, length_unit="mm")
    seen = meshio.read(tmp_path / name)
    np.testing.assert_allclose(seen.points, mesh.points * 1000, rtol=1e-14)
    key = next(key for key in ("gmsh:physical", "medit:ref", "region") if key in seen.cell_data)
    assert np.concatenate(seen.cell_data[key]).ravel().tolist() == mesh.region.tolist()
    first_line = (tmp_path / name).read_bytes().splitlines()[:2]
    if name == "a.msh":
        assert first_line[1].startswith(b"2.2" if file_format else b"4.1")
        assert {key: tuple(value) for key, value in seen.field_data.items()}["lesion deep"] == (2, 3)
        assert "parenchyma" not in seen.field_data  # gmsh gives a name of tag 0 to another tag


@pytest.mark.parametrize(("name", "file_format"), FORMATS[:4])
def test_data_on_nodes_and_tets_is_there_to_look_at(tmp_path, random_mesh, name, file_format):
    mesh = random_mesh(7)
    point_data = {"displacement": mesh.points * 2, "node": np.arange(mesh.node_count), "held": mesh.points[:, 0] > 0.03}
    cell_data = {"stress": mesh.volumes, "tensor": np.ones((mesh.tet_count, 3, 3))}
    write_mesh(tmp_path / name, mesh, point_data=point_data, cell_data=cell_data, file_format=file_format)
    seen = meshio.read(tmp_path / name)
    for key, values in point_data.items():
        np.testing.assert_allclose(np.squeeze(seen.point_data[key]), values, rtol=1e-15)
    np.testing.assert_allclose(np.concatenate(seen.cell_data["stress"]).ravel(), mesh.volumes, rtol=1e-15)
    assert np.concatenate(seen.cell_data["tensor"]).shape == (mesh.tet_count, 9)
    again = read_mesh(tmp_path / name)
    assert again.region.tolist() == mesh.region.tolist() and (again.tets == mesh.tets).all()


def test_the_callers_unit_wins_over_the_files_with_a_warning(tmp_path, random_mesh):
    write_mesh(tmp_path / "a.vtu", random_mesh(1), length_unit="m")
    with pytest.warns(UserWarning, match="states 1 m per unit, but length_unit says 0.1; length_unit is used"):
        mesh = read_mesh(tmp_path / "a.vtu", length_unit=0.1)
    np.testing.assert_allclose(mesh.points, random_mesh(1).points / 10)


def test_a_genuine_gmsh_41_file(tmp_path):
    (tmp_path / "a.msh").write_text(GMSH41)
    mesh = read_mesh(tmp_path / "a.msh", length_unit="mm")
    assert mesh.region.tolist() == [9, 5] and mesh.region_names == ((5, "lesion one"), (9, "liver"))
    np.testing.assert_array_equal(mesh.points, POINTS * 0.001)
    assert np.sort(mesh.tets, axis=1).tolist() == TETS.tolist()


def test_a_vtk_file_that_vtk_saved_again_as_text_keeps_unit_and_names(tmp_path):
    (tmp_path / "a.vtk").write_text(VTK_TEXT)
    mesh = read_mesh(tmp_path / "a.vtk")
    assert mesh.region.tolist() == [4, 8] and mesh.region_names == ((8, "lesion one"),)
    np.testing.assert_array_equal(mesh.points, POINTS * 0.001)


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


def test_any_cell_data_can_be_the_region(tmp_path):
    tags = {"organ": [np.array([3, 8])], "region": [np.array([1, 2])], "wide": [np.ones((2, 3))]}
    path = written(tmp_path / "a.vtu", cell_data=tags)
    assert read_mesh(path, length_unit="mm").region.tolist() == [1, 2]
    assert read_mesh(path, length_unit="mm", region_key="organ").region.tolist() == [3, 8]
    with pytest.raises(MeshError, match=r"a.vtu: has no cell data 'tissue'; the cell data there is: organ, region"):
        read_mesh(path, length_unit="mm", region_key="tissue")
    with pytest.raises(MeshError, match=r"a.vtu: region has shape \(2, 3\)"):
        read_mesh(path, length_unit="mm", region_key="wide")


@pytest.mark.parametrize(("unit", "metres"), [("m", 1), ("cm", 0.01), ("mm", 0.001), (0.0254, 0.0254), (1, 1)])
def test_units_scale_the_points(tmp_path, unit, metres):
    assert metres_per_unit(unit) == metres
    points = POINTS / 100 / metres * 0.2
    mesh = read_mesh(written(tmp_path / "a.vtu", points=points), length_unit=unit)
    assert np.ptp(mesh.points, axis=0) == pytest.approx([0.2] * 3)
