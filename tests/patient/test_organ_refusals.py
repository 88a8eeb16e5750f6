"""Refusals of `surgsim organ`, which leave an output folder as it was."""

import pytest
import trimesh

from surgsim_apps.cli.main import main
from surgsim_apps.patient.surface_files import ClosedSurface, read_organ_surface
from tests.patient.scans import LABELS, scan
from tests.patient.surfaces import ball


def test_nothing_half_written(tmp_path, refusal):
    file = scan(tmp_path / "ct.nii.gz", spacing=(3.0, 3.0, 3.0))
    out = tmp_path / "out"
    out.mkdir()
    given = ["organ", file, *LABELS, "--cell-size", "0.009", "--no-healthy-map", "--out", out / "a.vtu"]
    assert "approach is (0.0, 0.0, 0.0)" in refusal(*given, "--approach", "0,0,0")
    assert not list(out.iterdir())
    for _ in range(2):
        assert main([str(argument) for argument in given]) == 0
    assert {path.name for path in out.iterdir()} == {"a.vtu", "a.toml", "a_surface.ply", "report.html"}


@pytest.mark.parametrize(
    ("extra", "named"),
    [
        (["--labels", "liver=1", "--length-unit", "mm"], "--length-unit"),
        (["--labels", "liver=1", "--remesh"], "--remesh goes with a file of tets"),
        (["--labels", "liver=1", "--cell-data", "a"], "--cell-data goes with a file of tets"),
        ([], "labels"),
        (["--labels", "liver=1", "--modulus", "lesion=5"], "lesion"),
        (["--labels", "liver=1", "--cell-size", "-1"], "-1"),
    ],
)
def test_options_that_do_not_fit_a_scan(extra, named, tmp_path, refusal):
    file = scan(tmp_path / "ct.nii.gz", spacing=(4.0, 4.0, 4.0))
    assert named in refusal("organ", file, *extra)


def test_a_surface_beside_a_scan(tmp_path, refusal):
    file = scan(tmp_path / "ct.nii.gz", spacing=(4.0, 4.0, 4.0))
    assert "lesion.stl" in refusal("organ", file, ball(tmp_path / "lesion.stl", 9.0))


def test_surfaces_of_regions_that_are_no_one_body(tmp_path, refusal):
    """A stone in two parts, of which one would have to be taken; a lesion's surface with a hole; sheets."""
    organ, given = ball(tmp_path / "liver.stl"), ["--length-unit", "mm", "--cell-size", "0.01"]
    two = trimesh.util.concatenate(
        [trimesh.creation.icosphere(2, 5.0).apply_translation([x, 0.0, 0.0]) for x in (-12.0, 12.0)]
    )
    two.export(tmp_path / "stone.stl")
    assert "region 'stone' has 2 surfaces, and one is taken" in refusal("organ", organ, tmp_path / "stone.stl", *given)
    torn = ball(tmp_path / "lesion.stl", 9.0, drop=4)
    line = refusal("organ", organ, torn, *given)
    assert "lesion.stl" in line and "the surface is open" in line
    sheets = trimesh.creation.box((60.0, 60.0, 60.0))
    trimesh.Trimesh(sheets.vertices, sheets.faces[:1]).export(tmp_path / "sheet.stl")
    assert "encloses nothing, also when mended" in refusal("organ", tmp_path / "sheet.stl", "--mend", *given)


@pytest.mark.parametrize("suffix", [".stl", ".obj"])
def test_solids_beside_the_organ_are_named(tmp_path, suffix):
    """A liver with a tumour inside it, and a vein that its bounding box holds, outside of it."""
    parts = {"vein": (5.0, (20.0, 20.0, 20.0)), "liver": (30.0, (0.0, 0.0, 0.0)), "tumour": (8.0, (0.0, 0.0, 15.0))}
    text, start = "", 1
    for name, (radius, place) in parts.items():
        mesh = trimesh.creation.icosphere(2, radius).apply_translation(place)
        if suffix == ".stl":
            text += mesh.export(file_type="stl_ascii").replace("solid ", f"solid {name}", 1) + "\n"
        else:
            corners = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in mesh.vertices.tolist())
            text += f"o {name}\n{corners}" + "".join(f"f {a} {b} {c}\n" for a, b, c in (mesh.faces + start).tolist())
            start += len(mesh.vertices)
    file = tmp_path / f"scan{suffix}"
    file.write_text(text)
    with pytest.warns(UserWarning, match="beside the largest") as caught:
        surface = read_organ_surface(file, "mm", mend=True)
    note = str(caught[0].message)
    assert isinstance(surface, ClosedSurface) and surface.volume == pytest.approx(
        trimesh.creation.icosphere(2, 0.03).volume, rel=1e-5
    )
    assert "'tumour', inside" in note and "'vein', outside" in note
    assert f"{trimesh.creation.icosphere(2, 8.0).volume / 1e3:.3g} ml" in note
