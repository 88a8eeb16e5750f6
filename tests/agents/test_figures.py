"""Scores of palpation: who sees the truth has all of it, who guesses the middle has what chance predicts."""

import math
from dataclasses import replace

import numpy as np
import pytest

from surgsim_apps.scoring.figures import (
    ERROR_LINE,
    MapScore,
    PalpationRecord,
    ScoreEstimate,
    episode_columns,
    median_presses,
    press_errors,
    resamples,
)
from surgsim_apps.scoring.figures import score as score_columns
from surgsim_env.palpation import FOUND_SHARE

SIDE = 0.04  # of the square that lesions are drawn in [m]
BUDGET = 5
CUTOFF = 0.04  # beyond the square's half diagonal
NONE = np.zeros((0, 3))


def record(truth: np.ndarray, estimates: list[np.ndarray], made: MapScore | None = None) -> PalpationRecord:
    return PalpationRecord(
        truth=truth,
        estimates=estimates,
        cutoff=CUTOFF,
        force=np.full(len(estimates), 0.2),
        force_peak=np.linspace(0.2, 0.6, len(estimates)),
        pressure=np.linspace(3e3, 1e3, len(estimates)),
        strain=np.linspace(0.1, 0.3, len(estimates)),
        seconds=2.0,
        hard_limit=False,
        fault="",
        map=made,
    )


def score(records: list[PalpationRecord], budget: int, rng: np.random.Generator) -> dict[str, ScoreEstimate]:
    """Figures of records on one organ."""
    errors = [(1000.0 * press_errors(each, budget)).tolist() for each in records]
    return score_columns(episode_columns(records, budget), [], rng, errors, [len(each.truth) for each in records])


def places(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.column_stack([rng.uniform(0.0, SIDE, (count, 2)), np.zeros(count)])


def map_of(excess: np.ndarray, lesion: np.ndarray) -> MapScore:
    return MapScore(excess.ravel(), lesion.ravel(), excess > 0.5, lesion, 4e-6)


def disc(centre: np.ndarray, radius: float = 0.008) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0.0, SIDE, 21), np.linspace(0.0, SIDE, 21))
    return (x - centre[0]) ** 2 + (y - centre[1]) ** 2 <= radius**2


def test_who_sees_the_truth_has_all_of_it() -> None:
    rng = np.random.default_rng(0)
    records = []
    for count in (0, 1, 2, 3, 1, 1):
        truth = places(rng, count)
        lesion = np.any([disc(place) for place in truth], axis=0) if count else np.zeros((21, 21), dtype=bool)
        records.append(record(truth, [truth] * BUDGET, map_of(lesion.astype(float), lesion)))
    figures = score(records, BUDGET, rng)
    for name in ("recall", "precision", "count_right", "outline_iou", "auroc"):
        assert (figures[name].low, figures[name].value, figures[name].high) == (1.0, 1.0, 1.0), name
    for name in ("error_mm", "error_of_presses_mm", "centroid_error_mm", "fault_share"):
        assert (figures[name].low, figures[name].value, figures[name].high) == (0.0, 0.0, 0.0), name
    assert figures["presses_to_median"].value == 1.0


@pytest.mark.slow
def test_who_guesses_the_middle_has_what_chance_predicts() -> None:
    """Mean distance from a square's middle: side (sqrt 2 + asinh 1) / 6; share within r of it: pi r^2 / side^2."""
    rng = np.random.default_rng(1)
    middle = np.array([[0.5 * SIDE, 0.5 * SIDE, 0.0]])
    records = []
    for _ in range(600):
        truth = places(rng, 1)
        records.append(record(truth, [middle] * BUDGET, map_of(rng.random((21, 21)), disc(truth[0]))))
    distance = np.array([1000.0 * np.linalg.norm(episode.truth - middle) for episode in records])
    figures = score(records, BUDGET, rng)
    by_chance = 1000.0 * SIDE * (math.sqrt(2.0) + math.asinh(1.0)) / 6.0
    assert figures["error_mm"].value == pytest.approx(by_chance, abs=4.0 * distance.std() / math.sqrt(600))
    within = math.pi * (FOUND_SHARE * CUTOFF) ** 2 / SIDE**2
    for name in ("recall", "precision"):
        assert figures[name].value == pytest.approx(within, abs=4.0 * math.sqrt(within * (1.0 - within) / 600)), name
    # A map that knows nothing orders a site of a lesion before another one half of the time.
    assert figures["auroc"].value == pytest.approx(0.5, abs=0.02)
    assert figures["presses_to_median"].value == math.inf


