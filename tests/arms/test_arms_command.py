"""`surgsim arms` as a user meets it: files that repeat to the byte, a table of placements, one line for bad input."""

import csv
import shutil

import pytest

from surgsim_apps.arms import study
from surgsim_apps.arms.capability import Capability
from surgsim_apps.arms.ports import default_ports, read_ports
from surgsim_apps.arms.study import make_tables
from surgsim_apps.cli.main import main
from surgsim_env.instruments import load_arm
from surgsim_env.scene import read_description
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene, scenes_folder
from tests.arms.made import made_evaluation
from tests.arms.pivot_arm import FAR, MODEL, NEAR, SITE, write_pivot

INSTRUMENTS = scenes_folder() / "instruments"
PORTS = """
[left]
point = [-0.03, 0.03, 0.15]
target = [0.03, 0.03, 0.03]
[right]
point = [0.09, 0.03, 0.15]
target = [0.03, 0.03, 0.03]
[endoscope]
point = [0.03, -0.02, 0.15]
target = [0.03, 0.03, 0.03]
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with a ports file, a wider one, and an arm of one's own, its model beside it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ports.toml").write_text(PORTS)
    (tmp_path / "wide.toml").write_text(PORTS.replace("-0.03, 0.03, 0.15", "-0.06, 0.03, 0.15"))
    for suffix in ("toml", "xml"):
        shutil.copy(INSTRUMENTS / f"psm_grasper.{suffix}", tmp_path / f"psm_grasper.{suffix}")
    (tmp_path / "psm_grasper.toml").rename(tmp_path / "mine.toml")
    return tmp_path


@pytest.fixture
def made(monkeypatch):
    """In place of the evaluation, made-up ones: wider ports reach more, another arm less. Lists what was asked for."""
    asked = []

    def evaluate(anatomy, left, right, ports, *, seed, count, faced, progress, turning, tables):
        asked.append((left, right, ports))
        reach = 0.6 if ports.left.point[0] < -0.05 else 0.1 if left.name == "six_axis" else 0.3
        return made_evaluation(count=count, seed=seed, left_to=reach, right_to=reach)

    monkeypatch.setattr(study, "evaluate_arms", evaluate)
    monkeypatch.setattr(study, "make_tables", lambda *_, **__: {})
    return asked


def arguments(*more, left="psm_grasper", right="psm_palpator", ports="ports.toml", out="out"):
    return [
        *("arms", "--scene", "phantom", "--left", left, "--right", right, "--ports", ports),
        *("--points", "40", "--out", str(out), *more),
    ]


def test_a_search_writes_the_ports_found_and_ranks_them_with_the_given(folder, made, monkeypatch, capsys):
    arm = str(write_pivot(folder))
    # The left arm reaches less from its base than from another one.
    (folder / "short").mkdir()
    short = write_pivot(
        folder / "short", model=MODEL.replace(f'range="{NEAR} {FAR}"', f'range="{NEAR} 0.12"'), sites=SITE
    )

    def tables(setup, tip_radius, **_):
        usual = make_tables(setup, tip_radius, shifted=False)
        return usual | {"left": [Capability(read_description(short), tip_radius), *usual["left"]]}

    monkeypatch.setattr(study, "make_tables", tables)
    assert main(arguments("--search", "2", left=arm, right=arm)) == 0
    found, given = (read_ports(path) for path in (folder / "out" / "ports.toml", folder / "ports.toml"))
    assert [ports for *_, ports in made] == [found, given]
    assert found != given and found.endoscope.target == given.endoscope.target
    moved = read_description(folder / "out" / "left.toml")
    assert load_arm(moved).upper[2] == FAR and not (folder / "out" / "right.toml").exists()
    assert made[0][0].folder == folder
    page = (folder / "out" / "report.html").read_text(encoding="utf-8")
    assert "placements were tried" in page and "ports found" in page and "The base of the left arm" in page
    header, best, *front = csv.reader((folder / "out" / "placements.csv").open())
    assert [float(best[header.index(f"left_{axis}_m")]) for axis in "xyz"] == pytest.approx(list(found.left.point))
    assert front
    assert "--search 2" in page
    assert main(arguments("--search", "0")) == 2
    assert "--search is 0" in capsys.readouterr().err


def test_the_files(folder, made, capsys):
    assert main(arguments("--seed", "3", left="mine.toml")) == 0
    names = {path.name for path in (folder / "out").iterdir()}
    assert {"report.html", "points.csv", "map_reach.png", "map_tip_force.png"} <= names
    output = " ".join(capsys.readouterr().out.split())
    assert "the left arm reaches" in output and "written: out/{report.html" in output
    assert "drawing the maps ..." in output
    assert made[0][2].endoscope.point == (0.03, -0.02, 0.15)


@pytest.mark.slow
@pytest.mark.usefixtures("few_maps")
def test_a_run_repeats_to_the_byte_wherever_it_is_written(folder, made, tmp_path_factory):
    other = tmp_path_factory.mktemp("other") / "deep" / "er"
    outside = tmp_path_factory.mktemp("outside") / "wide.toml"
    shutil.copy(folder / "wide.toml", outside)
    compared = ("--compare", str(outside))
    assert main(arguments(*compared, ports=str(folder / "ports.toml"), out="a")) == 0
    assert main(arguments(*compared, ports=str(folder / "ports.toml"), out=other)) == 0
    assert main(arguments(*compared, "--seed", "1", out="c")) == 0
    names = {path.name for path in other.iterdir()}
    assert {"map_reach.png", "map_tip_force.png", "report.html"} < names
    for name in names:
        first = (folder / "a" / name).read_bytes()
        assert first == (other / name).read_bytes(), name
        assert str(folder).encode() not in first and str(other).encode() not in first
        assert str(outside.parent).encode() not in first
    assert (folder / "a" / "points.csv").read_bytes() != (folder / "c" / "points.csv").read_bytes()


@pytest.mark.slow
def test_a_real_run_repeats_to_the_byte_and_says_what_was_found(folder):
    for out in ("a", "b"):
        assert main(arguments("--compare", "wide.toml", out=out)) == 0
    names = {path.name for path in (folder / "a").iterdir()}
    for name in names:
        assert (folder / "a" / name).read_bytes() == (folder / "b" / name).read_bytes(), name
    assert "The arms in the patient" in (folder / "a" / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.usefixtures("few_maps")
def test_the_command_in_the_report_makes_it_again(folder, made):
    assert (
        main(arguments("--compare", "wide.toml", "six_axis", left="mine.toml", ports=str(folder / "ports.toml"))) == 0
    )
    text = (folder / "out" / "report.html").read_text(encoding="utf-8")
    command = text.split("<pre><code>")[1].split("</code>")[0]
    assert command == (
        "surgsim arms --scene phantom --left mine.toml --right psm_palpator --ports ports.toml "
        "--compare wide.toml six_axis --points 40 --seed 0"
    )
    assert main([*command.split()[1:], "--out", "again"]) == 0
    assert (folder / "again" / "report.html").read_bytes() == (folder / "out" / "report.html").read_bytes()


@pytest.mark.usefixtures("few_maps")
def test_the_command_says_how_the_patient_moves(folder, made):
    assert main(arguments("--motion", "calm")) == 0
    assert "--seed 0 --motion calm</code>" in (folder / "out" / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.usefixtures("few_maps")
def test_compare_ranks_ports_and_robots(folder, made):
    assert main(arguments("--compare", "wide.toml", "six_axis")) == 0
    text = (folder / "out" / "report.html").read_text(encoding="utf-8")
    places = [text.index(f'<th scope="row">{name}') for name in ("wide.toml", "ports.toml", "six_axis")]
    assert places == sorted(places)
    assert [(left.name, right.name) for left, right, _ in made] == [
        *[("psm_grasper", "psm_palpator")] * 2,
        ("six_axis", "six_axis"),
    ]
    assert made[1][2].left.point == (-0.06, 0.03, 0.15) and made[2][2].left.point == (-0.03, 0.03, 0.15)
    assert "Ranked by the share of the surface" in text


# What is changed in which file (None: the file is removed), and a word of what is said.
REFUSED = [
    ("mine.toml", 'site = "tip"', 'site = "tipp"', "tipp"),
    ("mine.toml", "insertion = 0.0963", "insertion = 0.3", "insertion"),
    ("mine.toml", None, None, "mine.toml"),
    ("psm_grasper.xml", None, None, "psm_grasper.xml"),
    ("ports.toml", "point = [-0.03, 0.03, 0.15]", "point = [0.03, 0.03, 0.015]", "the left port at (30.0, 30.0, "),
    ("ports.toml", "[endoscope]", "[endoskope]", "endoskope"),
    ("ports.toml", "0.15]", "nan]", "finite"),
    ("ports.toml", None, None, "ports.toml"),
    ("wide.toml", "point = [-0.06, 0.03, 0.15]", "point = [0.03, 0.03, 0.015]", "ports file wide.toml: the left port"),
]


@pytest.mark.parametrize(("name", "old", "new", "message"), REFUSED)
def test_bad_input_is_refused_in_one_line(folder, made, capsys, name, old, new, message):
    path = folder / name
    if old is None:
        path.unlink()
    else:
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1))
    refused(arguments("--compare", "wide.toml", left="mine.toml"), message, capsys)
    assert made == [] and not (folder / "out").exists()


def refused(given, message, capsys):
    assert main(given) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("surgsim: error: ") and err.count("\n") == 1 and err.endswith("\n")
    assert message in err and "Traceback" not in err
    assert len(err) < 700


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--points", "0"], "--points is 0"),
        (["--seed", "-1"], "--seed is -1"),
        (["--left", "psm_grabber"], "psm_grabber"),
        (["--scene", "lever"], "lever"),
        (["--compare", "psm_grabber"], "psm_grabber"),
        (["--motion", "clam"], "clam"),
        (["--out", "ports.toml"], "--out ports.toml"),
    ],
)
def test_a_bad_option_is_refused_in_one_line(folder, made, capsys, more, message):
    refused([*arguments(), *more], message, capsys)
    assert made == []


@pytest.mark.slow
@pytest.mark.usefixtures("few_maps")
def test_without_a_ports_file_they_stand_as_laparoscopy_places_them(folder, made):
    given = arguments()
    del given[given.index("--ports") : given.index("--ports") + 2]
    assert main(given) == 0
    assert made[0][2] == default_ports(load_anatomy(make_scene("phantom")))
    report = (folder / "out" / "report.html").read_text(encoding="utf-8")
    assert "surgsim arms --scene phantom" in report and "--ports" not in report
