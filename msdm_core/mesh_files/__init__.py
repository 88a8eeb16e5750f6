"""Files of tetrahedral meshes and surfaces."""

from msdm_core.mesh_files.mesh_file import LengthUnit, checked_content, metres_per_unit, parsed
from msdm_core.mesh_files.mesh_io import FORMATS, WRITTEN_SUFFIX, read_mesh, write_mesh
from msdm_core.mesh_files.surface_io import SURFACE_SUFFIXES, read_surface

__all__ = [
    "FORMATS",
    "SURFACE_SUFFIXES",
    "WRITTEN_SUFFIX",
    "LengthUnit",
    "checked_content",
    "metres_per_unit",
    "parsed",
    "read_mesh",
    "read_surface",
    "write_mesh",
]
