"""From materials to springs and masses."""

from msdm_core.material.continuum import (
    STRAIN_LEAST,
    SpringSolid,
    bar_gradient,
    lattice_directions,
    simple_shear_stress,
    sphere_directions,
    stretch_across,
    uniaxial_stress,
)
from msdm_core.material.fitting import spring_fit
from msdm_core.material.lumping import lump_mass, voronoi_fractions
from msdm_core.material.regions import Capsule, Damping, Lesion, Material, boundary_layer, lesion_extent
from msdm_core.material.stiffness import membrane_stiffness, spring_network
from msdm_core.material.tissue_law import Relaxation, Stiffening

__all__ = [
    "STRAIN_LEAST",
    "Capsule",
    "Damping",
    "Lesion",
    "Material",
    "Relaxation",
    "SpringSolid",
    "Stiffening",
    "bar_gradient",
    "boundary_layer",
    "lattice_directions",
    "lesion_extent",
    "lump_mass",
    "membrane_stiffness",
    "simple_shear_stress",
    "sphere_directions",
    "spring_fit",
    "spring_network",
    "stretch_across",
    "uniaxial_stress",
    "voronoi_fractions",
]
