"""What the sliders ask for: the tissue's modulus and damping, and which lesions it hides."""

import math
from dataclasses import dataclass, replace

import numpy as np

from msdm_core.errors import OrganError
from msdm_core.kernels import OrganModel
from msdm_core.regions import Lesion
from surgsim_env.anatomy import Anatomy, load_anatomy
from surgsim_env.scenes import Scene

# How much of an organ's mass may be added for fewer substeps, and the fewest.
ADDED_MASS_SHARE, SUBSTEPS_FEWEST = 0.01, 2
SHOWN, HIDDEN, NONE = "as in the scene", "hidden", "none"


@dataclass(frozen=True)
class OrganChoice:
    """An organ of a scene as the sliders have it.

    Args:
        modulus_factor: of the healthy tissue's and its capsule's moduli; lesions keep their ratio over it.
        damping_factor: of the scene's damping.
        lesions: SHOWN, the scene's own; HIDDEN, one drawn from the scene's ranges; NONE.
        lesion_ratio: modulus of every lesion over the tissue's; None: each its own.
        lesion_size: factor of every lesion's radius.
        seed: of the hidden lesion.

    Raises:
        ValueError: names the entry, its value and the rule.
    """

    modulus_factor: float = 1.0
    damping_factor: float = 1.0
    lesions: str = SHOWN
    lesion_ratio: float | None = None
    lesion_size: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("modulus_factor", "damping_factor", "lesion_size"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} is {value}; it must be finite and above 0")
        if self.lesion_ratio is not None and not (math.isfinite(self.lesion_ratio) and self.lesion_ratio > 0.0):
            raise ValueError(f"lesion_ratio is {self.lesion_ratio}; it must be finite and above 0, or None")
        if self.lesions not in (SHOWN, HIDDEN, NONE):
            raise ValueError(f"lesions is {self.lesions!r}; it is {SHOWN!r}, {HIDDEN!r} or {NONE!r}")


def live_scene(scene: Scene) -> Scene:
    """The scene in as few substeps as a hundredth of its mass more buys, so that there is time left in a haptic step.

    With mass scaling (`timing.mass_scaling`), as sliders ask for organs that no number of substeps was chosen for. The
    liver's 2 substeps instead of 4 take 0.3 % of its mass, on the nodes that limit the step.

    Raises:
        ValueError: a scene whose mesh cannot be made.
    """
    timing = replace(scene.timing, mass_scaling=True)
    anatomy, choice = load_anatomy(replace(scene, timing=timing)), OrganChoice(lesions=lesion_kinds(scene)[0])
    for count in range(SUBSTEPS_FEWEST, timing.substep_count):
        fewer = replace(anatomy.scene, timing=replace(timing, substep_count=count))
        try:
            organ = chosen_organ(replace(anatomy, scene=fewer), choice)
        except OrganError:
            # More than mass scaling may add at all.
            continue
        if organ.added_mass <= ADDED_MASS_SHARE * organ.node_mass.sum():
            return fewer
    return anatomy.scene


def lesion_kinds(scene: Scene) -> tuple[str, ...]:
    """What a scene's lesions may be, the first what it begins with."""
    shown = scene.demonstration or any(region.lesion for region in scene.regions)
    kinds = (SHOWN,) if shown else ()
    return (*kinds, *((HIDDEN,) if scene.lesion is not None else ()), NONE)


def chosen_lesions(anatomy: Anatomy, choice: OrganChoice) -> list[Lesion]:
    """The lesions of a choice.

    Raises:
        ValueError: hidden ones in a scene that has no ranges for them, or no room.
    """
    if choice.lesions == NONE:
        return []
    if choice.lesions == HIDDEN:
        lesions = [anatomy.random_lesion(np.random.default_rng(choice.seed))]
    else:
        lesions = anatomy.demonstration_lesions()
    return [_resized(anatomy, lesion, choice) for lesion in lesions]


def chosen_organ(anatomy: Anatomy, choice: OrganChoice) -> OrganModel:
    """The organ of a choice.

    Raises:
        ValueError: a lesion that there is no room for, or an organ too stiff for the scene's steps.
    """
    lesions = chosen_lesions(anatomy, choice)
    specification = anatomy.specification(lesions, modulus_factor=choice.modulus_factor)
    damping = anatomy.scene.damping
    factor = choice.damping_factor
    changed = replace(damping, alpha=damping.alpha * factor, beta=damping.beta * factor)
    return anatomy.compiled(replace(specification, damping=changed))


def _resized(anatomy: Anatomy, lesion: Lesion, choice: OrganChoice) -> Lesion:
    assert lesion.material is not None
    healthy = anatomy.scene.material.youngs_modulus
    ratio = lesion.material.youngs_modulus / healthy if choice.lesion_ratio is None else choice.lesion_ratio
    if lesion.region is not None:
        # A region keeps its tets, and so its size.
        modulus = ratio * choice.modulus_factor * healthy
        return replace(lesion, material=replace(lesion.material, youngs_modulus=modulus))
    assert lesion.centre is not None and lesion.radius is not None
    return anatomy.lesion_at(
        lesion.centre, lesion.radius * choice.lesion_size, ratio * choice.modulus_factor, lesion.name
    )
