"""`surgsim organ`, then `surgsim palpate`, on organs of a real patient: from file to map."""

import json
import re

import pytest

from msdm_core.mesh.quality import mesh_quality
from msdm_core.mesh_files.mesh_io import read_mesh
from surgsim_env.cli.main import main


@pytest.mark.slow
@pytest.mark.parametrize("name", ["openhelp_kidney_left", "openhelp_stomach"])
def test_real_organs_from_file_to_map(name, anatomy_folder, tmp_path):
    file, mesh = anatomy_folder / f"{name}.stl", tmp_path / f"{name}.vtu"
    given = ["organ", str(file), "--length-unit", "mm", "--no-healthy-map", "--out", str(mesh)]
    assert main(given) == 0
    assert main(["palpate", "--organ", str(mesh.with_suffix(".toml")), "--out", str(tmp_path)]) == 0
    check_run(tmp_path, name)


def check_run(folder, name):
    """Volume, angles, no inverted tet, some sites."""
    page = (folder / "report.html").read_text(encoding="utf-8")
    (error,) = re.findall(r"ml, ([+-][\d.]+)% of what the file has", page)
    assert abs(float(error)) < 2.0
    assert mesh_quality(read_mesh(folder / f"{name}.vtu")).dihedral_smallest_deg > 10
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert summary["volume_ratio_smallest"] > 0.0
    assert summary["sites"]["in_maps"] >= 10
