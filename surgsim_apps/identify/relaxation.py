"""Relaxation of tissue by presses with times: Prony terms of a quasi-linear solid, by least squares.

The force at a site is that of the elastic press plus a term per Maxwell arm (Fung 1993),
F(t) = E [A(t) + sum_i g_i int exp(-(t - s) / tau_i) dA/ds ds], with A(t) = A(d(t) + o) of `press_model`.
After a step it starts at (1 + sum g_i) times its final value.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from msdm_core.mesh import FloatArray
from surgsim_apps.identify.recordings import SitePress
from surgsim_apps.identify.site_fit import SampledCurve

# Most arms of the organ's springs, and least relative fall of the error for another arm.
ARMS_MOST, GAIN_LEAST = 3, 0.05
# Most samples of a site: half of the loading, half of the hold, evenly in the logarithm of time.
SAMPLES_MOST = 160
# Rounds of fits of the arms for given offsets and of offsets for given arms.
ROUNDS = 3
# Least held share of the time of a press that shows relaxation.
HELD_SHARE_LEAST = 0.2
# Range of relative moduli.
MODULUS_LEAST, MODULUS_MOST = 1e-3, 10.0


@dataclass(frozen=True)
class RelaxationFit:
    """Relative moduli g_i and times tau_i [s] of the arms, and the error on held-out sites.

    Fields:
        relative_moduli, times: as in the organ's material, times increasing
        error: median |F_model - F| / F over the samples from a third of the depth on
        elastic_error: the same without arms
        time_range: shortest and longest resolved time since the start of the press [s]
    """

    relative_moduli: tuple[float, ...]
    times: tuple[float, ...]
    error: float
    elastic_error: float
    time_range: tuple[float, float]


def held_sites(sites: Sequence[SitePress]) -> list[SitePress]:
    """Sites with times and a hold long enough for relaxation."""
    held = []
    for site in sites:
        if site.time is not None:
            full = site.time[site.loading.stop - 1]
            if site.time[-1] - full >= HELD_SHARE_LEAST * (site.time[-1] - site.time[0]):
                held.append(site)
    return held


@dataclass(frozen=True, eq=False)
class HeldSamples:
    """Samples of held presses in rows of equal length; a row's last sample is repeated with weight 0.

    Fields:
        depth, force, time: [m], [N], [s], (n_site, n_sample)
        weight: 1 for a sample, else 0, (n_site, n_sample)
        offset: contact offset of each site [m], (n_site,)
    """

    depth: FloatArray
    force: FloatArray
    time: FloatArray
    weight: FloatArray
    offset: FloatArray

    @classmethod
    def of(cls, sites: Sequence[SitePress]) -> "HeldSamples":
        """Thinned samples of sites with times, with offsets of 0."""
        rows = [_thinned(site) for site in sites]
        count = max(map(len, rows))
        table, weight = np.zeros((3, len(sites), count)), np.zeros((len(sites), count))
        for number, (site, indices) in enumerate(zip(sites, rows)):
            assert site.time is not None
            padded = np.concatenate([indices, np.full(count - len(indices), indices[-1])])
            table[:, number] = site.depth[padded], site.force[padded], site.time[padded] - site.time[0]
            weight[number, : len(indices)] = 1.0
        return cls(table[0], table[1], table[2], weight, np.zeros(len(sites)))

    def force_model(self, curve: SampledCurve, offset: FloatArray, arms: "Arms") -> FloatArray:
        """Model force of samples (n_site, n_sample) [N] with the best modulus at each site; offset (n_site,) [m]."""
        area = arms.relaxed(curve.at(self.depth + offset[:, None]), self.time)
        own = (self.weight * area * area).sum(axis=1)
        modulus = (self.weight * area * self.force).sum(axis=1) / np.maximum(own, 1e-300)
        return modulus[:, None] * area

    def residual(self, curve: SampledCurve, offset: FloatArray, arms: "Arms") -> FloatArray:
        """Model less measured force over each site's largest force, (n_site, n_sample)."""
        scale = self.weight / self.force.max(axis=1, keepdims=True)
        return (self.force_model(curve, offset, arms) - self.force) * scale

    def with_offsets(self, curve: SampledCurve, arms: "Arms", offsets: FloatArray) -> "HeldSamples":
        """Samples with the best of the offsets [m] at each site."""
        count = len(self.depth)
        squares = [(self.residual(curve, np.full(count, offset), arms) ** 2).sum(axis=1) for offset in offsets]
        return HeldSamples(self.depth, self.force, self.time, self.weight, offsets[np.argmin(squares, axis=0)])

    def error(self, curve: SampledCurve, arms: "Arms") -> float:
        """Median |F_model - F| / F over the samples from a third of the depth on."""
        deep = (self.weight > 0.0) & (self.depth > self.depth.max(axis=1, keepdims=True) / 3.0) & (self.force > 0.0)
        model = self.force_model(curve, self.offset, arms)
        return float(np.median(np.abs(model[deep] - self.force[deep]) / self.force[deep]))


