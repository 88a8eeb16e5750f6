"""Options of a command that replace values of a scene."""

import math
from dataclasses import dataclass, replace

import numpy as np

from msdm_core.arithmetic import matmul
from surgsim_env.scene import Anatomy, Ball, Scene, Vector

# Least press depth over the tip's radius; most sites of a raster, a day of presses.
DEPTH_LEAST = 1e-3
SITES_MOST = 100_000


@dataclass(frozen=True)
class SceneOptions:
    """Values that replace those of a scene; None: the scene's own.

    Args:
        approach: direction of the probe's approach.
        press_depth, tip_radius, spacing: [m].
        youngs_modulus: of the healthy tissue [Pa].
    """

    approach: Vector | None = None
    press_depth: float | None = None
    tip_radius: float | None = None
    spacing: float | None = None
    youngs_modulus: float | None = None


def with_options(scene: Scene, options: SceneOptions) -> Scene:
    """A scene with the given approach, press depth, tip radius and site spacing.

    Raises:
        ValueError: a value that is not above 0, or a direction without length.
    """
    check_options(options)
    palpation, instrument = scene.palpation, scene.instrument
    return replace(
        scene,
        palpation=replace(
            palpation,
            press_depth=options.press_depth or palpation.press_depth,
            site_spacing=options.spacing or palpation.site_spacing,
        ),
        instrument=replace(
            instrument,
            tip_radius=options.tip_radius or instrument.tip_radius,
            approach=_direction(options.approach) if options.approach else instrument.approach,
        ),
    )


def check_options(options: SceneOptions) -> None:
    """Refuse a length or modulus that is not above 0, and a direction without length."""
    if options.approach is not None:
        _direction(options.approach)
    for name in ("press_depth", "tip_radius", "spacing"):
        require_length(f"--{name.replace('_', '-')}", getattr(options, name))
    modulus = options.youngs_modulus
    if modulus is not None and not 0.0 < modulus < math.inf:
        raise ValueError(f"--youngs-modulus is {modulus:g} Pa; it must be finite and above 0")


def require_length(
    option: str, length: float | None, most: float = math.inf, body: str = "", least: float = 0.0
) -> None:
    """Refuse a length [m] that is not above 0, not finite, below `least`, or above `most`, that of a body.

    Raises:
        ValueError: names the option and the value; of metres instead of millimetres it says so.
    """
    if length is None or (0.0 < length < math.inf and least <= length <= most):
        return
    if not 0.0 < length < math.inf:
        raise ValueError(f"{option} is {length:g} m; it must be finite and above 0")
    # A number without its unit.
    hint = f"; did you mean {length:g}mm?" if length >= 0.1 and length * 1e-3 <= most else ""
    rule = f"{least:.2g} to" if least else "at most"
    raise ValueError(f"{option} is {length:g} m; the rule is {rule} {most:.3g} m, {body}{hint}")


def check_lengths(anatomy: Anatomy, around: Ball | None = None) -> None:
    """Refuse a press depth, tip, spacing or ball of sites beyond the organ's size or too small.

    Raises:
        ValueError: names the option, its value and the organ's length.
    """
    scene, points = anatomy.scene, anatomy.mesh.points
    side, thickness = float(np.ptp(points, axis=0).max()), float(np.ptp(matmul(points, anatomy.face.approach)))
    palpation, tip = scene.palpation, scene.instrument.tip_radius
    body, depth_least = "the organ along the approach", DEPTH_LEAST * tip
    require_length("--press-depth", palpation.press_depth, thickness, body, depth_least)
    body, spacing_least = "the organ's longest side", side / math.sqrt(SITES_MOST)
    require_length("the tip radius", tip, side, body)
    require_length("--around", around.radius if around else None, side, body)
    require_length("--spacing", palpation.site_spacing, side, body, spacing_least)


def _direction(vector: Vector) -> Vector:
    length = math.hypot(*vector)
    if not 0.0 < length < float("inf"):
        raise ValueError(f"approach is {vector}; give a direction such as 0,0,-1")
    x, y, z = (part / length for part in vector)
    return x, y, z
