"""The shape that all sites share, thickness and law: searched among runs of the forward model, with intervals.

Some dozens of presses, spread evenly over the range of shapes, are interpolated (radial basis functions); the best
shapes found so far are then pressed themselves and join them, so that the result is a run of the organ and not an
interpolation.
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.optimize import minimize
from scipy.stats import qmc

from msdm_core.mesh import FloatArray
from surgsim_apps.identify.press_model import PressCurve, PressSetting, PressShape, press_block
from surgsim_apps.identify.site_fit import GRID_COUNT, SampledCurve, SiteSamples, fit_sites
from surgsim_env.coupling import core_count

# Ranges that are searched: thickness in radii of the ball, onset strain, cap strain less onset strain, tangent cap.
THICKNESS_RADII = (1.2, 4.5)
ONSET_RANGE, WIDTH_RANGE, CAP_RANGE = (0.0, 0.2), (0.05, 0.25), (2.0, 80.0)
# Presses that are spread over all four; over the law alone, of a given thickness; linear ones of each kind.
SPREAD_COUNT, SPREAD_COUNT_LAW, LINEAR_COUNT = 56, 32, 6
# Rounds in which the best shapes are pressed themselves, and how many in each.
ROUNDS, ROUND_COUNT = 3, 4
# Distance between the best shapes that are pressed, in the unit box of shapes.
APART = 0.25
# Shapes that are looked at by interpolation.
LOOKED_AT = 768
# Training sites that choose the shape at most.
TRAINING_MOST = 160
# Sites count towards a shape's cost up to this quantile of their errors: a few bad ones do not choose it.
TRIM = 0.85
# A profile: values of one parameter over its range, at each of which the others are fitted anew; its interval holds
# those at which the sites' errors are not larger than at the best shape, paired by site, at this many standard errors
# (one-sided, 5 %).
PROFILE_COUNT, PROFILE_LOOKS, STANDARD_ERRORS = 9, 96, 1.645
# A parameter is not told by the data where its interval covers more than this share of the range searched.
UNTOLD_SHARE = 0.5

NAMES = ("thickness", "onset_strain", "cap_strain", "tangent_cap")
Progress = Callable[[], None]


@dataclass(frozen=True)
class ShapeSpace:
    """The box of shapes that is searched; points of it are in 0 to 1, logarithmic in thickness and cap.

    Fields:
        ball_radius: [m]
        depth: largest depth of a press [m]
        thickness: of the tissue [m] where it is known; None: searched
    """

    ball_radius: float
    depth: float
    thickness: float | None = None

    @property
    def thickness_range(self) -> tuple[float, float]:
        """Least and largest thickness that is searched [m]; tissue is thicker than the deepest press."""
        if self.thickness is not None:
            return self.thickness, self.thickness
        low, high = (radii * self.ball_radius for radii in THICKNESS_RADII)
        least = max(low, 1.7 * self.depth)
        return least, max(high, 1.5 * least)

    @property
    def dimension(self) -> int:
        """How many coordinates a point has: thickness if it is searched, onset, width and cap."""
        return 3 + (self.thickness is None)

    def shape(self, point: FloatArray) -> PressShape:
        """The shape at a point."""
        *first, onset, width, cap = point
        low, high = self.thickness_range
        thickness = low * (high / low) ** first[0] if first else low
        onset = _between(ONSET_RANGE, onset)
        least, most = CAP_RANGE
        return PressShape(thickness, onset, onset + _between(WIDTH_RANGE, width), least * (most / least) ** cap)

    def linear(self, place: float) -> PressShape:
        """The linear tissue at a place from 0 to 1 of the range of thickness."""
        low, high = self.thickness_range
        return PressShape(low * (high / low) ** place)


def _between(bounds: tuple[float, float], share: float) -> float:
    return bounds[0] + share * (bounds[1] - bounds[0])


@dataclass(eq=False)
class PressLibrary:
    """Runs of the forward model, kept for the length of a command; two sets with one ball share them.

    Fields:
        space: the shapes that are searched
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
        """Presses of `start`."""
        linear = 1 if self.space.thickness is not None else LINEAR_COUNT
        return linear + (SPREAD_COUNT if self.space.thickness is None else SPREAD_COUNT_LAW)

    def start(self, progress: Progress = lambda: None) -> None:
        """Press linear tissue of some thicknesses, and shapes spread over the whole range."""
        places = [0.0] if self.space.thickness is not None else np.linspace(0.0, 1.0, LINEAR_COUNT).tolist()
        count = self.start_count - len(places)
        # `rng`, which the stubs know alone, gives other points for the same number.
        spread = qmc.Sobol(self.space.dimension, seed=1).random(64)[:count]  # pyright: ignore[reportCallIssue]
        for place, found in zip(places, self.press([self.space.linear(one) for one in places], progress)):
            if isinstance(found, PressCurve):
                self.linear_places.append(place)
                self.linear_curves.append(found)
        if not self.linear_curves:
            raise ValueError(f"no press of linear tissue succeeds: {self.failed[0]}")
        self.add(list(spread), progress)

    def add(self, points: Sequence[FloatArray], progress: Progress = lambda: None) -> None:
        """Press the shapes at these points; those at which the press fails are remembered as failed."""
        for point, found in zip(points, self.press([self.space.shape(point) for point in points], progress)):
            if isinstance(found, PressCurve):
                self.points.append(np.asarray(point))
                self.curves.append(found)

    def press(self, shapes: Sequence[PressShape], progress: Progress = lambda: None) -> list[PressCurve | None]:
        """A curve for each shape, None where the press fails."""
        found: list[PressCurve | None] = [None] * len(shapes)
        with ThreadPoolExecutor(core_count()) as pool:
            asked = {pool.submit(press_block, shape, self.setting): place for place, shape in enumerate(shapes)}
            try:
                for done in as_completed(asked):
                    try:
                        found[asked[done]] = done.result()
                    except ValueError as error:
                        self.failed.append(str(error))
                    progress()
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
        return found

    def sampled(self, curve: PressCurve) -> SampledCurve:
        """A run on even depths."""
        return SampledCurve(self.setting.depth, curve.at(np.linspace(0.0, self.setting.depth, GRID_COUNT)) ** (2 / 3))

    def interpolated(self, points: FloatArray) -> list[SampledCurve]:
        """Curves at points, interpolated between all runs."""
        if self._fitted is None or self._fitted[0] != len(self.points):
            self._fitted = len(self.points), self._interpolator()
        return [
            SampledCurve(self.setting.depth, np.maximum(row, 0.0)) for row in self._fitted[1](np.atleast_2d(points))
        ]

    def _interpolator(self) -> RBFInterpolator:
        """Thin-plate splines through all runs; linear ones stand at cap 1, below the range of caps."""
        below = -math.log(CAP_RANGE[0]) / math.log(CAP_RANGE[1] / CAP_RANGE[0])
        known, values = list(self.points), [self.sampled(curve).root for curve in self.curves]
        for place, curve in zip(self.linear_places, self.linear_curves):
            first = [place] if self.space.thickness is None else []
            # The linear law is the same at any onset and width.
            for onset, width in ((0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)):
                known.append(np.array([*first, onset, width, below]))
                values.append(self.sampled(curve).root)
        return RBFInterpolator(np.array(known), np.array(values), kernel="thin_plate_spline", degree=1)


