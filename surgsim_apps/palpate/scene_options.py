"""Options of a command that replace values of a scene."""

import math
from dataclasses import dataclass, replace

from surgsim_env.scene import Scene, Vector


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
    values = {
        "press depth": options.press_depth,
        "tip radius": options.tip_radius,
        "spacing": options.spacing,
        "Young's modulus": options.youngs_modulus,
    }
    for name, value in values.items():
        if value is not None and not 0.0 < value < math.inf:
            unit = "Pa" if "modulus" in name else "metres"
            raise ValueError(f"{name} is {value:g}; it must be finite and above 0 ({unit})")


def _direction(vector: Vector) -> Vector:
    length = math.hypot(*vector)
    if not 0.0 < length < float("inf"):
        raise ValueError(f"approach is {vector}; give a direction such as 0,0,-1")
    x, y, z = (part / length for part in vector)
    return x, y, z
