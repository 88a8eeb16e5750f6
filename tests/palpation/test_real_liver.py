"""The main job on a CT-derived human liver: a small raster around one of the fixed places, and all five."""

import json
from pathlib import Path

import pytest

from surgsim_env.cli.main import main

LIVER = Path(__file__).parents[3] / "shared" / "data" / "anatomy" / "openhelp_liver.stl"
PLACES = json.loads(Path(__file__).with_name("places.json").read_text(encoding="utf-8"))

pytestmark = pytest.mark.skipif(
    not LIVER.is_file(), reason=f"{LIVER} is not there (the CT-derived liver is not shipped)"
)


def palpate(number, out, *extra):
    """The summary of the command line's run on one place."""
    lesion = [*PLACES["centres"][number], PLACES["radius"], PLACES["modulus_ratio"]]
    arguments = ["palpate", "--surface", str(LIVER), "--length-unit", "mm", "--cell-size", str(PLACES["cell_size"])]
    arguments += ["--approach", ",".join(map(str, PLACES["approach"]))]
    arguments += ["--lesion", ",".join(map(str, lesion)), "--out", str(out), *extra]
    assert main(arguments) == 0
    return json.loads((out / "summary.json").read_text(encoding="utf-8"))


def strongest_is_within_radius(summary, name):
    """Whether the strongest estimate of a map, not merely the nearest, lies within the lesion's radius."""
    (lesion,) = summary["maps"][name]["lesions"]
    return lesion["felt"] and lesion["estimate"] == 0


@pytest.mark.slow
def test_one_place(tmp_path):
    ball = ",".join(map(str, [*PLACES["below"][0], 0.034]))
    summary = palpate(0, tmp_path, "--around", ball)
    assert summary["sites"]["ended_early"] == {}
    assert 8 <= summary["sites"]["in_maps"] <= 25
    assert summary["volume_ratio_smallest"] > 0.2
    assert strongest_is_within_radius(summary, "pre-operative model")
    entry = summary["maps"]["pre-operative model"]
    assert entry["lesions"][0]["error_mm"] < 1e3 * PLACES["radius"]


@pytest.mark.slow
def test_four_of_five_places(tmp_path):
    summaries = [palpate(number, tmp_path / str(number)) for number in range(5)]
    assert all(summary["volume_ratio_smallest"] > 0.0 for summary in summaries)
    assert all(summary["sites"]["ended_early"] == {} for summary in summaries)
    assert sum(strongest_is_within_radius(summary, "pre-operative model") for summary in summaries) >= 4
