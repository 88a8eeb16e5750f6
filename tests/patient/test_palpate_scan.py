"""`surgsim palpate` from a scan or a surface: from file to map in one command."""

import json
import re

import numpy as np
import pytest

from msdm_core.mesh.quality import mesh_quality
from msdm_core.mesh_files.mesh_io import read_mesh
from surgsim_env.cli.main import main
from tests.patient.scans import LABELS, LESIONS, MIDDLE, scan


@pytest.mark.slow
def test_palpate_goes_from_a_scan_to_a_map_in_one_command(tmp_path, capsys):
    file = scan(tmp_path / "ct.nii.gz", spacing=(2.0, 2.0, 2.0))
    out = tmp_path / "out"
    # Around the larger lesion, 9 mm.
    centre = ",".join(f"{one:.4f}" for one in 1e-3 * (MIDDLE + LESIONS[0][0] + [0.0, -9.0, 5.0]))
    arguments = ["palpate", "--segmentation", str(file), *LABELS, "--cell-size", "0.007", "--around", f"{centre},0.017"]
    assert main([*arguments, "--out", str(out), "--workers", "1"]) == 0
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert [one["name"] for one in summary["truth"]] == ["lesion 1", "lesion 2"]
    assert summary["truth"][0]["radius_m"] == pytest.approx(0.009, rel=0.1)
    np.testing.assert_allclose(summary["truth"][0]["centre_m"], 1e-3 * (MIDDLE + LESIONS[0][0]), atol=1.5e-3)
    assert summary["volume_ratio_smallest"] > 0.0
    expected = {"ct.vtu", "ct.toml", "ct_surface.ply", "report.html"}
    expected |= {"palpation.csv", "summary.json", "stiffness_map.png"}
    assert {path.name for path in out.iterdir()} == expected
    # Healthy sites would be felt as 1.
    assert summary["maps"]["pre-operative model"]["lesions"][0]["contrast"] > 1.1
    assert "written" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("name", ["openhelp_kidney_left", "openhelp_stomach"])
def test_real_organs_in_one_command(name, anatomy_folder, tmp_path):
    file = anatomy_folder / f"{name}.stl"
    assert main(["palpate", "--surface", str(file), "--length-unit", "mm", "--out", str(tmp_path)]) == 0
    check_run(tmp_path, name)


@pytest.mark.slow
def test_a_scan_in_one_command(tmp_path):
    file = scan(tmp_path / "ct.nii.gz", spacing=(1.0, 1.0, 3.0))
    assert main(["palpate", "--segmentation", str(file), *LABELS, "--out", str(tmp_path / "out")]) == 0
    check_run(tmp_path / "out", "ct")


def check_run(folder, name):
    """What issue 8 asks of a run: volume, angles, no inverted tet, some sites."""
    page = (folder / "report.html").read_text(encoding="utf-8")
    (error,) = re.findall(r"ml, ([+-][\d.]+)% of what the file has", page)
    assert abs(float(error)) < 2.0
    assert mesh_quality(read_mesh(folder / f"{name}.vtu")).dihedral_smallest_deg > 10
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert summary["volume_ratio_smallest"] > 0.0
    assert summary["sites"]["in_maps"] >= 10
