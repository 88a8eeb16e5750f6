"""From recorded sets to one material, its errors on held-out sites, and what the data cannot tell."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from msdm_core.mesh import FloatArray
from surgsim_apps.identify.press_model import PressCurve, PressSetting, PressShape
from surgsim_apps.identify.recordings import Recording, SitePress
from surgsim_apps.identify.relaxation import Arms, HeldSamples, RelaxationFit, fit_relaxation, held_sites
from surgsim_apps.identify.shape_search import (
    CAP_RANGE,
    ROUND_COUNT,
    ROUNDS,
    STANDARD_ERRORS,
    FoundShape,
    PressLibrary,
    ShapeSpace,
    find_linear,
    find_shape,
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

# Fewest usable sites of a set: with fewer, half of them tells nothing of the other half.
SITES_LEAST = 6
# Poisson's ratios that are tried beside the one given.
OTHER_RATIOS = (0.40, 0.48)
# Held presses that tell relaxation at least, in each half.
HELD_LEAST = 2


@dataclass(frozen=True)
class IdentifyOptions:
    """What is known of the recordings, and how they are divided.

    Args:
        ball_radius: [m].
        thickness: of the tissue on its rigid bed [m]; None: searched.
        poisson_ratio: of the tissue.
        seed: draws the halves of the sites.

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
    def of(cls, fits: SiteFits) -> "ForceError":
        """The error of fitted sites."""
        errors = fits.deep_errors
        return cls(float(np.median(errors)), float(np.percentile(errors, 90.0)))


@dataclass(frozen=True, eq=False)
class SetResult:
    """One set after the identification.

    Fields:
        recording: the set
        left_out: sites that are not used, by reason
        fits: modulus, offset and force of every usable site with the identified shape
        linear_fits: the same with the best linear tissue
        is_training: which of the usable sites chose the shape, (n_site,)
        error, linear_error: on the held-out sites
    """

    recording: Recording
    left_out: dict[str, list[int]]
    fits: SiteFits
    linear_fits: SiteFits
    is_training: np.ndarray
    error: ForceError
    linear_error: ForceError


@dataclass(frozen=True, eq=False)
class Identification:
    """Result of `identify`.

    Fields:
        options: what was given
        sets: one per recording
        found, linear: the shape with its intervals; the best linear one
        is_linear: whether linear tissue describes the training sites as well, so that the material has no stiffening
        curve, linear_curve: their presses
        relaxation: arms, where presses were held; relative moduli are those of the springs
        other_ratios: for each other Poisson's ratio: error on the training sites, and factor on the modulus
        warnings: what the data cannot tell, one sentence each
        seconds: wall time
    """

    options: IdentifyOptions
    sets: tuple[SetResult, ...]
    found: FoundShape
    linear: PressShape
    is_linear: bool
    curve: SampledCurve
    linear_curve: SampledCurve
    relaxation: RelaxationFit | None
    other_ratios: dict[float, tuple[float, float]]
    warnings: tuple[str, ...]
    seconds: float

    @property
    def shape(self) -> PressShape:
        """The identified shape."""
        return self.linear if self.is_linear else self.found.shape

    @property
    def moduli(self) -> FloatArray:
        """Moduli of all usable sites of all sets [Pa]."""
        return np.concatenate([one.fits.modulus for one in self.sets])


