"""Options that replace values of a scene, and the fat that holds an organ."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from msdm_core.kernels import OrganModel
from msdm_core.material import Lesion
from surgsim_env.scene import Anatomy, Anchor, Scene, Side, Vector, load_anatomy, with_added_mass, with_substeps

PATTERN = "liver"
# An organ lies in fat but for the side that faces the probe: E / h and E / 3h of 8 mm of it (chosen).
# E is 3 x 752 Pa, the shear modulus of human fat that bears no load, by MR elastography at 50 Hz (gluteal, J Mech Behav
# Biomed Mater 2023, "Strain-dependent shear properties of human adipose tissue in vivo"); in pigs 3 x 530 Pa (doi
# 10.1007/s10237-010-0207-9).
FAT_STIFFNESS, FAT_SHEAR_STIFFNESS = 2.8e5, 9.4e4
# It reaches around the flanks: largest angle between outward normal and approach [degrees].
FAT_ANGLE = 110.0
FAT_SOURCE = (
    "[N/m^3] E / h, and E / 3h across, of a layer of fat, h 8 mm (chosen), E 3 x 752 Pa (human, MR elastography 2023)"
)
FAT_NAME = "surrounding fat and wall"
# Contact stiffness times cell over Young's modulus: about 0.2 mm of penetration in a press, as in the liver scene.
CONTACT_MODULI_PER_CELL = 18.0


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
    """A scene with another approach, press depth, tip radius or site spacing, where given.

    Raises:
        ValueError: a value that is not above 0 (names it).
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
    given = {
        "press depth": options.press_depth,
        "tip radius": options.tip_radius,
        "spacing": options.spacing,
        "Young's modulus": options.youngs_modulus,
    }
    for name, value in given.items():
        if value is not None and not 0.0 < value < math.inf:
            unit = "Pa" if "modulus" in name else "metres"
            raise ValueError(f"{name} is {value:g}; it must be finite and above 0 ({unit})")


def load_stable_anatomy(scene: Scene, lesions: Sequence[Lesion], *, modulus_factor_largest: float) -> Anatomy:
    """The anatomy with substeps, fewer by a little added mass, for the organ with lesions and a stiffer one without.

    Tissue that stiffens keeps its substeps: its stable step is shorter under a press than at rest.

    Args:
        scene: its mesh, materials and timing.
        lesions: hidden in the organ.
        modulus_factor_largest: largest modulus of the pre-operative model over the scene's.
    """

    def organs_of(one: Anatomy) -> Iterator[OrganModel]:
        yield one.organ(lesions)
        yield one.organ(modulus_factor=modulus_factor_largest)

    anatomy = load_anatomy(scene)
    stable = with_substeps(anatomy, [*organs_of(anatomy)], least=scene.timing.substep_count)
    return with_added_mass(stable, organs_of) if scene.material.stiffening is None else stable


def _direction(vector: Vector) -> Vector:
    length = math.hypot(*vector)
    if not 0.0 < length < float("inf"):
        raise ValueError(f"approach is {vector}; give a direction such as 0,0,-1")
    x, y, z = (part / length for part in vector)
    return x, y, z


def soft_bed(approach: Vector, name: str = FAT_NAME) -> Anchor:
    """Fat over the side away from the probe and the flanks."""
    return Anchor(name, side=Side(approach, FAT_ANGLE), stiffness=FAT_STIFFNESS, shear_stiffness=FAT_SHEAR_STIFFNESS)
