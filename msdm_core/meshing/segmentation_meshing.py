"""Meshes of label images: a smoothed level set on a BCC lattice, regions as tags of whole tets."""

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

# Standard deviation of the Gaussian over the voxels' steps, in widest voxel spacings and in cells: the larger counts.
# 0.7 of a spacing leaves 3 % of a step one spacing long (exp(-2 pi^2 0.49) of its first harmonic).
SMOOTHING_SPACINGS, SMOOTHING_CELLS = 0.7, 0.2
# Voxels are joined to blocks, at least this many of them along a cell.
BLOCKS_PER_CELL = 6
# Blocks of the image around the organ: about 2 GB while it is smoothed.
FIELD_LIMIT = 150_000_000
TETS_AT_ONCE = 4096  # sampled together
# Tolerance of the mesh's volume against that of the labels; largest number of meshes on the way there.
VOLUME_SHARE, VOLUME_TRIES = 0.002, 4
# Beyond these the level set follows the tail of the Gaussian instead of the organ.
LEVEL_RANGE = (0.15, 0.85)
LEVEL_HALVINGS = 12


@dataclass(frozen=True, eq=False)
class RegionShare:
    """Share of each tet in a region, shape (n_tet,), and the region's volume [m^3]."""

    tag: int
    name: str
    share: FloatArray
    volume: float


@dataclass(frozen=True, eq=False)
class FilledLabels:
    """A label image filled with tets.

    Fields:
        mesh: in metres from the centre of voxel (0, 0, 0); region tags are the labels.
        label_volume: of the voxels of the largest part [m^3].
        region_volumes: of the voxels of each label in that part [m^3].
        dropped: voxels of each other part, largest first.
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
    """Fill the named labels of an image with tets of a BCC lattice, each label a region.

    Args:
        labels: whole numbers, shape (n_x, n_y, n_z); those without a name are outside.
        spacing: of the voxels along the three axes [m], shape (3,).
        cell_size: cube edge of the lattice [m].
        region_names: labels of the organ, {1: "liver", 2: "lesion"}; the first takes the tets left by the others.

    Returns:
        The mesh, in metres from the centre of voxel (0, 0, 0) along the image's axes.

    Warns:
        UserWarning: parts beside the largest, left out; and as `mesh_surface`.

    Raises:
        MeshError: a label without a voxel or too small for a tet, or a cell size out of range; names one that works.
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
    """A face of a level set with fine cells, coarse cells elsewhere.

    Args:
        direction: of the press on the face, along the image's axes, shape (3,).
        angle_deg: largest angle between the face's inward normals and the direction [degrees].
        depth: cells within this distance of the face along each axis are fine [m].
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
    """`mesh_segmentation` with the volumes of the labels, graded if a fine face is given.

    The organ's share of each voxel (1 or 0) is smoothed by a Gaussian; the region above a level is filled. Smoothing
    takes volume from convex parts, and so do the flat faces of tets: the level moves from 1/2 until the mesh has the
    volume of the voxels.
    """
    image, step, names = _checked(labels, spacing, region_names)
    organ, corner, dropped = largest_part(image, [tag for tag, _ in names])
    volume = float(np.count_nonzero(organ)) * float(np.prod(step))
    check_cell_size(np.array(organ.shape) * step, volume, cell_size)
    field = smoothed_share(organ, corner, step, cell_size)
    mesh = _filled_to_volume(field, volume, cell_size, fine_face)
    box = tuple(slice(low, low + n) for low, n in zip(corner, organ.shape, strict=True))
    inside = np.where(organ, image[box], 0)
    region, volumes = _regions(mesh, inside, corner, step, names)
    return FilledLabels(TetMesh(mesh.points, mesh.tets, region, names), volume, volumes, dropped)


@dataclass(frozen=True, eq=False)
class SmoothedShare:
    """Smoothed share of a part on blocks of voxels.

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
        """Share at places [m] (n, 3), trilinear between the blocks' centres, 0 outside, shape (n,)."""
        from scipy import ndimage

        index = ((places - self.start) / self.step).T
        return ndimage.map_coordinates(self.values, index, order=1, mode="constant", output=np.float64)

    def volume_above(self, level: float) -> float:
        """Volume with a share above a level, from value and slope at each block [m^3]."""
        rise = np.zeros_like(self.values)
        for axis in range(3):
            rise += np.abs(np.gradient(self.values, axis=axis))
        share = 0.5 + (self.values - np.float32(level)) / np.maximum(rise, np.float32(1e-6))
        return float(np.clip(share, 0.0, 1.0).sum(dtype=np.float64) * np.prod(self.step))

    def level_of(self, volume: float) -> float:
        """Level within LEVEL_RANGE for a volume [m^3] above it, by bisection."""
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
    known = np.unique(image).tolist()
    for tag, name in names:
        if tag not in known:
            raise MeshError(
                f"label {tag} ({name!r}) is nowhere in the image; its labels are {', '.join(map(str, known[:20]))}"
            )
    return image, step, names


