"""Quantiles, exponents and the order of runs, by closed form; no test looks at how long anything takes."""

from itertools import pairwise

import pytest

from surgsim_env.bench.measurement import exponent, interleaved, quantile, seconds_per_call, spread


@pytest.mark.parametrize(("share", "value"), [(0.0, 1.0), (0.01, 1.0), (0.5, 50.0), (0.99, 99.0), (1.0, 100.0)])
def test_quantile_is_a_value_that_was_measured(share, value):
    assert quantile([float(number) for number in range(100, 0, -1)], share) == value


def test_quantile_of_one_value():
    assert quantile([7.0], 0.5) == quantile([7.0], 0.99) == 7.0


@pytest.mark.parametrize("power", [0.0, 1.0, 1.5])
def test_exponent_of_a_power_law(power):
    sizes = [640.0, 2000.0, 5000.0, 20000.0]
    assert exponent(sizes, [3e-8 * size**power for size in sizes]) == pytest.approx(power, abs=1e-12)


def test_exponent_of_two_points_is_the_slope():
    # log(6 / 2) / log(100 / 10)
    assert exponent([10.0, 100.0], [2.0, 6.0]) == pytest.approx(0.4771212547, rel=1e-9)


def test_runs_take_turns():
    order: list[str] = []

    def run(name: str, value: float) -> float:
        order.append(name)
        return value

    results = interleaved({"a": lambda: run("a", 1.0), "b": lambda: run("b", 2.0)}, 3)
    assert "".join(order) == "ababab"
    assert results == {"a": [1.0] * 3, "b": [2.0] * 3}


def test_spread():
    assert spread([1.0, 3.0, 2.0]) == "3 rounds, 1 to 3"


def test_repeats_until_it_lasts():
    counts: list[int] = []

    def work(count: int) -> None:
        counts.append(count)
        sum(range(10_000 * count))

    assert seconds_per_call(work, shortest=0.002) > 0.0
    assert counts[0] == 1
    assert all(later >= 2 * earlier for earlier, later in pairwise(counts))