@dataclass(frozen=True)
class Arms:
    """Maxwell arms: relative moduli g_i and times tau_i [s]."""

    moduli: tuple[float, ...] = ()
    times: tuple[float, ...] = ()

    def relaxed(self, area: FloatArray, time: FloatArray) -> FloatArray:
        """A(t) + sum g_i q_i(t), q_i = int exp(-(t - s) / tau_i) dA/ds ds, for a path straight between samples.

        q_n = a q_(n-1) + (1 - a) (tau / dt) (A_n - A_(n-1)), a = exp(-dt / tau), exact for straight pieces; at first
        q = A.

        Args:
            area: A at each time, (n_site, n_sample).
            time: [s], (n_site, n_sample).
        """
        total = area.copy()
        rise = np.diff(area, axis=1)
        for modulus, tau in zip(self.moduli, self.times):
            step = np.maximum(np.diff(time, axis=1) / tau, 1e-12)
            decay, gain = np.exp(-step), -np.expm1(-step) / step * rise
            response = area[:, 0].copy()
            total[:, 0] += modulus * response
            for place in range(rise.shape[1]):
                response = decay[:, place] * response + gain[:, place]
                total[:, place + 1] += modulus * response
        return total

    @classmethod
    def of(cls, logs: FloatArray) -> "Arms":
        """Arms in the order of their times, from the logarithms of moduli and then times."""
        moduli, times = np.exp(logs).reshape(2, -1)
        order = np.argsort(times)
        return cls(tuple(moduli[order].tolist()), tuple(times[order].tolist()))


def _thinned(site: SitePress) -> np.ndarray:
    """Indices of the used samples of a site."""
    assert site.time is not None
    count, full = len(site.time), site.loading.stop - 1
    if count <= SAMPLES_MOST:
        return np.arange(count)
    loading = np.linspace(0, full, SAMPLES_MOST // 2).round()
    after = site.time[full + 1 :] - site.time[full]
    hold = full + 1 + np.searchsorted(after, np.geomspace(after[0], after[-1], SAMPLES_MOST // 2) * (1.0 - 1e-9))
    return np.unique(np.concatenate([loading, hold])).astype(np.intp)


def fit_relaxation(
    curve: SampledCurve, training: Sequence[SitePress], held_out: Sequence[SitePress], offsets: FloatArray
) -> RelaxationFit:
    """Arms of the held presses of the training sites, as many as lower the error by GAIN_LEAST each.

    Args:
        curve: of the elastic press.
        training: sites with times, to fit the arms.
        held_out: sites with times, for the error; each has its own modulus and offset.
        offsets: candidates at each site [m].
    """
    samples, others = HeldSamples.of(training), HeldSamples.of(held_out)
    pieces = np.where(samples.weight[:, 1:] > 0.0, np.diff(samples.time, axis=1), np.inf)
    shortest, longest = float(np.median(pieces.min(axis=1))), float(np.median(samples.time[:, -1]))
    best = Arms()
    before = samples.with_offsets(curve, best, offsets).error(curve, best)
    for count in range(1, ARMS_MOST + 1):
        arms = _fitted_arms(curve, samples, count, (shortest, longest), offsets)
        error = samples.with_offsets(curve, arms, offsets).error(curve, arms)
        if not error < (1.0 - GAIN_LEAST) * before:
            break
        best, before = arms, error
    return RelaxationFit(
        best.moduli,
        best.times,
        error=others.with_offsets(curve, best, offsets).error(curve, best),
        elastic_error=others.with_offsets(curve, Arms(), offsets).error(curve, Arms()),
        time_range=(shortest, longest),
    )


def _fitted_arms(
    curve: SampledCurve, samples: HeldSamples, count: int, time_range: tuple[float, float], offsets: FloatArray
) -> Arms:
    """Arms by least squares of the force, with times within the resolved range [s]."""
    shortest, longest = time_range
    logs = np.log(np.concatenate([np.full(count, 0.3), np.geomspace(shortest, longest, count + 2)[1:-1]]))
    low = np.log(np.repeat([MODULUS_LEAST, shortest], count))
    high = np.log(np.repeat([MODULUS_MOST, 2.0 * longest], count))
    for _ in range(ROUNDS):
        placed = samples.with_offsets(curve, Arms.of(logs), offsets)
        logs = least_squares(
            lambda logs, placed=placed: placed.residual(curve, placed.offset, Arms.of(logs)).ravel(),
            np.clip(logs, low + 1e-6, high - 1e-6),
            bounds=(low, high),
            x_scale="jac",
            max_nfev=60,
        ).x
    return Arms.of(logs)
