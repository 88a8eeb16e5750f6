"""`surgsim palpate` from a scan or a surface: from file to map in one command."""

import json

import numpy as np
import pytest

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
