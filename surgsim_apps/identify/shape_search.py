"""Search for the common shape of all sites, thickness and law, among runs of the forward model, with intervals.

Dozens of presses spread over the range of shapes are interpolated (radial basis functions); the best shapes are then
pressed themselves and join them: the result is a run of the organ, not an interpolation.
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import PchipInterpolator, RBFInterpolator
from scipy.optimize import minimize
from scipy.stats import qmc

from msdm_core.mesh import FloatArray
from surgsim_apps.identify.press_model import PressCurve, PressSetting, PressShape, press_block
from surgsim_apps.identify.site_fit import GRID_COUNT, SampledCurve, SiteSamples, fit_sites
from surgsim_env.coupling import core_count

# Searched ranges: thickness in radii of the ball, onset strain, cap strain less onset strain, tangent cap.
THICKNESS_RADII = (1.2, 4.5)
ONSET_RANGE, WIDTH_RANGE, CAP_RANGE = (0.0, 0.2), (0.05, 0.25), (2.0, 80.0)
# Least thickness over the largest depth of a press with a law, and of linear tissue, whose presses succeed in thinner
# tissue: thickness is all that makes it stiffen, and the law is compared with the best.
DEPTH_SHARE, DEPTH_SHARE_LINEAR = 1.7, 1.3
# Presses spread over all four; over the law alone, for a given thickness; linear presses.
SPREAD_COUNT, SPREAD_COUNT_LAW, LINEAR_COUNT = 56, 32, 8
# Thicknesses between the linear presses at which their interpolation is compared.
LINEAR_GRID_COUNT = 61
# Rounds of presses of the best shapes, and their number in each.
ROUNDS, ROUND_COUNT = 3, 4
# Least distance between the best shapes, in the unit box of shapes.
APART = 0.25
# Candidate shapes of the interpolation.
CANDIDATES = 768
# Most training sites of a search.
TRAINING_MOST = 160
# Quantile of the sites' errors in a shape's cost: a few bad sites have no say.
TRIM = 0.85
# Profile of a parameter: values over its range with the others fitted anew, and candidates at each. Its interval holds
# the values whose sites' errors exceed those of the best shape by at most this many standard errors, paired by site
# (one-sided, 5 %).
PROFILE_COUNT, PROFILE_CANDIDATES, STANDARD_ERRORS = 9, 96, 1.645
# A parameter is identifiable up to this share of its interval in the searched range.
IDENTIFIABLE_SHARE = 0.5

NAMES = ("thickness", "onset_strain", "cap_strain", "tangent_cap")
Progress = Callable[[], None]


@dataclass(frozen=True)
class ShapeSpace:
    """Searched box of shapes; its points are in 0 to 1, logarithmic in thickness and cap.

    Fields:
        ball_radius: [m]
        depth: largest depth of a press [m]
        thickness: of the tissue [m]; None: searched
    """

    ball_radius: float
    depth: float
    thickness: float | None = None

    @property
    def thickness_range(self) -> tuple[float, float]:
        """Least and largest searched thickness of tissue with a law [m], above the deepest press."""
        if self.thickness is not None:
            return self.thickness, self.thickness
        low, high = (radii * self.ball_radius for radii in THICKNESS_RADII)
        least = max(low, DEPTH_SHARE * self.depth)
        return least, max(high, 1.5 * least)

    @property
    def dimension(self) -> int:
        """Number of coordinates of a point: thickness if searched, onset, width and cap."""
        return 3 + (self.thickness is None)

    def shape(self, point: FloatArray) -> PressShape:
        """Shape at a point."""
        *first, onset, width, cap = point
        low, high = self.thickness_range
        thickness = low * (high / low) ** first[0] if first else low
        onset = _between(ONSET_RANGE, onset)
        least, most = CAP_RANGE
        return PressShape(thickness, onset, onset + _between(WIDTH_RANGE, width), least * (most / least) ** cap)

    @property
    def linear_least(self) -> float:
        """Place of the thinnest linear tissue, at most 0."""
        low, high = self.thickness_range
        if self.thickness is not None:
            return 0.0
        return min(0.0, math.log(DEPTH_SHARE_LINEAR * self.depth / low) / math.log(high / low))

    def linear(self, place: float) -> PressShape:
        """Linear tissue at a place from `linear_least` to 1 of the range of thickness, logarithmic."""
        low, high = self.thickness_range
        return PressShape(low * (high / low) ** place)


def _between(bounds: tuple[float, float], share: float) -> float:
    return bounds[0] + share * (bounds[1] - bounds[0])


@dataclass(eq=False)
class PressLibrary:
    """Runs of the forward model, shared by sets with a common ball.

    Fields:
        space: searched shapes
        setting: of the presses
    """

    space: ShapeSpace
    setting: PressSetting
    points: list[FloatArray] = field(default_factory=list)
    curves: list[PressCurve] = field(default_factory=list)
    linear_places: list[float] = field(default_factory=list)
    linear_curves: list[PressCurve] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    _fitted: tuple[int, RBFInterpolator] | None = None

    @property
    def start_count(self) -> int:
        """Number of presses of `start`."""
        linear = 1 if self.space.thickness is not None else LINEAR_COUNT
        return linear + (SPREAD_COUNT if self.space.thickness is None else SPREAD_COUNT_LAW)

    def start(self, progress: Progress = lambda: None) -> None:
        """Press linear tissue of some thicknesses, and shapes spread over the whole range."""
        places = (
            np.linspace(self.space.linear_least, 1.0, LINEAR_COUNT).tolist() if self.space.thickness is None else [0.0]
        )
        count = self.start_count - len(places)
        # The stubs know only `rng`, which gives other points for the same number.
        spread = qmc.Sobol(self.space.dimension, seed=1).random(64)[:count]  # pyright: ignore[reportCallIssue]
        self.add_linear(places, progress)
        if not self.linear_curves:
            raise ValueError(f"no press of linear tissue succeeds: {self.failed[0]}")
        self.add(list(spread), progress)

    def add_linear(self, places: Sequence[float], progress: Progress = lambda: None) -> None:
        """Press linear tissue at places of the range of thickness; failures are recorded."""
        for place, curve in zip(places, self.press([self.space.linear(place) for place in places], progress)):
            if curve is not None:
                self.linear_places.append(place)
                self.linear_curves.append(curve)

    def add(self, points: Sequence[FloatArray], progress: Progress = lambda: None) -> None:
        """Press the shapes at points; failures are recorded."""
        for point, curve in zip(points, self.press([self.space.shape(point) for point in points], progress)):
            if curve is not None:
                self.points.append(np.asarray(point))
                self.curves.append(curve)

    def press(self, shapes: Sequence[PressShape], progress: Progress = lambda: None) -> list[PressCurve | None]:
        """Curve of each shape, None for a failed press."""
        curves: list[PressCurve | None] = [None] * len(shapes)
        with ThreadPoolExecutor(core_count()) as pool:
            futures = {pool.submit(press_block, shape, self.setting): place for place, shape in enumerate(shapes)}
            try:
                for future in as_completed(futures):
                    try:
                        curves[futures[future]] = future.result()
                    except ValueError as error:
                        self.failed.append(str(error))
                    progress()
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
        return curves

    def sampled(self, curve: PressCurve) -> SampledCurve:
        """Run on even depths."""
        return SampledCurve(self.setting.depth, curve.at(np.linspace(0.0, self.setting.depth, GRID_COUNT)) ** (2 / 3))

    def interpolated(self, points: FloatArray) -> list[SampledCurve]:
        """Curves at points, interpolated between all runs."""
        if self._fitted is None or self._fitted[0] != len(self.points):
            self._fitted = len(self.points), self._interpolator()
        roots = np.maximum(self._fitted[1](np.atleast_2d(points)), 0.0)
        return [SampledCurve(self.setting.depth, root) for root in roots]

    def _interpolator(self) -> RBFInterpolator:
        """Thin-plate splines through all runs; linear runs have a cap of 1, below the range."""
        below = -math.log(CAP_RANGE[0]) / math.log(CAP_RANGE[1] / CAP_RANGE[0])
        points, values = list(self.points), [self.sampled(curve).root for curve in self.curves]
        for place, curve in zip(self.linear_places, self.linear_curves):
            first = [place] if self.space.thickness is None else []
            # The linear law is the same at any onset and width.
            for onset, width in ((0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)):
                points.append(np.array([*first, onset, width, below]))
                values.append(self.sampled(curve).root)
        return RBFInterpolator(np.array(points), np.array(values), kernel="thin_plate_spline", degree=1)


@dataclass(frozen=True)
class Interval:
    """Fitted value, interval of values that describe the sites as well, and true for an identifiable parameter."""

    value: float
    low: float
    high: float
    is_identifiable: bool


@dataclass(frozen=True, eq=False)
class ShapeFit:
    """Best shape, its run of the organ, and its intervals.

    Fields:
        shape, press, curve: thickness and law, its run, and the run on even depths
        intervals: of each searched parameter, by its name
        training_count: number of training sites in the search
        cost: mean error of the training sites but the worst
        press_count: runs of the forward model so far
    """

    shape: PressShape
    press: PressCurve
    curve: SampledCurve
    intervals: dict[str, Interval]
    training_count: int
    cost: float
    press_count: int


def trimmed_mean(errors: FloatArray) -> FloatArray:
    """Mean of the lowest TRIM of the errors of sites, along the last axis."""
    kept = max(1, math.ceil(TRIM * errors.shape[-1]))
    return np.sort(errors, axis=-1)[..., :kept].mean(axis=-1)


def site_errors(curves: Sequence[SampledCurve], samples: Sequence[SiteSamples], *, refine: bool = False) -> FloatArray:
    """Error of each site of all sets for each curve, (n_curve, n_site)."""
    return np.array(
        [np.concatenate([fit_sites(curve, part, refine=refine).site_errors for part in samples]) for curve in curves]
    )


def find_linear(
    library: PressLibrary, samples: Sequence[SiteSamples], progress: Progress = lambda: None
) -> tuple[PressShape, PressCurve]:
    """Linear tissue that fits the training sites best, of the linear runs and one where their interpolation fits best.

    Args:
        library: with linear runs; the new one joins them.
        samples: training sites of each set.
        progress: called once.
    """
    grid = np.linspace(min(library.linear_places), 1.0, LINEAR_GRID_COUNT)
    if len(library.linear_places) > 1:
        order = np.argsort(library.linear_places)
        roots = np.array([library.sampled(library.linear_curves[run]).root for run in order])
        between = PchipInterpolator(np.array(library.linear_places)[order], roots)(grid)
        curves = [SampledCurve(library.setting.depth, root) for root in between]
        place = float(grid[trimmed_mean(site_errors(curves, samples)).argmin()])
        if np.abs(np.array(library.linear_places) - place).min() > grid[1] - grid[0]:
            library.add_linear([place])
    progress()
    costs = trimmed_mean(site_errors([library.sampled(curve) for curve in library.linear_curves], samples))
    best = int(costs.argmin())
    return library.space.linear(library.linear_places[best]), library.linear_curves[best]


def find_shape(
    library: PressLibrary, samples: Sequence[SiteSamples], *, seed: int = 0, progress: Progress = lambda: None
) -> ShapeFit:
    """Shape that fits the training sites of one or more sets best, with modulus and offset of each site.

    Args:
        library: with spread runs; the best shapes are pressed and added to it.
        samples: training sites of each set.
        seed: of the choice among many sites.
        progress: called after each press.
    """
    rng = np.random.default_rng(seed)
    parts = [_at_most(part, TRAINING_MOST // len(samples), rng) for part in samples]
    sobol = qmc.Sobol(library.space.dimension, seed=2)  # pyright: ignore[reportCallIssue]
    candidates = sobol.random(1024)[:CANDIDATES]
    for _ in range(ROUNDS):
        costs = trimmed_mean(site_errors(library.interpolated(candidates), parts))
        starts = candidates[_apart(candidates, costs, ROUND_COUNT)]
        library.add([_descended(library, parts, start) for start in starts], progress)
    errors = site_errors([library.sampled(curve) for curve in library.curves], parts)
    best = int(trimmed_mean(errors).argmin())
    shape = library.space.shape(library.points[best])
    return ShapeFit(
        shape=shape,
        press=library.curves[best],
        curve=library.sampled(library.curves[best]),
        intervals=_intervals(library, parts, best, candidates),
        training_count=errors.shape[1],
        cost=float(trimmed_mean(errors)[best]),
        press_count=len(library.curves) + len(library.linear_curves) + len(library.failed),
    )


def _at_most(part: SiteSamples, count: int, rng: np.random.Generator) -> SiteSamples:
    if len(part) <= count:
        return part
    return part.subset(np.sort(rng.choice(len(part), count, replace=False)))


def _apart(points: FloatArray, costs: FloatArray, count: int) -> list[int]:
    """Best points farther than APART from each other."""
    chosen: list[int] = []
    for place in np.argsort(costs):
        if all(np.linalg.norm(points[place] - points[other]) > APART for other in chosen):
            chosen.append(int(place))
            if len(chosen) == count:
                break
    return chosen


def _descended(library: PressLibrary, parts: Sequence[SiteSamples], start: FloatArray) -> FloatArray:
    """Best point near a start, by interpolated curves."""

    def cost(point: FloatArray) -> float:
        inside = np.clip(point, 0.0, 1.0)
        outside = float(np.abs(point - inside).sum())
        return float(trimmed_mean(site_errors(library.interpolated(inside), parts))[0]) + outside

    steps = np.vstack([start, start + 0.1 * np.where(start > 0.5, -1.0, 1.0) * np.eye(len(start))])
    minimum = minimize(cost, start, method="Nelder-Mead", options={"maxfev": 60, "initial_simplex": steps})
    return np.clip(minimum.x, 0.0, 1.0)


def _intervals(
    library: PressLibrary, parts: Sequence[SiteSamples], best: int, candidates: FloatArray
) -> dict[str, Interval]:
    """Interval of each parameter by its profile over interpolated curves."""
    space, point = library.space, library.points[best]
    reference = site_errors(library.interpolated(point), parts)[0]
    grid = np.linspace(0.0, 1.0, PROFILE_COUNT)
    accepted = [point]
    for axis in range(space.dimension):
        for value in grid:
            nearest = candidates[np.argsort(np.abs(candidates[:, axis] - value))[:PROFILE_CANDIDATES]]
            # Candidates nearest to the value, and points around the best shape.
            points = np.concatenate([[point], nearest, np.clip(point + 0.3 * (nearest - 0.5), 0.0, 1.0)])
            points[:, axis] = value
            errors = site_errors(library.interpolated(points), parts)
            chosen = int(trimmed_mean(errors).argmin())
            difference = errors[chosen] - reference
            scatter = difference.std(ddof=1) / math.sqrt(len(difference)) if len(difference) > 1 else math.inf
            if difference.mean() <= STANDARD_ERRORS * scatter:
                accepted.append(points[chosen])
    shapes = [space.shape(point) for point in accepted]
    intervals = {}
    for name in NAMES[len(NAMES) - space.dimension :]:
        values = [float(getattr(shape, name)) for shape in shapes]
        least, most = (float(getattr(space.shape(np.full(space.dimension, end)), name)) for end in (0.0, 1.0))
        if name in ("thickness", "tangent_cap"):
            share = math.log(max(values) / min(values)) / math.log(most / least)
        else:
            share = (max(values) - min(values)) / (most - least)
        intervals[name] = Interval(values[0], min(values), max(values), share <= IDENTIFIABLE_SHARE)
    return intervals
