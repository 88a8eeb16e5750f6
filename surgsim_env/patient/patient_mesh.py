"""The mesh of a patient's organ with its regions and their volumes, and the default cell size."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from msdm_core.mesh.quality import dihedral_angles
from msdm_core.mesh.tet_mesh import TetMesh

# Cells of a default mesh, with about two nodes and twelve tets each: a palpation then takes a minute.
CELLS_WANTED = 2000
# Default cell sizes are multiples of CELL_STEP, and at least CELL_SMALLEST [m].
CELL_STEP, CELL_SMALLEST = 1e-4, 1e-3
# A default mesh with a smaller dihedral angle [degrees] is made again with cells scaled by the next share.
DIHEDRAL_SMALLEST = 10.0
CELL_SHARES = (1.0, 0.98, 0.96, 0.94)


@dataclass(frozen=True)
class RegionVolume:
    """Volume of one region in its source and in the mesh [m^3]."""

    name: str
    source: float
    mesh: float

    @property
    def error(self) -> float:
        """(mesh - source) / source."""
        return self.mesh / self.source - 1.0


@dataclass(frozen=True, eq=False)
class PatientMesh:
    """An organ's mesh and its sources.

    Fields:
        mesh: with named regions, the organ's own first; in metres
        lesions: names of the regions that are lesions
        volumes: of the whole organ, under its name, then of each region
        cell_size, mesher: how it was made
        convention: the meaning of its axes, in words
        sources: names of the files
        is_scan: whether the axes are the patient's (LPS)
        smoothing, smoothing_change: width of the labels' smoothing [m] and relative change of the volume by it; None
            for surfaces
        notes: remarks on what was dropped, repaired or is unusual
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
        """Name of the organ."""
        return self.volumes[0].name

    @property
    def volume_error(self) -> float:
        """Relative volume error of the whole organ, (mesh - source) / source."""
        return self.volumes[0].error


def default_cell_size(volume: float) -> float:
    """Cell edge [m] in proportion to the size of an organ of a given volume [m^3]."""
    wanted = (volume / CELLS_WANTED) ** (1.0 / 3.0)
    return max(math.ceil(wanted / CELL_STEP) * CELL_STEP, CELL_SMALLEST)


def well_shaped(make: Callable[[float], PatientMesh], cell_size: float | None, volume: float) -> PatientMesh:
    """A mesh of a given cell size [m]; by default of the default size, or a slightly smaller one for better angles.

    Isosurface stuffing guarantees 9.3 degrees; slightly smaller cells are cut elsewhere, often with larger angles.
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


def region_volumes(
    mesh: TetMesh, names: Sequence[str], whole: float, sources: dict[int, float]
) -> tuple[RegionVolume, ...]:
    """Volumes of the whole organ and of the regions after the first; `sources` holds theirs by tag [m^3]."""
    volumes = [RegionVolume(names[0], whole, float(mesh.volumes.sum()))]
    for tag, name in enumerate(names[1:], start=2):
        volumes.append(RegionVolume(name, sources[tag], float(mesh.volumes[mesh.region == tag].sum())))
    return tuple(volumes)
