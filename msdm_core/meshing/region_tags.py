"""Which tets belong to which region: whole tets, so that each region keeps its volume."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from msdm_core.errors import MeshError
from msdm_core.material.regions import tet_samples
from msdm_core.mesh.tet_mesh import FloatArray, TetMesh


@dataclass(frozen=True, eq=False)
class RegionShare:
    """What of each tet a region fills, shape (n_tet,), and its volume [m^3]."""

    tag: int
    name: str
    share: FloatArray
    volume: float


def tag_tets(mesh: TetMesh, first: int, regions: Sequence[RegionShare]) -> NDArray[np.int32]:
    """Region tag of each tet, shape (n_tet,): `first` where no other region is.

    A region takes the tets of which it fills most until its volume is reached, so that it keeps its volume although
    tets are whole; small regions choose before large ones.

    Raises:
        MeshError: a region that fills no tet; names it, its volume and the tets'.
    """
    tags = np.full(mesh.tet_count, first, dtype=np.int32)
    free = np.ones(mesh.tet_count, dtype=bool)
    for region in sorted(regions, key=lambda one: one.volume):
        order = np.argsort(-region.share, kind="stable")
        order = order[(region.share[order] > 0) & free[order]]
        before = np.cumsum(mesh.volumes[order]) - 0.5 * mesh.volumes[order]
        taken = order[before <= region.volume]
        if not len(taken):
            raise MeshError(
                f"region {region.tag} ({region.name!r}) of {region.volume * 1e9:.3g} mm^3 fills no tet "
                f"({np.median(mesh.volumes) * 1e9:.3g} mm^3): use smaller cells, or leave it out"
            )
        tags[taken], free[taken] = region.tag, False
    return tags


def label_share(
    mesh: TetMesh, mask: NDArray[np.bool_], corner: NDArray[np.int64], step: FloatArray, *, chunk: int = 4096
) -> FloatArray:
    """Share of each tet's volume in the voxels of a mask, from 165 points a tet, shape (n_tet,).

    Args:
        mesh: in metres from the centre of voxel (0, 0, 0) of the image.
        mask: part of the image, shape (n_x, n_y, n_z).
        corner: its first voxel in the image, shape (3,).
        step: spacing of the voxels [m], shape (3,).
        chunk: how many tets are sampled at once.
    """
    share = np.zeros(mesh.tet_count)
    filled = [np.flatnonzero(mask.any(axis=tuple({0, 1, 2} - {axis}))) for axis in range(3)]
    if not len(filled[0]):
        return share
    low = (np.array([one[0] for one in filled]) + corner - 0.5) * step
    high = (np.array([one[-1] for one in filled]) + corner + 0.5) * step
    corners = mesh.points[mesh.tets]
    near = np.flatnonzero(((corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)).all(axis=1))
    for first in range(0, len(near), chunk):
        chosen = near[first : first + chunk]
        share[chosen] = voxels_at(tet_samples(corners[chosen]), mask, corner, step).mean(axis=1)
    return share


def voxels_at(
    places: FloatArray, mask: NDArray[np.bool_], corner: NDArray[np.int64], step: FloatArray
) -> NDArray[np.bool_]:
    """The mask's values at places [m] (..., 3), False beyond it, shape (...); the rest as in `label_share`."""
    index = np.rint(places / step).astype(np.int64) - corner
    within = np.asarray(np.logical_and(index >= 0, index < np.array(mask.shape)).all(axis=-1))
    i, j, k = np.moveaxis(np.where(within[..., None], index, 0), -1, 0)
    return mask[i, j, k] & within
