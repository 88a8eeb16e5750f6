"""Mesh and surface files that are refused."""

import numpy as np
import pytest

from msdm_core.errors import MeshError
from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.mesh_files.mesh_io import read_mesh, write_mesh
from msdm_core.mesh_files.surface_io import read_surface
from msdm_core.meshing.lattice_meshing import box_mesh
from tests.core.mesh_files.made_files import POINTS, TETS, written


@pytest.mark.parametrize(
    ("unit", "message"),
    [
        ("MM", 'length_unit is \'MM\'; it must be "m", "cm", "mm" or metres per unit'),
        ("furlong", "length_unit is 'furlong'"),
        (0, "metres per unit must be positive"),
        (-1.0, "metres per unit must be positive"),
        (float("nan"), "metres per unit must be positive"),
    ],
)
def test_a_unit_that_is_none_is_refused(tmp_path, unit, message):
    path = written(tmp_path / "a.vtu")
    for refuse in (
        lambda: read_mesh(path, length_unit=unit),
        lambda: read_surface(path, length_unit=unit),
    ):
        with pytest.raises(ValueError, match=message):
            refuse()


@pytest.mark.parametrize("name", ["a.vtu", "a.vtk", "a.msh", "a.mesh"])
def test_a_foreign_file_needs_a_unit(tmp_path, name):
    path = written(tmp_path / name, file_format="gmsh22" if name == "a.msh" else None)
    with pytest.raises(MeshError, match=f'{name}: states no length unit; give "m", "cm", "mm"'):
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
    "duplicate": (np.vstack([POINTS[:4], POINTS[:1]]), [("tetra", TETS)], "nodes 0 and 4 are duplicates"),
    "flat": (np.vstack([POINTS[:4] * [1, 1, 1e-9], POINTS[4:]]), [("tetra", TETS)], r"tet 0 \(of 1\) is degenerate"),
    "apart": (FAR, [("tetra", [[0, 1, 2, 3], [4, 5, 6, 7]])], "falls into 2 disconnected parts"),
    "hinged": (
        np.vstack([POINTS[:4], np.add(POINTS[1:4], [300, 0, 0])]),
        [("tetra", [[0, 1, 2, 3], [3, 4, 5, 6]])],
        "falls into 2 disconnected parts, which share no face, of 1, 1 tets; .*hinge",
    ),
    "triangles": (POINTS, [("triangle", TETS[:, :3])], r"has no tets \(2 triangle\): save a surface as STL"),
    "quadratic": (np.random.default_rng(0).random((10, 3)), [("tetra10", [range(10)])], "linear tets .*1 tetra10"),
    "mixed": (
        np.vstack([POINTS, FAR[5:]]),
        [("tetra", TETS), ("hexahedron", [range(8)])],
        "not linear tets .*1 hexahedron",
    ),
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


def test_a_file_cut_short_anywhere_is_refused_without_exit_or_print(tmp_path, random_mesh, capfd):
    mesh = random_mesh(3, cells=2)
    write_mesh(tmp_path / "a.vtu", mesh)
    whole = (tmp_path / "a.vtu").read_bytes()
    for stop in np.linspace(1, len(whole) - 12, 20).astype(int):
        (tmp_path / "a.vtu").write_bytes(whole[:stop])
        with pytest.raises(MeshError, match=r"a\.vtu"):
            read_mesh(tmp_path / "a.vtu", length_unit="m")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh", ".mesh", ".stl", ".obj", ".ply"])
@pytest.mark.parametrize("content", [b"\x00\xff garbage \x80" * 40, b"hello\nworld\n"])
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
    with pytest.raises(MeshError, match="no such file"):
        read(tmp_path, length_unit="mm")
    for name in ("empty.vtu", "empty.stl"):
        (tmp_path / name).touch()
    with pytest.raises(MeshError, match=r"empty.\w+: cannot be parsed|has no triangles"):
        read(tmp_path / ("empty.vtu" if read is read_mesh else "empty.stl"), length_unit="mm")
    (tmp_path / "a.step").write_text("solid")
    with pytest.raises(MeshError, match=r"a.step: unknown extension '.step'; known: "):
        read(tmp_path / "a.step", length_unit="mm")


def test_a_vtu_of_several_pieces_is_refused(tmp_path):
    path = written(tmp_path / "a.vtu")
    text = path.read_text()
    piece = text[text.index("<Piece") : text.index("</UnstructuredGrid>")]
    path.write_text(text.replace(piece, piece + piece))
    with pytest.raises(MeshError, match="holds 2 pieces"):
        read_mesh(path, length_unit="mm")


@pytest.mark.filterwarnings("error")
def test_coordinates_whose_powers_overflow_are_refused():
    """No ratio of volume and edge is left."""
    mesh = box_mesh((0.02, 0.01, 0.01), (2, 1, 1))
    points = mesh.points * 1e150
    with pytest.raises(MeshError, match=r"tet 0 \(of \d+\) is degenerate: volume / longest edge\^3 = nan"):
        TetMesh(points, mesh.tets)


def test_a_vertex_short_of_coordinates_is_refused(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 0.01\nv 0 0.01 0\nv 0 0 0.01\nf 1 2 3\nf 1 3 4\n")
    with pytest.raises(MeshError, match="a vertex has 1 coordinates"):
        read_surface(tmp_path / "a.obj", length_unit="m")


def test_tets_in_two_groups_of_gmsh_22_are_named(tmp_path):
    tags = {key: [np.array([3, 1, 5])] for key in ("gmsh:physical", "gmsh:geometrical")}
    cells = [("tetra", TETS[[0, 1, 1]])]
    path = written(tmp_path / "a.msh", cells=cells, cell_data=tags, file_format="gmsh22")
    with pytest.raises(MeshError, match=r"1 tets .*\b1, 5\b"):
        read_mesh(path, length_unit="mm")


@pytest.mark.parametrize(
    ("arrays", "named"),
    [({"a": [0, 1], "b": [2, 1]}, r"a \(0, 1\), b \(1, 2\)"), ({"region": [0.5, 1.0]}, "region of tet 0 is 0.5")],
)
def test_tags_in_doubt_are_refused(tmp_path, arrays, named):
    path = written(tmp_path / "a.vtu", cell_data={name: [np.array(values)] for name, values in arrays.items()})
    with pytest.raises(MeshError, match=named):
        read_mesh(path, length_unit="mm")
    with pytest.raises(MeshError, match="'c'"):
        read_mesh(path, length_unit="mm", cell_data="c")


@pytest.mark.parametrize("content", [".vtu", ".vtk", ".msh", ".mesh", ".stl", ".ply", ".obj"])
@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh", ".mesh", ".stl", ".ply", ".obj"])
def test_a_file_with_the_suffix_of_another_format_is_named(tmp_path, content, suffix):
    cells = [("tetra", TETS)] if content in (".vtu", ".vtk", ".msh", ".mesh") else [("triangle", TETS[:, :3])]
    # meshio alone writes ANSYS files as .msh.
    file_format = "gmsh" if content == ".msh" else None
    file = written(tmp_path / f"a{content}", cells=cells, file_format=file_format).rename(tmp_path / f"b{suffix}")
    read = read_mesh if suffix in (".vtu", ".vtk", ".msh", ".mesh") else read_surface
    if content != suffix:
        with pytest.raises(MeshError, match=f"is a {content} by its content"):
            read(file, length_unit="mm")
