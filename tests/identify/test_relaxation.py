"""Maxwell arms against closed forms, and found again from presses that are held."""

import numpy as np
import pytest

from surgsim_apps.identify.relaxation import Arms, fit_relaxation, held_sites
from surgsim_apps.identify.site_fit import GRID_COUNT, SampledCurve
from tests.identify.made import recording

# 0.5 s of loading in 40 samples, then 20 s of hold.
TIME = np.concatenate([np.linspace(0.0125, 0.5, 40), np.geomspace(0.52, 20.0, 120)])
ARMS = Arms((0.3, 0.5), (0.5, 6.0))


def area(depth):
    return 0.1 * depth**1.5 * np.exp(300.0 * depth)


CURVE = SampledCurve(4.5e-3, area(np.linspace(0.0, 4.5e-3, GRID_COUNT)) ** (2.0 / 3.0))


def test_a_step_decays_by_the_closed_form():
    time = np.geomspace(0.01, 100.0, 200)[None]
    relaxed = ARMS.relaxed(np.ones_like(time), time)[0]
    since = time[0] - time[0, 0]
    wanted = 1.0 + 0.3 * np.exp(-since / 0.5) + 0.5 * np.exp(-since / 6.0)
    np.testing.assert_allclose(relaxed, wanted, rtol=1e-9)


def test_a_ramp_has_the_closed_form():
    time = np.linspace(0.0, 2.0, 30)[None]
    relaxed = Arms((0.4,), (0.5,)).relaxed(3.0 * time, time)[0]
    wanted = 3.0 * time[0] + 0.4 * 3.0 * 0.5 * (1.0 - np.exp(-time[0] / 0.5))
    np.testing.assert_allclose(relaxed, wanted, rtol=1e-9, atol=1e-12)


def test_arms_are_found_again():
    made = recording(area, count=12, samples=40, time=TIME, arms=ARMS, noise=0.01)
    held = held_sites(made.presses)
    assert len(held) == 12
    fit = fit_relaxation(CURVE, held[:6], held[6:], np.linspace(0.0, 1.5e-3, 31))
    assert len(fit.times) == 2
    assert fit.relative_moduli == pytest.approx(ARMS.moduli, rel=0.08)
    assert fit.times == pytest.approx(ARMS.times, rel=0.1)
    # 1 % of noise has a median size of 0.67 %.
    assert fit.error < 0.01 < fit.elastic_error


def test_elastic_tissue_has_no_arms():
    made = recording(area, count=12, samples=40, time=TIME, noise=0.01)
    fit = fit_relaxation(CURVE, made.presses[:6], made.presses[6:], np.linspace(0.0, 1.5e-3, 31))
    assert fit.times == ()