@dataclass(frozen=True)
class Interval:
    """A fitted value, the interval of values that describe the sites as well, and whether the data tell the value."""

    value: float
    low: float
    high: float
    told: bool


@dataclass(frozen=True, eq=False)
class FoundShape:
    """The best shape, its run of the organ, and how well the training sites tell it.

    Fields:
        shape, curve: thickness and law, and its run
        intervals: of each parameter that was searched, by its name
        training_count: sites that chose the shape
        cost: mean error of the training sites but the worst
        press_count: runs of the forward model so far
    """

    shape: PressShape
    curve: SampledCurve
    intervals: dict[str, Interval]
    training_count: int
    cost: float
    press_count: int


def trimmed_mean(errors: FloatArray) -> FloatArray:
    """Mean of the lowest TRIM of the errors of sites, along the last axis."""
    kept = max(1, math.ceil(TRIM * errors.shape[-1]))
    return np.sort(errors, axis=-1)[..., :kept].mean(axis=-1)


def site_errors(curves: Sequence[SampledCurve], samples: Sequence[SiteSamples]) -> FloatArray:
    """Error of each site of all sets for each curve, (n_curve, n_site)."""
    return np.array(
        [np.concatenate([fit_sites(curve, part, refine=False).site_errors for part in samples]) for curve in curves]
    )


def find_linear(library: PressLibrary, samples: Sequence[SiteSamples]) -> tuple[PressShape, SampledCurve]:
    """The thickness at which linear tissue fits the training sites best, among the linear runs."""
    curves = [library.sampled(curve) for curve in library.linear_curves]
    best = int(trimmed_mean(site_errors(curves, samples)).argmin())
    return library.space.linear(library.linear_places[best]), curves[best]


