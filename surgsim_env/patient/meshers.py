"""An organ's mesh from a label image, or from closed surfaces of it and its regions: by the lattice or by fTetWild."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from msdm_core.errors import MeshError
from msdm_core.mesh.surface import surface_volume
from msdm_core.mesh.tet_mesh import FloatArray, TetMesh
from msdm_core.mesh_files.mesh_file import LengthUnit
from msdm_core.meshing.lattice_meshing import mesh_surface
from msdm_core.meshing.region_tags import RegionShare, label_share, tag_tets
from msdm_core.meshing.segmentation_meshing import fill_labels
from surgsim_env.patient.label_cleaning import clean_labels
from surgsim_env.patient.label_image import LabelImage
from surgsim_env.patient.label_source import CONVENTION
from surgsim_env.patient.materials import check_name, is_lesion
from surgsim_env.patient.patient_mesh import PatientMesh, region_volumes, well_shaped
from surgsim_env.patient.surface_files import (
    BrokenSurface,
    ClosedSurface,
    checked_names,
    mended_voxels,
    read_organ_surface,
    read_region_surfaces,
    region_name,
)
from surgsim_env.patient.tetwild_mesh import mesh_labels_conforming, tetwild_mesh
from surgsim_env.patient.voxels import voxels_inside

FILE_CONVENTION = "the files' own axes and origin, in metres"
# Voxels of a region's surface along one cell.
REGION_VOXELS = 8
# At least this share of a region must lie inside the organ.
SHARE_INSIDE = 0.5


def mesh_image(image: LabelImage, source: str, *, cell_size: float | None, mesher: str, mend: bool) -> PatientMesh:
    """Mesh the largest part of an image's labels, in LPS."""
    volume = float(np.count_nonzero(image.tags)) * image.voxel_volume
    return well_shaped(lambda size: _mesh_labels(image, source, size, mesher, mend), cell_size, volume)


def _mesh_labels(image: LabelImage, source: str, cell_size: float, mesher: str, mend: bool) -> PatientMesh:
    labels = clean_labels(image, cell_size=cell_size, mend=mend)
    if mesher == "tetwild":
        return mesh_labels_conforming(labels, source, cell_size)
    filled = fill_labels(
        labels.tags, image.geometry.spacing, cell_size=cell_size, region_names=list(enumerate(labels.names, start=1))
    )
    placed = filled.mesh
    mesh = TetMesh(image.geometry.places(placed.points), placed.tets, placed.region, placed.region_names)
    volumes = region_volumes(mesh, labels.names, filled.label_volume, filled.region_volumes)
    return PatientMesh(
        mesh=mesh,
        lesions=labels.lesions,
        volumes=volumes,
        cell_size=cell_size,
        mesher=mesher,
        convention=CONVENTION,
        sources=(source,),
        notes=(*image.notes, *labels.notes),
        is_scan=True,
        smoothing=filled.smoothing,
        smoothing_change=filled.smoothing_change,
    )


def mesh_surfaces(
    files: Sequence[Path],
    regions: Sequence[str],
    length_unit: LengthUnit,
    *,
    cell_size: float | None,
    mesher: str,
    mend: bool,
) -> PatientMesh:
    """Mesh closed surfaces, in the files' own axes.

    Args:
        files: the organ's surface, then those of regions, named after their files.
        regions: further regions, as NAME=FILE.
        length_unit: of all files.
        cell_size: of the lattice [m]; default: in proportion to the organ.
        mesher: "lattice" or "tetwild".
        mend: whether an organ's surface that is open or crosses itself may be rebuilt from voxels.
    """
    organ, notes = read_organ_surface(files[0], length_unit, mend=mend)
    inner = []
    for name, file in [*((region_name(file), file) for file in files[1:]), *map(_named, regions)]:
        inner += read_region_surfaces(file, length_unit, name)
    names = [organ.name, *(one.name for one in inner)]
    checked_names(names)
    sources = tuple(file.name for file in files) + tuple(_named(text)[1].name for text in regions)
    given = _Surfaces(organ, tuple(inner), sources, tuple(notes))
    volume = abs(surface_volume(organ.vertices, organ.triangles))
    return well_shaped(lambda size: _mesh_given(given, size, mesher), cell_size, volume)


