"""What a scan or surfaces became: the mesh with its regions, and what that did to volumes."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from msdm_core.mesh import TetMesh
from msdm_core.quality import dihedral_angles
from msdm_core.segmentation_meshing import fill_labels
from surgsim_env.patient.image_geometry import CONVENTION
from surgsim_env.patient.label_cleaning import clean_labels
from surgsim_env.patient.label_image import LabelImage

# A default mesh has about two nodes and twelve tets for each of so many cells: a palpation then takes a minute.
CELLS_WANTED = 2000
# Default cells are whole multiples of this [m], and none is smaller than the last.
CELL_STEP, CELL_SMALLEST = 1e-4, 1e-3
# A default mesh with a smaller dihedral angle [degrees] is made again with so much smaller cells.
DIHEDRAL_SMALLEST = 10.0
CELL_SHARES = (1.0, 0.98, 0.96, 0.94)


@dataclass(frozen=True)
class RegionVolume:
    """Volume of one region in what it came from and in the mesh [m^3]."""

    name: str
    source: float
    mesh: float

    @property
    def error(self) -> float:
        """(mesh - source) / source."""
        return self.mesh / self.source - 1.0


@dataclass(frozen=True, eq=False)
class PatientMesh:
    """An organ's mesh and where it comes from.

    Fields:
        mesh: its regions are named, the organ's own first; in metres
        lesions: which of the regions are lesions
        volumes: the whole organ's volume first, under its name, then each region's
        cell_size, mesher: how it was made
        convention: what the axes are
        sources: the files, in words
        is_scan: whether the axes are the patient's
        smoothing, smoothing_change: of labels: width [m] and share of the volume; None for surfaces
        notes: what was dropped, mended, or is odd
    """

    mesh: TetMesh
    lesions: tuple[str, ...]
    volumes: tuple[RegionVolume, ...]
    cell_size: float
    mesher: str
    convention: str
    sources: tuple[str, ...]
    notes: tuple[str, ...]
    is_scan: bool
    smoothing: float | None = None
    smoothing_change: float | None = None

    @property
    def organ_name(self) -> str:
        """Of the organ."""
        return self.volumes[0].name

    @property
    def volume_error(self) -> float:
        """Of the whole organ: (mesh - source) / source."""
        return self.volumes[0].error


def default_cell_size(volume: float) -> float:
    """Cell edge for an organ of a volume [m^3], in proportion to its size [m]."""
    wanted = (volume / CELLS_WANTED) ** (1.0 / 3.0)
    return max(math.ceil(wanted / CELL_STEP) * CELL_STEP, CELL_SMALLEST)


def well_shaped(make: Callable[[float], PatientMesh], cell_size: float | None, volume: float) -> PatientMesh:
    """A mesh of given cells [m], else of the default ones, or of slightly smaller ones if an angle is too small.

    Lattices keep 9.3 degrees wherever a surface cuts them; a little smaller cells are cut elsewhere.
    """
    if cell_size is not None:
        return make(cell_size)
    best, largest = None, -math.inf
    for share in CELL_SHARES:
        mesh = make(round(share * default_cell_size(volume), 6))
        angle = float(dihedral_angles(mesh.mesh).min())
        if angle > largest:
            best, largest = mesh, angle
        if angle >= DIHEDRAL_SMALLEST or mesh.mesher != "lattice":
            break
    assert best is not None
    return best


def mesh_image(image: LabelImage, source: str, *, cell_size: float | None, mesher: str, mend: bool) -> PatientMesh:
    """The largest part of an image's labels as a mesh in LPS."""
    volume = float(np.count_nonzero(image.tags)) * image.voxel_volume
    return well_shaped(lambda size: _mesh_labels(image, source, size, mesher, mend), cell_size, volume)


def _mesh_labels(image: LabelImage, source: str, cell_size: float, mesher: str, mend: bool) -> PatientMesh:
    labels = clean_labels(image, cell_size=cell_size, mend=mend)
    if mesher == "tetwild":
        from surgsim_env.patient.tetwild_mesh import mesh_labels_conforming

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


def region_volumes(
    mesh: TetMesh, names: Sequence[str], whole: float, sources: dict[int, float]
) -> tuple[RegionVolume, ...]:
    """The whole organ's volume, and those of the regions after the first, by tags that count from 1 [m^3]."""
    volumes = [RegionVolume(names[0], whole, float(mesh.volumes.sum()))]
    for tag, name in enumerate(names[1:], start=2):
        volumes.append(RegionVolume(name, sources[tag], float(mesh.volumes[mesh.region == tag].sum())))
    return tuple(volumes)
