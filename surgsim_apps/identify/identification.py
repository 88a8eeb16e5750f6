"""Identification of a material from recorded sets, with errors on held-out sites and warnings."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from msdm_core.mesh import FloatArray
from surgsim_apps.identify.press_model import PressCurve, PressSetting, PressShape
from surgsim_apps.identify.recordings import Recording, SitePress
from surgsim_apps.identify.relaxation import Arms, HeldSamples, RelaxationFit, fit_relaxation, held_sites
from surgsim_apps.identify.shape_search import (
    CAP_RANGE,
    ROUND_COUNT,
    ROUNDS,
    STANDARD_ERRORS,
    PressLibrary,
    ShapeFit,
    ShapeSpace,
    find_linear,
    find_shape,
    site_errors,
)
from surgsim_apps.identify.site_fit import (
    OFFSET_SHARE,
    SampledCurve,
    SiteFits,
    SiteSamples,
    depth_largest,
    draw_halves,
    fit_sites,
    sort_out,
)
from surgsim_env.step_progress import StepProgress

# Fewest usable sites of a set, of which half judge the other half.
SITES_LEAST = 6
# Poisson's ratios beside the given one.
OTHER_RATIOS = (0.40, 0.48)
# Least gain of a stiffening law, beyond its own noise, over the error of linear tissue: less is no better for any press
# within the recorded ones, and a law many times too stiff beyond them.
GAIN_LEAST = 0.1
# Fewest held presses for relaxation, in each half.
HELD_LEAST = 2


@dataclass(frozen=True)
class IdentifyOptions:
    """Known facts about the recordings, and their division.

    Args:
        ball_radius: [m].
        thickness: of the tissue on its rigid bed [m]; None: searched.
        poisson_ratio: of the tissue.
        seed: of the halves of the sites.

    Raises:
        ValueError: names the field, its value and its range.
    """

    ball_radius: float = 0.00635
    thickness: float | None = None
    poisson_ratio: float = 0.45
    seed: int = 0

    def __post_init__(self) -> None:
        PressSetting(self.ball_radius, 0.1 * self.ball_radius, self.poisson_ratio)
        if self.thickness is not None and not 0.5 * self.ball_radius <= self.thickness <= 20.0 * self.ball_radius:
            raise ValueError(
                f"thickness is {self.thickness:g} m; the rule is 0.5 to 20 radii of the ball ({self.ball_radius:g} m): "
                "give it in metres, or leave it out and it is searched"
            )


@dataclass(frozen=True)
class ForceError:
    """Error over depth on held-out sites: median and 90th percentile of |F_model - F| / F."""

    median: float
    high: float

    @classmethod
    def of(cls, errors: FloatArray) -> "ForceError":
        """Error of samples (n_sample,)."""
        return cls(float(np.median(errors)), float(np.percentile(errors, 90.0)))


@dataclass(frozen=True, eq=False)
class SetResult:
    """Result of a set.

    Fields:
        recording: the set
        left_out: unusable sites, by reason
        kept_in: error with these sites kept in, the fitted half counted as the held-out half; only for reasons with
            samples of a force above 0
        fits: modulus, offset and force of every usable site with the identified shape
        linear_fits: the same with the best linear tissue
        is_training: true for usable sites of the training half, (n_site,)
        error, linear_error: on the held-out sites
    """

    recording: Recording
    left_out: dict[str, list[int]]
    kept_in: dict[str, ForceError]
    fits: SiteFits
    linear_fits: SiteFits
    is_training: np.ndarray
    error: ForceError
    linear_error: ForceError


@dataclass(frozen=True)
class LawGain:
    """Mean error of the held-out sites with linear tissue and with the best law, and the gain that accepts the law.

    The error of a site is its median; the gain needed is GAIN_LEAST of the linear error and STANDARD_ERRORS standard
    errors of the gain, paired by site.
    """

    linear: float
    law: float
    needed: float

    @classmethod
    def of(cls, linear: SampledCurve, law: SampledCurve, samples: Sequence[SiteSamples]) -> "LawGain":
        """Gain of a law's curve over a linear curve on sites."""
        before, after = (site_errors([curve], samples, refine=True)[0] for curve in (linear, law))
        noise = STANDARD_ERRORS * (before - after).std(ddof=1) / math.sqrt(len(before))
        mean = float(before.mean())
        return cls(mean, float(after.mean()), GAIN_LEAST * mean + float(noise))

    @property
    def is_enough(self) -> bool:
        """True if the law is accepted."""
        return self.linear - self.law >= self.needed


