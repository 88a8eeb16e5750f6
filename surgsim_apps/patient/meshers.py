"""Meshes of organs with regions from label images or closed surfaces, by the lattice or by fTetWild."""

import contextlib
import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import matmul, norm
from msdm_core.errors import MeshError
from msdm_core.mesh import FloatArray, TetMesh, check_surface, dihedral_angles, outward_facing, surface_volume
from msdm_core.mesh_files import LengthUnit
from msdm_core.meshing import (
    FineFace,
    RegionShare,
    SmoothedShare,
    fill_labels,
    label_share,
    largest_body_mesh,
    largest_part,
    mesh_surface,
    smoothed_share,
    tag_tets,
    voxels_at,
)
from surgsim_apps.patient.fine_surface import SurfaceFit, fitted_surface, level_surface, surface_area
from surgsim_apps.patient.label_image import CleanLabels, LabelImage, clean_labels
from surgsim_apps.patient.label_readers import CONVENTION
from surgsim_apps.patient.materials import is_lesion
from surgsim_apps.patient.surface_files import (
    BrokenSurface,
    ClosedSurface,
    bodies_of,
    mended_voxels,
    read_organ_surface,
    read_region_surfaces,
    region_name,
    voxels_inside,
)
from surgsim_env.scene import Vector

# Least dihedral angle of a default mesh [degrees]; below it the next share scales the cells.
DIHEDRAL_SMALLEST = 10.0
CELL_SHARES = (1.0, 0.98, 0.96, 0.94)
FILE_CONVENTION = "the files' own axes and origin, in metres"
# Voxels of a region's surface along one cell.
CELL_VOXELS = 8
# At least this share of a region must lie inside the organ.
SHARE_INSIDE = 0.5
# fTetWild's target edge over the lattice's cell, for about as many tets.
EDGE_PER_CELL = 0.9
# Largest distance of its surface from the given one over the bounding box's diagonal: fTetWild's default.
EPSILON = 1e-3
# Voxels along a region's longest extent, to find its tets.
REGION_VOXELS = 160


@dataclass(frozen=True)
class RegionVolume:
    """Volume of a region in its source and in the mesh [m^3]."""

    name: str
    source: float
    mesh: float

    @property
    def error(self) -> float:
        """Relative error, (mesh - source) / source."""
        return self.mesh / self.source - 1.0


@dataclass(frozen=True, eq=False)
class PatientMesh:
    """Mesh of an organ and its sources.

    Fields:
        mesh: with named regions, the organ's own first; in metres
        lesions: names of the lesions' regions
        volumes: of the whole organ, under its name, then of each region
        cell_size, coarsening, mesher: edge of the fine cells [m], edge of the largest over that of the fine, name of
            the mesher
        convention: the meaning of its axes, in words
        sources: names of the files
        is_scan: true for the axes of a patient (LPS)
        surface: of the scan, for pictures; None for the mesh's boundary
        notes: remarks on dropped, repaired and unusual parts
    """

    mesh: TetMesh
    lesions: tuple[str, ...]
    volumes: tuple[RegionVolume, ...]
    cell_size: float
    coarsening: int
    mesher: str
    convention: str
    sources: tuple[str, ...]
    notes: tuple[str, ...]
    is_scan: bool
    surface: SurfaceFit | None = None

    @property
    def organ_name(self) -> str:
        """Name of the organ."""
        return self.volumes[0].name

    @property
    def cells_text(self) -> str:
        """The cells in words."""
        graded = f" at the pressed face, {self.coarsening} times as long elsewhere" if self.coarsening > 1 else ""
        return f"cells of {self.cell_size * 1e3:.4g} mm{graded}"

    @property
    def volume_error(self) -> float:
        """Relative volume error of the whole organ, (mesh - source) / source."""
        return self.volumes[0].error


@dataclass(frozen=True)
class Cells:
    """Cells of a mesh.

    Fields:
        size: edge of the lattice's cells, of the fine ones where it is graded [m]
        is_given: true for a size of the user; else slightly smaller cells are tried for better angles
        coarsening: edge of the largest cells over that of the fine ones, 1, 2 or 4; the lattice's alone
        fine_depth: of fine cells under the face towards the approach [m]
        approach, face_angle_deg: direction of the probe in the organ's axes, and angle of that face [degrees]
    """

    size: float
    is_given: bool
    coarsening: int
    fine_depth: float
    approach: Vector
    face_angle_deg: float


