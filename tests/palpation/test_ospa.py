"""OSPA against its definition, worked out by hand and over all permutations."""

from itertools import permutations

import numpy as np
import pytest

from surgsim_env.palpation.scores import ospa

NONE = np.zeros((0, 2))


def by_permutations(truth: np.ndarray, estimate: np.ndarray, cutoff: float) -> float:
    """Schuhmacher, Vo & Vo 2008, eq. (1), p = 1, with the minimum taken over all permutations."""
    fewer, more = sorted((truth, estimate), key=len)
    best = min(
        sum(min(float(np.linalg.norm(a - more[i])), cutoff) for a, i in zip(fewer, order, strict=False))
        for order in permutations(range(len(more)))
    )
    return (best + cutoff * (len(more) - len(fewer))) / len(more)


def test_cases_by_hand() -> None:
    a, b = np.array([[0.01, 0.0]]), np.array([[0.01, 0.004], [0.03, 0.0]])
    assert ospa(NONE, NONE, 0.02) == 0.0
    assert ospa(a, NONE, 0.02) == 0.02
    assert ospa(NONE, b, 0.02) == 0.02
    # (4 mm + one too many) / 2
    assert ospa(a, b, 0.02) == pytest.approx(0.012)
    # 50 mm off counts as the cutoff.
    assert ospa(a, a + 0.05, 0.02) == pytest.approx(0.02)


def test_equals_the_best_permutation() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        truth, estimate = (rng.uniform(0.0, 0.05, (rng.integers(1, 4), 3)) for _ in range(2))
        assert ospa(truth, estimate, 0.02) == pytest.approx(by_permutations(truth, estimate, 0.02), abs=1e-15)


def test_is_a_metric() -> None:
    rng = np.random.default_rng(1)
    for _ in range(200):
        a, b, c = (rng.uniform(0.0, 0.05, (rng.integers(0, 4), 2)) for _ in range(3))
        assert ospa(a, b, 0.02) == pytest.approx(ospa(b, a, 0.02))
        assert ospa(a, a[::-1], 0.02) == 0.0
        assert ospa(a, c, 0.02) <= ospa(a, b, 0.02) + ospa(b, c, 0.02) + 1e-15