def largest_part(image: NDArray, tags: list[int]) -> tuple[NDArray[np.bool_], NDArray[np.int64], tuple[int, ...]]:
    """Largest part of the labels connected through faces.

    Returns the part, cropped to its box, the corner of the box, and the sizes of the other parts, largest first.
    """
    from scipy import ndimage

    mask = np.isin(image, tags) if len(tags) > 1 else image == tags[0]
    part, count = parts_of(mask)
    sizes = np.bincount(part.ravel(), minlength=count + 1)[1:]
    kept = int(np.argmax(sizes))
    # The box of this part alone: noise has millions of parts, and a list of their boxes is larger than the image.
    box = ndimage.find_objects((part == kept + 1).view(np.uint8))[0]
    corner = np.array([side.start for side in box], dtype=np.int64)
    return part[box] == kept + 1, corner, tuple(np.sort(np.delete(sizes, kept))[::-1].tolist())


def parts_of(mask: NDArray[np.bool_], *, corners: bool = False) -> tuple[NDArray[np.int32], int]:
    """Number of each voxel's part, from 1, 0 outside, and the number of parts; joined by faces, or corners too."""
    from scipy import ndimage

    labelled: Any = ndimage.label(mask, structure=np.ones((3, 3, 3)) if corners else None)
    return labelled[0], int(labelled[1])


def smoothed_share(
    organ: NDArray[np.bool_], corner: NDArray[np.int64], step: FloatArray, cell_size: float
) -> SmoothedShare:
    """Part of an image smoothed by a Gaussian, its width from voxels and cells.

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
    joined = np.maximum(np.floor(cell_size / (BLOCKS_PER_CELL * step)), 1).astype(np.int64)
    block = joined * step
    # Beyond three standard deviations the smoothed organ vanishes; one more block for the interpolation.
    margin = (np.ceil(3.0 * smoothing / block) + 1).astype(np.int64)
    shape = -(-np.array(organ.shape) // joined) + 2 * margin
    block_count = np.prod(shape.astype(np.float64))
    if block_count > FIELD_LIMIT:
        raise MeshError(
            f"the organ's box has {block_count:.3g} blocks of voxels for cells of {cell_size:g} m; "
            f"the rule is at most {FIELD_LIMIT:.3g}: use larger cells, or resample the image"
        )
    share = np.zeros(shape, dtype=np.float32)
    for offset in np.ndindex(*joined.tolist()):
        voxels = organ[tuple(slice(first, None, count) for first, count in zip(offset, joined, strict=True))]
        share[tuple(slice(m, m + n) for m, n in zip(margin, voxels.shape, strict=True))] += voxels
    values: Any = share / np.float32(np.prod(joined))
    for axis, width in enumerate((smoothing / block).tolist()):
        # Not `gaussian_filter`, whose exponentials are rounded by processor.
        offset = np.arange(-int(3.0 * width + 0.5), int(3.0 * width + 0.5) + 1)
        bell = exp(-0.5 / (width * width) * (offset * offset))
        values = ndimage.correlate1d(values, bell / bell.sum(), axis, mode="constant")
    start = (corner + 0.5 * (joined - 1)) * step - margin * block
    return SmoothedShare(values, start, block, smoothing)


def _filled_to_volume(field: SmoothedShare, volume: float, cell_size: float, fine_face: FineFace | None) -> TetMesh:
    """Mesh with the volume nearest to the wanted one [m^3]."""
    level, best, before = 0.5, None, None
    # Volume lost as the level rises; the secant through the last two meshes takes over.
    slope = (field.volume_above(0.4) - field.volume_above(0.6)) / 0.2
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
    layers = _layers(field.values > level)
    if not len(layers[0]):
        raise MeshError(
            f"smoothing by {field.smoothing * 1e3:.3g} mm removes the organ: it is thinner than its voxels' "
            "widest spacing, or than a cell: use smaller cells"
        )
    # A block beyond the outermost one above the level: the level lies between the two.
    box = np.array([[layer[0] - 1, layer[-1] + 1] for layer in layers]).T * field.step + field.start
    body = LevelSetBody(lambda at: field.at(at) - level, box)
    finer = f"a cell_size below {cell_size:g} m"
    width = 1 if fine_face is None else fine_face.coarsening
    nodes, tets = stuff(body, lattice_around(box, width * cell_size))
    if fine_face is not None and len(tets):
        # The mesh of coarse cells has the face.
        rough = largest_body_mesh(nodes, tets, finer)
        faces = rough.boundary_triangles
        chosen = outward_facing(rough.points, faces, fine_face.direction, fine_face.angle_deg)
        corners = rough.points[faces[chosen]]
        nodes, tets = stuff_graded(body, corners, cell_size, fine_face.depth, COARSENINGS.index(width))
    if not len(tets):
        raise MeshError(
            f"cell_size {cell_size:g} m leaves no tets: every part of the organ is thinner than a cell; "
            f"try {cell_size / 2:g} m"
        )
    return largest_body_mesh(nodes, tets, finer)


def _layers(mask: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Indices of the layers of a mask with True in them, along each axis."""
    return [np.flatnonzero(mask.any(axis=others)) for others in ((1, 2), (0, 2), (0, 1))]


