"""`surgsim` as a user meets it: what it writes, what it says, and one line for bad input."""

import csv
import json
from dataclasses import replace
from xml.etree import ElementTree

import meshio
import numpy as np
import pytest
from matplotlib.image import imread

from msdm_core.material import Stiffening
from surgsim_apps.cli.main import main
from surgsim_apps.palpate.results import COLUMNS
from surgsim_env.palpation.site_press import scan
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.save import as_toml

COARSE = ["palpate", "--scene", "phantom", "--spacing", "0.008"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A coarse palpation of the phantom: folder and what it printed."""
    folder = tmp_path_factory.mktemp("runs") / "deep" / "phantom"
    assert main([*COARSE, "--out", str(folder), "--seed", "7"]) == 0
    return folder


@pytest.fixture(scope="module")
def rows(run):
    with (run / "palpation.csv").open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


@pytest.fixture(scope="module")
def summary(run):
    return json.loads((run / "summary.json").read_text(encoding="utf-8"))


def test_files(run, rows):
    pictures = {"stiffness_map.png", "organ.png"}
    assert {path.name for path in run.iterdir()} == {"report.html", "palpation.csv", "summary.json"} | pictures
    assert tuple(rows[0]) == COLUMNS
    picture = imread(run / "stiffness_map.png")
    assert len(np.unique(picture.reshape(-1, picture.shape[2]), axis=0)) > 100


def test_fields_of_a_press(tmp_path):
    """`--fields`: the series ends with the force of a press over the lesion, and the page shows its picture."""
    options = ["--fields", "--spacing", "0.03", "--out", str(tmp_path)]
    assert main(["palpate", "--scene", "phantom", *options]) == 0
    listed = ElementTree.parse(tmp_path / "fields" / "press.pvd").getroot().findall("./Collection/DataSet")
    last = meshio.read(tmp_path / "fields" / listed[-1].attrib["file"])
    corners = last.points[last.cells[1].data]
    area = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    anatomy = load_anatomy(make_scene("phantom"))
    (truth,) = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))["truth"]
    place, up = np.array([truth["surface_point_m"]]), np.array([[0.0, 0.0, 1.0]])
    (press,) = scan(anatomy, anatomy.organ(anatomy.demonstration_lesions()), place, up)
    pressure, shear = (last.cell_data[name][1] for name in ("pressure", "shear"))
    push = pressure @ area - np.linalg.norm(area, axis=1) @ shear
    assert push[2] == pytest.approx(press.force, rel=0.01)
    assert (tmp_path / "fields.png").is_file()
    assert "Fields of a press" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_table_agrees_with_itself(rows):
    assert [int(row["site"]) for row in rows] == list(range(len(rows)))
    assert len(rows) == 36
    for row in rows:
        assert float(row["z"]) == pytest.approx(0.03, abs=1e-6)
        assert np.hypot(float(row["normal_x"]), float(row["normal_y"])) < 1e-6
        assert float(row["depth"]) == pytest.approx(0.004, abs=2e-4)
        assert float(row["stiffness"]) == pytest.approx(float(row["reading"]) / float(row["depth"]), rel=1e-4)
        assert abs(float(row["reading"]) - float(row["force"])) < 0.05
        assert row["ended_early"] == ""
        assert float(row["contrast_neighbours"]) > 0.5


def test_summary_agrees_with_the_table(rows, summary):
    assert summary["seed"] == 7
    assert summary["inputs"]["scene"] == "phantom"
    assert summary["sites"]["pressed"] == summary["sites"]["in_maps"] == len(rows)
    assert summary["force_peak_N"] >= max(float(row["force"]) for row in rows)
    assert 0.0 < summary["volume_ratio_smallest"] < 1.0
    assert summary["tissue_equivalent_strain_supported"] is None
    assert summary["real_time_factor"] == pytest.approx(summary["simulated_time_s"] / summary["wall_time_s"], rel=1e-3)
    assert summary["simulated_time_s"] == pytest.approx(2 * len(rows) * 0.225, rel=0.01)
    assert abs(summary["model"]["modulus_factor"] - 1.0) <= 0.2
    assert summary["model"]["modulus_factor"] != 1.0
    assert set(summary["maps"]) == {"healthy neighbours", "pre-operative model"}


def test_presses_beyond_the_strain_that_supports_the_law_are_reported(tmp_path, capsys):
    scene = make_scene("phantom_small")
    law = Stiffening(0.1, 0.3, 2.0, strain_supported=0.02)
    path = tmp_path / "supported.toml"
    path.write_text(as_toml(replace(scene, material=replace(scene.material, stiffening=law))))
    assert main(["palpate", "--scene", str(path), "--spacing", "0.02", "--out", str(tmp_path / "out")]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    count, largest = summary["sites"]["pressed"], summary["tissue_equivalent_strain_largest"]
    assert summary["tissue_equivalent_strain_supported"] == 0.02 < largest
    line = f"at {count} of {count} sites the equivalent strain ({largest:.2f} at most) is beyond 0.02"
    assert line in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert line in " ".join(capsys.readouterr().out.split())


def test_summary_gives_the_truth_and_the_error(summary):
    (truth,) = summary["truth"]
    assert truth["surface_point_m"] == pytest.approx([0.036, 0.026, 0.03], abs=1e-6)
    assert truth["centre_m"] == pytest.approx([0.036, 0.026, 0.018], abs=1e-6)
    entry = summary["maps"]["pre-operative model"]
    (lesion,) = entry["lesions"]
    assert lesion["felt"]
    assert entry["felt"] == 1
    assert entry["false_alarms"] == 0
    place = np.array(entry["estimates"][lesion["estimate"]]["point_m"])
    # The path leads over points on edges: off by their gap at most, an eighth of 5 mm, over less than an edge.
    straight = 1e3 * np.linalg.norm(place - truth["surface_point_m"])
    assert straight - 1e-3 < lesion["error_mm"] < straight + 5.0 / 8.0
    assert lesion["error_mm"] < 8.0
    assert lesion["contrast"] > 1.0 + 4.0 * entry["healthy_std"]


def test_the_report_has_the_lesion_with_its_error_and_loads_nothing(run, summary):
    text = (run / "report.html").read_text(encoding="utf-8")
    entry = summary["maps"]["pre-operative model"]
    (lesion,), (truth,) = entry["lesions"], summary["truth"]
    for place in (entry["estimates"][lesion["estimate"]]["point_m"], truth["surface_point_m"]):
        assert ", ".join(f"{1e3 * value:.1f}" for value in place) in text
    assert f">{lesion['error_mm']:.1f}<" in text and f">{lesion['contrast']:.2f}<" in text
    assert text.count('<img src="data:image/webp;base64,') == text.count("<img") == 2
    assert "surgsim palpate --scene phantom --spacing 0.008 --seed 7" in text and str(run) not in text


def test_the_lesion_raises_the_stiffness_above_it(rows):
    sites = np.array([[float(row[key]) for key in "xy"] for row in rows])
    stiffest = sites[np.argmax([float(row["contrast_model"]) for row in rows])]
    assert np.linalg.norm(stiffest - [0.036, 0.026]) < 0.008


def test_interrupt(monkeypatch, capsys):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("surgsim_apps.cli.scenes.list_scenes", stop)
    assert main(["scenes"]) == 130
    assert capsys.readouterr().err == "surgsim: stopped\n"


def test_an_interrupt_during_a_scan_ends_after_the_press_at_hand(monkeypatch):
    monkeypatch.setattr("surgsim_env.palpation.site_press.core_count", lambda: 2)
    anatomy = load_anatomy(make_scene("phantom"))
    sites, normals = anatomy.face.raster(0.01)
    pressed = []

    def stop() -> None:
        pressed.append(1)
        if len(pressed) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        scan(anatomy, anatomy.organ(), sites, normals, progress=stop)
    assert len(sites) > 8
    assert len(pressed) <= 4  # the two that were at hand when it came


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["palpate", "--scene", "fantom"], "'phantom'"),
        ([*COARSE, "--seed", "-1"], "-1"),
        ([*COARSE, "--lesion", "0.03,0.03,0.015,0.008,-8"], "-8"),
        ([*COARSE, "--lesion", "0.03,0.03,0.025,0.008,8"], "30.0, 30.0, 30.0 mm"),
        ([*COARSE, "--lesion-below", "99,0.015,0.008,8"], "0 to 35"),
        ([*COARSE, "--lesion-below", "3,0.007,0.008,8"], "depth"),
        ([*COARSE, "--approach", "down"], "down"),
        ([*COARSE, "--spacing", "nan"], "nan"),
    ],
)
def test_bad_input_gets_one_line_and_exit_2(arguments, named, capsys):
    assert main(arguments) == 2
    line = capsys.readouterr().err
    assert line.startswith("surgsim: error: ") and line.count("\n") == 1, line
    assert named in line


@pytest.mark.parametrize(("arguments", "named"), [(["palpat"], "palpat"), (["palpate", "--sceen", "liver"], "--sceen")])
def test_an_unknown_option_is_named(arguments, named, capsys):
    assert main(arguments) == 2
    assert named in capsys.readouterr().err
