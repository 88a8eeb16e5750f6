"""Mesh and surface files: round trips in every format, foreign files, real files, and every refusal."""

import warnings

import meshio
import numpy as np
import pytest

from msdm_core.errors import MeshError
from msdm_core.length_unit import metres_per_unit
from msdm_core.mesh import TetMesh
from msdm_core.mesh_io import read_mesh, read_surface, write_mesh

FORMATS = [("a.vtu", None), ("a.vtk", None), ("a.msh", None), ("a.msh", "gmsh22"), ("a.mesh", None)]
every_format = pytest.mark.parametrize(("name", "file_format"), FORMATS)

POINTS = np.array([[0.0, 0, 0], [100, 0, 0], [0, 100, 0], [0, 0, 100], [100, 100, 100]])
TETS = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])

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


def written(path, points=POINTS, cells=None, file_format=None, **more):
    meshio.Mesh(points, cells or [("tetra", TETS)], **more).write(path, file_format=file_format)
    return path


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


@pytest.mark.parametrize(
    ("unit", "message"),
    [
        ("MM", 'length_unit is \'MM\'; it must be "m", "cm", "mm" or metres per unit; did you mean "mm"'),
        ("millimeters", 'did you mean "mm"'),
        ("centimetre", 'did you mean "cm"'),
        ("furlong", "length_unit is 'furlong'"),
        (0, "metres per unit must be positive"),
        (-1.0, "metres per unit must be positive"),
        (float("nan"), "metres per unit must be positive"),
        (True, "length_unit is True"),
        ([1], r"length_unit is \[1\]"),
    ],
)
def test_a_unit_that_is_none_is_refused(tmp_path, random_mesh, unit, message):
    path = written(tmp_path / "a.vtu")
    for refuse in (
        lambda: read_mesh(path, length_unit=unit),
        lambda: read_surface(path, length_unit=unit),
        lambda: write_mesh(tmp_path / "b.vtu", random_mesh(1), length_unit=unit),
    ):
        with pytest.raises(ValueError, match=message):
            refuse()


@pytest.mark.parametrize("name", ["a.vtu", "a.vtk", "a.msh", "a.mesh"])
def test_a_foreign_file_needs_a_unit(tmp_path, name):
    path = written(tmp_path / name, file_format="gmsh22" if name == "a.msh" else None)
    with pytest.raises(MeshError, match=f'{name}: states no length unit; give length_unit="m", "cm", "mm"'):
        read_mesh(path)


@pytest.mark.parametrize(
    ("size", "unit", "message"),
    [
        (100, "m", r'spans 100 m \(100 file units of 1 m\).*units forgotten\?.*length_unit="mm" would make it 0.1 m'),
        (0.1, "mm", 'spans 0.0001 m .*0.001 to 2 m: units forgotten.* length_unit="m" would make it 0.1 m'),
        (1e6, "mm", "spans 1000 m .*give metres per unit as a number"),
        (2.1, "m", "spans 2.1 m"),
        (0.99, "mm", "spans 0.00099 m"),
    ],
)
def test_a_body_too_large_or_too_small_is_asked_for_its_unit(tmp_path, size, unit, message):
    path = written(tmp_path / "a.vtu", points=POINTS / 100 * size)
    with pytest.raises(MeshError, match=message):
        read_mesh(path, length_unit=unit)


def test_the_limits_of_size_are_allowed(tmp_path):
    for size in (1e-3, 2.0):
        read_mesh(written(tmp_path / "a.vtu", points=POINTS / 100 * size), length_unit="m")


FAR = np.vstack([POINTS[:4], POINTS[:4] + 300])
BAD_BODIES = {
    "nan": (np.where(POINTS == 100, np.nan, POINTS), [("tetra", TETS)], "node 1 is at"),
    "unused": (POINTS, [("tetra", TETS[:1])], r"node 4 \(of 1\) belongs to no tet; .*drop unused nodes"),
    "duplicate": (np.vstack([POINTS[:4], POINTS[:1]]), [("tetra", TETS)], "nodes 0 and 4 are duplicates"),
    "flat": (np.vstack([POINTS[:4] * [1, 1, 1e-9], POINTS[4:]]), [("tetra", TETS)], r"tet 0 \(of 1\) is degenerate"),
    "apart": (FAR, [("tetra", [[0, 1, 2, 3], [4, 5, 6, 7]])], "falls into 2 disconnected parts"),
    "hinged": (
        np.vstack([POINTS[:4], np.add(POINTS[1:4], [300, 0, 0])]),
        [("tetra", [[0, 1, 2, 3], [3, 4, 5, 6]])],
        "falls into 2 disconnected parts, which share no face, of 1, 1 tets; .*hinge",
    ),
    "triangles": (POINTS, [("triangle", TETS[:, :3])], r"has no tets \(2 triangle\); mesh the volume first"),
    "quadratic": (np.random.default_rng(0).random((10, 3)), [("tetra10", [range(10)])], "quadratic .*1 tetra10"),
    "mixed": (np.vstack([POINTS, FAR[5:]]), [("tetra", TETS), ("hexahedron", [range(8)])], "not tets .*1 hexahedron"),
}


