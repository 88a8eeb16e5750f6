"""The organ of the sliders: modulus and damping of the tissue, and its lesions."""

from dataclasses import dataclass, replace

import numpy as np

from msdm_core.kernels import OrganModel
from msdm_core.material import Lesion
from surgsim_env.scene import Anatomy, Scene

SHOWN, HIDDEN, NONE = "as in the scene", "hidden", "none"


@dataclass(frozen=True)
class OrganChoice:
    """An organ of a scene by the values of the sliders.

    Args:
        modulus_factor: on the moduli of healthy tissue and capsule; lesions keep their ratio to it.
        damping_factor: on the scene's damping.
        lesions: SHOWN, the scene's own; HIDDEN, one drawn from the scene's ranges; NONE.
        lesion_ratio: modulus of every lesion over the tissue's; None: as in the scene.
        lesion_size: factor of every lesion's radius.
        seed: of the hidden lesion.
    """

    modulus_factor: float = 1.0
    damping_factor: float = 1.0
    lesions: str = SHOWN
    lesion_ratio: float | None = None
    lesion_size: float = 1.0
    seed: int = 0


def lesion_kinds(scene: Scene) -> tuple[str, ...]:
    """The choices of lesions in a scene, the initial one first."""
    shown = scene.demonstration or any(region.lesion for region in scene.regions)
    kinds = (SHOWN,) if shown else ()
    return (*kinds, *((HIDDEN,) if scene.lesion is not None else ()), NONE)


def chosen_lesions(anatomy: Anatomy, choice: OrganChoice) -> list[Lesion]:
    """The lesions of a choice.

    Raises:
        ValueError: hidden lesions in a scene without ranges for them, or without room.
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
        ValueError: no room for a lesion, or an organ too stiff for the scene's substep.
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