@dataclass(frozen=True, eq=False)
class Identification:
    """Result of `identify`.

    Fields:
        options: as given
        sets: one per recording
        best, linear: best shape with its intervals; best linear shape
        gain: of the best law over linear tissue; not enough: the material has no stiffening
        strain_supported: largest equivalent strain that the model's tissue reaches at half of the fitted sites or more;
            0 for linear tissue
        curve, linear_curve: presses of the identified and of the linear shape
        relaxation: arms by held presses
        other_ratios: error on the training sites and factor on the modulus for other Poisson's ratios
        warnings: limits of the data and of the identification, a sentence each
        seconds: wall time
    """

    options: IdentifyOptions
    sets: tuple[SetResult, ...]
    best: ShapeFit
    linear: PressShape
    gain: LawGain
    strain_supported: float
    curve: SampledCurve
    linear_curve: SampledCurve
    relaxation: RelaxationFit | None
    other_ratios: dict[float, tuple[float, float]]
    warnings: tuple[str, ...]
    seconds: float

    @property
    def is_linear(self) -> bool:
        """True if the material has no stiffening."""
        return not self.gain.is_enough

    @property
    def shape(self) -> PressShape:
        """The identified shape."""
        return self.linear if self.is_linear else self.best.shape

    @property
    def moduli(self) -> FloatArray:
        """Moduli of all usable sites of all sets [Pa]."""
        return np.concatenate([dataset.fits.modulus for dataset in self.sets])


def make_library(recordings: Sequence[Recording], options: IdentifyOptions) -> PressLibrary:
    """Empty library of presses, deep enough for sets with their offsets."""
    usable = [sort_out(recording.presses, options.ball_radius)[0] for recording in recordings]
    depth = (1.0 + OFFSET_SHARE) * max(map(depth_largest, usable))
    if not depth > 0.0:
        # Without a usable site `identify` raises.
        depth = options.ball_radius
    setting = PressSetting(options.ball_radius, depth, options.poisson_ratio)
    return PressLibrary(ShapeSpace(options.ball_radius, depth, options.thickness), setting)