def well_shaped(make: Callable[[float], PatientMesh], cells: Cells) -> PatientMesh:
    """Mesh of given cells, or of slightly smaller ones for better angles if the size is not the user's.

    Isosurface stuffing guarantees 9.3 degrees; slightly smaller cells are cut elsewhere, often with larger angles.
    """
    if cells.is_given:
        return make(cells.size)
    best, largest = None, -math.inf
    for share in CELL_SHARES:
        mesh = make(round(share * cells.size, 6))
        angle = float(dihedral_angles(mesh.mesh).min())
        if angle > largest:
            best, largest = mesh, angle
        if angle >= DIHEDRAL_SMALLEST or mesh.mesher != "lattice":
            break
    assert best is not None
    return best


def region_volumes(
    mesh: TetMesh, names: Sequence[str], whole: float, sources: dict[int, float]
) -> tuple[RegionVolume, ...]:
    """Volumes of the whole organ and of the regions after the first, by theirs in the source by tag [m^3]."""
    volumes = [RegionVolume(names[0], whole, float(mesh.volumes.sum()))]
    for tag, name in enumerate(names[1:], start=2):
        volumes.append(RegionVolume(name, sources[tag], float(mesh.volumes[mesh.region == tag].sum())))
    return tuple(volumes)


def image_volume(image: LabelImage) -> float:
    """Volume of an image's labels [m^3]."""
    return float(np.count_nonzero(image.tags)) * image.voxel_volume


def mesh_image(image: LabelImage, source: str, *, cells: Cells, mesher: str, mend: bool) -> PatientMesh:
    """Mesh of the largest part of an image's labels, in LPS."""
    return well_shaped(lambda size: _mesh_labels(image, source, cells, size, mesher, mend), cells)


def _mesh_labels(
    image: LabelImage, source: str, cells: Cells, cell_size: float, mesher: str, mend: bool
) -> PatientMesh:
    labels = clean_labels(image, cell_size=cell_size, mend=mend)
    if mesher == "tetwild":
        placed, volumes = _conforming(labels, cell_size)
        whole = math.fsum(volumes.values())
    else:
        names = dict(enumerate(labels.names, start=1))
        fine = _fine_face(cells, image.geometry.direction)
        filled = fill_labels(
            labels.tags, image.geometry.spacing, cell_size=cell_size, region_names=names, fine_face=fine
        )
        placed, volumes, whole = filled.mesh, filled.region_volumes, filled.label_volume
    mesh = TetMesh(image.geometry.places(placed.points), placed.tets, placed.region, placed.region_names)
    return PatientMesh(
        mesh=mesh,
        lesions=labels.lesions,
        volumes=region_volumes(mesh, labels.names, whole, volumes),
        cell_size=cell_size,
        coarsening=1 if mesher == "tetwild" else cells.coarsening,
        mesher=mesher,
        convention=CONVENTION,
        sources=(source,),
        notes=labels.notes,
        is_scan=True,
    )


def image_surface(image: LabelImage, mesh: PatientMesh, *, mend: bool) -> SurfaceFit:
    """Level set of an image's labels with their volume, in LPS, fitted to the mesh made of them."""
    labels = clean_labels(image, cell_size=mesh.cell_size, mend=mend)
    area = surface_area(mesh.mesh.points, mesh.mesh.boundary_triangles)
    vertices, triangles = level_surface(_smoothed(labels, 1, mesh.cell_size), mesh.volumes[0].source, area)
    placed = image.geometry.places(vertices)
    # The image's axes may be left-handed.
    if surface_volume(placed, triangles) < 0.0:
        triangles = triangles[:, ::-1]
    return fitted_surface(placed, triangles, mesh.mesh, mesh.cell_size)


def _fine_face(cells: Cells, axes: FloatArray) -> FineFace | None:
    """Face of fine cells in an image with axes as columns of (3, 3); None for cells of one size."""
    if cells.coarsening == 1:
        return None
    x, y, z = matmul(np.asarray(cells.approach), axes).tolist()
    return FineFace((x, y, z), cells.face_angle_deg, cells.fine_depth, cells.coarsening)


@dataclass(frozen=True, eq=False)
class PatientSurfaces:
    """Surfaces of an organ and of the regions in it.

    Fields:
        organ: closed, or broken and to be mended
        inner: of the regions, in their order
        sources: names of the files
    """

    organ: ClosedSurface | BrokenSurface
    inner: tuple[ClosedSurface, ...]
    sources: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the regions, the organ's own first."""
        return tuple(surface.name for surface in (self.organ, *self.inner))

    @property
    def volume(self) -> float:
        """Volume inside the organ's surface [m^3]."""
        return abs(surface_volume(self.organ.vertices, self.organ.triangles))


