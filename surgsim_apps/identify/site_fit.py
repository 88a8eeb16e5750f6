"""Fit of modulus and contact offset to each site, and the error of all reports.

A recording's depth counts from a declared contact at a small force, an unknown offset deep. The force at a site is
E A(d + o), with the curve A of `press_model`, modulus E and offset o, both by least squares of the force, as a sensor's
noise is the same at every depth. The error is |F_model - F| / F over the deeper two thirds of the press.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray
from surgsim_apps.identify.recordings import SitePress

# Least depth of samples in the error, over the site's largest depth.
SHALLOW_SHARE = 1.0 / 3.0
# Largest candidate of the offset over the set's largest depth, and number of candidates.
OFFSET_SHARE, OFFSET_COUNT = 0.5, 46
# Fewest samples of a usable site in its deeper two thirds.
DEEP_COUNT_LEAST = 4
# Least and largest depth of a usable site over the set's median, and least rise of its force from a third of it on.
DEPTH_SHARE_LEAST, DEPTH_SHARE_MOST, RISE_LEAST = 0.6, 1.5, 1.2
# Least depth of a usable site over the ball's radius: depths in metres are below, as the model's are at most 1.2 radii.
BALL_SHARE_LEAST = 0.01
# Ranges of a usable site: Hertz' modulus of its deepest sample [Pa], from slime to cartilage and ten times beyond;
# duration [s], up to a day of holding.
MODULUS_RANGE, DURATION_RANGE = (1.0, 1e9), (1e-3, 1e5)
# Depths of a sampled curve, straight in (F / E)^(2/3) between them.
GRID_COUNT = 181


@dataclass(frozen=True, eq=False)
class SampledCurve:
    """Force over modulus on depths in even steps from 0 to `depth` [m]; `root` is its power 2/3 [m^(4/3)]."""

    depth: float
    root: FloatArray

    def at(self, depth: FloatArray) -> FloatArray:
        """Force over modulus [m^2]; 0 above the surface."""
        place = np.clip(depth / self.depth, 0.0, 1.0) * (len(self.root) - 1)
        lower = np.minimum(place.astype(np.intp), len(self.root) - 2)
        share = place - lower
        return (self.root[lower] * (1.0 - share) + self.root[lower + 1] * share) ** 1.5


@dataclass(frozen=True, eq=False)
class SiteSamples:
    """Loading of the usable sites of a set, in rows of equal length, padded by samples of weight 0.

    Fields:
        sites: the presses
        depth: [m], (n_site, n_sample)
        force: [N], (n_site, n_sample)
        weight: 1 for a sample, else 0, (n_site, n_sample)
        deep: true for samples in the error, (n_site, n_sample)
        offsets: candidates [m], (n_offset,)
    """

    sites: tuple[SitePress, ...]
    depth: FloatArray
    force: FloatArray
    weight: FloatArray
    deep: np.ndarray
    offsets: FloatArray

    @classmethod
    def of(cls, sites: Sequence[SitePress], offset_largest: float) -> "SiteSamples":
        """Samples of sites, with candidate offsets from 0 to the largest [m]."""
        loading = [(site.depth[site.loading], site.force[site.loading]) for site in sites]
        count = max(len(depth) for depth, _ in loading)
        depth, force, weight = (np.zeros((len(sites), count)) for _ in range(3))
        for row, (site_depth, site_force) in enumerate(loading):
            filled = slice(len(site_depth))
            depth[row, filled], force[row, filled], weight[row, filled] = site_depth, site_force, 1.0
        deep = (weight > 0.0) & (depth > SHALLOW_SHARE * depth.max(axis=1, keepdims=True)) & (force > 0.0)
        return cls(tuple(sites), depth, force, weight, deep, np.linspace(0.0, offset_largest, OFFSET_COUNT))

    def __len__(self) -> int:
        return len(self.sites)

    def subset(self, rows: NDArray[np.int64]) -> "SiteSamples":
        """Samples of a part of the sites."""
        return SiteSamples(
            tuple(self.sites[row] for row in rows),
            self.depth[rows], self.force[rows], self.weight[rows], self.deep[rows], self.offsets,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class SiteFits:
    """Fitted modulus [Pa] and offset [m] of each site, (n_site,), and the model's force [N], (n_site, n_sample)."""

    samples: SiteSamples
    modulus: FloatArray
    offset: FloatArray
    force: FloatArray

    @property
    def deep_errors(self) -> FloatArray:
        """|F_model - F| / F of all samples in the deeper two thirds of their presses."""
        deep = self.samples.deep
        return np.abs(self.force[deep] - self.samples.force[deep]) / self.samples.force[deep]

    @property
    def site_errors(self) -> FloatArray:
        """Median of `deep_errors` at each site, (n_site,)."""
        deep = self.samples.deep
        ordered = np.sort(
            np.where(deep, np.abs(self.force - self.samples.force) / np.where(deep, self.samples.force, 1.0), np.inf),
            axis=1,
        )
        count, rows = deep.sum(axis=1), np.arange(len(deep))
        return 0.5 * (ordered[rows, (count - 1) // 2] + ordered[rows, count // 2])


def fit_sites(curve: SampledCurve, samples: SiteSamples, *, refine: bool = True) -> SiteFits:
    """Modulus and offset of each site by least squares of the force.

    The modulus is E = sum(A F) / sum(A^2) for a given offset; the offset is the best candidate, refined by a parabola
    through its neighbours if `refine`.
    """
    offsets = np.broadcast_to(samples.offsets, (len(samples), len(samples.offsets)))
    modulus, square = _best_modulus(curve, samples, offsets)
    best = square.argmin(axis=1)
    rows = np.arange(len(samples))
    offset = offsets[rows, best]
    if refine and len(samples.offsets) > 2:
        step = samples.offsets[1] - samples.offsets[0]
        middle = np.clip(best, 1, len(samples.offsets) - 2)
        low, mid, high = (square[rows, middle + shift] for shift in (-1, 0, 1))
        curvature = low - 2.0 * mid + high
        with np.errstate(divide="ignore", invalid="ignore"):
            shift = np.where(curvature > 0.0, 0.5 * (low - high) / curvature, 0.0)
        refined = np.clip(samples.offsets[middle] + step * np.clip(shift, -1.0, 1.0), 0.0, samples.offsets[-1])
        tried = np.stack([offset, refined], axis=1)
        modulus, square = _best_modulus(curve, samples, tried)
        best = square.argmin(axis=1)
        offset = tried[rows, best]
    modulus = modulus[rows, best]
    force = modulus[:, None] * curve.at(samples.depth + offset[:, None])
    return SiteFits(samples, modulus, offset, np.where(samples.weight > 0.0, force, 0.0))


def _best_modulus(curve: SampledCurve, samples: SiteSamples, offsets: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Modulus and sum of squares for each site and offset, (n_site, n_offset) each."""
    area = curve.at(samples.depth[:, None, :] + offsets[:, :, None]) * samples.weight[:, None, :]
    across = np.einsum("sok,sk->so", area, samples.force * samples.weight)
    own = np.einsum("sok,sok->so", area, area)
    with np.errstate(divide="ignore", invalid="ignore"):
        modulus = np.where(own > 0.0, across / own, 0.0)
    return modulus, np.einsum("sk,sk->s", samples.force**2, samples.weight)[:, None] - modulus * across


def sort_out(sites: Sequence[SitePress], ball_radius: float) -> tuple[list[SitePress], dict[str, list[int]]]:
    """Usable sites of a ball [m], and numbers of the others by reason; judged without a model."""
    usual = float(np.median([site.depth.max() for site in sites]))
    usable: list[SitePress] = []
    left_out: dict[str, list[int]] = {}
    for site in sites:
        reason = _fault(site, usual, ball_radius)
        if reason:
            left_out.setdefault(reason, []).append(site.site)
        else:
            usable.append(site)
    return usable, left_out


def _fault(site: SitePress, usual: float, ball_radius: float) -> str:
    """Fault of a site; empty for a usable site."""
    deepest = float(site.depth.max())
    if not deepest >= BALL_SHARE_LEAST * ball_radius:
        return f"a depth below {BALL_SHARE_LEAST:.0%} of the ball's radius: are these metres, not mm?"
    if not deepest <= DEPTH_SHARE_MOST * usual:
        return f"deeper than {DEPTH_SHARE_MOST:.0%} of the set's median"
    depth, force = site.depth[site.loading], site.force[site.loading]
    deepest = float(depth.max())
    if deepest < DEPTH_SHARE_LEAST * usual:
        return f"less deep than {DEPTH_SHARE_LEAST:.0%} of the set's median"
    deep = depth > SHALLOW_SHARE * deepest
    if deep.sum() < DEEP_COUNT_LEAST:
        return f"fewer than {DEEP_COUNT_LEAST} samples in the deeper two thirds"
    if not (force[deep] > 0.0).all():
        return "a force that is not above 0 in the deeper two thirds"
    modulus = 0.75 * force[-1] / (math.sqrt(ball_radius) * deepest**1.5)
    if not MODULUS_RANGE[0] <= modulus <= MODULUS_RANGE[1]:
        return f"a modulus (Hertz) outside {MODULUS_RANGE[0]:g} to {MODULUS_RANGE[1]:g} Pa: are the forces newtons?"
    if site.time is not None and not DURATION_RANGE[0] <= site.time[-1] - site.time[0] <= DURATION_RANGE[1]:
        return f"a duration outside {DURATION_RANGE[0]:g} to {DURATION_RANGE[1]:g} s: are the times seconds?"
    if force[-1] < RISE_LEAST * force[deep][0]:
        return f"force that rises by less than {RISE_LEAST:g} times over the deeper two thirds"
    return ""


def depth_largest(sites: Sequence[SitePress]) -> float:
    """Depth of the deepest press of sites [m]; 0 for none."""
    return max((float(site.depth.max()) for site in sites), default=0.0)


def draw_halves(count: int, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of the training half and of the held-out half, by a random permutation."""
    order = np.random.default_rng(seed).permutation(count)
    return np.sort(order[: math.ceil(count / 2)]), np.sort(order[math.ceil(count / 2) :])