def identify(
    recordings: Sequence[Recording],
    options: IdentifyOptions = IdentifyOptions(),
    *,
    library: PressLibrary | None = None,
    console: Console | None = None,
) -> Identification:
    """Material of one or more sets, with common thickness and law, and modulus and offset of each site.

    Args:
        recordings: the sets.
        options: known facts about them.
        library: presses so far, shared by calls with the same options; default: a new one.
        console: for the progress; none by default.

    Raises:
        ValueError: a set with too few usable sites, with numbers and reasons of the others.
    """
    begin = time.perf_counter()
    library = make_library(recordings, options) if library is None else library
    sorted_sets = [sort_out(recording.presses, options.ball_radius) for recording in recordings]
    for recording, (usable, left_out) in zip(recordings, sorted_sets):
        if len(usable) < SITES_LEAST:
            reasons = "; ".join(f"{len(sites)} with {reason}" for reason, sites in left_out.items())
            raise ValueError(
                f"recording {recording.name}: {len(usable)} of {len(recording.presses)} sites can be used "
                f"({reasons or 'there are no more'}); the rule is at least {SITES_LEAST}"
            )
    starting = 0 if library.linear_curves else library.start_count
    has_holds = all(len(held_sites(usable)) >= 2 * HELD_LEAST for usable, _ in sorted_sets)
    total = starting + (2 if has_holds else 1) * (1 + ROUNDS * ROUND_COUNT) + len(OTHER_RATIOS)
    halves = [draw_halves(len(usable), options.seed) for usable, _ in sorted_sets]
    samples = [SiteSamples.of(usable, OFFSET_SHARE * depth_largest(usable)) for usable, _ in sorted_sets]
    relaxation = None
    with StepProgress(console) as progress, progress.step("pressing the model", total) as advance:

        def advance_by_one() -> None:
            advance(1)

        if starting:
            library.start(advance_by_one)
        while True:
            training, held_out = ([part.subset(rows[half]) for part, rows in zip(samples, halves)] for half in (0, 1))
            linear, linear_press = find_linear(library, training, advance_by_one)
            best = find_shape(library, training, seed=options.seed, progress=advance_by_one)
            linear_curve = library.sampled(linear_press)
            gain = LawGain.of(linear_curve, best.curve, held_out)
            shape, press, curve = (
                (best.shape, best.press, best.curve) if gain.is_enough else (linear, linear_press, linear_curve)
            )
            if not has_holds:
                break
            is_second = relaxation is not None
            relaxation = _relaxation(curve, sorted_sets, halves)
            if is_second:
                break
            # Arms also act while the ball moves: the second search uses forces without them.
            samples = _without_arms(samples, curve, relaxation)
        other_ratios = _other_ratios(library, shape, curve, training, advance_by_one)
    sets = []
    for recording, (_, left_out), part, others, (trained, _) in zip(recordings, sorted_sets, samples, held_out, halves):
        is_training = np.isin(np.arange(len(part)), trained)
        errors, linear_errors = (fit_sites(area, others).deep_errors for area in (curve, linear_curve))
        sets.append(
            SetResult(
                recording, left_out, _kept_in(recording, left_out, curve, part.offsets, errors), fit_sites(curve, part),
                fit_sites(linear_curve, part), is_training, ForceError.of(errors), ForceError.of(linear_errors),
            )
        )  # fmt: skip
    result = Identification(
        options, tuple(sets), best, linear, gain, _strain_supported(press, curve, training), curve, linear_curve,
        relaxation, other_ratios, (), time.perf_counter() - begin,
    )  # fmt: skip
    return replace(result, warnings=tuple(_warnings(result, library)))


def _strain_supported(press: PressCurve, curve: SampledCurve, training: Sequence[SiteSamples]) -> float:
    """Median over the fitted sites of the largest equivalent strain at full depth with their offsets."""
    depths = [part.depth.max(axis=1) + fit_sites(curve, part).offset for part in training]
    return float(np.median(np.interp(np.concatenate(depths), press.depth, press.strain)))


def _kept_in(
    recording: Recording,
    left_out: dict[str, list[int]],
    curve: SampledCurve,
    offsets: FloatArray,
    errors: FloatArray,
) -> dict[str, ForceError]:
    """Error with the unusable sites of each reason kept in, from the errors of the held-out samples (n_sample,)."""
    kept_in = {}
    for reason, numbers in left_out.items():
        sites = [press for press in recording.presses if press.site in numbers]
        added = fit_sites(curve, SiteSamples.of(sites, offsets[-1])).deep_errors
        if len(added):
            kept_in[reason] = ForceError.of(np.concatenate([errors, errors, added]))
    return kept_in


def _relaxation(
    curve: SampledCurve,
    sorted_sets: Sequence[tuple[list[SitePress], dict[str, list[int]]]],
    halves: Sequence[tuple[NDArray[np.int64], NDArray[np.int64]]],
) -> RelaxationFit:
    """Arms from the held presses of all sets."""
    training, held_out = (
        held_sites([usable[row] for (usable, _), rows in zip(sorted_sets, halves) for row in rows[half]])
        for half in (0, 1)
    )
    offsets = np.linspace(0.0, OFFSET_SHARE * max(depth_largest(usable) for usable, _ in sorted_sets), 31)
    return fit_relaxation(curve, training, held_out or training, offsets)


