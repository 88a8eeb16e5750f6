"""A label image filled with tets: a smoothed level set on a BCC lattice, the regions as tags of whole tets.

Tets are whole, and each region keeps its volume.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msdm_core.arithmetic import exp
from msdm_core.errors import MeshError
from msdm_core.material.regions import tet_samples
from msdm_core.mesh.surface import outward_facing
from msdm_core.mesh.tet_mesh import FloatArray, TetMesh
from msdm_core.meshing.grading import COARSENINGS, stuff_graded
from msdm_core.meshing.lattice_meshing import check_cell_size, largest_body_mesh
from msdm_core.meshing.stuffing import LevelSetBody, lattice_around, stuff

# Width of the Gaussian that smooths the voxels' steps, in voxels of the widest spacing and in cells: the larger counts.
# 0.7 of a spacing leaves 3 % of a step one spacing long (exp(-2 pi^2 0.49) of its first harmonic).
SMOOTHING_SPACINGS, SMOOTHING_CELLS = 0.7, 0.2
# Voxels are joined to blocks as long as at least this number of blocks fits along a cell.
VOXELS_PER_CELL = 6
# Blocks of the image around the organ: about 2 GB while it is smoothed.
FIELD_LIMIT = 150_000_000
# The level is moved until the mesh's volume matches that of the labels to this share; the largest number of tries.
VOLUME_SHARE, VOLUME_TRIES = 0.002, 4
# Beyond these the level set follows the tail of the Gaussian instead of the organ.
LEVEL_RANGE = (0.15, 0.85)
LEVEL_HALVINGS = 12


@dataclass(frozen=True, eq=False)
class RegionShare:
    """What of each tet a region fills, shape (n_tet,), and its volume [m^3]."""

    tag: int
    name: str
    share: FloatArray
    volume: float


@dataclass(frozen=True, eq=False)
class FilledLabels:
    """A label image filled with tets.

    Fields:
        mesh: tags are the labels, in metres from the centre of voxel (0, 0, 0).
        label_volume: of the voxels that were filled, the largest part [m^3].
        region_volumes: of the voxels of each label of the mesh [m^3].
        dropped: voxels of the parts that do not hang together with the largest by faces, largest first.
    """

    mesh: TetMesh
    label_volume: float
    region_volumes: dict[int, float]
    dropped: tuple[int, ...]

    @property
    def volume_error(self) -> float:
        """(mesh - labels) / labels."""
        return float(self.mesh.volumes.sum()) / self.label_volume - 1.0


def mesh_segmentation(
    labels: ArrayLike, spacing: ArrayLike, *, cell_size: float, region_names: Mapping[int, str]
) -> TetMesh:
    """Fill the named labels of an image with tets of a BCC lattice; tags and names of its regions are the labels'.

    Args:
        labels: whole numbers, shape (n_x, n_y, n_z); those without a name are outside.
        spacing: of the voxels along the three axes [m], shape (3,).
        cell_size: cube edge of the lattice [m].
        region_names: the labels that make up the organ: {1: "liver", 2: "lesion"}; the first has the tets that no
            other fills.

    Returns:
        The mesh, in metres from the centre of voxel (0, 0, 0) along the image's axes.

    Warns:
        UserWarning: says which parts beside the largest were left out, and what `mesh_surface` warns of.

    Raises:
        MeshError: names the label that is empty or too small for a tet, or a cell size that would work.
    """
    filled = fill_labels(labels, spacing, cell_size=cell_size, region_names=region_names)
    if filled.dropped:
        warnings.warn(
            f"{len(filled.dropped)} part(s) of {sum(filled.dropped)} voxels hang together with the largest by no face "
            "and were left out",
            UserWarning,
            stacklevel=2,
        )
    return filled.mesh


@dataclass(frozen=True)
class FineFace:
    """Where the cells of a level set are fine, and how coarse they are elsewhere.

    Args:
        direction: of what presses the body, along the image's axes, shape (3,).
        angle_deg: the face's inward normals are within this angle of the direction [degrees].
        depth: cells that come within this distance of the face along each axis are fine [m].
        coarsening: edge of the largest cells over that of the fine ones: 2 or 4.
    """

    direction: tuple[float, float, float]
    angle_deg: float
    depth: float
    coarsening: int


def fill_labels(
    labels: ArrayLike,
    spacing: ArrayLike,
    *,
    cell_size: float,
    region_names: Mapping[int, str],
    fine_face: FineFace | None = None,
) -> FilledLabels:
    """`mesh_segmentation`, with the change of volume, and graded where a face is given at which cells are fine.

    The organ's share of each voxel (1 or 0) is smoothed by a Gaussian, and filled where it exceeds a level. Smoothing
    removes volume where the surface is convex, and so do the flat faces of tets; the level is moved from 1/2 until the
    mesh has the volume of the voxels.
    """
    image, step, names = _checked(labels, spacing, region_names)
    organ, corner, dropped = largest_part(image, [tag for tag, _ in names])
    inside = image[tuple(slice(low, low + n) for low, n in zip(corner, organ.shape, strict=True))]
    volume = float(np.count_nonzero(organ)) * float(np.prod(step))
    check_cell_size(np.array(organ.shape) * step, volume, cell_size)
    field = smoothed_share(organ, corner, step, cell_size)
    mesh = _filled_to_volume(field, volume, cell_size, fine_face)
    inside = np.where(organ, inside, 0)
    region, volumes = _regions(mesh, inside, corner, step, names)
    return FilledLabels(TetMesh(mesh.points, mesh.tets, region, names), volume, volumes, dropped)


@dataclass(frozen=True, eq=False)
class SmoothedShare:
    """The smoothed share of a part on blocks of voxels.

    Fields:
        values: from 0 outside to 1 inside          (n_x, n_y, n_z)
        start, step: centre of the first block and size of the blocks [m]   (3,)
        smoothing: standard deviation [m]
    """

    values: NDArray[np.float32]
    start: FloatArray
    step: FloatArray
    smoothing: float

    def at(self, places: FloatArray) -> FloatArray:
        """Trilinear between the blocks' centres, 0 outside, at places [m] (n, 3), shape (n,)."""
        from scipy import ndimage

        index = ((places - self.start) / self.step).T
        return ndimage.map_coordinates(self.values, index, order=1, mode="constant", output=np.float64)

    def volume_above(self, level: float) -> float:
        """Volume where the field exceeds a level, from its value and slope at each block [m^3]."""
        rise = np.zeros_like(self.values)
        for axis in range(3):
            rise += np.abs(np.gradient(self.values, axis=axis))
        share = 0.5 + (self.values - np.float32(level)) / np.maximum(rise, np.float32(1e-6))
        return float(np.clip(share, 0.0, 1.0).sum(dtype=np.float64) * np.prod(self.step))

    def level_of(self, volume: float) -> float:
        """The level above which it has a volume [m^3], within LEVEL_RANGE."""
        low, high = LEVEL_RANGE
        for _ in range(LEVEL_HALVINGS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.volume_above(middle) > volume else (low, middle)
        return 0.5 * (low + high)


def _checked(
    labels: ArrayLike, spacing: ArrayLike, region_names: Mapping[int, str]
) -> tuple[NDArray, FloatArray, tuple[tuple[int, str], ...]]:
    image, step = np.asarray(labels), np.asarray(spacing, dtype=np.float64)
    if image.ndim != 3:
        raise MeshError(f"the label image has shape {image.shape}; the rule is three axes: choose one volume of it")
    names = tuple(region_names.items())
    there = set(np.unique(image).tolist())
    for tag, name in names:
        if tag not in there:
            known = ", ".join(map(str, sorted(there)[:20]))
            raise MeshError(f"label {tag} ({name!r}) is nowhere in the image; the labels in it are {known}")
    return image, step, names


def largest_part(image: NDArray, tags: list[int]) -> tuple[NDArray[np.bool_], NDArray[np.int64], tuple[int, ...]]:
    """The largest part of the labels that is connected through faces.

    Returns the part, cropped to its box, the corner of the box, and the sizes of the other parts.
    """
    from scipy import ndimage

    mask = np.isin(image, tags) if len(tags) > 1 else image == tags[0]
    part, count = parts_of(mask)
    sizes = np.bincount(part.ravel(), minlength=count + 1)[1:]
    kept = int(np.argmax(sizes))
    # The box of this part alone: noise has millions of parts, and a list of their boxes is larger than the image.
    box = ndimage.find_objects((part == kept + 1).view(np.uint8))[0]
    corner = np.array([one.start for one in box], dtype=np.int64)
    rest = np.sort(np.delete(sizes, kept))[::-1]
    return part[box] == kept + 1, corner, tuple(int(size) for size in rest)


def parts_of(mask: NDArray[np.bool_], *, corners: bool = False) -> tuple[NDArray[np.int32], int]:
    """The number of each voxel's part, from 1, 0 outside, and how many there are; joined by faces, or corners too."""
    from scipy import ndimage

    labelled: Any = ndimage.label(mask, structure=np.ones((3, 3, 3)) if corners else None)
    return labelled[0], int(labelled[1])


def smoothed_share(
    organ: NDArray[np.bool_], corner: NDArray[np.int64], step: FloatArray, cell_size: float
) -> SmoothedShare:
    """A part of an image smoothed by a Gaussian whose width follows from voxels and cells.

    Args:
        organ: the part, shape (n_x, n_y, n_z).
        corner: its first voxel in the image, shape (3,).
        step: spacing of the voxels [m], shape (3,).
        cell_size: of the mesh [m].

    Raises:
        MeshError: more blocks than FIELD_LIMIT.
    """
    from scipy import ndimage

    smoothing = max(SMOOTHING_SPACINGS * float(step.max()), SMOOTHING_CELLS * cell_size)
    joined = np.maximum(np.floor(cell_size / (VOXELS_PER_CELL * step)), 1).astype(np.int64)
    block = joined * step
    # Beyond three standard deviations the smoothed organ vanishes; one more block for the interpolation.
    margin = (np.ceil(3.0 * smoothing / block) + 1).astype(np.int64)
    shape = -(-np.array(organ.shape) // joined) + 2 * margin
    if np.prod(shape.astype(np.float64)) > FIELD_LIMIT:
        raise MeshError(
            f"the organ's box has {np.prod(shape.astype(np.float64)):.3g} blocks of voxels for cells of {cell_size:g} "
            f"m; at most {FIELD_LIMIT:.3g} are smoothed: use larger cells, or resample the image"
        )
    share = np.zeros(shape, dtype=np.float32)
    for offset in np.ndindex(*joined.tolist()):
        some = organ[tuple(slice(first, None, count) for first, count in zip(offset, joined, strict=True))]
        place = tuple(slice(m, m + n) for m, n in zip(margin, some.shape, strict=True))
        share[place] += some
    share /= np.float32(np.prod(joined))
    values: Any = share
    for axis, width in enumerate((smoothing / block).tolist()):
        # Not `gaussian_filter`, whose exponentials are rounded by processor.
        offset = np.arange(-int(3.0 * width + 0.5), int(3.0 * width + 0.5) + 1)
        bell = exp(-0.5 / (width * width) * (offset * offset))
        values = ndimage.correlate1d(values, bell / bell.sum(), axis, mode="constant")
    start = (corner + 0.5 * (joined - 1)) * step - margin * block
    return SmoothedShare(values, start, block, smoothing)


def _filled_to_volume(field: SmoothedShare, volume: float, cell_size: float, fine_face: FineFace | None) -> TetMesh:
    """The mesh whose volume is nearest to the wanted one [m^3]."""
    level, best = 0.5, None
    # Volume lost as the level rises; the secant through the last two meshes takes over.
    slope = (field.volume_above(0.4) - field.volume_above(0.6)) / 0.2
    before = None
    for _ in range(VOLUME_TRIES):
        mesh = _mesh_above(field, level, cell_size, fine_face)
        error = float(mesh.volumes.sum()) - volume
        if best is None or abs(error) < abs(best[0]):
            best = (error, mesh)
        if abs(error) <= VOLUME_SHARE * volume:
            break
        if before is not None and (level - before[0]) * (error - before[1]) < 0.0:
            slope = -(error - before[1]) / (level - before[0])
        before = (level, error)
        level = float(np.clip(level + error / slope, *LEVEL_RANGE))
    assert best is not None
    return best[1]


def _mesh_above(field: SmoothedShare, level: float, cell_size: float, fine_face: FineFace | None) -> TetMesh:
    places = [np.flatnonzero((field.values > level).any(axis=tuple({0, 1, 2} - {axis}))) for axis in range(3)]
    if not len(places[0]):
        raise MeshError(
            f"smoothing by {field.smoothing * 1e3:.3g} mm removes the organ: it is thinner than its voxels' "
            "widest spacing, or than a cell: use smaller cells"
        )
    # A block beyond the outermost one above the level: the level lies between the two.
    box = np.array([[one[0] - 1, one[-1] + 1] for one in places]).T * field.step + field.start
    body = LevelSetBody(lambda at: field.at(at) - level, box)
    # Where the face is, a mesh of cells of one size tells.
    width = 1 if fine_face is None else fine_face.coarsening
    nodes, tets = stuff(body, lattice_around(box, width * cell_size))
    if fine_face is not None and len(tets):
        rough = largest_body_mesh(nodes, tets, f"a cell_size below {cell_size:g} m")
        faces = rough.boundary_triangles
        chosen = outward_facing(rough.points, faces, fine_face.direction, fine_face.angle_deg)
        corners = rough.points[faces[chosen]]
        nodes, tets = stuff_graded(body, corners, cell_size, fine_face.depth, COARSENINGS.index(width))
    if not len(tets):
        raise MeshError(
            f"cell_size {cell_size:g} m leaves no tets: every part of the organ is thinner than a cell; "
            f"try {cell_size / 2:g} m"
        )
    return largest_body_mesh(nodes, tets, f"a cell_size below {cell_size:g} m")


def _regions(
    mesh: TetMesh, inside: NDArray, corner: NDArray[np.int64], step: FloatArray, names: tuple[tuple[int, str], ...]
) -> tuple[NDArray[np.int32], dict[int, float]]:
    """Tag of each tet (n_tet,), and the volume of each label [m^3]."""
    voxel = float(np.prod(step))
    volumes = {tag: float(np.count_nonzero(inside == tag)) * voxel for tag, _ in names}
    shares = [
        RegionShare(*pair, label_share(mesh, inside == pair[0], corner, step), volumes[pair[0]]) for pair in names
    ]
    return tag_tets(mesh, names[0][0], shares[1:]), volumes


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