# Medit has no quadratic tets.
@pytest.mark.parametrize(
    ("case", "suffix"),
    [(c, s) for c in BAD_BODIES for s in (".vtu", ".vtk", ".msh", ".mesh") if (c, s) != ("quadratic", ".mesh")],
)
def test_a_body_that_is_no_organ_is_refused_with_the_files_name(tmp_path, case, suffix):
    points, cells, message = BAD_BODIES[case]
    path = written(tmp_path / f"a{suffix}", points, cells, file_format="gmsh22" if suffix == ".msh" else None)
    with pytest.raises(MeshError, match=rf"a{suffix}: .*({message})"):
        read_mesh(path, length_unit="mm")


@every_format
def test_a_file_cut_short_anywhere_is_refused_without_exit_or_print(tmp_path, random_mesh, capfd, name, file_format):
    mesh = random_mesh(3, cells=2)
    write_mesh(tmp_path / name, mesh, file_format=file_format)
    whole = (tmp_path / name).read_bytes()
    needed = len(whole) if name != "a.mesh" else whole.index(b"\nEnd")
    for stop in np.linspace(1, needed - 12, 60).astype(int):
        (tmp_path / name).write_bytes(whole[:stop])
        try:
            again = read_mesh(tmp_path / name, length_unit="m")
        except MeshError as error:
            assert name in str(error)
        else:
            # Nothing that was lost may be missed: the cut was in a closing mark, or in the last array.
            assert again.tet_count == mesh.tet_count and (again.points == mesh.points).all()
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh", ".mesh", ".stl", ".obj", ".ply"])
@pytest.mark.parametrize("content", [b"\x00\xff garbage \x80" * 40, b"hello\nworld\n", b"\n\n\n", b"<a/>"])
def test_garbage_is_refused_without_exit_or_print(tmp_path, capfd, suffix, content):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(content)
    read = read_mesh if suffix in (".vtu", ".vtk", ".msh", ".mesh") else read_surface
    with pytest.raises(MeshError, match=f"a{suffix}: "):
        read(path, length_unit="mm")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("read", [read_mesh, read_surface])
def test_a_path_that_is_no_file_is_refused(tmp_path, read):
    with pytest.raises(MeshError, match=r"missing.vtu: no such file; check the path"):
        read(tmp_path / "missing.vtu", length_unit="mm")
    with pytest.raises(MeshError, match="is a directory"):
        read(tmp_path, length_unit="mm")
    for name in ("empty.vtu", "empty.stl"):
        (tmp_path / name).touch()
    with pytest.raises(MeshError, match=r"empty.\w+: is empty \(0 bytes\)"):
        read(tmp_path / ("empty.vtu" if read is read_mesh else "empty.stl"), length_unit="mm")
    (tmp_path / "a.step").write_text("solid")
    with pytest.raises(MeshError, match=r"a.step: unknown extension '.step'; known: "):
        read(tmp_path / "a.step", length_unit="mm")


def test_a_file_that_may_not_be_read_is_refused(tmp_path, monkeypatch):
    def refuse(*_args, **_options):
        raise PermissionError(13, "Permission denied")

    path = written(tmp_path / "a.vtu")
    monkeypatch.setattr("pathlib.Path.open", refuse)  # chmod does not stop root
    with pytest.raises(MeshError, match=r"a.vtu: cannot be read \(Permission denied\)"):
        read_mesh(path, length_unit="mm")


def test_other_files_called_msh_are_told_what_they_are(tmp_path):
    (tmp_path / "a.msh").write_text("$NOD\n1\n1 0 0 0\n$ENDNOD\n")
    with pytest.raises(MeshError, match=r"gmsh 1 file \(\$NOD header\).*-format msh22"):
        read_mesh(tmp_path / "a.msh", length_unit="mm")
    (tmp_path / "a.msh").write_text("(0 fluent)\n")
    with pytest.raises(MeshError, match=r"starts with b'\(0 fluent\)\\n', not \$MeshFormat"):
        read_mesh(tmp_path / "a.msh", length_unit="mm")


