"""Surface files: read in metres with shared vertices, and refused where they are no surface."""

import numpy as np
import pytest
import trimesh

from msdm_core.errors import MeshError
from msdm_core.mesh_files.surface_io import read_surface

CORNERS = np.array([[0.0, 0, 0], [60, 0, 0], [0, 60, 0], [0, 0, 60]])
FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])


def surface_file(path, points=CORNERS, faces=FACES):
    """A surface file written by hand: trimesh must not have the say on both sides."""
    rows = "\n".join(" ".join(map(repr, map(float, point))) for point in points)
    if path.suffix == ".obj":
        text = "".join(f"v {row}\n" for row in rows.splitlines()) + "".join(
            "f " + " ".join(str(i + 1) for i in face) + "\n" for face in faces
        )
    elif path.suffix == ".ply":
        text = (
            f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty double x\nproperty double y\n"
            f"property double z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
            f"{rows}\n"
        ) + "".join(f"{len(face)} " + " ".join(map(str, face)) + "\n" for face in faces)
    else:
        loops = "".join(
            "facet normal 0 0 0\nouter loop\n"
            + "".join("vertex " + " ".join(map(repr, map(float, points[i]))) + "\n" for i in face)
            + "endloop\nendfacet\n"
            for face in faces
        )
        text = f"solid organ\n{loops}endsolid organ\n"
    path.write_text(text)
    return path


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply"])
def test_surfaces_are_read_in_metres_with_shared_vertices(tmp_path, suffix):
    vertices, triangles = read_surface(surface_file(tmp_path / f"a{suffix}"), length_unit="mm")
    assert vertices.shape == (4, 3) and vertices.dtype == np.float64 and triangles.dtype == np.int32
    seen = {frozenset(tuple(np.round(vertices[i], 12)) for i in triangle) for triangle in triangles}
    assert seen == {frozenset(tuple(CORNERS[i] / 1000) for i in face) for face in FACES}
    corners = vertices[triangles]
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert volume == pytest.approx(0.06**3 / 6)  # turned outward still


def test_a_surface_without_twins_keeps_its_numbering(tmp_path):
    vertices, triangles = read_surface(surface_file(tmp_path / "a.obj"), length_unit="cm")
    np.testing.assert_allclose(vertices, CORNERS * 0.01)
    assert triangles.tolist() == FACES.tolist()


def test_objects_quads_and_pinched_triangles_of_a_surface(tmp_path):
    points = np.array([[0.0, 0, 0], [50, 0, 0], [50, 50, 0], [0, 50, 0], [7, 7, 7], [0, 0, 0]])
    path = surface_file(tmp_path / "a.ply", points, [[0, 1, 2, 3], [0, 5, 1]])
    vertices, triangles = read_surface(path, length_unit="mm")
    assert len(vertices) == 4 and len(triangles) == 2 and set(triangles.ravel()) == {0, 1, 2, 3}
    rows = ["o one", *(f"v {x} {y} {z}" for x, y, z in points[:3]), "usemtl red", "f 1 2 3"]
    rows += ["o two", *(f"v {x} {y} {z + 50}" for x, y, z in points[:3]), "usemtl blue", "f 4 5 6"]
    (tmp_path / "b.obj").write_text("mtllib missing.mtl\n" + "\n".join(rows) + "\n")
    vertices, triangles = read_surface(tmp_path / "b.obj", length_unit="mm")
    assert len(vertices) == 6 and len(triangles) == 2


@pytest.mark.parametrize(
    ("points", "faces", "message"),
    [
        (CORNERS, [], r"has no triangles"),
        (np.where(CORNERS == 60, np.nan, CORNERS), FACES, "spans nan"),
        (CORNERS * 100, FACES, 'spans 6 m .*units forgotten.*length_unit="mm" would make it|spans 6 m'),
        (CORNERS, [[0, 1, 1]], "every triangle uses a vertex twice"),
        (CORNERS, [[0, 1, 9]], "triangle|cannot be parsed"),
    ],
)
@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_a_surface_that_is_none_is_refused(tmp_path, points, faces, message, suffix):
    path = surface_file(tmp_path / f"a{suffix}", points, faces)
    with pytest.raises(MeshError, match=rf"a{suffix}: .*({message})"):
        read_surface(path, length_unit="mm")


@pytest.mark.parametrize("header", [b"", b"solid liver"])
def test_a_binary_stl_of_another_length_than_its_header_states(tmp_path, header):
    whole = trimesh.Trimesh(CORNERS, FACES).export(file_type="stl")
    whole = header.ljust(80) + whole[80:]
    path = tmp_path / "a.stl"
    for cut, there in ((20, 3), (60, 2), (200, 0)):
        path.write_bytes(whole[:-cut])
        with pytest.raises(MeshError, match=rf"\b4 triangles .*\b{there} are there"):
            read_surface(path, length_unit="mm")
    for extra in (1, 16, 1000):
        path.write_bytes(whole + bytes(extra))
        with pytest.warns(UserWarning, match=f"{extra} bytes"):
            _, triangles = read_surface(path, length_unit="mm")
        assert len(triangles) == 4


@pytest.mark.parametrize("suffix", [".stl", ".ply"])
@pytest.mark.parametrize("share", [0.5, 0.9])
def test_a_text_cut_short_is_refused(tmp_path, suffix, share):
    path = surface_file(tmp_path / f"a{suffix}")
    text = path.read_text()
    path.write_text(text[: int(share * len(text))])
    with pytest.raises(MeshError, match="cut short"):
        read_surface(path, length_unit="mm")


def test_empty_lines_after_a_text_are_no_content(tmp_path):
    path = surface_file(tmp_path / "a.ply")
    path.write_text(path.read_text() + "\n \n")
    assert len(read_surface(path, length_unit="mm")[1]) == 4
    path.write_text(path.read_text() + "1 2 3\n")
    with pytest.raises(MeshError, match=r"\b8 .* 9 are there"):
        read_surface(path, length_unit="mm")


def test_a_second_solid_cut_short_is_refused(tmp_path):
    text = surface_file(tmp_path / "a.stl").read_text()
    (tmp_path / "a.stl").write_text(text + text[:-60])
    with pytest.raises(MeshError, match=r"2 solids .* 1 are there"):
        read_surface(tmp_path / "a.stl", length_unit="mm")