def test_presses_to_a_line_count_till_it_is_crossed_for_good() -> None:
    over, under = 2000.0 * ERROR_LINE, 500.0 * ERROR_LINE

    def presses(*errors: list[float]) -> float:
        return median_presses(errors, [1] * len(errors), np.arange(len(errors)))

    assert presses([over, under, under]) == 2.0
    assert presses([over, under, over, under]) == 4.0
    assert presses([under, under]) == 1.0
    assert presses([under, over]) == math.inf
    # Of three organs two are under the line from the second press on.
    assert presses([over, under, under], [under, under, under], [over, over, under]) == 2.0


def test_an_episode_that_ended_early_keeps_its_last_error() -> None:
    truth = places(np.random.default_rng(2), 1)
    errors = press_errors(record(truth, [NONE, truth + np.array([0.003, 0.0, 0.0])]), BUDGET)
    np.testing.assert_allclose(errors, [CUTOFF, 0.003, 0.003, 0.003, 0.003])


def test_missed_and_imagined_lesions_count() -> None:
    """Of two lesions one is found 4 mm off; of three estimates two are nowhere near."""
    truth = np.array([[0.01, 0.01, 0.0], [0.03, 0.03, 0.0]])
    estimates = np.array([[0.014, 0.01, 0.0], [0.01, 0.035, 0.0], [0.0, 0.04, 0.0]])
    figures = score([record(truth, [estimates])], 1, np.random.default_rng(0))
    assert figures["recall"].value == pytest.approx(1.0 / 2.0)
    assert figures["precision"].value == pytest.approx(1.0 / 3.0)
    assert figures["centroid_error_mm"].value == pytest.approx(4.0)
    matched = 4.0 + 1000.0 * math.hypot(0.02, 0.005)
    assert figures["error_mm"].value == pytest.approx((matched + 1000.0 * CUTOFF) / 3.0)
    assert figures["count_right"].value == 0.0
    # Nothing hidden, nothing said: no recall, no precision, no line, but no error either.
    nothing = score([record(NONE, [NONE])], 1, np.random.default_rng(0))
    assert nothing["recall"].value is nothing["precision"].value is nothing["presses_to_median"].value is None
    assert nothing["error_mm"].value == 0.0 and nothing["count_right"].value == 1.0


def test_forces_are_those_of_the_presses() -> None:
    truth = places(np.random.default_rng(3), 1)
    figures = score([replace(record(truth, [truth] * 5), hard_limit=True)], BUDGET, np.random.default_rng(0))
    assert figures["force_mean"].value == pytest.approx(0.2)
    assert figures["force_peak"].value == pytest.approx(0.6)
    assert figures["pressure_peak"].value == 3e3 and figures["strain_peak"].value == 0.3
    assert figures["hard_limit_share"].value == 1.0


def test_intervals_are_those_of_the_mean() -> None:
    """For many organs the interval is mean +- 1.96 s / sqrt(n), by the central limit theorem."""
    rng = np.random.default_rng(4)
    truth = np.zeros((1, 3))
    offsets = rng.uniform(0.0, 0.02, 400)
    figure = score([record(truth, [truth + np.array([offset, 0.0, 0.0])]) for offset in offsets], 1, rng)["error_mm"]
    half = 1.96 * 1000.0 * offsets.std() / math.sqrt(400)
    assert figure.value == pytest.approx(1000.0 * offsets.mean())
    # 2000 draws: the ends are known to some 4 % of the half width.
    assert figure.value - figure.low == pytest.approx(half, rel=0.15)
    assert figure.high - figure.value == pytest.approx(half, rel=0.15)


def test_a_draw_takes_whole_organs() -> None:
    """Episodes alike within an organ have the interval of as many episodes as organs, each of them once."""
    values, rng = np.arange(8.0), np.random.default_rng
    repeated, members = np.repeat(values, 5), [f"test {number}" for number in np.repeat(np.arange(8), 5)]
    by_organ = score_columns({"a": repeated}, members, rng(0))["a"]
    assert by_organ == score_columns({"a": values}, [], rng(0))["a"]
    by_episode = score_columns({"a": repeated}, [], rng(0))["a"]
    assert by_organ.low is not None and by_episode.low is not None and by_organ.low < by_episode.low
    # Organs of unequal numbers of episodes, in any order.
    for draw in resamples(5, ["a", "b", "a", "c", "b"], rng(0))[:20]:
        counts = np.bincount(draw, minlength=5)
        assert counts[0] == counts[2] and counts[1] == counts[4] and counts[[0, 1, 3]].sum() == 3
