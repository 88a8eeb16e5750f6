"""Modulus and offset of made sites are found again; sites that cannot be used are told, not hidden."""

import numpy as np
import pytest

from surgsim_apps.identify.recordings import SitePress
from surgsim_apps.identify.site_fit import GRID_COUNT, SampledCurve, SiteSamples, fit_sites, sort_out
from tests.identify.made import recording, truth


def hertz(depth):
    return 0.1 * depth**1.5


def sampled(area, depth=4.5e-3):
    return SampledCurve(depth, area(np.linspace(0.0, depth, GRID_COUNT)) ** (2.0 / 3.0))


def test_modulus_and_offset_are_found():
    made = recording(lambda depth: hertz(depth) * np.exp(300.0 * depth))
    samples = SiteSamples.of(made.presses, 1.5e-3)
    fits = fit_sites(sampled(lambda depth: hertz(depth) * np.exp(300.0 * depth)), samples)
    moduli, shifts = truth()
    # Offsets are tried in steps of 33 um: half a step at the end of the range, and d ln A / d o = 1.5 / d + 300 per m.
    np.testing.assert_allclose(fits.offset, shifts, atol=17e-6)
    np.testing.assert_allclose(fits.modulus, moduli, rtol=17e-6 * (1.5 / 2e-3 + 300.0))
    assert np.median(fits.deep_errors) < 1e-3


def test_the_wrong_shape_has_the_error_that_follows_from_it():
    """F = d against A = d^1.5 without offsets: E by least squares of the force, errors computed by hand."""
    depth = np.linspace(1.0, 10.0, 10) * 1e-4
    samples = SiteSamples.of([SitePress(0, np.zeros(3), depth, depth)], 0.0)
    fits = fit_sites(sampled(lambda depth: depth**1.5, 1e-3), samples)
    modulus = (depth**2.5).sum() / (depth**3).sum()
    assert fits.modulus[0] == pytest.approx(modulus, rel=1e-3)
    deep = depth > depth[-1] / 3.0
    wanted = np.abs(modulus * depth[deep] ** 0.5 - 1.0)
    np.testing.assert_allclose(np.sort(fits.deep_errors), np.sort(wanted), atol=2e-3)
    assert fits.site_errors[0] == pytest.approx(np.median(wanted), abs=2e-3)


def test_sites_that_cannot_be_used_are_named_with_their_reason():
    made = recording(hertz)
    press = made.presses[0]

    def other(site, depth=press.depth, force=press.force, time=None):
        return SitePress(site, press.place, depth, force, time)

    bad = [
        other(100, depth=0.3 * press.depth),
        other(101, depth=press.depth[[0, 1, 9]], force=press.force[[0, 1, 9]]),
        other(102, force=-press.force),
        other(103, force=np.full(len(press.force), 0.1)),
        other(104, depth=20.0 * press.depth),
    ]
    usable, left_out = sort_out([*made.presses, *bad], 0.006)
    assert [site.site for site in usable] == [press.site for press in made.presses]
    assert {reason.split(" ")[0]: sites for reason, sites in left_out.items()} == {
        "less": [100], "fewer": [101], "a": [102], "force": [103], "deeper": [104]
    }  # fmt: skip


@pytest.mark.parametrize(
    ("factors", "reason"),
    [
        *(((depth, 1.0, 1.0), "metres") for depth in (1e-3, 1e-300)),
        *(((1.0, force, 1.0), "newtons") for force in (1e-300, 1e-6, 1e9)),
        *(((1.0, 1.0, time), "seconds") for time in (1e-300, 1e-6, 1e9)),
    ],
)
@pytest.mark.parametrize("ball_radius", [0.0005, 0.006, 0.05])
def test_presses_that_no_tissue_has_are_not_used(factors, reason, ball_radius):
    """Also where all sites of a set have the same wrong unit."""
    made = recording(hertz, depth=0.5 * ball_radius, time=np.linspace(0.1, 2.0, 10))
    assert len(sort_out(made.presses, ball_radius)[0]) == len(made.presses)
    depth, force, time = factors
    wrong = [
        SitePress(press.site, press.place, depth * press.depth, force * press.force, time * press.time)
        for press in made.presses
    ]
    usable, left_out = sort_out(wrong, ball_radius)
    assert not usable and len(left_out) == 1 and reason in next(iter(left_out))