def read_surfaces(files: Sequence[Path], length_unit: LengthUnit, *, mend: bool) -> PatientSurfaces:
    """Closed surfaces of files, in their own axes.

    Args:
        files: the organ's surface, then those of regions, named after their files.
        length_unit: of all files.
        mend: rebuild an organ's surface that is open or crosses itself from voxels.
    """
    organ = read_organ_surface(files[0], length_unit, mend=mend)
    inner = []
    for file in files[1:]:
        inner += read_region_surfaces(file, length_unit, region_name(file))
    surfaces = PatientSurfaces(organ, tuple(inner), tuple(file.name for file in files))
    twice = next((name for name in surfaces.names if surfaces.names.count(name) > 1), None)
    if twice is not None:
        raise MeshError(f"region {twice!r} is given twice; give the files other names")
    return surfaces


def mesh_surfaces(surfaces: PatientSurfaces, *, cells: Cells, mesher: str) -> PatientMesh:
    """Mesh of closed surfaces, in the files' own axes.

    Args:
        surfaces: of the organ and its regions.
        cells: of the mesh.
        mesher: "lattice" or "tetwild".
    """
    organ, inner, names = surfaces.organ, surfaces.inner, surfaces.names
    graded: dict[str, Any] = {}
    if cells.coarsening > 1 and isinstance(organ, ClosedSurface):
        facing = outward_facing(organ.vertices, organ.triangles, cells.approach, cells.face_angle_deg)
        graded = {"fine_triangles": facing, "fine_depth": cells.fine_depth}

    def make(cell_size: float) -> PatientMesh:
        notes = []
        if isinstance(organ, BrokenSurface):
            tags, step, start, note = mended_voxels(organ, cell_size)
            notes.append(note)
            fine = _fine_face(cells, np.eye(3))
            filled = fill_labels(tags, step, cell_size=cell_size, region_names={1: organ.name}, fine_face=fine)
            notes += [f"{len(filled.dropped)} part(s) apart from the largest were left out"] if filled.dropped else []
            plain = TetMesh(filled.mesh.points + start, filled.mesh.tets)
            volume = filled.label_volume
        elif mesher == "tetwild":
            plain, volume = _tetwild_mesh([organ, *inner], cell_size), organ.volume
        else:
            coarse = cells.coarsening * cell_size if graded else None
            plain = mesh_surface(
                organ.vertices, organ.triangles, cell_size=cell_size, coarse_cell_size=coarse, **graded
            )
            volume = organ.volume
        mesh, tagged = _with_regions(plain, names[0], inner, cell_size)
        return PatientMesh(
            mesh=mesh,
            lesions=tuple(name for name in names[1:] if is_lesion(name)),
            volumes=region_volumes(mesh, names, volume, tagged),
            cell_size=cell_size,
            coarsening=1 if mesher == "tetwild" else cells.coarsening,
            mesher="lattice" if isinstance(organ, BrokenSurface) else mesher,
            convention=FILE_CONVENTION,
            sources=surfaces.sources,
            notes=tuple(notes),
            is_scan=False,
        )

    return well_shaped(make, cells)


def file_surface(surfaces: PatientSurfaces, mesh: PatientMesh) -> SurfaceFit:
    """Surface of an organ's file, or rebuilt from voxels if it is broken, fitted to its mesh."""
    organ = surfaces.organ
    if isinstance(organ, ClosedSurface):
        return fitted_surface(organ.vertices, organ.triangles, mesh.mesh, mesh.cell_size)
    tags, step, start, _ = mended_voxels(organ, mesh.cell_size)
    inside, corner, _ = largest_part(tags, [1])
    area = surface_area(mesh.mesh.points, mesh.mesh.boundary_triangles)
    field = smoothed_share(inside, corner, step, mesh.cell_size)
    vertices, triangles = level_surface(field, mesh.volumes[0].source, area)
    return fitted_surface(vertices + start, triangles, mesh.mesh, mesh.cell_size)


def _with_regions(
    mesh: TetMesh, name: str, inner: Sequence[ClosedSurface], cell_size: float
) -> tuple[TetMesh, dict[int, float]]:
    """The mesh with tags from 2 on for the surfaces inside it, and the volume to be tagged for each [m^3]."""
    shares = [
        RegionShare(tag, surface.name, *_share_inside(mesh, surface, cell_size))
        for tag, surface in enumerate(inner, start=2)
    ]
    tags = tag_tets(mesh, 1, shares)
    names = [(1, name), *((share.tag, share.name) for share in shares)]
    return TetMesh(mesh.points, mesh.tets, tags, tuple(names)), {share.tag: share.volume for share in shares}


