"""Which lesions a sensor can feel at all: pressed right over each, with it and without it."""

from dataclasses import dataclass, replace

from msdm_core.kernels import OrganModel
from msdm_core.mesh import FloatArray
from surgsim_env.anatomy import Anatomy
from surgsim_env.levels import DrawnOrgan
from surgsim_env.palpation.scan import scan

# A lesion whose force changes by less than so many standard deviations of the sensor's noise is below its reach.
NOISES_LEAST = 2.0


@dataclass(frozen=True)
class LesionReach:
    """What one lesion adds to a press right over it.

    Fields:
        force, force_without: held at the scene's depth with the lesion there, and with all others but it [N]
        noise: standard deviation of the sensor [N]
    """

    force: float
    force_without: float
    noise: float

    @property
    def below(self) -> bool:
        """Whether the sensor's noise hides it from a single press."""
        return abs(self.force - self.force_without) < NOISES_LEAST * self.noise


def lesion_reaches(anatomy: Anatomy, drawn: DrawnOrgan) -> list[LesionReach]:
    """Press over each lesion of a drawn organ, along the surface's normal, as `scan` does.

    Args:
        anatomy: of the scene as its level has it, whose sensor counts.
        drawn: the organ.
    """
    if not drawn.lesions:
        return []
    reaches = []
    whole = drawn.compiled(anatomy)
    for index, lesion in enumerate(drawn.lesions):
        place, normal = anatomy.face.project(lesion.centre)  # type: ignore[arg-type]
        others = drawn.lesions[:index] + drawn.lesions[index + 1 :]
        without = replace(drawn, lesions=others).compiled(anatomy)
        force, force_without = (_held_force(anatomy, organ, place, normal) for organ in (whole, without))
        reaches.append(LesionReach(force, force_without, anatomy.scene.sensor.noise))
    return reaches


def _held_force(anatomy: Anatomy, organ: OrganModel, place: FloatArray, normal: FloatArray) -> float:
    return scan(anatomy, organ, place[None], normal[None], workers=1)[0].force