def _regions(
    mesh: TetMesh, inside: NDArray, corner: NDArray[np.int64], step: FloatArray, names: tuple[tuple[int, str], ...]
) -> tuple[NDArray[np.int32], dict[int, float]]:
    """Tag of each tet (n_tet,), and the volume of each label [m^3]."""
    voxel = float(np.prod(step))
    volumes = {tag: float(np.count_nonzero(inside == tag)) * voxel for tag, _ in names}
    shares = [
        RegionShare(tag, name, label_share(mesh, inside == tag, corner, step), volumes[tag]) for tag, name in names[1:]
    ]
    return tag_tets(mesh, names[0][0], shares), volumes


def tag_tets(mesh: TetMesh, first: int, regions: Sequence[RegionShare]) -> NDArray[np.int32]:
    """Region tag of each tet, shape (n_tet,): `first` outside the other regions.

    A region takes the tets with the largest share in it until its volume is reached, so that it keeps its volume
    although tets are whole; small regions choose before large ones.

    Raises:
        MeshError: a region without a tet; names it, its volume and the tets'.
    """
    tags = np.full(mesh.tet_count, first, dtype=np.int32)
    free = np.ones(mesh.tet_count, dtype=bool)
    for region in sorted(regions, key=lambda region: region.volume):
        order = np.argsort(-region.share, kind="stable")
        order = order[(region.share[order] > 0) & free[order]]
        before = np.cumsum(mesh.volumes[order]) - 0.5 * mesh.volumes[order]
        members = order[before <= region.volume]
        if not len(members):
            raise MeshError(
                f"region {region.tag} ({region.name!r}) of {region.volume * 1e9:.3g} mm^3 fills no tet "
                f"({np.median(mesh.volumes) * 1e9:.3g} mm^3): use smaller cells, or leave it out"
            )
        tags[members], free[members] = region.tag, False
    return tags


def label_share(mesh: TetMesh, mask: NDArray[np.bool_], corner: NDArray[np.int64], step: FloatArray) -> FloatArray:
    """Share of each tet's volume in the voxels of a mask, from 165 points a tet, shape (n_tet,).

    Args:
        mesh: in metres from the centre of voxel (0, 0, 0) of the image.
        mask: part of the image, shape (n_x, n_y, n_z).
        corner: its first voxel in the image, shape (3,).
        step: spacing of the voxels [m], shape (3,).
    """
    share = np.zeros(mesh.tet_count)
    layers = _layers(mask)
    if not len(layers[0]):
        return share
    low = (np.array([layer[0] for layer in layers]) + corner - 0.5) * step
    high = (np.array([layer[-1] for layer in layers]) + corner + 0.5) * step
    corners = mesh.points[mesh.tets]
    near = np.flatnonzero(((corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)).all(axis=1))
    for first in range(0, len(near), TETS_AT_ONCE):
        chosen = near[first : first + TETS_AT_ONCE]
        share[chosen] = voxels_at(tet_samples(corners[chosen]), mask, corner, step).mean(axis=1)
    return share


def voxels_at(
    places: FloatArray, mask: NDArray[np.bool_], corner: NDArray[np.int64], step: FloatArray
) -> NDArray[np.bool_]:
    """Values of the mask of `label_share` at places [m] (..., 3), False beyond it, shape (...)."""
    index = np.rint(places / step).astype(np.int64) - corner
    within = np.asarray(np.logical_and(index >= 0, index < np.array(mask.shape)).all(axis=-1))
    i, j, k = np.moveaxis(np.where(within[..., None], index, 0), -1, 0)
    return mask[i, j, k] & within
