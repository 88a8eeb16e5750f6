"""An organ's mesh from closed surfaces: its own, and one for each region in it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from msdm_core.errors import MeshError
from msdm_core.length_unit import LengthUnit
from msdm_core.mesh import FloatArray, TetMesh
from msdm_core.meshing import mesh_surface
from msdm_core.region_tags import RegionShare, label_share, tag_tets
from msdm_core.segmentation_meshing import fill_labels
from msdm_core.surface import surface_volume
from surgsim_env.patient.label_names import check_name
from surgsim_env.patient.materials import is_lesion
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
from surgsim_env.patient.surface_voxels import voxels_inside

CONVENTION = "the files' own axes and origin, in metres"
# Voxels of a region's surface along one cell.
REGION_VOXELS = 8
# At least this share of a region must lie inside the organ.
SHARE_INSIDE = 0.5


def mesh_surfaces(
    files: Sequence[Path],
    regions: Sequence[str],
    length_unit: LengthUnit,
    *,
    cell_size: float | None,
    mesher: str,
    mend: bool,
) -> PatientMesh:
    """A mesh in the files' own axes.

    Args:
        files: the organ's surface, then those of regions, named after their files.
        regions: more of these, as NAME=FILE.
        length_unit: of all files.
        cell_size: of the lattice [m]; default: in proportion to the organ.
        mesher: "lattice" or "tetwild".
        mend: whether the organ's surface may be rebuilt where it is open or crosses itself.
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
    """What was read: the organ, the regions in it, the files' names, and what was left out."""

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
        from surgsim_env.patient.tetwild_mesh import tetwild_mesh

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
        convention=CONVENTION,
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
    """The mesh with a tag for each surface inside it, from 2, and the volumes that are to be tagged [m^3]."""
    shares = [
        RegionShare(tag, one.name, *_share_inside(mesh, one, cell_size)) for tag, one in enumerate(inner, start=2)
    ]
    tags = tag_tets(mesh, 1, shares)
    names = [(1, name), *((one.tag, one.name) for one in shares)]
    return TetMesh(mesh.points, mesh.tets, tags, tuple(names)), {one.tag: one.volume for one in shares}


def _share_inside(mesh: TetMesh, surface: ClosedSurface, cell_size: float) -> tuple[FloatArray, float]:
    """Share of each tet that a surface encloses (n_tet,), and the volume of that [m^3]."""
    extent = np.ptp(surface.vertices, axis=0)
    # Fine enough for what is small against a cell, too.
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
