"""msdm_core: a tetrahedral mass-spring-damper organ (Sala et al. 2011) in numba, without MuJoCo and Gymnasium."""

from pathlib import Path

from msdm_core import numba_cache

with numba_cache.kernel_cache(Path(__file__).parent):
    # First of all: what is compiled is cached where it was decorated.
    from msdm_core import kernels, lane_kernels, linear_kernels  # noqa: F401
from msdm_core.damping import Damping
from msdm_core.errors import MeshError, OrganDivergedError, OrganError
from msdm_core.fitting import FitReport, spring_fit
from msdm_core.kernels import ContactLaw, ContactShapes, OrganModel, OrganState
from msdm_core.lumping import lump_mass
from msdm_core.mesh import TetMesh
from msdm_core.mesh_io import read_mesh, read_surface, write_mesh
from msdm_core.meshing import box_mesh, mesh_surface
from msdm_core.organ import OrganSpec, compile_organ, rest_state
from msdm_core.quality import mesh_quality
from msdm_core.regions import Capsule, Lesion, Material
from msdm_core.segmentation_meshing import mesh_segmentation
from msdm_core.stability import stable_dt
from msdm_core.stepping import advance
from msdm_core.stiffness import spring_network

__all__ = [
    "Capsule",
    "ContactLaw",
    "ContactShapes",
    "Damping",
    "FitReport",
    "Lesion",
    "Material",
    "MeshError",
    "OrganDivergedError",
    "OrganError",
    "OrganModel",
    "OrganSpec",
    "OrganState",
    "TetMesh",
    "advance",
    "box_mesh",
    "compile_organ",
    "lump_mass",
    "mesh_quality",
    "mesh_segmentation",
    "mesh_surface",
    "read_mesh",
    "read_surface",
    "rest_state",
    "spring_fit",
    "spring_network",
    "stable_dt",
    "write_mesh",
]
