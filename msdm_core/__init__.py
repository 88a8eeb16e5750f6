"""msdm_core: a tetrahedral mass-spring-damper organ (Sala et al. 2011) in numba, without MuJoCo and Gymnasium."""

from pathlib import Path

from msdm_core import numba_cache

with numba_cache.kernel_cache(Path(__file__).parent):
    # First of all: a function is cached in the folder at its decoration.
    from msdm_core.kernels import linear_kernels, load_kernels, matrix_kernels, ray_kernels, substep_kernels  # noqa: F401
from msdm_core.errors import MeshError, OrganDivergedError, OrganError
from msdm_core.kernels.structure_kernels import ContactLaw, ContactShapes, OrganModel, OrganState
from msdm_core.material.fitting import FitReport, spring_fit
from msdm_core.material.lumping import lump_mass
from msdm_core.material.regions import Capsule, Damping, Lesion, Material
from msdm_core.material.stiffness import spring_network
from msdm_core.material.tissue_law import Relaxation, Stiffening
from msdm_core.mesh.quality import mesh_quality
from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.mesh_files.mesh_io import read_mesh, write_mesh
from msdm_core.mesh_files.surface_io import read_surface
from msdm_core.meshing.lattice_meshing import box_mesh, mesh_surface
from msdm_core.meshing.segmentation_meshing import mesh_segmentation
from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from msdm_core.organ.stability import stable_dt
from msdm_core.organ.stepping import advance
from msdm_core.organ.support import Support, SupportLaw

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
    "Relaxation",
    "Stiffening",
    "Support",
    "SupportLaw",
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