def test_a_vtu_of_several_pieces_is_refused(tmp_path):
    path = written(tmp_path / "a.vtu")
    text = path.read_text()
    piece = text[text.index("<Piece") : text.index("</UnstructuredGrid>")]
    path.write_text(text.replace(piece, piece + piece))
    with pytest.raises(MeshError, match="holds 2 pieces; one is the rule"):
        read_mesh(path, length_unit="mm")


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("a.step", {}, "unknown extension '.step'; known: .vtu, .vtk, .msh, .mesh"),
        ("a.vtu", {"file_format": "gmsh22"}, "file_format 'gmsh22' does not fit .vtu; use vtu"),
        ("a.msh", {"file_format": "gmsh1"}, "use gmsh or gmsh22"),
        ("none/a.vtu", {}, "the folder .*none does not exist; create it first"),
        (
            "a.vtu",
            {"point_data": {"u": np.ones(3)}},
            r"point_data 'u' has shape \(3,\), dtype float64; the rule is \(5, ...\)",
        ),
        (
            "a.vtu",
            {"cell_data": {"u": np.ones(5)}},
            r"cell_data 'u' has shape \(5,\), dtype float64; the rule is \(2, ...\)",
        ),
        ("a.vtu", {"cell_data": {"u": ["a", "b"]}}, "cell_data 'u' has shape"),
        ("a.vtu", {"cell_data": {"region": [1, 2]}}, "not region or cell_tags"),
        ("a.vtk", {"cell_data": {"a b": [1, 2]}}, "cell_data name 'a b' must be letters"),
        ("a.vtk", {"cell_data": {"u": np.ones((2, 2))}}, "2 components; vtk holds 1, 3 or 9: use .vtu"),
        ("a.mesh", {"cell_data": {"u": [1, 2]}}, r"cell_data \['u'\] has no room in a medit file"),
    ],
)
def test_what_cannot_be_written_is_refused(tmp_path, name, options, message):
    with pytest.raises(ValueError, match=message):
        write_mesh(tmp_path / name, TetMesh(POINTS, TETS), **options)
    assert not list(tmp_path.iterdir())


def test_a_path_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "a.vtu").mkdir()
    with pytest.raises(MeshError, match=r"a.vtu: cannot be written \(Is a directory\)"):
        write_mesh(tmp_path / "a.vtu", TetMesh(POINTS, TETS))


@pytest.mark.parametrize("name", ['a "b"', "back\\slash", "two\nlines", "", " padded"])
def test_region_names_that_files_would_break_are_refused(tmp_path, name):
    with pytest.raises(MeshError, match="region 1 is named"):
        write_mesh(tmp_path / "a.vtu", TetMesh(POINTS, TETS, [1, 1], {1: name}))


def test_regions_that_a_format_would_lose_are_refused(tmp_path):
    twice = TetMesh(POINTS, TETS, [1, 2], ((1, "liver"), (2, "liver")))
    with pytest.raises(MeshError, match="region name 'liver' is given to more than one tag"):
        write_mesh(tmp_path / "a.vtu", twice)
    negative = TetMesh(POINTS / 1000, TETS, [-4, 2])
    for file_format in ("gmsh", "gmsh22"):
        with pytest.raises(MeshError, match="region tag -4 is negative; gmsh needs"):
            write_mesh(tmp_path / "a.msh", negative, file_format=file_format)
    for name in ("a.vtu", "a.vtk", "a.mesh"):
        write_mesh(tmp_path / name, negative)
        assert read_mesh(tmp_path / name).region.tolist() == [-4, 2]


def test_a_mesh_of_loose_bad_tets_is_refused(anatomy_folder):
    with pytest.raises(MeshError, match=r"6_tetra_bad.msh: .* 6 disconnected parts, .* of 1, 1, 1, 1, 1, 1 tets"):
        read_mesh(anatomy_folder / "6_tetra_bad.msh", length_unit="cm")


def test_the_gmsh_1_liver_is_told_how_to_convert(anatomy_folder):
    with pytest.raises(MeshError, match=r"sofa_liver_gmsh1.msh: is a gmsh 1 file .*-format msh22"):
        read_mesh(anatomy_folder / "sofa_liver_gmsh1.msh", length_unit="cm")


def test_the_vtu_liver_is_a_human_liver_once_its_unit_is_told(anatomy_folder):
    path = anatomy_folder / "sofa_liver.vtu"
    with pytest.raises(MeshError, match="states no length unit"):
        read_mesh(path)
    with pytest.raises(MeshError, match=r'units forgotten.*length_unit="cm"'):
        read_mesh(path, length_unit="m")
    mesh = read_mesh(path, length_unit=0.028)
    assert (mesh.node_count, mesh.tet_count) == (181, 596) and not mesh.region.any()
    assert 0.5e-3 < mesh.volumes.sum() < 3e-3
