"""The whole path of a kidney and a spleen: organ made, held, pressed over lesions, mapped, reported."""

import csv
import html
import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import trimesh

from surgsim_apps.cli.main import main
from surgsim_apps.palpate.hold import FAR_SHARE_LARGEST, FORCE_SHARE_LEAST
from surgsim_apps.palpate.palpation import MODEL
from surgsim_apps.palpate.scene_options import SceneOptions, with_options
from surgsim_apps.palpate.sites import plan_sites
from surgsim_apps.patient.supports import held_text
from surgsim_env.scene.anatomy import Anatomy, load_anatomy
from surgsim_env.scene.load import load_scene
from tests.patient.organs import kidney_surface
from tests.patient.scans import SPLEEN_CROWN, spleen

LESION_RATIO = 8.0


@dataclass(frozen=True)
class Touch:
    """A tip that leaves 1500 to 2100 nodes, and a raster of 30 to 40 sites: coarser than by default, of the same kind.

    Fields:
        tip, spacing: radius of the ball and distance of the sites [m]
    """

    tip: float
    spacing: float


@dataclass(frozen=True)
class Hidden:
    """Lesions to be hidden below sites.

    Fields:
        depth, radius: of the middle below the surface, and of the ball [m]
    """

    depth: float
    radius: float


KIDNEY, SPLEEN = Touch(0.008, 0.009), Touch(0.008, 0.0095)


def stl(surface: trimesh.Trimesh, path: Path) -> Path:
    """A surface in metres as a file in millimetres."""
    surface.copy().apply_scale(1e3).export(path)
    return path


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Standard output and standard error of a command that must succeed."""
    capsys.readouterr()
    assert main([str(argument) for argument in arguments]) == 0
    printed = capsys.readouterr()
    return printed.out + printed.err


def fits(anatomy: Anatomy, point: np.ndarray, radius: float) -> bool:
    """True if a lesion lies inside the organ."""
    try:
        anatomy.check_inside(anatomy.lesion_at(tuple(point.tolist()), radius, LESION_RATIO, "tried"))
    except ValueError:
        return False
    return True


def far_apart(anatomy: Anatomy, lesion: Hidden) -> list[int]:
    """Two sites of the raster away from its rim and from each other, below which a lesion fits."""
    sites, normals, _ = plan_sites(anatomy)
    rim = np.array([anatomy.face.rim_distance(site) for site in sites])
    inner = [int(site) for site in np.flatnonzero(rim >= np.median(rim))]
    inner = [site for site in inner if fits(anatomy, sites[site] - lesion.depth * normals[site], lesion.radius)]
    distance = np.linalg.norm(sites[inner][:, None] - sites[inner], axis=2)
    return [inner[index] for index in np.unravel_index(np.argmax(distance), distance.shape)]


def check_held(summary: dict) -> None:
    held = summary["held"]
    assert held["faults"] == []
    assert max(held["far_travel_over_depth"]) <= FAR_SHARE_LARGEST
    assert np.median(held["healthy_force_over_hertz"]) >= FORCE_SHARE_LEAST


def check_found(summary: dict, count: int) -> None:
    """The model map shows every lesion, and either map says why it misses one."""
    assert len(summary["truth"]) == count
    entry = summary["maps"][MODEL]
    assert entry["felt"] == count and entry["false_alarms"] == 0, entry
    for entry in summary["maps"].values():
        for lesion in entry["lesions"]:
            assert lesion["felt"] or (lesion["miss"] and lesion["why"]), lesion


def check_files(out: Path, summary: dict) -> None:
    with (out / "palpation.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == summary["sites"]["pressed"]
    complete = [row for row in rows if not row["ended_early"]]
    assert len(complete) == summary["sites"]["in_maps"] > 0
    assert all(math.isfinite(float(row[name])) for row in complete for name in ("force", "stiffness", "contrast_model"))
    assert (out / "stiffness_map.png").read_bytes()[-8:-4] == b"IEND"


def check_report(folder: Path, name: str) -> None:
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert page.rstrip().endswith("</html>")
    assert "data:image/webp;base64," in page
    assert all(held_text(anchor) in html.unescape(page) for anchor in load_scene(folder / f"{name}.toml").anchors)


def test_from_a_surface_to_lesions_on_a_map(tmp_path, capsys):
    name, surface, touch, lesion = "kidney", kidney_surface(), KIDNEY, Hidden(0.013, 0.009)
    file, folder = stl(surface, tmp_path / f"{name}.stl"), tmp_path / "patient"
    given = ["organ", file, "--length-unit", "mm", "--tip-radius", touch.tip, "--out", folder / f"{name}.vtu"]
    printed = run(capsys, *given, "--no-healthy-map")
    assert "sways" not in printed and "of Hertz's force" in printed
    check_report(folder, name)
    scene, out = folder / f"{name}.toml", tmp_path / "palpated"
    anatomy = load_anatomy(with_options(load_scene(scene), SceneOptions(spacing=touch.spacing)))
    hidden = [
        f"--lesion-below={site},{lesion.depth},{lesion.radius},{LESION_RATIO}" for site in far_apart(anatomy, lesion)
    ]
    printed = run(capsys, "palpate", "--scene", scene, "--spacing", touch.spacing, *hidden, "--out", out)
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    check_held(summary)
    check_found(summary, 2)
    check_files(out, summary)
    assert "pre-operative model: all 2 lesions felt" in printed


def test_from_a_scan_with_its_lesions_to_a_map(tmp_path, capsys):
    """Cells as by default, fine at the pressed face, so that the probe is turned before they are made."""
    out = tmp_path / "out"
    given = ["organ", spleen(tmp_path / "spleen.nii.gz"), "--labels", "spleen=1,lesion=2", "--no-healthy-map"]
    printed = run(capsys, *given, "--tip-radius", SPLEEN.tip, "--out", out / "spleen.vtu")
    assert "turning the probe to the lesions" in printed and "does not face" not in printed
    assert "times as long elsewhere" in printed
    scene = load_scene(out / "spleen.toml")
    assert -np.dot(scene.instrument.approach, SPLEEN_CROWN) > 0.7
    assert [anchor.name for anchor in scene.anchors] == ["surrounding fat and wall", "hilum"]
    check_report(out, "spleen")
    run(capsys, "palpate", "--scene", out / "spleen.toml", "--spacing", SPLEEN.spacing, "--out", out)
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    check_held(summary)
    check_found(summary, 2)
    check_files(out, summary)
