"""`surgsim validate --measured` on made recordings, with a closed-form press in place of the organ's."""

import pytest

from surgsim_env.cli.main import main
from surgsim_env.identify import shape_search
from surgsim_env.identify.press_model import PressShape
from tests.identify.made import closed_area, closed_press, recording, write_csv

LAW = PressShape(0.012, 0.08, 0.2, 25.0)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(shape_search, "press_block", closed_press)
    monkeypatch.setattr(shape_search, "LOOKED_AT", 192)
    monkeypatch.setattr(shape_search, "PROFILE_LOOKS", 32)
    for name, law in (("liver", LAW), ("silicone", PressShape(0.012))):
        made = recording(lambda depth, law=law: closed_area(depth, law), noise=0.01, count=16)
        write_csv(made, tmp_path / f"{name}.csv")
    return tmp_path


def test_errors_of_every_set(folder, capsys):
    out = folder / "out"
    assert main(["validate", "--measured", str(folder), "--out", str(out)]) == 0
    text = (out / "validation_measured.md").read_text(encoding="utf-8")
    rows = {line.split(" | ")[0].strip("| "): line.split(" | ") for line in text.splitlines() if line.startswith("| ")}
    liver, silicone = rows["liver"], rows["silicone"]
    assert float(liver[3].rstrip("%")) < 2.0 < 5.0 < float(liver[5].rstrip("%"))
    assert silicone[3] == silicone[5] and "linear" in silicone
    assert liver[-1].strip("| ") == "met"
    assert "liver" in capsys.readouterr().out
    # No path of this machine and none of the recorded numbers.
    assert str(folder) not in text


def test_a_law_that_is_worse_than_linear_tissue_ends_with_status_1(folder, monkeypatch):
    from surgsim_env.validation import measured

    def spoilt(*given):
        found = real(*given)
        for result in found:
            object.__setattr__(result.sets[0].error, "median", 1.0)
        return found

    real = measured.identify_folder
    monkeypatch.setattr(measured, "identify_folder", spoilt)
    assert main(["validate", "--measured", str(folder), "--out", str(folder / "out")]) == 1
