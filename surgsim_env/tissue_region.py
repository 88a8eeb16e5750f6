"""A named region of an organ's mesh with its own material: the `[[regions]]` of a scene."""

from dataclasses import dataclass

from msdm_core.regions import Lesion, Material


@dataclass(frozen=True)
class TissueRegion:
    """The tets of one region of the mesh, which have a material of their own.

    Args:
        name: of the region in the mesh file.
        material: of its tets.
        lesion: whether it is what a palpation looks for: the organ has it as a demonstration lesion, and healthy
            organs (pre-operative models, episodes that hide a lesion of their own) do not. Else all have it.
    """

    name: str
    material: Material
    lesion: bool = False

    @property
    def as_lesion(self) -> Lesion:
        """The region as `compile_organ` takes it."""
        return Lesion(region=self.name, material=self.material, name=self.name)
