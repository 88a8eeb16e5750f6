"""A file of tets becomes a patient: with its own tets, or its surfaces filled anew."""

import re
import warnings
from pathlib import Path

import meshio
import nibabel
import numpy as np
import pytest

from msdm_core.errors import MeshError
from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.mesh_files.mesh_io import read_mesh, write_mesh
from msdm_core.meshing.lattice_meshing import box_mesh
from surgsim_apps.cli.main import main
from surgsim_apps.patient.label_image import parse_labels
from surgsim_apps.patient.make_patient import _noted
from surgsim_apps.patient.tet_files import patient_of_tets, read_tets, surfaces_of_tets
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import load_scene
from tests.patient.surfaces import ball

SIDE, CORE = 0.06, 0.02


def block(names=()) -> TetMesh:
    """A block of 60 x 60 x 40 mm with a core of 20 x 20 x 20 mm, whose tets have tag 7, the others 3."""
    mesh = box_mesh((SIDE, SIDE, 0.04), (6, 6, 4))
    middle = mesh.points[mesh.tets].mean(axis=1)
    inside = (np.abs(middle - [SIDE / 2, SIDE / 2, 0.02]) < CORE / 2).all(axis=1)
    return TetMesh(mesh.points, mesh.tets, np.where(inside, 7, 3), names)


def test_tets_are_kept_and_their_regions_named(tmp_path):
    file = tmp_path / "organ.vtu"
    # The smaller region is named first: the organ is the largest.
    write_mesh(file, block(((7, "tumour"), (3, "kidney"))))
    given = read_tets(file, None, ())
    assert given.names == ("kidney", "tumour")
    assert given.volume == pytest.approx(SIDE * SIDE * 0.04)
    patient = patient_of_tets(given, 0.01)
    assert patient.lesions == ("tumour",)
    assert [region.name for region in patient.volumes] == ["kidney", "tumour"]
    mesh = block()
    assert patient.volumes[1].mesh == pytest.approx(mesh.volumes[mesh.region == 7].sum())


def test_tags_without_names_are_named_by_the_user(tmp_path):
    file = tmp_path / "organ.vtu"
    write_mesh(file, block())
    for labels, named in ((None, "3, 7"), ("kidney=3", r"\b7 of 3, 7"), ("kidney=3,tumour=7,stone=9", "stone=9")):
        with pytest.raises(MeshError, match=named):
            read_tets(file, None, parse_labels(labels) if labels else ())
    assert read_tets(file, None, parse_labels("kidney=3,tumour=7")).names == ("kidney", "tumour")


def test_surfaces_of_tets_enclose_the_same_volumes(tmp_path):
    file = tmp_path / "organ.vtu"
    write_mesh(file, block(((3, "kidney"), (7, "tumour"))))
    given = read_tets(file, None, ())
    surfaces = surfaces_of_tets(given)
    assert surfaces.volume == pytest.approx(given.volume)
    (tumour,) = surfaces.inner
    mesh = given.mesh
    assert tumour.name == "tumour" and tumour.volume == pytest.approx(mesh.volumes[mesh.region == 2].sum())


def test_a_scene_is_made_of_tets(tmp_path):
    file, out = tmp_path / "organ.vtu", tmp_path / "made" / "patient.vtu"
    write_mesh(file, block(((3, "kidney"), (7, "tumour"))))
    assert main(["organ", str(file), "--length-unit", "0.9", "--no-healthy-map", "--out", str(out)]) == 0
    assert {path.name for path in out.parent.iterdir()} >= {"patient.vtu", "patient.toml", "report.html"}
    for name in ("patient.toml", "report.html"):
        # The file states metres.
        assert "length_unit says 0.9" in (out.parent / name).read_text()
    scene = load_scene(out.with_suffix(".toml"))
    assert [(region.name, region.lesion) for region in scene.regions] == [("tumour", True)]
    anatomy = load_anatomy(scene)
    assert np.array_equal(np.sort(anatomy.mesh.volumes), np.sort(read_mesh(out).volumes))
    assert len(anatomy.demonstration_lesions()) == 1


def padded(tags: np.ndarray, name: str, file: Path) -> Path:
    """The block [mm] with its tags as cell data of a name."""
    mesh = block()
    meshio.Mesh(mesh.points * 1e3, [("tetra", mesh.tets)], cell_data={name: [tags]}).write(file)
    return file


