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
        successes=(errors[:, -1] <= 5.0).tolist(),
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
    first, error, success = compare(quick, slow, np.random.default_rng(0))
    assert first.figure == "presses_to_median" and first.difference == ScoreEstimate(-2.0, -2.0, -2.0)
    assert error.difference == success.difference == ScoreEstimate(0.0, 0.0, 0.0)
    assert "difference -2.0 (-2.0 to -2.0); ratio 0." in describe(first, "one", "other")


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


def test_a_line_that_is_never_reached():
    """Infinitely many presses more; where neither reaches it, the difference is undefined."""
    never, quick = result("never", np.full((40, BUDGET), 9.0)), result("quick", falling(np.full(40, 3)))
    first, *_ = compare(never, quick, np.random.default_rng(0))
    assert first.difference == ScoreEstimate(math.inf, math.inf, math.inf)
    assert "never inf, quick 3.0; difference +inf" in describe(first, "never", "quick")
    first, *_ = compare(never, replace(never, method="too"), np.random.default_rng(0))
    assert first.difference == ScoreEstimate(None, None, None)


def test_episodes_without_lesions_do_not_count_for_presses():
    errors = falling(np.repeat([2, 9], 20))
    method = result("one", errors, lesion_counts=[1] * 20 + [0] * 20)
    first, *_ = compare(method, method, np.random.default_rng(0))
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
        ({"successes": []}, "the result of other does not list its episodes"),
        ({"physics_version": 2}, "their physics versions are 1 and 2"),
    ],
)
def test_results_of_other_episodes_are_refused(changes: dict[str, object], message: str):
    method = result("one", falling(np.full(40, 3)))
    with pytest.raises(ValueError, match=message):
        compare(method, replace(method, method="other", **changes), np.random.default_rng(0))  # type: ignore[arg-type]
