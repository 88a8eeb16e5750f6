"""Values of options: lengths with units, and those beyond the organ; empty and unwritable paths."""

import pytest
import tyro

from surgsim_apps.cli.main import EXAMPLES, TYRO, main
from surgsim_apps.cli.values import length_of, numbers_of

SMALL = ["palpate", "--scene", "phantom_small"]


@pytest.mark.parametrize(
    ("text", "length"),
    [("5mm", 0.005), ("0.5cm", 0.005), ("0.005", 0.005), ("0.3mm", 0.0003), ("7e-3m", 0.007), ("-2 mm", -0.002)],
)
def test_a_length_has_a_unit_or_is_in_metres(text, length):
    assert length_of(text) == length


@pytest.mark.parametrize("text", ["", "mm", "5in", "5MM", "five", "5mmm", "1e9999999999999999999"])
def test_another_text_is_no_length(text):
    with pytest.raises(ValueError, match="length"):
        length_of(text)


def test_lists_of_lengths():
    assert numbers_of("--lesion", "2cm,20mm,0.01,4mm,8", "x,y,z,radius,ratio") == (0.02, 0.02, 0.01, 0.004, 8.0)
    assert numbers_of("--lesion-below", "3,15mm,0.008,8", "SITE,DEPTH,RADIUS,RATIO") == (3.0, 0.015, 0.008, 8.0)


@pytest.mark.parametrize(
    ("command", "option"),
    [
        *(
            ("palpate", "press_depth"),
            ("palpate", "spacing"),
            ("organ a.stl", "cell_size"),
            ("organ a.stl", "tip_radius"),
        ),
        *(("organ a.stl", "press_depth"), ("arm check a.urdf", "tool")),
        *(("identify a.csv", "ball_radius"), ("identify a.csv", "thickness")),
    ],
)
def test_every_option_of_a_length_takes_a_unit(command, option):
    name, *words = command.split()
    given = tyro.cli(EXAMPLES[name][0], args=[*words, f"--{option.replace('_', '-')}", "12.5mm"], config=TYRO)
    assert getattr(given, option) == 0.0125


@pytest.mark.parametrize(
    ("arguments", "value", "meant"),
    [
        ([*SMALL, "--press-depth", "5"], "5 m", "5mm"),
        ([*SMALL, "--spacing", "8"], "8 m", "8mm"),
        ([*SMALL, "--around", "0,0,0,20"], "20 m", "20mm"),
        (["identify", "a.csv", "--ball-radius", "6.35"], "6.35 m", "6.35mm"),
        (["identify", "a.csv", "--thickness", "12"], "12 m", "12mm"),
        (["arm", "check", "a.urdf", "--tool", "400"], "400 m", "400mm"),
        # No number without its unit.
        ([*SMALL, "--press-depth", "50mm"], "0.05 m", ""),
        ([*SMALL, "--press-depth", "0"], "0 m", ""),
        ([*SMALL, "--press-depth", "-5mm"], "-0.005 m", ""),
        ([*SMALL, "--press-depth", "1e-9"], "1e-09 m", ""),
        ([*SMALL, "--spacing", "1e-6"], "1e-06 m", ""),
        ([*SMALL, "--lesion", "1e300,0,0,5mm,8"], "1e300", ""),
        ([*SMALL, "--lesion", "nan,0,0,5mm,8"], "nan", ""),
    ],
)
def test_a_length_out_of_range_is_refused_before_a_press(arguments, value, meant, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("surgsim_apps.palpate.palpation.scan", None)
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    text = capsys.readouterr().err.splitlines()[-1]
    assert value in text
    assert (f"did you mean {meant}?" in text) if meant else ("did you mean" not in text)


@pytest.mark.parametrize(
    ("option", "value", "meant"),
    [("cell-size", "5", "5mm"), ("tip-radius", "6", "6mm"), ("press-depth", "3.5", "3.5mm"), ("cell-size", "1e-6", "")],
)
@pytest.mark.parametrize("tiny", [False, True])
def test_lengths_of_an_organ_follow_its_volume(option, value, meant, tiny, tmp_path, capsys):
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box((60.0, 60.0, 30.0)).export(tmp_path / "box.stl")
    given = "1e-7" if tiny else value
    assert main(["organ", str(tmp_path / "box.stl"), "--length-unit", "mm", f"--{option}", given]) == 2
    text = capsys.readouterr().err
    assert f"--{option} is {float(given):g} m" in text
    assert tiny or meant in text


@pytest.mark.parametrize(
    "arguments",
    [
        [*SMALL, "--out", ""],
        ["identify", ""],
        ["arm", "check", ""],
        ["view", "--scene", ""],
        ["view", "--instrument", ""],
        ["haptics", "--trajectory", ""],
        ["evaluate", "--agent", "", "--scene", "phantom_small"],
    ],
)
def test_an_empty_text_is_no_default(arguments, capsys):
    assert main(arguments) == 2
    assert capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        [*SMALL, "--out"],
        ["retract", "--out"],
        ["view", "--scene", "phantom_small", "--seconds", "1", "--out"],
        ["arms", "--left", "psm_grasper", "--right", "psm_palpator", "--out"],
        ["evaluate", "--agent", "random", "--scene", "phantom_small", "--results"],
    ],
)
def test_a_folder_that_cannot_be_written_is_refused_at_once(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("gymnasium.make", None)
    (tmp_path / "file").touch()
    assert main([*arguments, str(tmp_path / "file")]) == 2
    text = capsys.readouterr().err
    assert f"{arguments[-1]} {tmp_path / 'file'}" in text and text.count("\n") == 1


@pytest.mark.parametrize("folder", [False, True])
@pytest.mark.parametrize("command", ["palpate", "retract", "view", "haptics", "maps", "arms"])
def test_a_scene_is_a_name_or_a_path_in_every_command(command, folder, tmp_path, capsys):
    path = tmp_path / "scene.toml"
    if folder:
        path.mkdir()
    more = ["--left", "psm_grasper", "--right", "psm_palpator"] if command == "arms" else []
    assert main([command, "--scene", str(path), *more]) == 2
    assert f"scene file {path} cannot be read" in capsys.readouterr().err
    assert main([command, "--scene", "phantm", *more]) == 2
    assert "did you mean 'phantom'?" in capsys.readouterr().err
