"""Materials of an organ, and the springs and masses that follow from them."""

from msdm_core.material.fitting import spring_fit
from msdm_core.material.lumping import lump_mass, voronoi_fractions
from msdm_core.material.regions import Capsule, Damping, Lesion, Material, boundary_layer, lesion_extent
from msdm_core.material.stiffness import membrane_stiffness, spring_network
from msdm_core.material.tissue_law import Relaxation, Stiffening

__all__ = [
    "Capsule",
    "Damping",
    "Lesion",
    "Material",
    "Relaxation",
    "Stiffening",
    "boundary_layer",
    "lesion_extent",
    "lump_mass",
    "membrane_stiffness",
    "spring_fit",
    "spring_network",
    "voronoi_fractions",
]