def _share_inside(mesh: TetMesh, surface: ClosedSurface, cell_size: float) -> tuple[FloatArray, float]:
    """Share of each tet inside a surface (n_tet,), and the total volume inside it [m^3]."""
    extent = np.ptp(surface.vertices, axis=0)
    # Fine enough for a region smaller than a cell, too.
    step = min(cell_size, float(extent.min())) / CELL_VOXELS
    inside, first = voxels_inside(surface.vertices, surface.triangles, step)
    share = label_share(mesh, inside, first, np.full(3, step))
    volume = float(matmul(share, mesh.volumes))
    if volume < SHARE_INSIDE * surface.volume:
        raise MeshError(
            f"region {surface.name!r}: only {volume / surface.volume:.0%} of it lies inside the organ; at least "
            f"{SHARE_INSIDE:.0%} must: are both surfaces in the same axes and unit?"
        )
    return share, min(volume, surface.volume)


def _tetwild_mesh(surfaces: Sequence[ClosedSurface], cell_size: float) -> TetMesh:
    """Tets inside the first surface; the others, inside it, are regions, tagged from 2 in their order.

    fTetWild is not deterministic: the same surfaces give a different mesh each time.

    Raises:
        MeshError: fTetWild is not installed, or makes no tets.
    """
    try:
        import pytetwild  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise MeshError(f"--mesher tetwild needs pytetwild ({error}): pip install 'surgsim[tetwild]'") from None
    starts = np.cumsum([0, *(len(surface.vertices) for surface in surfaces)])
    vertices = np.concatenate([surface.vertices for surface in surfaces])
    triangles = np.concatenate([surface.triangles + start for surface, start in zip(surfaces, starts, strict=False)])
    diagonal = float(norm(np.ptp(vertices, axis=0)))
    share = EDGE_PER_CELL * cell_size / diagonal
    # fTetWild leaves a file, __tracked_surface.stl, in the current folder.
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        nodes, tets = pytetwild.tetrahedralize(
            vertices, triangles.astype(np.int32), edge_length_fac=share, epsilon=EPSILON, optimize=True, quiet=True
        )[:2]
    if not len(tets):
        raise MeshError(f"fTetWild made no tets of {surfaces[0].name}; use --mesher lattice")
    nodes, tets = np.asarray(nodes, dtype=np.float64), np.asarray(tets, dtype=np.int64)
    body = largest_body_mesh(nodes, tets, f"a cell_size below {cell_size:g} m")
    tags = np.ones(body.tet_count, dtype=np.int32)
    middles = body.points[body.tets].mean(axis=1)
    for tag, surface in enumerate(surfaces[1:], start=2):
        step = float(np.ptp(surface.vertices, axis=0).max()) / REGION_VOXELS
        inside, first = voxels_inside(surface.vertices, surface.triangles, step)
        tags[voxels_at(middles, inside, first, np.full(3, step))] = tag
        if not (tags == tag).any():
            raise MeshError(f"region {surface.name!r} holds no tet: use smaller cells, or leave it out")
    names = tuple((tag, surface.name) for tag, surface in enumerate(surfaces, start=1))
    return TetMesh(body.points, body.tets, tags, names)


def _conforming(labels: CleanLabels, cell_size: float) -> tuple[TetMesh, dict[int, float]]:
    """Tets inside level sets of the smoothed labels, and the labels' volumes by tag [m^3]."""
    tags, voxel = range(1, len(labels.names) + 1), labels.image.voxel_volume
    volumes = {tag: float(np.count_nonzero(labels.tags == tag)) * voxel for tag in tags}
    organ = _smoothed(labels, 1, cell_size)
    surfaces = [ClosedSurface(labels.names[0], *_level_surface(organ, math.fsum(volumes.values())))]
    for tag in tags[1:]:
        surface = _level_surface(_smoothed(labels, tag, cell_size), volumes[tag])
        surfaces.append(ClosedSurface(labels.names[tag - 1], *surface))
    return _tetwild_mesh(surfaces, cell_size), volumes


def _smoothed(labels: CleanLabels, tag: int, cell_size: float) -> SmoothedShare:
    """A smoothed label; for tag 1 the whole organ."""
    mask = labels.tags > 0 if tag == 1 else labels.tags == tag
    return smoothed_share(mask, np.zeros(3, dtype=np.int64), labels.image.geometry.spacing, cell_size)


def _level_surface(field: SmoothedShare, volume: float) -> tuple[FloatArray, NDArray[np.int64]]:
    """Largest closed level set of a smoothed label that encloses a volume [m^3]."""
    try:
        from skimage.measure import marching_cubes  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise MeshError("--mesher tetwild of labels needs scikit-image: pip install 'surgsim[tetwild]'") from None
    vertices, faces = marching_cubes(field.values, field.level_of(volume))[:2]
    points = field.start + np.asarray(vertices, dtype=np.float64) * field.step
    return check_surface(*bodies_of(points, np.asarray(faces, dtype=np.int64))[0])
