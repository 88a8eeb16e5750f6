"""docs/palpation.md says what the code does: its example runs, its levels and its estimator's numbers are those."""

import re
from pathlib import Path

import pytest

from surgsim_env.palpation import lesion_estimator
from surgsim_env.scene.levels import LEVELS
from surgsim_env.scene.load import make_scene

TEXT = (Path(__file__).resolve().parents[2] / "docs" / "palpation.md").read_text(encoding="utf-8")


def row(beginning: str) -> list[list[float]]:
    """The numbers of a table's row, a list for each of the three levels."""
    line = next(line for line in TEXT.splitlines() if line.startswith(f"| {beginning}"))
    return [[float(number) for number in re.findall(r"\d+\.?\d*", cell)] for cell in line.split("|")[2:5]]


def test_the_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    exec(compile(code, "docs/palpation.md", "exec"), {})
    assert re.search(r"\d lesions estimated, error \d+\.\d mm", capsys.readouterr().out)


def test_levels_are_those_of_the_code() -> None:
    scene = make_scene("phantom")
    for index, name in enumerate(("easy", "standard", "hard")):
        level = LEVELS[name]
        draw, sensor = level.lesion_draw(scene), level.scene(scene).sensor
        assert row("radius [mm]")[index] == pytest.approx([1000.0 * value for value in draw.radius])
        assert row("tissue above")[index] == pytest.approx([1000.0 * value for value in draw.cover])
        assert row("modulus over")[index] == pytest.approx(list(draw.modulus_ratio))
        assert row("modulus of the tissue")[index] == pytest.approx(list(level.background))
        assert row("sensor noise")[index] == pytest.approx([1000.0 * sensor.noise])
        assert row("sensor bias")[index] == pytest.approx([1000.0 * sensor.bias])
        chances = row("lesions: chance")[index]
        assert chances[: len(level.lesion_count_weights)] == pytest.approx(list(level.lesion_count_weights))
        assert not any(chances[len(level.lesion_count_weights) :])


def test_the_estimators_numbers_are_those_of_the_code() -> None:
    for said in (
        f"b \\sim N(0, \\, {lesion_estimator.BACKGROUND_SPREAD:g}^2)",
        f"\\left( 0, \\, {lesion_estimator.EXCESS_SPREAD:g}^2",
        f"l = {1000.0 * lesion_estimator.EXCESS_LENGTH:g} \\text{{ mm}}",
        f"+ {lesion_estimator.MODEL_SPREAD:g}²",
        f"above {lesion_estimator.EXCESS_LEAST:g} + {lesion_estimator.EXCESS_LEAST_NOISE:g} (sensor's noise",
        f"+ {lesion_estimator.EXCESS_LEAST_MAP:g} (map's deviation)",
        f"map's deviation is {lesion_estimator.ORGAN_MAP_SPREAD:g}",
        f"these are for {1000.0 * lesion_estimator.REFERENCE_LESION_RADIUS:g} mm",
        f"at least {1000.0 * lesion_estimator.DISTANCE_LEAST:g} mm apart",
        f"within {1000.0 * lesion_estimator.CENTROID_RADIUS:g} mm",
        f"above {lesion_estimator.OUTLINE_SHARE:g} of its maximum",
    ):
        assert said in " ".join(TEXT.split()), said