@dataclass(frozen=True, eq=False)
class _Surfaces:
    """The surfaces of the organ and its regions, the files' names, and notes on what was dropped."""

    organ: ClosedSurface | BrokenSurface
    inner: tuple[ClosedSurface, ...]
    files: tuple[str, ...]
    notes: tuple[str, ...]


def _mesh_given(given: _Surfaces, cell_size: float, mesher: str) -> PatientMesh:
    organ, inner, notes = given.organ, given.inner, list(given.notes)
    names = [organ.name, *(one.name for one in inner)]
    smoothing = change = None
    if isinstance(organ, BrokenSurface):
        tags, step, start, note = mended_voxels(organ, cell_size)
        notes.append(note)
        filled = fill_labels(tags, step, cell_size=cell_size, region_names={1: organ.name})
        notes += [f"{len(filled.dropped)} part(s) apart from the largest were left out"] if filled.dropped else []
        plain = TetMesh(filled.mesh.points + start, filled.mesh.tets)
        volume, smoothing, change = filled.label_volume, filled.smoothing, filled.smoothing_change
    elif mesher == "tetwild":
        plain, volume = tetwild_mesh([organ, *inner], cell_size), organ.volume
    else:
        plain, volume = mesh_surface(organ.vertices, organ.triangles, cell_size=cell_size), organ.volume
    mesh, tagged = _with_regions(plain, names[0], inner, cell_size)
    return PatientMesh(
        mesh=mesh,
        lesions=tuple(name for name in names[1:] if is_lesion(name)),
        volumes=region_volumes(mesh, names, volume, tagged),
        cell_size=cell_size,
        mesher="lattice" if isinstance(organ, BrokenSurface) else mesher,
        convention=FILE_CONVENTION,
        sources=given.files,
        notes=tuple(notes),
        is_scan=False,
        smoothing=smoothing,
        smoothing_change=change,
    )


def _named(text: str) -> tuple[str, Path]:
    name, found, file = text.partition("=")
    if not found or not file:
        raise MeshError(f"--region: {text!r} is no NAME=FILE, such as lesion=tumour.stl")
    return check_name(name, "--region"), Path(file)


def _with_regions(
    mesh: TetMesh, name: str, inner: Sequence[ClosedSurface], cell_size: float
) -> tuple[TetMesh, dict[int, float]]:
    """The mesh with tags from 2 on for the surfaces inside it, and the volume to be tagged for each [m^3]."""
    shares = [
        RegionShare(tag, one.name, *_share_inside(mesh, one, cell_size)) for tag, one in enumerate(inner, start=2)
    ]
    tags = tag_tets(mesh, 1, shares)
    names = [(1, name), *((one.tag, one.name) for one in shares)]
    return TetMesh(mesh.points, mesh.tets, tags, tuple(names)), {one.tag: one.volume for one in shares}


def _share_inside(mesh: TetMesh, surface: ClosedSurface, cell_size: float) -> tuple[FloatArray, float]:
    """Share of each tet inside a surface (n_tet,), and the total volume inside it [m^3]."""
    extent = np.ptp(surface.vertices, axis=0)
    # Fine enough also for a region that is small against a cell.
    step = min(cell_size / REGION_VOXELS, float(extent.min()) / REGION_VOXELS)
    inside, first = voxels_inside(surface.vertices, surface.triangles, step)
    share = label_share(mesh, inside, first, np.full(3, step))
    volume = float(share @ mesh.volumes)
    if volume < SHARE_INSIDE * surface.volume:
        raise MeshError(
            f"region {surface.name!r}: only {volume / surface.volume:.0%} of it lies inside the organ; at least "
            f"{SHARE_INSIDE:.0%} must: are both surfaces in the same axes and unit?"
        )
    return share, min(volume, surface.volume)