def find_shape(
    library: PressLibrary, samples: Sequence[SiteSamples], *, seed: int = 0, progress: Progress = lambda: None
) -> FoundShape:
    """The shape that describes the training sites of one or more sets best; every site has its modulus and offset.

    Args:
        library: with its spread of runs; the best shapes are pressed and added to it.
        samples: training sites of each set.
        seed: of the choice among very many sites and of the bootstrap.
        progress: called after each press.
    """
    rng = np.random.default_rng(seed)
    parts = [_at_most(part, TRAINING_MOST // len(samples), rng) for part in samples]
    sobol = qmc.Sobol(library.space.dimension, seed=2)  # pyright: ignore[reportCallIssue]
    looked_at = sobol.random(1024)[:LOOKED_AT]
    for _ in range(ROUNDS):
        costs = trimmed_mean(site_errors(library.interpolated(looked_at), parts))
        starts = looked_at[_apart(looked_at, costs, ROUND_COUNT)]
        library.add([_descended(library, parts, start) for start in starts], progress)
    errors = site_errors([library.sampled(curve) for curve in library.curves], parts)
    best = int(trimmed_mean(errors).argmin())
    shape = library.space.shape(library.points[best])
    return FoundShape(
        shape=shape,
        curve=library.sampled(library.curves[best]),
        intervals=_intervals(library, parts, best, looked_at),
        training_count=errors.shape[1],
        cost=float(trimmed_mean(errors)[best]),
        press_count=len(library.curves) + len(library.linear_curves) + len(library.failed),
    )


def _at_most(part: SiteSamples, count: int, rng: np.random.Generator) -> SiteSamples:
    if len(part) <= count:
        return part
    return part.subset(np.sort(rng.choice(len(part), count, replace=False)))


def _apart(points: FloatArray, costs: FloatArray, count: int) -> list[int]:
    """The best points that are farther than APART from each other."""
    chosen: list[int] = []
    for place in np.argsort(costs):
        if all(np.linalg.norm(points[place] - points[other]) > APART for other in chosen):
            chosen.append(int(place))
            if len(chosen) == count:
                break
    return chosen


def _descended(library: PressLibrary, parts: Sequence[SiteSamples], start: FloatArray) -> FloatArray:
    """The best point near a start, by interpolated curves."""

    def cost(point: FloatArray) -> float:
        inside = np.clip(point, 0.0, 1.0)
        outside = float(np.abs(point - inside).sum())
        return float(trimmed_mean(site_errors(library.interpolated(inside), parts))[0]) + outside

    steps = np.vstack([start, start + 0.1 * np.where(start > 0.5, -1.0, 1.0) * np.eye(len(start))])
    found = minimize(cost, start, method="Nelder-Mead", options={"maxfev": 60, "initial_simplex": steps})
    return np.clip(found.x, 0.0, 1.0)


def _intervals(
    library: PressLibrary, parts: Sequence[SiteSamples], best: int, looked_at: FloatArray
) -> dict[str, Interval]:
    """Profile of each parameter by interpolated curves, and the interval in which the sites' errors stay as small."""
    space, point = library.space, library.points[best]
    reference = site_errors(library.interpolated(point), parts)[0]
    grid = np.linspace(0.0, 1.0, PROFILE_COUNT)
    accepted = [point]
    for axis in range(space.dimension):
        for value in grid:
            nearest = looked_at[np.argsort(np.abs(looked_at[:, axis] - value))[:PROFILE_LOOKS]]
            # Points of the spread nearest to the value, and points around the best shape.
            tried = np.concatenate([[point], nearest, np.clip(point + 0.3 * (nearest - 0.5), 0.0, 1.0)])
            tried[:, axis] = value
            errors = site_errors(library.interpolated(tried), parts)
            chosen = int(trimmed_mean(errors).argmin())
            difference = errors[chosen] - reference
            scatter = difference.std(ddof=1) / math.sqrt(len(difference)) if len(difference) > 1 else math.inf
            if difference.mean() <= STANDARD_ERRORS * scatter:
                accepted.append(tried[chosen])
    shapes = [space.shape(one) for one in accepted]
    intervals = {}
    for name in NAMES[len(NAMES) - space.dimension :]:
        values = [float(getattr(one, name)) for one in shapes]
        least, most = (float(getattr(space.shape(np.full(space.dimension, end)), name)) for end in (0.0, 1.0))
        if name in ("thickness", "tangent_cap"):
            share = math.log(max(values) / min(values)) / math.log(most / least)
        else:
            share = (max(values) - min(values)) / (most - least)
        intervals[name] = Interval(values[0], min(values), max(values), share <= UNTOLD_SHARE)
    return intervals
