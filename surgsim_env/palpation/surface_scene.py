"""A scene for any closed surface: where the file says nothing, the shipped liver's values stand, and are stated."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from msdm_core.length_unit import LengthUnit
from msdm_core.regions import Lesion
from msdm_core.stability import stable_dt
from surgsim_env.anatomy import Anatomy, load_anatomy
from surgsim_env.scenes import Anchor, Ball, Bed, MeshSource, Scene, SurfaceMesh, Vector, make_scene
from surgsim_env.timing import substeps_needed

PATTERN = "liver"
# Against the file's third axis: from above in a file drawn z up; from the head in a CT's patient axes (z to the head).
DEFAULT_APPROACH = (0.0, 0.0, -1.0)
# "It lies on its bed": without anchors, surface nodes in this deepest share of the organ along the approach are held.
BED_SHARE = 0.15
# Contact stiffness over Young's modulus per cell: about 0.2 mm of penetration under a press, see the liver scene.
CONTACT_MODULI_PER_CELL = 18.0
# More organ substeps in a haptic step than this would take hours.
SUBSTEPS_MOST = 200
# Where a healthy press may lie; sites with less tissue below them than this many press depths are left out.
THICKNESS_PRESS_DEPTHS = 5.0


@dataclass(frozen=True)
class SurfaceOptions:
    """What is said of a surface beyond its file; see `surgsim palpate --help` for the meaning.

    Args:
        approach: direction in which the probe comes, in the file's axes; DEFAULT_APPROACH if nothing is said.
        anchors: balls that hold the surface nodes inside them: x, y, z, radius [m]; none: its bed.
        press_depth, tip_radius, spacing: [m].
        youngs_modulus: of the healthy tissue [Pa].
    """

    approach: Vector | None = None
    anchors: tuple[tuple[float, float, float, float], ...] = ()
    press_depth: float | None = None
    tip_radius: float | None = None
    spacing: float | None = None
    youngs_modulus: float | None = None


def surface_scene(file: Path, *, length_unit: LengthUnit, cell_size: float, options: SurfaceOptions) -> Scene:
    """The shipped liver's scene with another surface.

    Raises:
        ValueError: names the length or the direction that is impossible.
    """
    scene = with_options(make_scene(PATTERN), replace(options, approach=options.approach or DEFAULT_APPROACH))
    if not cell_size > 0.0:
        raise ValueError(f"cell size is {cell_size} m; it must be above 0")
    contact = CONTACT_MODULI_PER_CELL * scene.material.youngs_modulus / cell_size
    return replace(
        scene,
        name=file.stem,
        description=f"the surface {file.name}",
        folder=Path.cwd(),
        mesh=MeshSource(surface=SurfaceMesh(str(file), length_unit, cell_size)),
        anchors=anchors_of(options, scene.instrument.approach),
        contact=replace(scene.contact, stiffness=contact),
        palpation=replace(scene.palpation, thickness_smallest=THICKNESS_PRESS_DEPTHS * scene.palpation.press_depth),
        demonstration=(),
    )


def with_options(scene: Scene, options: SurfaceOptions) -> Scene:
    """A scene with another approach, press depth, tip radius, site spacing or modulus, where given.

    Raises:
        ValueError: names the value that is not above 0.
    """
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
    palpation, material = scene.palpation, scene.material
    instrument = scene.instrument
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
        material=replace(material, youngs_modulus=options.youngs_modulus or material.youngs_modulus),
    )


def load_stable_anatomy(scene: Scene, lesions: Sequence[Lesion], *, modulus_factor_largest: float) -> Anatomy:
    """The anatomy with as many organ substeps as the organ with lesions, and a stiffer one without, need.

    Args:
        scene: what is pressed.
        lesions: hidden in it.
        modulus_factor_largest: how much stiffer than the scene's tissue the pre-operative model may be.
    """
    anatomy = load_anatomy(scene)
    organs = [anatomy.organ(lesions), anatomy.organ(modulus_factor=modulus_factor_largest)]
    step = min(stable_dt(organ, scene.contact.law) for organ in organs)
    count = max(substeps_needed(scene.timing.haptic_step, step), scene.timing.substep_count)
    if count > SUBSTEPS_MOST:
        raise ValueError(
            f"this organ needs {count} substeps in {scene.timing.haptic_step:g} s, its stable step is {step:.3g} s; at "
            f"most {SUBSTEPS_MOST} are allowed: is the modulus in pascals? Else use larger cells"
        )
    return replace(anatomy, scene=replace(scene, timing=replace(scene.timing, substep_count=count)))


def _direction(vector: Vector) -> Vector:
    length = sum(part * part for part in vector) ** 0.5
    if not 0.0 < length < float("inf"):
        raise ValueError(f"approach is {vector}; give a direction such as 0,0,-1")
    x, y, z = (part / length for part in vector)
    return x, y, z


def anchors_of(options: SurfaceOptions, approach: Vector) -> tuple[Anchor, ...]:
    """The balls that options name as anchors, else the bed along the approach."""
    if not options.anchors:
        return (Anchor("bed", bed=Bed(approach, BED_SHARE)),)
    balls = []
    for number, (x, y, z, radius) in enumerate(options.anchors, start=1):
        if not radius > 0.0:
            raise ValueError(f"anchor {number}: radius is {radius:g} m; it must be above 0")
        balls.append(Anchor(f"anchor {number}", ball=Ball((x, y, z), radius)))
    return tuple(balls)
