"""Tetrahedral meshes of blocks, surfaces and label images."""

from msdm_core.meshing.lattice_meshing import box_mesh, largest_body_mesh, mesh_surface
from msdm_core.meshing.segmentation_meshing import (
    FineFace,
    RegionShare,
    SmoothedShare,
    fill_labels,
    label_share,
    largest_part,
    parts_of,
    smoothed_share,
    tag_tets,
    voxels_at,
)

__all__ = [
    "FineFace",
    "RegionShare",
    "SmoothedShare",
    "box_mesh",
    "fill_labels",
    "label_share",
    "largest_body_mesh",
    "largest_part",
    "mesh_surface",
    "parts_of",
    "smoothed_share",
    "tag_tets",
    "voxels_at",
]