@pytest.mark.parametrize("outside", [0, -1, 255, 3])
@pytest.mark.parametrize(("suffix", "name"), [(".vtu", "labels"), (".vtk", "region"), (".mesh", "medit:ref")])
def test_nameless_tets_at_the_surface_are_outside(tmp_path, suffix, name, outside):
    """A block of three layers: of the outside, of the organ and of its lesion."""
    mesh = block()
    height = mesh.points[mesh.tets].mean(axis=1)[:, 2]
    tags = np.select([height < 0.01, height < 0.03], [outside, 1], 2)
    file = padded(tags, name, tmp_path / f"a{suffix}")
    volume = {tag: mesh.volumes[tags == tag].sum() for tag in (outside, 1, 2)}
    left_out = [f"{tag} ({volume[tag] * 1e6:.4g} ml)" for tag in (outside, 2)]
    with pytest.warns(UserWarning, match=re.escape(left_out[0])):
        given = read_tets(file, "mm", parse_labels("liver=1,lesion=2"))
    assert given.names == ("liver", "lesion") and given.volume == pytest.approx(volume[1] + volume[2])
    with pytest.warns(UserWarning, match=".*".join(map(re.escape, sorted(left_out)))):
        assert read_tets(file, "mm", parse_labels("liver=1")).volume == pytest.approx(volume[1])
    named = read_tets(file, "mm", parse_labels(f"liver={outside},stone=1,lesion=2", zero_is_outside=False))
    assert named.names == ("liver", "stone", "lesion") and named.volume == pytest.approx(SIDE * SIDE * 0.04)


@pytest.mark.parametrize("hole", [0, 9])
def test_a_hole_in_the_organ_has_tag_0(tmp_path, hole):
    """A core without a name in a block, beside a layer of nameless tets."""
    mesh = block()
    tags = np.where(mesh.points[mesh.tets].mean(axis=1)[:, 0] < 0.01, 5, np.where(mesh.region == 7, hole, 1))
    file = padded(tags, "region", tmp_path / "a.vtu")
    if hole:
        with pytest.raises(MeshError, match=r"\b9 of 1, 5, 9"):
            read_tets(file, "mm", parse_labels("liver=1"))
    else:
        with pytest.warns(UserWarning, match=r"0 \(.*, 5 \("):
            given = read_tets(file, "mm", parse_labels("liver=1"))
        assert given.volume == pytest.approx(mesh.volumes[tags == 1].sum())


def test_cell_data_are_chosen_on_the_command_line(tmp_path, refusal):
    mesh = block()
    file = tmp_path / "a.vtu"
    tags = {"labels": [mesh.region], "part": [(mesh.region == 7) + 4]}
    meshio.Mesh(mesh.points * 1e3, [("tetra", mesh.tets)], cell_data=tags).write(file)
    given = ("organ", file, "--length-unit", "mm", "--labels", "liver=3")
    assert "labels (3, 7), part (4, 5)" in refusal(*given)
    assert "tags are 4, 5" in refusal(*given, "--cell-data", "part")
    assert "7 of 3, 7" in refusal(*given, "--cell-data", "labels")


@pytest.mark.parametrize("kind", ["tets", "surface", "image"])
def test_notes_are_shown_before_a_later_step_fails(tmp_path, capsys, kind):
    """A node without a tet, a byte after the triangles and a header without a unit; then a region that is not there."""
    given, noted = ["--modulus", "stone=5"], "1 nodes"
    if kind == "tets":
        mesh, file = block(((3, "kidney"), (7, "tumour"))), tmp_path / "a.vtu"
        write_mesh(file, mesh)
        raw = meshio.read(file)
        raw.points = np.vstack([raw.points, [[1.0, 1.0, 1.0]]])
        raw.write(file)
        given += ["--length-unit", "m", "--labels", "kidney=3,tumour=7"]
    elif kind == "surface":
        file, noted = ball(tmp_path / "a.stl"), "1 bytes"
        file.write_bytes(file.read_bytes() + b"0")
        given += ["--length-unit", "mm", "--cell-size", "0.01"]
    else:
        file, noted = tmp_path / "a.nii", "millimetres are assumed"
        nibabel.Nifti1Image(np.pad(np.ones((12, 12, 12), np.uint8), 2), np.diag([4.0, 4.0, 4.0, 1.0])).to_filename(file)
        given += ["--labels", "liver=1", "--cell-size", "0.01"]
    assert main(["organ", str(file), *given]) == 2
    *notes, error = capsys.readouterr().err.splitlines()
    assert any("surgsim: warning" in note and noted in note for note in notes) and "stone" in error


def test_notes_of_the_report_name_files_without_their_folder(tmp_path):
    file = tmp_path / "a.vtu"
    with pytest.warns(UserWarning, match=str(tmp_path)), _noted([file]) as notes:
        warnings.warn(f"{file}: 3 nodes are left out", stacklevel=2)
    assert notes == ["a.vtu: 3 nodes are left out"]
