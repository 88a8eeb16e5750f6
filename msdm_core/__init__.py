"""msdm_core: a tetrahedral mass-spring-damper organ (Sala et al. 2011) in numba, without MuJoCo and Gymnasium."""

from pathlib import Path

from msdm_core.numba_cache import provide_cache_folder

# Before the kernels are imported: where nothing can be written, numba would refuse to cache and the import to work.
provide_cache_folder(Path(__file__).resolve().parent)

from msdm_core.damping import Damping  # noqa: E402
from msdm_core.errors import MeshError, OrganDivergedError, OrganError  # noqa: E402
from msdm_core.kernels import ContactLaw, ContactShapes, OrganModel, OrganState  # noqa: E402
from msdm_core.lumping import lump_mass  # noqa: E402
from msdm_core.mesh import TetMesh  # noqa: E402
from msdm_core.mesh_io import read_mesh, read_surface, write_mesh  # noqa: E402
from msdm_core.meshing import box_mesh, mesh_surface  # noqa: E402
from msdm_core.organ import OrganSpec, advance, compile_organ, rest_state  # noqa: E402
from msdm_core.quality import mesh_quality  # noqa: E402
from msdm_core.regions import Capsule, Lesion, Material  # noqa: E402
from msdm_core.stability import stable_dt  # noqa: E402
from msdm_core.stiffness import spring_network  # noqa: E402

__all__ = [
    "Capsule",
    "ContactLaw",
    "ContactShapes",
    "Damping",
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
    "mesh_surface",
    "read_mesh",
    "read_surface",
    "rest_state",
    "spring_network",
    "stable_dt",
    "write_mesh",
]