def make_library(recordings: Sequence[Recording], options: IdentifyOptions) -> PressLibrary:
    """An empty library of presses, deep enough for these sets with their offsets."""
    depth = (1.0 + OFFSET_SHARE) * max(depth_largest(sort_out(one.presses)[0]) for one in recordings)
    if not depth > 0.0:
        # No site can be used: `identify` says why.
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
    """The material that describes one or more sets; they share thickness and law, each site has modulus and offset.

    Args:
        recordings: the sets.
        options: what is known of them.
        library: presses so far, shared by calls with the same options; None: made anew.
        console: where the progress bar is shown; nowhere by default.

    Raises:
        ValueError: a set with too few usable sites; says how many are left out and why.
    """
    begin = time.perf_counter()
    library = make_library(recordings, options) if library is None else library
    sorted_sets = [sort_out(recording.presses) for recording in recordings]
    for recording, (usable, left_out) in zip(recordings, sorted_sets):
        if len(usable) < SITES_LEAST:
            said = "; ".join(f"{len(sites)} with {reason}" for reason, sites in left_out.items()) or "there are no more"
            raise ValueError(
                f"recording {recording.name}: {len(usable)} of {len(recording.presses)} sites can be used ({said}); "
                f"the rule is at least {SITES_LEAST}"
            )
    columns = (TextColumn("{task.description:24}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    starting = 0 if library.linear_curves else library.start_count
    held = [held_sites(usable) for usable, _ in sorted_sets]
    rounds = 2 if all(len(sites) >= 2 * HELD_LEAST for sites in held) else 1
    total = starting + rounds * ROUNDS * ROUND_COUNT + len(OTHER_RATIOS)
    with Progress(*columns, console=console or Console(quiet=True), transient=True) as progress:
        task = progress.add_task("pressing the model", total=total)

        def advanced() -> None:
            progress.advance(task)

        if starting:
            library.start(advanced)
        drawn = [draw_halves(len(usable), options.seed) for usable, _ in sorted_sets]
        samples = _samples([usable for usable, _ in sorted_sets])
        training = [part.subset(rows) for part, (rows, _) in zip(samples, drawn)]
        linear, linear_curve = find_linear(library, training)
        found = find_shape(library, training, seed=options.seed, progress=advanced)
        is_linear = _is_linear(found, linear_curve, training)
        relaxation = None
        if rounds == 2:
            # Arms also act while the ball moves: take them out of the forces, and search the shape again.
            curve = linear_curve if is_linear else found.curve
            relaxation = _relaxation(curve, sorted_sets, drawn)
            samples = _without_arms(samples, curve, relaxation)
            training = [part.subset(rows) for part, (rows, _) in zip(samples, drawn)]
            linear, linear_curve = find_linear(library, training)
            found = find_shape(library, training, seed=options.seed, progress=advanced)
            is_linear = _is_linear(found, linear_curve, training)
            relaxation = _relaxation(linear_curve if is_linear else found.curve, sorted_sets, drawn)
        shape, curve = (linear, linear_curve) if is_linear else (found.shape, found.curve)
        other_ratios = _other_ratios(library, shape, curve, training, advanced)
        if relaxation is not None:
            relaxation = _of_springs(library, shape, curve, relaxation)
    sets = []
    for recording, (_, left_out), part, (trained, held_out) in zip(recordings, sorted_sets, samples, drawn):
        is_training = np.isin(np.arange(len(part)), trained)
        rest = part.subset(held_out)
        error, linear_error = (ForceError.of(fit_sites(one, rest)) for one in (curve, linear_curve))
        sets.append(
            SetResult(
                recording, left_out, fit_sites(curve, part), fit_sites(linear_curve, part), is_training, error,
                linear_error,
            )
        )  # fmt: skip
    result = Identification(
        options, tuple(sets), found, linear, is_linear, curve, linear_curve, relaxation, other_ratios, (),
        time.perf_counter() - begin,
    )  # fmt: skip
    return replace(result, warnings=tuple(_warnings(result, library)))


def _samples(usable: Sequence[Sequence[SitePress]]) -> list[SiteSamples]:
    return [SiteSamples.of(sites, OFFSET_SHARE * depth_largest(sites)) for sites in usable]


def _is_linear(found: FoundShape, linear_curve: SampledCurve, training: Sequence[SiteSamples]) -> bool:
    """Whether stiffening does not lower the errors of the training sites, paired by site, by STANDARD_ERRORS."""
    gain = np.concatenate(
        [fit_sites(linear_curve, part).site_errors - fit_sites(found.curve, part).site_errors for part in training]
    )
    return bool(gain.mean() <= STANDARD_ERRORS * gain.std(ddof=1) / math.sqrt(len(gain)))


def _relaxation(
    curve: SampledCurve,
    sorted_sets: Sequence[tuple[list[SitePress], dict[str, list[int]]]],
    drawn: Sequence[tuple[NDArray[np.int64], NDArray[np.int64]]],
) -> RelaxationFit:
    """Arms from the held presses of all sets."""
    training, held_out = (
        held_sites([usable[row] for (usable, _), halves in zip(sorted_sets, drawn) for row in halves[half]])
        for half in (0, 1)
    )
    offsets = np.linspace(0.0, OFFSET_SHARE * max(depth_largest(usable) for usable, _ in sorted_sets), 31)
    return fit_relaxation(curve, training, held_out or training, offsets)


def _without_arms(samples: Sequence[SiteSamples], curve: SampledCurve, relaxation: RelaxationFit) -> list[SiteSamples]:
    """The samples with forces as they would be without arms, F A / (A with arms), by the curve found so far."""
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
    """For other Poisson's ratios: median error on the training sites, and factor on the modulus."""
    found = {}
    own = np.concatenate([fit_sites(curve, part).modulus for part in training])
    for ratio in OTHER_RATIOS:
        other = replace(library, setting=replace(library.setting, poisson_ratio=ratio))
        (press,) = other.press([shape], advanced)
        if isinstance(press, PressCurve):
            fits = [fit_sites(library.sampled(press), part) for part in training]
            errors = np.concatenate([one.deep_errors for one in fits])
            moduli = np.concatenate([one.modulus for one in fits])
            found[ratio] = float(np.median(errors)), float(np.median(moduli / own))
    return found


def _of_springs(
    library: PressLibrary, shape: PressShape, curve: SampledCurve, relaxation: RelaxationFit
) -> RelaxationFit:
    """Relative moduli of the springs from those of the force: the volume term is elastic, and bears a part of it.

    With springs gamma times as stiff and the same volume term, the force is gamma^p times as large; p from one press.
    """
    gain = 1.0 + math.fsum(relaxation.relative_moduli)
    if gain == 1.0:
        return relaxation
    nu = library.setting.poisson_ratio
    # Volume over spring modulus, (4 nu - 1) / (2.5 (1 - 2 nu)), divided by gamma gives nu with stiffer springs.
    ratio = (4.0 * nu - 1.0) / (2.5 * (1.0 - 2.0 * nu)) / gain
    stiffer = (2.5 * ratio + 1.0) / (4.0 + 5.0 * ratio)
    (press,) = replace(library, setting=replace(library.setting, poisson_ratio=stiffer)).press([shape])
    if not isinstance(press, PressCurve):
        return relaxation
    depths = np.linspace(0.4, 0.8, 9) * library.setting.depth
    modulus = gain * (1.0 + stiffer) / (1.0 + nu)
    force = float(np.median(modulus * library.sampled(press).at(depths) / curve.at(depths)))
    power = math.log(force) / math.log(gain)
    share = (gain ** (1.0 / power) - 1.0) / (gain - 1.0)
    return replace(relaxation, relative_moduli=tuple(share * one for one in relaxation.relative_moduli))


def _warnings(result: Identification, library: PressLibrary) -> list[str]:
    """What the data cannot tell, and what the identification could not do, one sentence each."""
    said = []
    if result.is_linear:
        said.append(
            "stiffening is not told: linear tissue describes the training sites as well; the material has no stiffening"
        )
    else:
        for name, one in result.found.intervals.items():
            if not one.told:
                low, high = (1e3 * one.low, 1e3 * one.high) if name == "thickness" else (one.low, one.high)
                unit = " mm" if name == "thickness" else ""
                said.append(
                    f"{name} is not told: values from {low:.3g} to {high:.3g}{unit} describe the sites as well, with "
                    "other values of the rest"
                )
        if "thickness" in result.found.intervals:
            one = result.found.intervals["thickness"]
            said.append(
                f"thickness ({1e3 * one.low:.3g} to {1e3 * one.high:.3g} mm describe the sites as well) and stiffening "
                "stand for each other: measure the thickness and give --thickness"
            )
        if result.found.intervals["tangent_cap"].high > 0.95 * CAP_RANGE[1]:
            said.append(
                f"the interval of tangent_cap ends with the range searched ({CAP_RANGE[1]:g}): a higher cap may do as "
                "well"
            )
    for ratio, (error, factor) in result.other_ratios.items():
        said.append(
            f"poisson_ratio is given, not fitted ({result.options.poisson_ratio:g}): with {ratio:g} the training error "
            f"is {error:.1%} and moduli are {factor:.2f} times as large"
        )
    for one in result.sets:
        for reason, sites in one.left_out.items():
            said.append(f"{one.recording.name}: {len(sites)} sites are left out, with {reason}: {_listed(sites)}")
    if library.failed:
        said.append(f"{len(library.failed)} presses of the model failed and are not considered: {library.failed[0]}")
    return said


def _listed(sites: Sequence[int]) -> str:
    shown = ", ".join(map(str, sites[:10]))
    return shown + (", ..." if len(sites) > 10 else "")