def _without_arms(samples: Sequence[SiteSamples], curve: SampledCurve, relaxation: RelaxationFit) -> list[SiteSamples]:
    """Samples with forces less the arms' part, F A / (A with arms), by a curve."""
    arms = Arms(relaxation.relative_moduli, relaxation.times)
    cleaned = []
    for part in samples:
        offset = fit_sites(curve, part).offset
        force = part.force.copy()
        for row, site in enumerate(part.sites):
            if site.time is not None:
                held = HeldSamples.of([replace(site, depth=site.depth[site.loading], force=site.force[site.loading],
                                               time=site.time[site.loading])])  # fmt: skip
                area = curve.at(held.depth + offset[row])
                relaxed = arms.relaxed(area, held.time)[0]
                share = np.divide(area[0], relaxed, out=np.ones_like(relaxed), where=relaxed > 0.0)
                times = site.time[site.loading] - site.time[0]
                force[row, : len(times)] *= np.interp(times, held.time[0], share)
        cleaned.append(replace(part, force=force))
    return cleaned


def _other_ratios(
    library: PressLibrary, shape: PressShape, curve: SampledCurve, training: Sequence[SiteSamples], advanced
) -> dict[float, tuple[float, float]]:
    """Median error on the training sites and factor on the modulus for other Poisson's ratios."""
    results = {}
    own = np.concatenate([fit_sites(curve, part).modulus for part in training])
    for ratio in OTHER_RATIOS:
        other = replace(library, setting=replace(library.setting, poisson_ratio=ratio))
        (press,) = other.press([shape], advanced)
        if isinstance(press, PressCurve):
            fits = [fit_sites(library.sampled(press), part) for part in training]
            errors = np.concatenate([fit.deep_errors for fit in fits])
            moduli = np.concatenate([fit.modulus for fit in fits])
            results[ratio] = float(np.median(errors)), float(np.median(moduli / own))
    return results


def _warnings(result: Identification, library: PressLibrary) -> list[str]:
    """Limits of the data and of the identification, a sentence each."""
    warnings = []
    intervals = result.best.intervals
    if result.is_linear:
        gain = result.gain
        warnings.append(
            f"the material is linear: the best law lowers the mean error of held-out sites from {gain.linear:.2%} to "
            f"{gain.law:.2%}; a law needs a gain of {gain.needed:.2%}, a tenth of the error beyond its noise"
        )
    else:
        for name, interval in intervals.items():
            if not interval.is_identifiable:
                scale, unit = (1e3, " mm") if name == "thickness" else (1.0, "")
                warnings.append(
                    f"{name} is not identifiable: values from {scale * interval.low:.3g} to "
                    f"{scale * interval.high:.3g}{unit} describe the sites as well, with other values of the rest"
                )
        if "thickness" in intervals:
            interval = intervals["thickness"]
            warnings.append(
                f"thickness ({1e3 * interval.low:.3g} to {1e3 * interval.high:.3g} mm describe the sites as well) and "
                "stiffening stand for each other: measure the thickness and give --thickness"
            )
        if intervals["tangent_cap"].high > 0.95 * CAP_RANGE[1]:
            warnings.append(
                f"the interval of tangent_cap ends with the range searched ({CAP_RANGE[1]:g}): a higher cap may do as "
                "well"
            )
    for ratio, (error, factor) in result.other_ratios.items():
        warnings.append(
            f"poisson_ratio is given, not fitted ({result.options.poisson_ratio:g}): with {ratio:g} the training error "
            f"is {error:.1%} and moduli are {factor:.2f} times as large"
        )
    for dataset in result.sets:
        for reason, sites in dataset.left_out.items():
            kept_in = dataset.kept_in.get(reason)
            error = f"with them kept in, {kept_in.median:.1%}" if kept_in else "none of their deeper forces is above 0"
            warnings.append(
                f"{dataset.recording.name}, left out: {len(sites)} of {len(dataset.recording.presses)} sites "
                f"({reason}); {error}: sites {_listed(sites)}"
            )
    if library.failed:
        warnings.append(
            f"{len(library.failed)} presses of the model failed and are not considered: {library.failed[0]}"
        )
    return warnings


def _listed(sites: Sequence[int]) -> str:
    shown = ", ".join(map(str, sites[:10]))
    return shown + (", ..." if len(sites) > 10 else "")
