"""Differences of two methods on the same episodes, against what is known exactly."""

import math
from dataclasses import replace

import numpy as np
import pytest

from surgsim_apps.scoring.comparison import compare, describe
from surgsim_apps.scoring.figures import ScoreEstimate
from surgsim_apps.scoring.results import SITES, Result

pytestmark = pytest.mark.agents
SEEDS = tuple(range(1_000_000, 1_000_040))
BUDGET = 10


def result(method: str, errors: np.ndarray, **changes: object) -> Result:
    """A result with errors after each press [mm] (n, BUDGET)."""
    made = Result(
        method=method,
        env_id=SITES,
        env_kwargs={"scene": "phantom", "level": "standard"},
        seeds=SEEDS[: len(errors)],
        budget=BUDGET,
        figures={"success": ScoreEstimate(float((errors[:, -1] <= 5.0).mean()), 0.0, 1.0)},
        command="",
        wall_time=1.0,
        date="2026-11-24",
        physics_version=1,
        errors_mm=errors.tolist(),
        lesion_counts=[1] * len(errors),
        episodes={
            "error_of_presses_mm": errors.mean(axis=1).tolist(),
            "error_mm": errors[:, -1].tolist(),
            "success": (errors[:, -1] <= 5.0).astype(float).tolist(),
        },
    )
    return replace(made, **changes)  # type: ignore[arg-type]


def falling(presses: np.ndarray) -> np.ndarray:
    """Errors of 9 mm that fall to 1 mm at a press (n,)."""
    return np.where(np.arange(1, BUDGET + 1) >= presses[:, None], 1.0, 9.0)


def test_the_same_method_differs_by_nothing():
    """The draws are paired: an interval of width 0, however much the episodes differ."""
    method = result("one", falling(np.random.default_rng(0).integers(1, 12, 40)))
    for difference in compare(method, replace(method, method="other"), np.random.default_rng(0)):
        assert difference.difference == ScoreEstimate(0.0, 0.0, 0.0), difference
        assert difference.first == difference.second


def test_a_method_that_takes_two_presses_more_in_every_episode():
    presses = np.random.default_rng(1).integers(2, 6, 40)
    quick, slow = result("one", falling(presses)), result("other", falling(presses + 2))
    area, first, error, success = compare(quick, slow, np.random.default_rng(0))
    assert first.figure == "presses_to_median" and first.difference == ScoreEstimate(-2.0, -2.0, -2.0)
    assert error.difference == success.difference == ScoreEstimate(0.0, 0.0, 0.0)
    # Two presses of ten at 9 instead of 1 mm.
    assert area.difference.value == pytest.approx(-1.6) and area.episode_count == pytest.approx(0.0, abs=1e-9)
    assert describe(first, "one", "other").endswith("; difference -2.0 (-2.0 to -2.0)")


def test_the_interval_of_a_share_is_that_of_the_paired_binomial():
    """Success differs in 10 of 40 episodes, by d_i = 1: mean 0.25, standard error sqrt(var d / n) = 0.068."""
    won, lost = np.full((40, BUDGET), 1.0), np.full((40, BUDGET), 9.0)
    other = np.where((np.arange(40) < 10)[:, None], lost, won)
    *_, success = compare(result("one", won), result("other", other), np.random.default_rng(0))
    assert success.difference.value == 0.25
    error = math.sqrt(0.25 * 0.75 / 40)
    # The bootstrap of 40 zeros and ones steps by 0.025.
    assert success.difference.low == pytest.approx(0.25 - 1.96 * error, abs=0.03)
    assert success.difference.high == pytest.approx(0.25 + 1.96 * error, abs=0.03)


def test_the_episodes_that_tell_methods_apart():
    """n (2.8 se / d)^2, with se = s / sqrt(n) of the paired differences: (2.8 s / d)^2, by organs m times as many."""
    differences = np.random.default_rng(2).normal(0.5, 1.0, 40)
    base = np.full((40, BUDGET), 9.0)
    other, method = result("other", base), result("one", base + differences[:, None])
    area, *_ = compare(method, other, np.random.default_rng(0))
    count = (2.8 * differences.std() / differences.mean()) ** 2
    # The deviation of 2000 draws is known to 2 %, its square to 4.
    assert area.episode_count == pytest.approx(count, rel=0.12)
    assert f"; {area.episode_count:.0f} episodes tell them apart" in describe(area, "one", "other")
    # Four episodes alike on each of ten organs are worth one.
    alike, members = base + np.repeat(differences[:10], 4)[:, None], [f"test {n // 4}" for n in range(40)]
    area, *_ = compare(result("one", alike, members=members), replace(other, members=members), np.random.default_rng(0))
    count = 4.0 * (2.8 * differences[:10].std() / differences[:10].mean()) ** 2
    assert area.episode_count == pytest.approx(count, rel=0.12)


def test_a_line_that_is_never_reached():
    """Infinitely many presses more; where neither reaches it, the difference is undefined."""
    never, quick = result("never", np.full((40, BUDGET), 9.0)), result("quick", falling(np.full(40, 3)))
    _, first, *_ = compare(never, quick, np.random.default_rng(0))
    assert first.difference == ScoreEstimate(math.inf, math.inf, math.inf)
    assert "never inf, quick 3.0; difference +inf" in describe(first, "never", "quick")
    _, first, *_ = compare(never, replace(never, method="too"), np.random.default_rng(0))
    assert first.difference == ScoreEstimate(None, None, None)


def test_episodes_without_lesions_do_not_count_for_presses():
    errors = falling(np.repeat([2, 9], 20))
    method = result("one", errors, lesion_counts=[1] * 20 + [0] * 20)
    _, first, *_ = compare(method, method, np.random.default_rng(0))
    assert first.first == 2.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": tuple(range(40))}, "their seeds are 1000000:1000039 and 0:39"),
        (
            {"env_kwargs": {"scene": "phantom", "level": "hard"}},
            "PalpateSites_phantom_standard with 10 steps and PalpateSites_phantom_hard with 10",
        ),
        ({"budget": 25}, "with 10 steps and PalpateSites_phantom_standard with 25"),
        ({"episodes": {}}, "the result of other does not list its episodes"),
        ({"physics_version": 2}, "their physics versions are 1 and 2"),
    ],
)
def test_results_of_other_episodes_are_refused(changes: dict[str, object], message: str):
    method = result("one", falling(np.full(40, 3)))
    with pytest.raises(ValueError, match=message):
        compare(method, replace(method, method="other", **changes), np.random.default_rng(0))  # type: ignore[arg-type]
